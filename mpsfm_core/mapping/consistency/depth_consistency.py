"""Dense depth consistency check between views (paper section 3.4).

Each pixel of one image's refined map is carried into another view. Where it lands clearly in front
of the surface seen there, the two contradict each other: something would have to float in space
that was seen to be empty. Behind is an occlusion. Two explanations compete for such a pixel:

* The *priors* are off there. The surface then lies elsewhere on the pixel's own ray, and the other
  surface elsewhere on its ray. If errors of log depth are normal with std ``s`` and ``s'``, what is
  seen has the likelihood ``L``, the mean of ``exp(-(e' / s')^2 / 2)`` over all ``e`` along the ray,
  where ``e'`` brings the other surface there (0 where it need not: out of sight, or behind it).
  This is no matter of depth alone: of two views at a wide angle, an error of depth in one is a
  shift to the side in the other. The mean and not the best: some error to the side nearly always
  takes a pixel past an edge, which explains no more than that error is likely.
* The *pose* is wrong. Then whatever is seen there has nothing to do with the pixel, and one gap is
  as likely as another.

A pixel speaks for the second where ``L`` is below that of a deviation of ``max_deviation`` std
(2.7: 38 times less likely than none); the share of such pixels decides. So all depends on what std
is true at the place. A prior that is good on the whole may be far off in one spot, and only there.
What a map is worth at a place is therefore measured: by the points around whose depth hangs on no
prior, as rays hold them at wide angles
(:func:`~mpsfm_core.mapping.refinement.depth_noise.local_noise`). Where they deny the prior, it is
at fault, its std is what they say, and the pixel contradicts nothing. Where they confirm it, or
where there are none, the std of the whole stands and so does the contradiction. This tells
look-alikes from bad priors: an image that stands in the twin of its room has points only on what
both rooms share, where depth is right; what differs has none to excuse it.

What fills the picture of a near view may fall into few pixels of a far one, whose refined map is
least sure of what is small. Images that hold already go on clear evidence only: there it counts as
these few pixels. A newcomer, which is tried again, is held to all.

An image is held against all views that it overlaps with, not only those it shares points with:
those that led an image to a wrong place look alike there, others tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from mpsfm_core.data import Bool, Float32, Float64, Int64, PinholeCamera
from mpsfm_core.geometry import pixel_centers, unproject
from mpsfm_core.mapping.options import ConsistencyOptions
from mpsfm_core.mapping.refinement.depth_noise import local_noise, witnesses
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.optimize.depth_integration import RefinedDepth
from mpsfm_core.optimize.subsampling import compute_subsampling_step, subsample, subsample_camera
from mpsfm_core.support import jit

STEPS = 4
"""Errors to either side along a pixel's ray over which the mean is taken, evenly spaced up to the
limit (ours)."""
SAMPLING = 2
"""Every so many columns and rows a pixel of a thinned map is carried over: thousands are left, and
a share of 5 % of independent ones is known within 0.4 % (ours)."""
CLEAR = 3.0
"""A quarter of these pixels is enough where their share is so many of its stds off the limit (ours:
most views that overlap agree in all of them)."""
OVERLAP_GRID = 16
"""Columns and rows of the pixels by which overlap is judged (ours)."""
MIN_OVERLAP = 0.05
"""Share of those pixels that must fall into another view for a comparison (ours)."""


class DepthViolation(NamedTuple):
    """The view that contradicts an image most, and the share of contradicting pixels.

    ``share``: of the pixels of either map, summed over both directions, as beta in the paper,
    in [0, 2]. ``other``: -1 when no view overlaps.
    """

    share: float
    other: int


class DepthConsistencyCheck:
    """The check of one scene; remembers what maps are worth as long as they stay what they are.

    ``fills_holes``: holes of a pixel or two, as sensors leave, are no gap in what is seen. A right
    pose hides nothing there; one that is a little off may, and so does an image whose pose is not
    settled (ours, hololens_room).
    """

    def __init__(
        self, scene: Scene, options: ConsistencyOptions, *, fills_holes: bool = False
    ) -> None:
        self._scene = scene
        self._options = options
        self._fills_holes = fills_holes
        self._grids: dict[int, tuple[_MapState, _Grid]] = {}

    def check_image(
        self, image: int, std_factor: float = 1.0, limit: float = math.nan
    ) -> DepthViolation:
        """How much an image contradicts the registered views that it overlaps with most.

        ``std_factor``: how many times its declaration the std of depth is on the whole. ``limit``:
        as of :meth:`between`.
        """
        found = [
            DepthViolation(self.violation_ratio(image, other, std_factor, limit), other)
            for other in find_overlapping_images(self._scene, image, self._options.num_views)
        ]
        return max(found, default=DepthViolation(0.0, -1))

    def find_conflicting_images(
        self, images: Sequence[int] | Int64, limit: float, std_factor: float = 1.0
    ) -> list[tuple[int, float]]:
        """Registered images to leave out so that none of ``images`` and another contradict each
        other, and how much each did.

        ``limit``: share of contradicting pixels above which two do. The image with most conflicts
        goes first.
        """
        scene = self._scene
        shares = np.full((scene.num_images, scene.num_images), np.nan)
        for image in map(int, images):
            for other in find_overlapping_images(scene, image, self._options.num_views):
                if np.isnan(shares[image, other]):
                    share = self.violation_ratio(image, other, std_factor, limit, once=True)
                    shares[image, other] = shares[other, image] = share
        shares = np.nan_to_num(shares)
        removed = []
        while (shares > limit).any():
            conflicts = (shares > limit).sum(axis=1)
            worst = int(np.lexsort((shares.sum(axis=1), conflicts))[-1])
            removed.append((worst, float(shares[worst].max())))
            shares[worst] = shares[:, worst] = 0
        return removed

    def violation_ratio(
        self,
        a: int,
        b: int,
        std_factor: float = 1.0,
        limit: float = math.nan,
        *,
        once: bool = False,
    ) -> float:
        """Share of pixels of two views at which one sees empty space and the other a surface.

        ``limit``: that it is held against; what is clearly below or above it is known less exactly.
        ``once``: those that fall into one pixel of the other view together count as one.
        """
        scene, options = self._scene, self._options
        rotation = scene.rotations[b] @ scene.rotations[a].T
        translation = scene.translations[b] - rotation @ scene.translations[a]
        return compute_violation_ratio(
            self._grid(a, std_factor),
            self._grid(b, std_factor),
            rotation,
            translation,
            ViolationCriteria(options.max_deviation, options.min_gap, once),
            limit,
        )

    def _grid(self, image: int, std_factor: float) -> _Grid:
        """The depth map of an image, thinned out, with what it was worth when it came about."""
        depth_map = self._scene.maps[image]
        state = _MapState(depth_map.refined, depth_map.scale, depth_map.camera, std_factor)
        known = self._grids.get(image)
        if known is None or known[0] != state:
            known = self._grids[image] = state, self._make_grid(image, std_factor)
        return known[1]

    def _make_grid(self, image: int, std_factor: float) -> _Grid:
        depth_map = self._scene.maps[image]
        step = compute_subsampling_step(depth_map.valid.shape[1], self._options.map_width)
        depth = subsample(depth_map.depth, step)
        valid = subsample(depth_map.valid, step)
        std = subsample(depth_map.log_std, step) * np.float32(std_factor)
        if self._options.weigh_evidence:
            local = local_noise(self._scene, image, witnesses(self._scene, image), std_factor)
            std = subsample(depth_map.log_std, step) * subsample(local, step)
        # A pixel's error of place is one of depth at edges and where sight grazes a surface.
        around = np.ones((3, 3))
        nearest = cv2.erode(np.where(valid, depth, np.float32(np.inf)), around)
        if self._fills_holes:
            std = np.where(valid, std, cv2.dilate(np.where(valid, std, np.float32(0)), around))
            depth, valid = np.where(valid, depth, nearest), np.isfinite(nearest)
        params = np.array(subsample_camera(depth_map.camera, step).params)
        return _Grid(depth, np.maximum(std, np.float32(1e-6)), valid, nearest, params)


def find_overlapping_images(scene: Scene, image: int, limit: int) -> list[int]:
    """Registered images, most overlapping first, into which a good part of a depth map falls."""
    others = scene.registered_images()
    others = others[(others != image) & np.array([scene.maps[i].active for i in others])]
    depth_map = scene.maps[image]
    rows, columns = depth_map.depth.shape
    xy = pixel_centers(OVERLAP_GRID, OVERLAP_GRID) * [columns, rows] / OVERLAP_GRID
    at = xy[..., 1].astype(np.int64), xy[..., 0].astype(np.int64)
    points = unproject(depth_map.camera, xy, depth_map.depth[at].astype(np.float64))
    world = (points[depth_map.valid[at]] - scene.translations[image]) @ scene.rotations[image]
    sizes = np.array([scene.problem.images[i].camera.size for i in others]).reshape(-1, 2)
    inside = count_visible_points(
        world,
        scene.rotations[others],
        scene.translations[others],
        scene.intrinsics[others],
        sizes.astype(np.float64),
    )
    share = inside / OVERLAP_GRID**2
    order = np.argsort(-share, kind="stable")[:limit]
    return [int(others[k]) for k in order if share[k] >= MIN_OVERLAP]


@jit.kernel()
def count_visible_points(
    points: Float64, rotations: Float64, translations: Float64, intrinsics: Float64, sizes: Float64
) -> Int64:
    """How many of the points (p, 3) project into each of n views, (n,) int64.

    ``rotations`` (n, 3, 3), ``translations`` (n, 3): cam_from_world. ``intrinsics`` (n, 4): fx, fy,
    cx, cy, and ``sizes`` (n, 2) in pixels.
    """
    counts = np.zeros(len(rotations), np.int64)
    for view in range(len(rotations)):
        r, t = rotations[view], translations[view]
        fx, fy, cx, cy = intrinsics[view]
        width, height = sizes[view]
        for k in range(len(points)):
            x, y, z = points[k]
            depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
            if depth <= 1e-9:
                continue
            u = fx * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) / depth + cx
            v = fy * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) / depth + cy
            counts[view] += 0 <= u < width and 0 <= v < height
    return counts


class _Grid(NamedTuple):
    """A depth map thinned out, (h, w): depth, the std of its logarithm, where it is valid, the
    least depth around each pixel; and the (fx, fy, cx, cy) that belong to it."""

    depth: Float32
    log_std: Float32
    valid: Bool
    nearest: Float32
    params: Float64


class _MapState(NamedTuple):
    """What a grid depends on: the refined map, its scale and camera, the std of depth on the whole.

    The points that deny or confirm a prior also move on, but they are those that the map was
    refined with."""

    refined: RefinedDepth | None
    scale: float
    camera: PinholeCamera
    std_factor: float


class ViolationCriteria(NamedTuple):
    """What a pixel that lies before what another view sees is held to.

    ``max_deviation``: errors in terms of their std up to which they are likely. ``min_gap``: share
    of the seen depth up to which before it is not in front of it. ``once``: those that fall into
    one pixel of the other view together count as one."""

    max_deviation: float
    min_gap: float
    once: bool


@jit.kernel()
def compute_violation_ratio(
    one: _Grid,
    two: _Grid,
    rotation: Float64,
    translation: Float64,
    terms: ViolationCriteria,
    limit: float,
) -> float:
    """Share of the pixels of two views that lie before what the other sees, whatever errors of
    depth are likely; summed over both directions.

    ``rotation`` (3, 3), ``translation`` (3,): ``two_from_one``. ``limit``: the answer may be that
    of a quarter of the pixels where this says on which side of it the share is.
    """
    back, found = rotation.T.copy(), np.zeros((2, 2))
    for quarter in range(4):
        found[0] += _unexplained(one, two, rotation, translation, terms, quarter)
        found[1] += _unexplained(two, one, back, -back @ translation, terms, quarter)
        share, looked_at = (found[:, 0] / found[:, 1]).sum(), found[:, 1].mean()
        if not quarter and abs(share - limit) > CLEAR * math.sqrt(2 * limit / looked_at):
            break
    return float(share)


@jit.kernel()
def _unexplained(
    source: _Grid,
    target: _Grid,
    rotation: Float64,
    translation: Float64,
    terms: ViolationCriteria,
    quarter: int,
) -> Float64:
    """How many pixels do in one direction, and of how many: one of four lattices of them."""
    rows, columns = target.depth.shape
    r, t, total, visited = rotation, translation, 0.0, 0.0
    limit = terms.max_deviation
    zoom = target.params[0] / source.params[0]
    # 0, then nearer and farther in turn: most pixels need no error at all
    turns = np.arange(2 * STEPS + 1)
    errors = limit * ((turns + 1) // 2) / STEPS * (1 - 2 * (turns % 2))
    weights = np.exp(-errors * errors / 2) * limit / STEPS / math.sqrt(2 * math.pi)
    least = math.exp(-limit * limit / 2)
    top, left = SAMPLING // 2 + SAMPLING * (quarter // 2), SAMPLING // 2 + SAMPLING * (quarter % 2)
    for row in range(top, source.depth.shape[0], 2 * SAMPLING):
        y = (row + 0.5 - source.params[3]) / source.params[1]
        for column in range(left, source.depth.shape[1], 2 * SAMPLING):
            visited += 1.0
            if not source.valid[row, column]:
                continue
            x = (column + 0.5 - source.params[2]) / source.params[0]
            across = r[0, 0] * x + r[0, 1] * y + r[0, 2]
            down = r[1, 0] * x + r[1, 1] * y + r[1, 2]
            along = r[2, 0] * x + r[2, 1] * y + r[2, 2]
            here, likelihood = np.float64(source.depth[row, column]), 0.0
            for step in range(len(errors)):
                error = errors[step] * source.log_std[row, column]
                depth = here * math.exp(error) if step else here
                z, other = depth * along + t[2], 0.0
                if z > 1e-9:
                    inverse = 1.0 / z
                    u = (depth * across + t[0]) * inverse * target.params[0] + target.params[2]
                    v = (depth * down + t[1]) * inverse * target.params[1] + target.params[3]
                    if 0 <= u < columns and 0 <= v < rows:
                        i, j = int(v), int(u)
                        seen = target.nearest[i, j]
                        if target.valid[i, j] and seen - z > terms.min_gap * seen:
                            other = math.log(seen / z) / target.log_std[i, j]
                likelihood += weights[step] * math.exp(-other * other / 2)
                if likelihood >= least:
                    break
            if likelihood < least:
                pixels = (zoom * here / (here * along + t[2])) ** 2
                total += min(1.0, pixels) if terms.once else 1.0
    return np.array([total, max(visited, 1.0)])
