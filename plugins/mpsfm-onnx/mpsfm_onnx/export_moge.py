"""Export of MoGe-2 with normals to ONNX by its authors' code.

The command ``mpsfm models export`` runs this module as a program, see
:mod:`mpsfm_core.providers.model_export`.
"""

from __future__ import annotations

from typing import Any

import torch
from moge.model.v2 import MoGeModel

from mpsfm_core.providers.model_export.author_script import ExportJob

_DIMS = [384, 64, 32, 16, 8]
_NONE = {"res_block_in_norm": "none", "res_block_hidden_norm": "none"}
_STEPS = ["conv_transpose", "conv_transpose", "conv_transpose", "bilinear"]
TOKENS = 1800
_SIDES = ((140, 196), (182, 126))


def _head(channels: int) -> dict[str, Any]:
    return {
        "dim_in": _DIMS,
        "dim_out": [None] * 4 + [channels],
        "dim_res_blocks": _DIMS,
        "num_res_blocks": [0, 1, 1, 1, 0],
        "resamplers": _STEPS,
        **_NONE,
    }


def small_with_normals() -> dict[str, Any]:
    """Return the constructor arguments of the published MoGe-2 network, ViT-S with normals."""
    return {
        "encoder": {
            "backbone": "dinov2_vits14",
            "intermediate_layers": [2, 5, 8, 11],
            "dim_out": 384,
        },
        "neck": {
            "dim_in": [386, 2, 2, 2, 2],
            "dim_out": None,
            "dim_res_blocks": _DIMS,
            "num_res_blocks": [0, 2, 2, 2, 0],
            "resamplers": _STEPS,
            **_NONE,
        },
        "points_head": _head(3),
        "normal_head": _head(3),
        "mask_head": _head(1),
        "scale_head": {"dims": [384, 384, 1]},
        "remap_output": "exp",
        "num_tokens_range": [1200, 3600],
    }


def export(job: ExportJob, model: torch.nn.Module) -> None:
    """Export MoGe-2 for images of any size and any number of image tokens."""
    model.onnx_compatible_mode = True
    tokens = torch.tensor(TOKENS)
    given = [{"image": torch.rand(1, 3, *size), "num_tokens": tokens} for size in _SIDES]
    outputs = ["points", "normal", "mask", "scale"]
    job.export(model, given, outputs, {"image": {2: "height", 3: "width"}})


def main() -> None:
    """Export MoGe-2 with the weights and the architecture of a checkpoint."""
    job = ExportJob.from_arguments()
    if job.weights is None:
        export(job, MoGeModel(**small_with_normals()))
        return
    stored = job.checkpoint()
    model = MoGeModel(**stored["model_config"])
    job.load(model, {**dict(model.named_buffers()), **stored["model"]})
    export(job, model)


if __name__ == "__main__":
    main()
