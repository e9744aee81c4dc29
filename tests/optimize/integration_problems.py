"""Small problems for tests of depth integration."""

import numpy as np

from mpsfm_core.data import DepthPrior, NormalPrior, PinholeCamera
from mpsfm_core.optimize.depth_integration import Anchors
from mpsfm_core.testing.synthetic.scenes import AnalyticScene

CAMERA = PinholeCamera(33, 26, 30.0, 31.0, 16.2, 13.1)


def camera_of(shape: tuple[int, int]) -> PinholeCamera:
    return PinholeCamera(shape[1], shape[0], 30.0, 31.0, shape[1] / 2 + 0.2, shape[0] / 2 - 0.3)


def depth_prior(depth, std=0.05, valid=None) -> DepthPrior:
    return DepthPrior.from_arrays(depth, (std * np.asarray(depth)) ** 2, valid)


def normal_prior(normals, std=0.05, valid=None) -> NormalPrior:
    return NormalPrior.from_arrays(normals, np.full(normals.shape[:2], std**2), valid)


def random_problem(shape, seed, *, masked=0.0):
    """Create a problem of rough depth and unrelated normals, with anchor points everywhere."""
    rng = np.random.default_rng(seed)
    depth = np.exp(rng.normal(1.0, 0.1, shape))
    normals = rng.normal(0, 0.5, (*shape, 3)) - (0, 0, 1)
    valid = rng.random(shape) >= masked
    count = 5
    anchors = Anchors(
        np.column_stack([rng.uniform(0, shape[1], count), rng.uniform(0, shape[0], count)]),
        np.exp(rng.normal(1.0, 0.2, count)),
        np.full(count, 0.02**2),
    )
    seen = valid & (rng.random(shape) >= masked)
    return depth_prior(depth, 0.05, valid), normal_prior(normals, 0.1, seen), anchors


def rendered(scene: AnalyticScene, pose, camera: PinholeCamera = CAMERA):
    rendering = scene.render(camera, pose)
    return rendering.depth.astype(np.float64), rendering.normals


def exact_anchors(depth, count, *, seed=0, std=0.005) -> Anchors:
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(0, depth.shape[0], count), rng.integers(0, depth.shape[1], count)
    values = depth[rows, columns]
    return Anchors(np.column_stack([columns, rows]) + 0.5, values, (std * values) ** 2)
