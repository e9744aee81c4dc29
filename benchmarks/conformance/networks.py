"""The networks: which code of their authors is run, and how our provider's answer compares."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpsfm_core import DepthPrior, NormalPrior, View
from mpsfm_core.data import Bool
from mpsfm_core.geometry import resize_map

Arrays = Mapping[str, NDArray[Any]]
Differences = dict[str, float]


@dataclass(frozen=True)
class Network:
    """A network under comparison.

    ``repository``, ``commit``: the authors' code. ``script``: in ``authors/``. ``libraries``:
    further checkouts (folder -> repository and commit) and packages that it needs. ``provider``:
    ours, as kind, name and options for a model file. ``ask``: calls it. ``compare``: the largest
    differences from the authors' arrays. ``tolerance``: of each of them, see the README.
    """

    name: str
    repository: str
    commit: str
    script: str
    size: str
    provider: Callable[[Path], tuple[Any, str, dict[str, Any]]]
    ask: Callable[[Any, View], Any]
    compare: Callable[[Any, Arrays], Differences]
    libraries: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    packages: tuple[str, ...] = ()
    photos: int = 3


def relative(ours: NDArray[Any], theirs: NDArray[Any], where: Bool) -> float:
    """Largest relative difference."""
    return float(np.abs(ours[where] / theirs[where] - 1).max())


def angle_deg(ours: NDArray[Any], theirs: NDArray[Any], where: Bool) -> float:
    """Largest angle between unit vectors, in degrees."""
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
    from mpsfm_onnx.decode import expected_angle

    std = expected_angle(theirs["kappa"].astype(np.float64))
    assert answer.variance is not None
    return {
        "normals, deg": angle_deg(answer.normals, -theirs["normal"], answer.valid),
        "std": relative(np.sqrt(answer.variance), std, answer.valid),
        "pixels that face away": float(1 - answer.valid.mean()),
    }


def _metric3d(answer: tuple[DepthPrior, NormalPrior], theirs: Arrays) -> Differences:
    from mpsfm_onnx.decode import expected_angle

    depth, normals = answer
    height, width = depth.shape
    expected = {name: resize_map(values, width, height) for name, values in theirs.items()}
    std = expected["depth"] * (1 - np.clip(expected["confidence"], 0, 1))
    assert depth.variance is not None and normals.variance is not None
    angle = expected_angle(expected["kappa"].astype(np.float64))
    certain = depth.valid & (std > 1e-3 * expected["depth"])
    return {
        "depth": relative(depth.depth, expected["depth"], depth.valid),
        "std of depth": relative(np.sqrt(depth.variance), std, certain) if certain.any() else 0.0,
        "normals, deg": angle_deg(normals.normals, expected["normal"], normals.valid),
        "std of normals": relative(np.sqrt(normals.variance), angle, normals.valid),
        "rows or columns": float(max(abs(np.subtract(theirs["depth"].shape, depth.shape)))),
    }


NETWORKS = (
    Network(
        "moge-2",
        "microsoft/MoGe",
        "07444410f1e33f402353b99d6ccd26bd31e469e8",
        "moge_2.py",
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
        "baegwangbin/DSINE",
        "ef0c2afa32b4dd19cb8ca4567c652802cd92591c",
        "dsine_kappa.py",
        "EfficientNet-B0, 1280 features",
        lambda file: ("normals", "dsine", {"model": str(file)}),
        lambda provider, view: provider.predict(view),
        _dsine,
        packages=("geffnet", "timm"),
    ),
    Network(
        "metric3d-v2",
        "YvanYin/Metric3D",
        "eb5b6fac0dc155e4e52f576e304fbf11655ff339",
        "metric3d_v2.py",
        "ViT-S/14 with 4 registers, 4 refinements",
        lambda file: ("depth", "metric3d-v2-small", {"weights": str(file), "confidence": True}),
        lambda provider, view: provider.predict_joint(view),
        _metric3d,
        packages=("mmengine", "timm"),
        photos=1,
    ),
)
