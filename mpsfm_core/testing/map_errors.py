"""How far answers are from the truth: errors of maps, what depth really is, shifts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float64, NormalPrior
from mpsfm_core.geometry import angle_between_deg, pixel_centers
from mpsfm_core.testing.examples import Example, TrueMaps
from mpsfm_core.testing.outcome import CheckFailed

_FEWEST = 40
"""Pixels that a statement about a map needs."""
_OUTLIER_MADS = 5.0
_HALF_STEP_PX = 0.5


def error_quantile(errors: Float64) -> float:
    """What 80 % of the errors (n,) stay below: a fault on a fifth of the map shows."""
    return float(np.quantile(np.abs(errors), 0.8))


class MapShift(NamedTuple):
    """Where content of a map lies, relative to where it should: right and down, in pixels of the
    view, at the centre; and how much that changes towards the border. ``std``: of the least
    certain of the four."""

    x: float
    y: float
    stretch_x: float
    stretch_y: float
    std: float

    @property
    def largest(self) -> float:
        """At the border of the view, in one direction."""
        return max(abs(self.x) + abs(self.stretch_x), abs(self.y) + abs(self.stretch_y))


def select_comparable(valid: Bool, truth: TrueMaps) -> Bool:
    """Pixels where an answer can be compared with the truth: valid and away from edges."""
    both = valid & truth.smooth
    if both.sum() < min(_FEWEST, truth.smooth.sum() / 2):
        raise CheckFailed(
            f"only {both.sum()} of {truth.smooth.sum()} pixels with a surface are valid"
        )
    return both


def log_errors(prior: DepthPrior, example: Example, *, any_scale: bool) -> Float64:
    """``log(depth / z)`` (n,) of select_comparable pixels; less its median if any scale will do."""
    truth = example.truth(prior.shape)
    where = select_comparable(prior.valid, truth)
    error: Float64 = np.log(prior.depth[where].astype(np.float64) / truth.depth[where])
    return error - np.median(error) if any_scale else error


def angle_errors_deg(normals: NormalPrior, example: Example) -> Float64:
    """Angles (n,) between the normals and the true ones, of select_comparable pixels."""
    truth = example.truth(normals.shape)
    where = select_comparable(normals.valid, truth)
    return angle_between_deg(normals.normals[where].astype(np.float64), truth.normals[where])


def estimate_ray_exponent(prior: DepthPrior, example: Example) -> float:
    """The power of ``ray length / z`` that the depth is proportional to, besides the true z:
    0 for depth along the axis, 1 for the length of the ray."""
    truth = example.truth(prior.shape)
    where = select_comparable(prior.valid, truth)
    rows, columns = prior.shape
    camera = example.camera.resized(columns, rows)
    offset = (pixel_centers(columns, rows) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    ray = 0.5 * np.log1p((offset**2).sum(axis=-1))[where]
    error = np.log(prior.depth[where].astype(np.float64) / truth.depth[where])
    centred = ray - ray.mean()
    return float((centred * error).sum() / (centred**2).sum())


def estimate_depth_shift(prior: DepthPrior, example: Example) -> MapShift:
    """By how much the depth map is shifted, from where the true depth changes."""
    truth = example.truth(prior.shape)
    moved = [
        [example.truth(prior.shape, (s * x, s * y)).depth for s in (1, -1)]
        for x, y in ((_HALF_STEP_PX, 0.0), (0.0, _HALF_STEP_PX))
    ]
    # On a grid finer than the view half a pixel may lead beyond the border of a surface.
    where = select_comparable(prior.valid, truth) & (np.min(moved, axis=(0, 1)) > 0)
    error = np.log(prior.depth[where].astype(np.float64) / truth.depth[where])
    slopes = [np.log(after[where] / before[where])[:, None] for after, before in moved]
    return _shift(error[:, None], slopes, _places(prior.shape)[where])


def estimate_normals_shift(prior: NormalPrior, example: Example) -> MapShift:
    """By how much the normal map is shifted, from where the true normals turn."""
    truth = example.truth(prior.shape)
    where = select_comparable(prior.valid, truth)
    error = prior.normals[where].astype(np.float64) - truth.normals[where]
    slopes = []
    for step in ((_HALF_STEP_PX, 0.0), (0.0, _HALF_STEP_PX)):
        after = example.truth(prior.shape, step).normals[where]
        slopes.append(after - example.truth(prior.shape, (-step[0], -step[1])).normals[where])
    return _shift(error, slopes, _places(prior.shape)[where])


def _places(shape: tuple[int, int]) -> Float64:
    """Where pixels lie in the map, from -1 to 1 in x and y, (h, w, 2)."""
    return pixel_centers(shape[1], shape[0]) / (shape[1] / 2, shape[0] / 2) - 1


def _shift(error: Float64, slopes: list[Float64], places: Float64) -> MapShift:
    """Least squares of ``error (n, k) = -slope . (shift + stretch * place) + constant``, twice:
    the second time without outliers."""
    columns = [
        *(-slope for slope in slopes),
        *(-slope * places[:, axis : axis + 1] for axis, slope in enumerate(slopes)),
        *(np.broadcast_to(unit, error.shape) for unit in np.eye(error.shape[1])),
    ]
    design = np.stack([column.ravel() for column in columns], axis=1)
    target = error.ravel()
    kept = np.ones(len(target), dtype=np.bool_)
    for _ in range(2):
        a, b = design[kept], target[kept]
        solution, _, rank, _ = np.linalg.lstsq(a, b, rcond=None)
        residual = np.abs(target - design @ solution)
        kept = residual <= _OUTLIER_MADS * np.median(residual) + 1e-12
    if rank < design.shape[1]:
        return MapShift(0.0, 0.0, 0.0, 0.0, np.inf)
    spread = np.linalg.inv(a.T @ a).diagonal()[:4].max()
    noise = np.mean((b - a @ solution) ** 2)
    x, y, stretch_x, stretch_y = map(float, solution[:4])
    return MapShift(x, y, stretch_x, stretch_y, float(np.sqrt(spread * noise)))
