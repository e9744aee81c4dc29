"""Errors of depth and normal maps, such as angles, pixel shifts, ray length instead of z."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, DepthPrior, Float32, Float64, Int64, NormalPrior
from mpsfm_core.geometry import angle_between_deg, pixel_centers
from mpsfm_core.testing.examples import Example, TrueMaps, thin
from mpsfm_core.testing.outcome import CheckFailed

_MIN_PIXELS = 40
"""Smallest number of valid pixels for which the errors of a map are computed."""
_OUTLIER_MADS = 5.0
_HALF_STEP_PX = 0.5
_NEARBY_PX = 2
"""Distance in pixels up to which a depth map may mix the depth of neighboring surfaces."""
_RANGE_TOLERANCE = 0.05
"""Relative error of depth that is accepted in addition to the mixture of neighboring depths."""


def error_quantile(errors: Float64) -> float:
    """Return the 80 % quantile of absolute errors (n,).

    The 80 % quantile detects a fault that affects a fifth of the map.
    """
    return float(np.quantile(np.abs(errors), 0.8))


class MapShift(NamedTuple):
    """Shift of a map's content relative to its true position, in pixels of the view."""

    x: float
    """Shift of the map content to the right at the center of the map, in pixels."""
    y: float
    """Downward shift of the map content at the center of the map, in pixels."""
    stretch_x: float
    """Additional outward shift of the map content at the left and right border, in pixels."""
    stretch_y: float
    """Additional outward shift of the map content at the upper and lower border, in pixels."""
    std: float
    """Largest standard deviation of the four estimated shift values, in pixels."""

    @property
    def largest(self) -> float:
        """Largest shift of the map content in x or y, reached at the border of the view."""
        return max(abs(self.x) + abs(self.stretch_x), abs(self.y) + abs(self.stretch_y))


def select_comparable(valid: Bool, truth: TrueMaps) -> Bool:
    """Select the pixels of a map that can be compared with the ground truth.

    Args:
        valid: Validity mask (h, w) of a provider's map.
        truth: Ground-truth maps (h, w) on the pixel grid of the provider's map.

    Returns:
        Mask (h, w) of the valid pixels that are away from surface edges.

    Raises:
        CheckFailed: the map has too few valid pixels for a comparison.
    """
    both = valid & truth.smooth
    if both.sum() < min(_MIN_PIXELS, truth.smooth.sum() / 2):
        raise CheckFailed(
            f"only {both.sum()} of {truth.smooth.sum()} pixels with a surface are valid"
        )
    return both


def log_errors(prior: DepthPrior, example: Example, *, any_scale: bool) -> Float64:
    """Return ``log(depth / z)`` (n,) of the pixels that can be compared with the ground truth.

    Args:
        prior: Predicted depth.
        example: Synthetic view that the depth belongs to.
        any_scale: If true, subtract the median of the logarithms, which removes a common factor of
            all depths.
    """
    truth = example.truth(prior.shape)
    where = select_comparable(prior.valid, truth)
    error: Float64 = np.log(prior.depth[where].astype(np.float64) / truth.depth[where])
    return error - np.median(error) if any_scale else error


def measure_outside_local_range(
    prior: DepthPrior, example: Example, *, any_scale: bool, mixes_with_zero: bool
) -> float:
    """Return the ratio of valid pixels whose depth does not occur nearby in the view.

    At the border of two surfaces, each depth between those of both surfaces is accepted.

    Args:
        prior: Predicted depth.
        example: Synthetic view that the depth belongs to.
        any_scale: True removes a common factor of all depths.
        mixes_with_zero: True accepts depth that is too small near pixels without ground truth, from
            a network that resizes a view whose colors encode a depth of 0 there.
    """
    import cv2  # The import is local, because pytest loads this module when it collects tests.

    truth = example.truth(prior.shape)
    both = prior.valid & truth.smooth
    if not both.any():
        return 0.0
    rows, columns = prior.shape
    finer = max(1, round(columns / example.camera.width), round(rows / example.camera.height))
    kernel = np.ones((2 * finer * _NEARBY_PX + 1,) * 2, np.uint8)
    depth = prior.depth.astype(np.float64)
    if any_scale:
        depth = depth / np.median(depth[both] / truth.depth[both])
    high = cv2.dilate(truth.depth, kernel)
    low = cv2.erode(np.where(truth.valid, truth.depth, 0.0 if mixes_with_zero else np.inf), kernel)
    outside = (depth < (1 - _RANGE_TOLERANCE) * low) | (depth > (1 + _RANGE_TOLERANCE) * high)
    return float(outside[prior.valid & (high > 0)].mean())


def angle_errors_deg(normals: NormalPrior, example: Example) -> Float64:
    """Return the angles (n,) in degrees between predicted and true normals."""
    truth = example.truth(normals.shape)
    where = select_comparable(normals.valid, truth)
    return angle_between_deg(normals.normals[where].astype(np.float64), truth.normals[where])


def estimate_ray_exponent(prior: DepthPrior, example: Example) -> float:
    """Estimate p in ``depth = z * (ray length / z) ** p`` by least squares.

    The exponent p is 0 for z-depth and 1 for depth measured along the viewing ray.
    """
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
    """Estimate the shift of a depth map from pixels where the true depth changes."""
    return _estimate_smallest_shift(_estimate_depth_shift, prior.depth, prior.valid, example)


def estimate_normals_shift(prior: NormalPrior, example: Example) -> MapShift:
    """Estimate the shift of a normal map from pixels where the true normals change."""
    return _estimate_smallest_shift(_estimate_normals_shift, prior.normals, prior.valid, example)


def _estimate_smallest_shift(
    estimate: Callable[[Float32, Bool, Example], MapShift],
    values: Float32,
    valid: Bool,
    example: Example,
) -> MapShift:
    """Estimate the shift of a map that may repeat the pixels of its view.

    In a map of 1.5 times the size of its view, a repeated pixel is up to half a pixel away from its
    true position, and some pixels are repeated more often than others. The shift of such a map is
    also estimated from the map pixels at the centers of the view's pixels, and the smaller shift
    counts.

    Args:
        estimate: Function that estimates the shift from values, validity and synthetic view.
        values: Map (h, w) of depth or (h, w, 3) of normals.
        valid: Validity mask (h, w).
        example: Synthetic view that shows the true content of the map.
    """
    shift = estimate(values, valid, example)
    sizes = list(zip(valid.shape, (example.camera.height, example.camera.width), strict=True))
    if any(fine < coarse for fine, coarse in sizes) or not any(fine % n for fine, n in sizes):
        return shift
    centers = np.ix_(*(_nearest_to_centers(fine, coarse) for fine, coarse in sizes))
    unrepeated = estimate(values[centers], valid[centers], example)
    return min(shift, unrepeated, key=lambda each: (np.isinf(each.std), each.largest))


def _nearest_to_centers(fine: int, coarse: int) -> Int64:
    """Return the pixels (coarse,) of a fine grid nearest to the pixel centers of a coarse one.

    If two pixels have the same distance, the first and the second are returned in turn.
    """
    pixels = np.arange(coarse)
    position = (pixels + 0.5) * fine / coarse
    nearest = np.where(pixels % 2, np.ceil(position) - 1, np.floor(position))
    return nearest.astype(np.int64)


def _estimate_depth_shift(depth: Float32, valid: Bool, example: Example) -> MapShift:
    step = _choose_step(valid.shape, example)
    truth = example.truth(valid.shape, step=step)
    moved = [
        [example.truth(valid.shape, (s * x, s * y), step).depth for s in (1, -1)]
        for x, y in ((_HALF_STEP_PX, 0.0), (0.0, _HALF_STEP_PX))
    ]
    # On a grid finer than the view, half a pixel of the view can cross the border of a surface.
    where = select_comparable(thin(valid, step), truth)
    where &= np.min(moved, axis=(0, 1)) > 0
    error = np.log(thin(depth, step)[where].astype(np.float64) / truth.depth[where])
    slopes = [np.log(after[where] / before[where])[:, None] for after, before in moved]
    return _solve_shift(error[:, None], slopes, _normalized_positions(valid.shape, step)[where])


def _estimate_normals_shift(normals: Float32, valid: Bool, example: Example) -> MapShift:
    step = _choose_step(valid.shape, example)
    truth = example.truth(valid.shape, step=step)
    where = select_comparable(thin(valid, step), truth)
    error = thin(normals, step)[where].astype(np.float64) - truth.normals[where]
    slopes = []
    for x, y in ((_HALF_STEP_PX, 0.0), (0.0, _HALF_STEP_PX)):
        after, before = (example.truth(valid.shape, (s * x, s * y), step) for s in (1, -1))
        slopes.append(after.normals[where] - before.normals[where])
    return _solve_shift(error, slopes, _normalized_positions(valid.shape, step)[where])


def _choose_step(shape: tuple[int, int], example: Example) -> int:
    """Return the distance of the rows and columns that suffice to estimate the shift of a map.

    A map finer than its view has more pixels than the estimate needs.
    """
    return max(1, min(shape[0] // example.camera.height, shape[1] // example.camera.width))


def _normalized_positions(shape: tuple[int, int], step: int) -> Float64:
    """Return the x and y positions of the pixels of a thinned map, scaled to [-1, 1]."""
    return thin(pixel_centers(shape[1], shape[0]), step) / (shape[1] / 2, shape[0] / 2) - 1


def _solve_shift(error: Float64, slopes: list[Float64], positions: Float64) -> MapShift:
    """Fit shift and stretch to ``error = constant - dot(slope, shift + stretch * position)``.

    The least-squares fit is repeated once without outliers.

    Args:
        error: Errors (n, k) of a map at n pixels in k channels.
        slopes: Derivatives of the true map per pixel in x and in y, (n, k) each.
        positions: Pixel positions (n, 2), scaled to [-1, 1].
    """
    columns = [
        *(-slope for slope in slopes),
        *(-slope * positions[:, axis : axis + 1] for axis, slope in enumerate(slopes)),
        *(np.broadcast_to(unit, error.shape) for unit in np.eye(error.shape[1])),
    ]
    design = np.stack([column.ravel() for column in columns], axis=1)
    target = error.ravel()
    inliers = np.ones(len(target), dtype=np.bool_)
    for _ in range(2):
        a, b = design[inliers], target[inliers]
        solution, _, rank, _ = np.linalg.lstsq(a, b, rcond=None)
        residual = np.abs(target - design @ solution)
        inliers = residual <= _OUTLIER_MADS * np.median(residual) + 1e-12
    if rank < design.shape[1]:
        return MapShift(0.0, 0.0, 0.0, 0.0, np.inf)
    spread = np.linalg.inv(a.T @ a).diagonal()[:4].max()
    noise = np.mean((b - a @ solution) ** 2)
    x, y, stretch_x, stretch_y = map(float, solution[:4])
    return MapShift(x, y, stretch_x, stretch_y, float(np.sqrt(spread * noise)))
