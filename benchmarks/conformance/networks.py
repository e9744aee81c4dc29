"""Networks that are compared with their authors' code, and the metrics of the differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.conformance import netvlad, roma
from mpsfm_core import DepthPrior, NormalPrior, PairMatches
from mpsfm_core.data import Bool
from mpsfm_core.geometry import resize_map
from mpsfm_core.providers.environments.environment import Environment

Arrays = Mapping[str, NDArray[Any]]
Differences = dict[str, float]


@dataclass(frozen=True)
class Network:
    """Network whose exported ONNX file is compared with the authors' code.

    ``export`` is the name for ``mpsfm models export``. ``script`` is the file in the folder
    ``authors`` that runs the original code of the network. ``size`` is the network size for the
    export, and ``described`` its text in the table. ``libraries`` maps folders of further checkouts
    to repository and commit. ``packages`` lists the Python packages to install by ``pip install
    --no-deps``. ``provider`` returns kind, name and options of our provider for an ONNX file.
    ``ask`` calls our provider with ``views`` photos. ``compare`` computes the largest differences
    from the authors' arrays.
    """

    export: str
    script: str
    size: str
    described: str
    provider: Callable[[Path], tuple[Any, str, dict[str, Any]]]
    ask: Callable[..., Any]
    compare: Callable[[Any, Arrays], Differences]
    libraries: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    packages: tuple[str, ...] = ()
    views: int = 1


@dataclass(frozen=True)
class Hosted:
    """Network whose authors' code needs torchvision, in a separate Python environment.

    ``repository`` and ``commit`` are those of the authors' code. ``described`` is the network size
    as text. ``compare`` computes the largest differences for an environment and a checkout.
    """

    name: str
    repository: str
    commit: str
    described: str
    compare: Callable[[Environment, Path], Differences]


def relative(ours: NDArray[Any], theirs: NDArray[Any], where: Bool) -> float:
    """Compute the largest relative difference of two arrays, or NaN if the arrays are empty."""
    return float(np.abs(ours[where] / theirs[where] - 1).max()) if where.any() else np.nan


def angle_deg(ours: NDArray[Any], theirs: NDArray[Any], where: Bool) -> float:
    """Compute the largest angle in degrees between unit vectors, or NaN if there are none."""
    if not where.any():
        return np.nan
    a, b = ours[where].astype(np.float64), theirs[where].astype(np.float64)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return float(np.degrees(2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2)).max())


def _moge(answer: tuple[DepthPrior, NormalPrior], theirs: Arrays) -> Differences:
    depth, normals = answer
    seen = theirs["mask"] & np.isfinite(theirs["depth"])
    facing = normals.valid & seen
    return {
        "depth": relative(depth.depth, theirs["depth"], seen & depth.valid),
        "pixels of the mask": float((seen != depth.valid).mean()),
        "normals, deg": angle_deg(normals.normals, theirs["normal"], facing),
    }


def _dsine(answer: NormalPrior, theirs: Arrays) -> Differences:
    from mpsfm_onnx.decode import compute_expected_angle

    std = compute_expected_angle(theirs["kappa"].astype(np.float64))
    assert answer.variance is not None
    return {
        "normals, deg": angle_deg(answer.normals, -theirs["normal"], answer.valid),
        "std": relative(np.sqrt(answer.variance), std, answer.valid),
        "pixels that face away": float(1 - answer.valid.mean()),
    }


def _mast3r(answer: PairMatches, theirs: Arrays) -> Differences:
    """Compare depth and std inside MASt3R's image crop, and matches in pixels of the crop."""
    assert answer.dense is not None and answer.depth is not None
    differences: Differences = {"depth": np.nan, "std": np.nan, "pixels behind": 0.0}
    cells = []
    positions = answer.dense.points_a, answer.dense.points_b
    priors = answer.depth.depth_a, answer.depth.depth_b
    for side, ours, xy in zip("ab", priors, positions, strict=True):
        z, std = theirs[f"z_{side}"], 1 / theirs[f"confidence_{side}"]
        top, left = ((o - t) // 2 for o, t in zip(ours.shape, z.shape, strict=True))
        crop = slice(top, top + z.shape[0]), slice(left, left + z.shape[1])
        assert ours.variance is not None
        seen = ours.valid[crop]
        differences["depth"] = np.fmax(differences["depth"], relative(ours.depth[crop], z, seen))
        differences["std"] = np.fmax(
            differences["std"], relative(np.sqrt(ours.variance[crop]), std, seen)
        )
        behind = float((seen != (z > 0)).mean())
        differences["pixels behind"] = max(differences["pixels behind"], behind)
        scale = np.array(ours.shape[::-1]) / theirs[f"size_{side}"]
        cells.append(np.rint(xy * scale - (left, top) - 0.5).astype(int))
    matches = np.concatenate([theirs["matches_a"], theirs["matches_b"]], axis=1)
    expected = set(map(tuple, matches.tolist()))
    pairs = np.concatenate(cells, axis=1)
    got = set(map(tuple, pairs.tolist()))
    differences["matches of one side only"] = len(got ^ expected) / len(expected)
    (xa, ya, xb, yb), scores = pairs.T, []
    for a, b in (("11", "21"), ("12", "22")):
        of_both = theirs[f"certainty_{a}"][ya, xa] * theirs[f"certainty_{b}"][yb, xb]
        scores.append(np.sqrt(of_both) / (1 + np.sqrt(of_both)))
    nearest = np.abs(np.array(scores) / answer.dense.scores - 1).min(axis=0)
    differences["scores"] = float(nearest.max())
    return differences


def _metric3d(answer: tuple[DepthPrior, NormalPrior], theirs: Arrays) -> Differences:
    from mpsfm_onnx.decode import compute_expected_angle

    depth, normals = answer
    height, width = depth.shape
    expected = {name: resize_map(values, width, height) for name, values in theirs.items()}
    std = expected["depth"] * (1 - np.clip(expected["confidence"], 0, 1))
    assert depth.variance is not None and normals.variance is not None
    angle = compute_expected_angle(expected["kappa"].astype(np.float64))
    certain = depth.valid & (std > 1e-3 * expected["depth"])
    return {
        "depth": relative(depth.depth, expected["depth"], depth.valid),
        "std of depth": relative(np.sqrt(depth.variance), std, certain),
        "normals, deg": angle_deg(normals.normals, expected["normal"], normals.valid),
        "std of normals": relative(np.sqrt(normals.variance), angle, normals.valid),
        "rows or columns": float(max(abs(np.subtract(theirs["depth"].shape, depth.shape)))),
    }


def _unidepth(answer: DepthPrior, theirs: Arrays) -> Differences:
    std = np.log(theirs["confidence"])
    certain = answer.valid & (std > 1e-2 * theirs["depth"])
    assert answer.variance is not None
    return {
        "depth": relative(answer.depth, theirs["depth"], answer.valid),
        "std": relative(np.sqrt(answer.variance), std, certain),
    }


NETWORKS = (
    Network(
        "moge",
        "moge_2.py",
        "",
        "ViT-S/14, 1800 tokens",
        lambda file: ("depth", "moge-2-small", {"weights": str(file)}),
        lambda provider, view: provider.predict_joint(view),
        _moge,
        libraries={
            "utils3d": (
                "EasternJournalist/utils3d",
                "3fab839f0be9931dac7c8488eb0e1600c236e183",
            )
        },
        packages=("moderngl",),
    ),
    Network(
        "dsine",
        "dsine_kappa.py",
        "b0",
        "EfficientNet-B0, 1280 features",
        lambda file: ("normals", "dsine", {"model": str(file)}),
        lambda provider, view: provider.predict(view),
        _dsine,
        packages=("geffnet",),
    ),
    Network(
        "mast3r",
        "mast3r_pairs.py",
        "tiny",
        "2 encoder blocks, 12 + 12 decoder blocks of width 128, its heads",
        lambda file: ("matcher", "mast3r", {"model": str(file), "size": 256}),
        lambda provider, a, b: provider.match(a, b),
        _mast3r,
        libraries={
            "mast3r/dust3r": ("naver/dust3r", "3cc8c88c413bb9e34c41db0e0eef99c2ee010b12"),
            "mast3r/dust3r/croco": ("naver/croco", "d7de0705845239092414480bd829228723bf20de"),
        },
        packages=("einops", "matplotlib", "roma", "tqdm", "trimesh"),
        views=2,
    ),
    Network(
        "metric3d",
        "metric3d_v2.py",
        "small",
        "ViT-S/14 with 4 registers, 4 refinements, 616 x 1064",
        lambda file: ("depth", "metric3d-v2-small", {"weights": str(file), "confidence": True}),
        lambda provider, view: provider.predict_joint(view),
        _metric3d,
        packages=("mmengine", "addict", "yapf", "termcolor"),
    ),
    Network(
        "unidepth",
        "unidepth_v2.py",
        "small",
        "ViT-S/14, 462 x 630",
        lambda file: ("depth", "onnx", {"description": "unidepth-v2", "model": str(file)}),
        lambda provider, view: provider.predict(view),
        _unidepth,
        packages=("einops", "huggingface_hub", "scipy", "tqdm"),
    ),
)

HOSTED = (
    Hosted(
        "roma",
        "Parskatt/RoMa",
        "a1494f87ab85485ad8a92a981876ca837e2334e4",
        "DINOv2 ViT-L/14, VGG19, 560 and 280 pixels",
        roma.compare,
    ),
    Hosted(
        "netvlad",
        "cvg/Hierarchical-Localization",
        "c13273bd0ecc2917a35910fd843712a1c6243193",
        "VGG16, 64 centres, no whitening",
        netvlad.compare,
    ),
)
