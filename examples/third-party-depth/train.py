"""Fit the regression to a scene with exact depth: python train.py SCENE WEIGHTS.npz."""

import sys
from pathlib import Path

import cv2
import numpy as np
from ridge_depth.model import COLUMNS, ROWS, Array, Regression, features

Views = list[tuple[Array, Array]]


def read(scene: Path, name: str) -> tuple[Array, Array]:
    """Read features (n, 13) and depth (n,) in meters of all pixels with known depth."""
    image = cv2.imread(str(scene / "images" / f"{name}.jpg"))[..., ::-1]
    depth = cv2.imread(str(scene / "gt_depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED) / 1000.0
    known = cv2.resize(1.0 * (depth > 0), (COLUMNS, ROWS), interpolation=cv2.INTER_AREA) == 1
    small = cv2.resize(depth, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
    return features(image)[known], small[known]


def fit(
    views: Views, cosines: int = 300, spread: float = 0.1, penalty: float = 1.0
) -> dict[str, Array]:
    x, depth = (np.concatenate(parts) for parts in zip(*views, strict=True))
    rng = np.random.default_rng(0)
    fixed = {
        "mean": x.mean(axis=0),
        "scale": x.std(axis=0),
        "directions": np.float32(spread * rng.normal(size=(x.shape[1], cosines))),
        "phases": np.float32(rng.uniform(0, 2 * np.pi, cosines)),
    }
    a = Regression(**fixed, weights=np.zeros(0)).expand(x).astype(np.float64)
    weights = np.linalg.solve(a.T @ a + penalty * np.eye(a.shape[1]), a.T @ depth)
    return fixed | {"weights": weights.astype(np.float32)}


def relative_error(weights: dict[str, Array], views: Views) -> float:
    ratios = np.concatenate([Regression(**weights)(x) / depth for x, depth in views])
    return float(np.sqrt(np.mean((ratios - 1) ** 2)))


if __name__ == "__main__":
    scene, output = map(Path, sys.argv[1:])
    views = [read(scene, path.stem) for path in sorted((scene / "images").iterdir())]
    unseen = relative_error(fit(views[::2]), views[1::2])
    print(f"fitted to every second view, error on the others: {unseen:.3f}")
    weights = fit(views)
    print(f"fitted to all views, error on the same: {relative_error(weights, views):.3f}")
    np.savez(output, **weights)
