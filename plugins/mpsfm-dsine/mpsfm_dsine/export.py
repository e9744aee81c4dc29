"""Export of DSINE, with normals and their concentration kappa, to ONNX by its authors' code.

The command ``mpsfm models export`` runs this module as a program, see
:mod:`mpsfm_core.providers.model_export`.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import geffnet
import torch
from models.dsine import v02_kappa

from mpsfm_core.providers.model_export.author_script import ExportJob

ENCODERS = {"": 5, "b0": 0, "b5": 5}
_SIDES = ((96, 128), (160, 96))


class LastRefinement(torch.nn.Module):
    """Torch module that returns only the output of DSINE's last refinement iteration."""

    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, image: torch.Tensor, intrins: torch.Tensor) -> torch.Tensor:
        """Run the network."""
        output: torch.Tensor = self.model(image, intrins=intrins.clone(), mode="test")[-1]
        return output


class _CpuCoordinates:
    """Pixel coordinates that stay on the CPU, although DSINE moves them to the first GPU."""

    def __init__(self, coordinates: torch.Tensor) -> None:
        self._coordinates = coordinates

    def to(self, device: Any) -> torch.Tensor:
        return self._coordinates


def network(encoder: int) -> LastRefinement:
    """Create DSINE as in the authors' experiment exp002_kappa, with EfficientNet-B0 or -B5."""
    settings = SimpleNamespace(
        NNET_encoder_B=encoder,
        NNET_decoder_NF={0: 1280, 5: 2048}[encoder],
        NNET_decoder_BN=False,
        NNET_decoder_down=8,
        NNET_learned_upsampling=True,
        NNET_output_dim=4,
        NNET_feature_dim=64,
        NNET_hidden_dim=64,
        NRN_prop_ps=5,
        NRN_num_iter_train=5,
        NRN_num_iter_test=5,
        NRN_ray_relu=True,
    )
    coordinates, create = v02_kappa.get_pixel_coords, geffnet.create_model
    v02_kappa.get_pixel_coords = lambda h, w: _CpuCoordinates(coordinates(h, w))
    geffnet.create_model = lambda name, pretrained: create(name, pretrained=False)
    return LastRefinement(v02_kappa.DSINE_v02_kappa(settings)).eval()


def export(job: ExportJob, model: LastRefinement) -> None:
    """Export DSINE for inputs of images, with sides in multiples of 32, and their intrinsics."""
    examples = []
    for height, width in _SIDES:
        intrinsics = torch.tensor([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]])
        image = torch.randn(1, 3, height, width)
        examples.append({"image": image, "intrins": intrinsics[None]})
    axes = {2: "height", 3: "width"}
    job.export(model, examples, ["normal"], {"image": axes, "normal": axes})


def main() -> None:
    """Export DSINE with the weights of a checkpoint."""
    job = ExportJob.from_arguments()
    model = network(ENCODERS[job.size])
    if job.weights is not None:
        state = job.checkpoint()["model"]
        state = {name.removeprefix("module."): tensor for name, tensor in state.items()}
        job.load(model.model, state)
    export(job, model)


if __name__ == "__main__":
    main()
