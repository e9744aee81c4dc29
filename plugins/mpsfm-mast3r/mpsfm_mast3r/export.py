"""Export of MASt3R to ONNX by its authors' code.

The command ``mpsfm models export`` runs this module as a program, see
:mod:`mpsfm_core.providers.model_export`.
"""

from __future__ import annotations

import ast
import sys
from argparse import Namespace
from typing import Any

import torch

from mpsfm_core.providers.model_export.author_script import ExportJob, run_network

sys.modules["models.curope"] = None  # torch code replaces the CUDA rotary embeddings

from mast3r.model import AsymmetricMASt3R  # noqa: E402
from models.pos_embed import RoPE2D  # noqa: E402

_INFINITE = "1e999"
_PUBLISHED = """AsymmetricMASt3R(
    pos_embed='RoPE100', patch_embed_cls='ManyAR_PatchEmbed', img_size=(512, 512),
    head_type='catmlp+dpt', output_mode='pts3d+desc24', depth_mode=('exp', -inf, inf),
    conf_mode=('exp', 1, inf), enc_embed_dim=1024, enc_depth=24, enc_num_heads=16,
    dec_embed_dim=768, dec_depth=12, dec_num_heads=12, two_confs=True,
    desc_conf_mode=('exp', 0, inf))"""
"""Constructor arguments of the published checkpoint, from the training command of
MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric in the authors' README.
"""
_NARROW = {
    "enc_embed_dim": 128,
    "enc_depth": 2,
    "enc_num_heads": 2,
    "dec_embed_dim": 128,
    "dec_num_heads": 2,
}
"""Constructor arguments of the network size ``tiny`` for tests. The ``tiny`` network has the
classes and heads of MASt3R, which need 12 decoder blocks.
"""
_POSITIONS = 256
"""Number of patches along an image side for which rotary embeddings are stored in the file. 256
patches of 16 pixels limit image sides to 4096 pixels."""
_SIDES = (((96, 128), (128, 64)), ((64, 160), (64, 160)))
_KEYS = ("pts3d", "conf", "desc", "desc_conf")
_OUTPUTS = [f"{key}_{side}" for side in (1, 2) for key in _KEYS]


class TwoViews(torch.nn.Module):
    """Torch module that calls MASt3R with two images, like the authors' scripts."""

    def __init__(self, model: AsymmetricMASt3R) -> None:
        super().__init__()
        self.model = model

    def forward(self, img1: torch.Tensor, img2: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Run the network."""
        views = [
            {"img": image, "true_shape": torch.tensor([image.shape[-2:]]), "instance": [str(n)]}
            for n, image in enumerate((img1, img2))
        ]
        one, two = self.model(*views)
        two["pts3d"] = two["pts3d_in_other_view"]
        return tuple(view[key] for view in (one, two) for key in _KEYS)


class AnySize(torch.nn.Module):
    """Torch module that runs MASt3R on images whose sides are multiples of the patch size.

    Each image is encoded separately, and patch positions are computed from the input size.
    """

    def __init__(self, model: AsymmetricMASt3R) -> None:
        super().__init__()
        self.model = model

    def forward(self, img1: torch.Tensor, img2: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Run the network."""
        model, images = self.model, (img1, img2)
        (feat1, pos1), (feat2, pos2) = (self._encoded(image) for image in images)
        heads = model.downstream_head1, model.downstream_head2
        sides = zip(images, heads, model._decoder(feat1, pos1, feat2, pos2), strict=True)
        predictions = [head(tokens, image.shape[-2:]) for image, head, tokens in sides]
        return tuple(view[key] for view in predictions for key in _KEYS)

    def _encoded(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        patches = self.model.patch_embed.proj(image)
        rows, columns = (torch.arange(side) for side in patches.shape[-2:])
        grid = torch.stack(torch.meshgrid(rows, columns, indexing="ij"), dim=-1)
        positions = grid.reshape(1, -1, 2)
        tokens = patches.flatten(2).transpose(1, 2)
        for block in self.model.enc_blocks:
            tokens = block(tokens, positions)
        return self.model.enc_norm(tokens), positions


def arguments(constructor_call: str) -> dict[str, Any]:
    """Parse the constructor call that a MASt3R checkpoint stores, without executing it."""
    call = ast.parse(constructor_call.replace("inf", _INFINITE), mode="eval").body
    if not (isinstance(call, ast.Call) and ast.unparse(call.func) == AsymmetricMASt3R.__name__):
        raise SystemExit(f"the checkpoint stores another network than MASt3R: {constructor_call}")
    given = {str(word.arg): ast.literal_eval(word.value) for word in call.keywords}
    return {**given, "patch_embed_cls": "PatchEmbedDust3R", "landscape_only": False}


def network(size: str) -> AsymmetricMASt3R:
    """Create the published or the ``tiny`` network, with random weights and positive depth."""
    narrowed = {"": {}, "tiny": _NARROW}[size]
    model = AsymmetricMASt3R(**(arguments(_PUBLISHED) | narrowed)).eval()
    for head in (model.downstream_head1, model.downstream_head2):
        head.dpt.head[-1].bias.data[2] += 1.0
    return model


def export(job: ExportJob, model: AsymmetricMASt3R) -> None:
    """Export MASt3R for two images with sides in multiples of 16 pixels."""
    given = [
        {f"img{n}": torch.rand(1, 3, *sides) * 2 - 1 for n, sides in enumerate(pair, start=1)}
        for pair in _SIDES
    ]
    axes = {f"img{n}": {2: f"height{n}", 3: f"width{n}"} for n in (1, 2)}
    axes |= {name: {1: f"height{name[-1]}", 2: f"width{name[-1]}"} for name in _OUTPUTS}
    rotations = RoPE2D.get_cos_sin

    def all_rotations(self: RoPE2D, dimensions: int, count: int, *of: Any) -> Any:
        return rotations(self, dimensions, _POSITIONS, *of)

    outputs = run_network(TwoViews(model), given)
    RoPE2D.get_cos_sin = all_rotations
    job.export(AnySize(model), given, _OUTPUTS, axes, outputs)


def main() -> None:
    """Export MASt3R with the weights of a checkpoint, which also stores the architecture."""
    job = ExportJob.from_arguments()
    if job.weights is None:
        export(job, network(job.size))
        return
    stored = job.checkpoint(Namespace)
    if "model" not in stored:  # checkpoints from the Hugging Face Hub contain only weights
        stored = {"model": stored, "args": Namespace(model=_PUBLISHED)}
    model = AsymmetricMASt3R(**arguments(stored["args"].model))
    job.load(model, stored["model"])
    export(job, model.eval())


if __name__ == "__main__":
    main()
