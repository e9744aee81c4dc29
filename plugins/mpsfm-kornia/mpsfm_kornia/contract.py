"""Random weights of kornia's networks for the provider contract tests."""

from __future__ import annotations

from pathlib import Path

import torch
from kornia.feature import DeDoDe, LightGlue, LoFTR

from mpsfm_core.providers.torch_runtime import SkipRandomWeights
from mpsfm_core.testing import ContractSetup
from mpsfm_kornia.lightglue import LIGHTGLUE_256


def not_symmetric(folder: Path) -> ContractSetup:
    """Return a contract test setup for detectors that are not invariant to rotation."""
    reason = "the detector is not invariant to a rotation by 180 degrees"
    return ContractSetup(expected_failures={"features-pixel-convention": reason})


def sift(folder: Path) -> ContractSetup:
    """Return a contract test setup with few features, because kornia's SIFT is slow."""
    return ContractSetup(options={"max_keypoints": 200})


def loftr(folder: Path) -> ContractSetup:
    """Write random weights of LoFTR in the file format of the published weights."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = LoFTR(pretrained=None).eval()
    path = folder / "loftr.ckpt"
    state = {f"matcher.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state}, path)
    options = {"weights": str(path), "resize": 128, "match_threshold": 0.0}
    return ContractSetup(options=options, truth_source="none")


def dedode(folder: Path) -> ContractSetup:
    """Write random weights of DeDoDe's detector and descriptor in separate files."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        with SkipRandomWeights():  # most layers of VGG are not part of DeDoDe
            network = DeDoDe("L", "B", amp_dtype=torch.float32).eval()
        for module in network.modules():
            if hasattr(module, "reset_parameters"):
                module.reset_parameters()
    paths = folder / "dedode_detector.pth", folder / "dedode_descriptor.pth"
    for path, module in zip(paths, (network.detector, network.descriptor), strict=True):
        torch.save(module.state_dict(), path)
    options = {"detector_weights": str(paths[0]), "weights": str(paths[1]), "resize": 64}
    return ContractSetup(options={**options, "max_keypoints": 200}, truth_source="none")


def lightglue_dedode(folder: Path) -> ContractSetup:
    """Write random weights of LightGlue for 256-dimensional descriptors."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = LightGlue(None, **LIGHTGLUE_256, weights=None).eval()  # type: ignore[arg-type]
    path = folder / "dedode_lightglue.pth"
    torch.save(network.state_dict(), path)
    return ContractSetup(
        options={"weights": str(path), "filter_threshold": 0.0}, truth_source="none"
    )
