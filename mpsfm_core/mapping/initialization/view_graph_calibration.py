"""Estimation of guessed focal lengths and radial distortion from matches of image pairs.

The relative pose of two images with one known camera has five parameters, but their fundamental
matrix has seven. Therefore the matches of an image pair constrain a focal length that both images
share (view graph calibration; Sweeney et al., "Optimizing the Viewing Graph for
Structure-from-Motion", ICCV 2015). For each focal length of a grid, the relative poses of all pairs
are refined to the smallest robust Sampson errors. The sum over the pairs is the profile likelihood
of the focal length. The lens of each pair has a shift of the principal point and a radial
distortion with zero-mean priors, because both would bias the focal length. In contrast to focal
lengths from fundamental matrices, the likelihood is flat for critical motions, and needs no
selection of pairs. The profile likelihood of a radial distortion that all pairs share follows in
the same way. Without distortion, relative poses of pairs with small overlap would be wrong by many
degrees, because such pairs match at the image borders.
"""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Bool, Float64, Int64, MappingImage, MappingProblem, VerifiedPair
from mpsfm_core.mapping.initialization.refined_focal_lengths import (
    MIN_FOCAL_CHANGE,
    estimate_relative_poses,
    select_matches,
)
from mpsfm_core.mapping.refinement.self_calibration import PRINCIPAL_POINT_PRIOR_STD
from mpsfm_core.mapping.registration.pose_hypotheses import sample_focal_lengths
from mpsfm_core.support.jit import helper, kernel

MAX_PAIRS = 60
"""Number of image pairs with the largest total displacement of matches that estimate a focal
length; the run time is proportional. [tuned: benchmarks.walks]"""
MAX_EVIDENCE = 10.0
"""Largest difference of log-likelihoods of an image pair, because the matches of a pair with a
wrong relative pose prefer a wrong focal length. [tuned: benchmarks.distortion --buckets]"""
MAX_IMAGE_EVIDENCE = 7.0
"""Largest difference of log-likelihoods of all pairs of an image together, because the image may be
zoomed or cropped. [tuned: benchmarks.verdicts]"""
MIN_EVIDENCE = 3.0
"""Smallest difference of the log-posteriors of the best and the guessed focal length that replaces
the guess, strong evidence on the scale of Kass and Raftery ("Bayes Factors", 1995). The difference
is small for critical motions, such as an orbit at constant distance."""
MIN_NOISE_PX = 0.5
"""Smallest Sampson error in standard deviations of the keypoints that a match has by chance.
[tuned: benchmarks.distortion --buckets]"""
DIVISION_PRIOR_STD = 0.1
"""Standard deviation of the zero-mean prior on the coefficient of the division model, for radii in
half image diagonals. [ours]"""
DIVISIONS = np.linspace(-0.3, 0.3, 21)
"""Coefficients of the division model to try. [ours]"""
CONVERSION_RADIUS = 0.8
"""Radius in half image diagonals at which the division model is converted to SIMPLE_RADIAL. [ours]
"""
MIN_DIVISOR = 0.3
"""Smallest divisor of the division model, which prevents infinite offsets. [ours]"""
NUM_PARAMETERS = 6
"""Number of parameters of a relative pose and a focal length, which explain as many matches."""
NUM_FINE_STEPS = 12
"""Number of steps between the two neighbors of the best focal length of the grid. [ours]"""
NUM_ITERATIONS = 8
"""Maximum number of Levenberg-Marquardt iterations for the relative poses at a focal length."""
MIN_DECREASE = 1e-3
"""Relative decrease of the cost of a pair below which its relative pose has converged."""


class LensEstimate(NamedTuple):
    """Focal length and radial distortion that the images of a camera share."""

    focal_px: float
    """Focal length ``fx`` in pixels."""
    k1: float
    """Coefficient of SIMPLE_RADIAL."""


def calibrate_view_graph(
    problem: MappingProblem, seed: int, *, refine_distortion: bool = True
) -> MappingProblem:
    """Return the problem with guessed cameras that are estimated from image pairs.

    A camera takes the estimated focal length if the focal length changes by a factor of
    ``MIN_FOCAL_CHANGE`` or more. The priors on focal length and distortion stay the same, because
    bundle adjustment uses the same matches. Fisheye cameras keep their guess.

    Args:
        problem: Mapping problem with guessed cameras.
        seed: Seed of RANSAC for the relative poses of images with a changed camera.
        refine_distortion: Estimate the distortion of cameras whose model has distortion.
    """
    pairs_of_camera = defaultdict(list)
    for pair in problem.pairs:
        image_a, image_b = problem.images[pair.image_a], problem.images[pair.image_b]
        is_guessed = not (image_a.focal_known or image_a.camera_model.is_fisheye)
        if is_guessed and image_a.shared_camera == image_b.shared_camera:
            pairs_of_camera[image_a.shared_camera].append(pair)
    lenses = {
        shared_camera: estimate_shared_lens(problem, pairs, refine_distortion=refine_distortion)
        for shared_camera, pairs in pairs_of_camera.items()
    }
    images = tuple(
        image if image.focal_known else _apply_lens(image, lenses.get(image.shared_camera))
        for image in problem.images
    )
    is_changed = [new is not old for new, old in zip(images, problem.images, strict=True)]
    if not any(is_changed):
        return problem
    return estimate_relative_poses(replace(problem, images=images), np.array(is_changed), seed)


def _apply_lens(image: MappingImage, lens: LensEstimate | None) -> MappingImage:
    """Return the image with an estimated focal length and distortion that differ from the guess."""
    if lens is None:
        return image
    camera = image.camera
    ratio = lens.focal_px / camera.fx
    if abs(np.log(ratio)) >= np.log(MIN_FOCAL_CHANGE):
        image = image.with_camera(replace(camera, fx=camera.fx * ratio, fy=camera.fy * ratio))
    k1 = lens.k1 * (image.camera.fx / lens.focal_px) ** 2
    return replace(image, initial_distortion=(k1, 0.0, 0.0, 0.0)) if k1 else image


def estimate_shared_lens(
    problem: MappingProblem, pairs: Sequence[VerifiedPair], *, refine_distortion: bool = True
) -> LensEstimate:
    """Estimate the guessed focal length and distortion that the images of all pairs share.

    Args:
        problem: Mapping problem with verified relative poses.
        pairs: Image pairs of one camera; the ``MAX_PAIRS`` pairs with the largest
            :func:`_total_displacement` are used.
        refine_distortion: Estimate the distortion if the camera model has distortion.

    Returns:
        Maxima of the posteriors of focal length and distortion. A guess whose log-posterior is
        smaller by less than ``MIN_EVIDENCE`` is kept.
    """
    pairs = sorted(pairs, key=lambda pair: -_total_displacement(problem, pair))[:MAX_PAIRS]
    image = problem.images[pairs[0].image_a]
    matches = _collect_matches(problem, pairs)
    log_focals = np.log(sample_focal_lengths(image.camera))
    log_guess = float(np.log(image.camera.fx))
    log_focal, poses = _maximize_posterior(
        _Profile(log_focals, float(np.log(image.focal_prior_px)), image.focal_log_std),
        int(np.argmin(np.abs(log_focals - log_guess))),
        _RelativePoses.of(pairs),
        matches,
        lambda poses, value: _refine_poses(poses, matches, float(np.exp(value))),
        retrace=True,
    )
    focal_px = image.camera.fx if log_focal is None else float(np.exp(log_focal))
    if not (refine_distortion and image.camera_model.num_distortion) or any(image.distortion):
        return LensEstimate(focal_px, 0.0)
    division, _ = _maximize_posterior(
        _Profile(DIVISIONS, 0.0, DIVISION_PRIOR_STD),
        len(DIVISIONS) // 2,
        poses,
        matches,
        lambda poses, value: _refine_poses(poses, matches, focal_px, division=value),
        retrace=False,
    )
    return LensEstimate(focal_px, _convert_division(division or 0.0, focal_px / matches.radius))


def _total_displacement(problem: MappingProblem, pair: VerifiedPair) -> float:
    """Return the number of matches times the median distance of matched keypoints in pixels.

    Neighboring frames of a video have the most matches, but their motion is too small to constrain
    the focal length.
    """
    xy_a = problem.images[pair.image_a].keypoints[pair.matches[:, 0]]
    xy_b = problem.images[pair.image_b].keypoints[pair.matches[:, 1]]
    return len(pair.matches) * float(np.median(np.linalg.norm(xy_b - xy_a, axis=1)))


def _convert_division(division: float, focal_ratio: float) -> float:
    """Convert a coefficient of the division model to k1 of SIMPLE_RADIAL.

    With the distorted radius d and the undistorted radius ``u = d / (1 + c d^2)``, both models
    agree at d if ``1 + k1 u^2 = d / u``.

    Args:
        division: Coefficient c of the division model, for radii in half image diagonals.
        focal_ratio: Focal length in half image diagonals.
    """
    return division * (1 + division * CONVERSION_RADIUS**2) ** 2 * focal_ratio**2


class _Profile(NamedTuple):
    """Grid of values of a parameter that all pairs share, with a normal prior."""

    grid: Float64
    """(k,) ascending values with constant step."""
    mean: float
    """Mean of the prior."""
    std: float
    """Standard deviation of the prior."""

    def log_prior(self, values: Float64) -> Float64:
        """Return the log-prior (m,) of values, up to a constant."""
        return -0.5 * ((values - self.mean) / self.std) ** 2


def _maximize_posterior(
    profile: _Profile,
    start: int,
    poses: _RelativePoses,
    matches: _Matches,
    refine: Callable[[_RelativePoses, float], tuple[_RelativePoses, Float64]],
    *,
    retrace: bool,
) -> tuple[float | None, _RelativePoses]:
    """Maximize the posterior of a parameter, with refined relative poses for each value.

    Args:
        profile: Grid and prior of the parameter.
        start: Row of the guess in the grid.
        poses: Initial relative poses for the guess.
        matches: Matches of the pairs.
        refine: Function that refines relative poses for a value of the parameter, and returns them
            with the cost (p,) of each pair.
        retrace: Sweep the whole grid in both directions after the sweeps from the guess, which
            avoids local minima of relative poses with a wrong focal length.

    Returns:
        Value of the parameter, or None if the evidence against the guess is below ``MIN_EVIDENCE``,
        and relative poses for the best value of the grid or for the guess.
    """
    grid = profile.grid
    costs = np.full((len(grid), len(matches.std_px)), np.inf)
    solutions = [poses] * len(grid)
    # A pose follows the parameter to the next value.
    upward, downward = range(len(grid)), range(len(grid) - 1, -1, -1)
    outward = range(start, -1, -1), range(start, len(grid))
    for order in (outward[0], upward, downward) if retrace else outward:
        poses = solutions[order[0]]
        for row in order:
            poses, cost = refine(poses, float(grid[row]))
            is_better = cost < costs[row]
            solutions[row] = poses = poses.where(is_better, solutions[row])
            costs[row] = np.minimum(cost, costs[row])
    posterior = _log_likelihood(costs, costs, matches) + profile.log_prior(grid)
    best = int(np.argmax(posterior))
    if posterior[best] - posterior[start] < MIN_EVIDENCE:
        return None, solutions[start]
    step = (grid[-1] - grid[0]) / (len(grid) - 1)
    fine = grid[best] + np.linspace(-step, step, NUM_FINE_STEPS + 1)
    fine_costs = np.array([refine(solutions[best], float(value))[1] for value in fine])
    posterior = _log_likelihood(fine_costs, costs, matches) + profile.log_prior(fine)
    return float(fine[np.argmax(posterior)]), solutions[best]


class _Matches(NamedTuple):
    """Matches of p image pairs with up to m matches each."""

    images: Int64
    """(p, 2) indices of the images of each pair."""
    offsets_a: Float64
    """(p, m, 2) keypoints of the first images, relative to the principal point in pixels."""
    offsets_b: Float64
    """(p, m, 2) keypoints of the second images."""
    std_px: Float64
    """(p, m) standard deviation of the keypoints in pixels, infinite for unused elements."""
    radius: float
    """Half of the image diagonal in pixels."""
    lens_stds: Float64
    """(3,) standard deviations of the priors on principal point and radial distortion."""

    @property
    def counts(self) -> Float64:
        """Number (p,) of matches of each pair."""
        counts: Float64 = np.isfinite(self.std_px).sum(axis=1).astype(np.float64)
        return counts


class _RelativePoses(NamedTuple):
    """Relative poses ``cam_b_from_cam_a`` of p image pairs, and the lens of each pair."""

    rotations: Float64
    """(p, 3, 3) rotations."""
    translations: Float64
    """(p, 3) translations of unit length."""
    lenses: Float64
    """(p, 3) shift of the principal point in pixels, and coefficient of the division model of
    radial distortion (see :func:`_undistort`), of the camera of each pair."""

    @classmethod
    def of(cls, pairs: Sequence[VerifiedPair]) -> _RelativePoses:
        """Return the verified relative poses; a rotation without translation moves sideways."""
        translations = np.array([pair.translation for pair in pairs])
        translations[~translations.any(axis=1)] = 1.0, 0.0, 0.0
        lengths = np.linalg.norm(translations, axis=1, keepdims=True)
        rotations = np.array([pair.rotation for pair in pairs])
        return cls(rotations, translations / lengths, np.zeros((len(pairs), 3)))

    def where(self, mask: Bool, other: _RelativePoses) -> _RelativePoses:
        """Return the poses of the pairs in the mask (p,), and those of ``other`` elsewhere."""
        return _RelativePoses(
            np.where(mask[:, None, None], self.rotations, other.rotations),
            np.where(mask[:, None], self.translations, other.translations),
            np.where(mask[:, None], self.lenses, other.lenses),
        )

    def with_division(self, division: float) -> _RelativePoses:
        """Return the poses with the same coefficient of the division model for all pairs."""
        lenses = self.lenses.copy()
        lenses[:, 2] = division
        return self._replace(lenses=lenses)

    def tangents(self) -> Float64:
        """Return two unit vectors (p, 2, 3) that are orthogonal to each translation."""
        axis = np.eye(3)[np.abs(self.translations).argmin(axis=1)]
        first = np.cross(self.translations, axis)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(self.translations, first)], axis=1)

    def moved(self, step: Float64) -> _RelativePoses:
        """Return the poses after a step (p, 8) of rotation, translation direction and lens."""
        rotations = Rotation.from_rotvec(step[:, :3]).as_matrix() @ self.rotations
        moved = self.translations + np.einsum("pk,pki->pi", step[:, 3:5], self.tangents())
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        return _RelativePoses(rotations, moved, self.lenses + step[:, 5:])


def _collect_matches(problem: MappingProblem, pairs: Sequence[VerifiedPair]) -> _Matches:
    """Return evenly spaced matches of each pair, as offsets from the principal point."""
    chosen = [select_matches(pair) for pair in pairs]
    shape = len(pairs), max(map(len, chosen))
    offsets, std_px = np.zeros((2, *shape, 2)), np.full(shape, np.inf)
    for row, (pair, matches) in enumerate(zip(pairs, chosen, strict=True)):
        for side, index in enumerate((pair.image_a, pair.image_b)):
            image = problem.images[index]
            fx, fy, cx, cy = image.camera.params
            xy = image.keypoints[matches[:, side]]
            offsets[side, row, : len(matches)] = (xy - (cx, cy)) * (1.0, fx / fy)
        both = problem.images[pair.image_a], problem.images[pair.image_b]
        std_px[row, : len(matches)] = max(image.keypoint_std_px for image in both)
    center_std = PRINCIPAL_POINT_PRIOR_STD * max(image.camera.size)
    lens_stds = np.array([center_std, center_std, DIVISION_PRIOR_STD])
    radius = 0.5 * float(np.hypot(*image.camera.size))
    images = np.array([(pair.image_a, pair.image_b) for pair in pairs])
    return _Matches(images, offsets[0], offsets[1], std_px, radius, lens_stds)


def _refine_poses(
    poses: _RelativePoses, matches: _Matches, focal_px: float, division: float | None = None
) -> tuple[_RelativePoses, Float64]:
    """Minimize the Cauchy loss of the Sampson errors by Levenberg-Marquardt.

    Args:
        poses: Initial relative poses.
        matches: Matches of the pairs.
        focal_px: Focal length in pixels.
        division: Coefficient of the division model for all pairs, or None to estimate a coefficient
            of each pair with a prior.

    Returns:
        The refined relative poses, and the cost (p,) of each pair.
    """
    damping = np.full(len(matches.std_px), 1e-3)
    precisions = matches.lens_stds**-2
    if division is not None:
        poses = poses.with_division(division)
        precisions[-1] = 0.0
    system = _linearize(poses, matches, focal_px, precisions)
    for _ in range(NUM_ITERATIONS):
        diagonal = damping[:, None] * (np.einsum("pii->pi", system.hessian) + 1e-9)
        damped = system.hessian + diagonal[:, :, None] * np.eye(8)
        moved = poses.moved(-np.linalg.solve(damped, system.gradient[:, :, None])[:, :, 0])
        moved_system = _linearize(moved, matches, focal_px, precisions)
        decrease = system.cost - moved_system.cost
        is_better = decrease > 0
        poses, system = moved.where(is_better, poses), moved_system.where(is_better, system)
        damping = np.where(is_better, damping / 5, damping * 10)
        if (np.abs(decrease) <= MIN_DECREASE * system.cost).all():
            break
    return poses, system.cost


class _NormalEquations(NamedTuple):
    """Cost of p image pairs, and the Gauss-Newton system of the relative pose of each pair."""

    cost: Float64
    """(p,) Cauchy losses of the Sampson errors of all matches, and cost of the lens prior."""
    hessian: Float64
    """(p, 8, 8) approximate Hessian by rotation, translation direction and lens."""
    gradient: Float64
    """(p, 8) gradient."""

    def where(self, mask: Bool, other: _NormalEquations) -> _NormalEquations:
        """Select the system of each pair from these where the mask (p,) is True, else ``other``."""
        return _NormalEquations(
            np.where(mask, self.cost, other.cost),
            np.where(mask[:, None, None], self.hessian, other.hessian),
            np.where(mask[:, None], self.gradient, other.gradient),
        )


def _linearize(
    poses: _RelativePoses, matches: _Matches, focal_px: float, precisions: Float64
) -> _NormalEquations:
    """Compute cost, gradient and Hessian of the Sampson errors and of the prior on the lens.

    Args:
        poses: Relative poses.
        matches: Matches of the pairs.
        focal_px: Focal length in pixels.
        precisions: (3,) inverse variances of the prior on the lens, 0 if the coefficient of the
            division model is constant.
    """
    count = len(matches.std_px)
    system = _NormalEquations(np.zeros(count), np.zeros((count, 8, 8)), np.zeros((count, 8)))
    essential = _cross_matrices(poses.translations) @ poses.rotations
    scale = 1.0 / matches.radius**2
    observed = matches.offsets_a, matches.offsets_b, matches.std_px
    _add_matches(*poses, poses.tangents(), essential, *observed, scale, focal_px, *system)
    if precisions[-1] == 0.0:
        system.hessian[:, 7] = system.hessian[:, :, 7] = system.gradient[:, 7] = 0.0
    lens = np.arange(5, 8)
    system.hessian[:, lens, lens] += precisions
    system.gradient[:, lens] += precisions * poses.lenses
    return system._replace(cost=system.cost + poses.lenses**2 @ precisions)


@kernel()
def _add_matches(
    rotations: Float64,
    translations: Float64,
    lenses: Float64,
    tangents: Float64,
    essential: Float64,
    offsets_a: Float64,
    offsets_b: Float64,
    std_px: Float64,
    radius_factor: float,
    focal_px: float,
    cost: Float64,
    hessian: Float64,
    gradient: Float64,
) -> None:
    """Add the Sampson errors of all matches to the normal equations.

    The derivatives regard the norms of the gradients of the epipolar constraint as constant.

    Args:
        rotations: (p, 3, 3) rotations ``cam_b_from_cam_a``.
        translations: (p, 3) unit translations.
        lenses: (p, 3) lenses, see :class:`_RelativePoses`.
        tangents: (p, 2, 3) unit vectors that are orthogonal to the translations.
        essential: (p, 3, 3) essential matrices.
        offsets_a: (p, m, 2) keypoints of the first images.
        offsets_b: (p, m, 2) keypoints of the second images.
        std_px: (p, m) standard deviations of the keypoints, infinite for unused elements.
        radius_factor: Factor from squared pixels to squared radii of the division model.
        focal_px: Focal length in pixels.
        cost: (p,) output.
        hessian: (p, 8, 8) output.
        gradient: (p, 8) output.
    """
    slopes = np.empty(8)
    for pair in range(len(std_px)):
        rotation, matrix, shift = rotations[pair], essential[pair], translations[pair]
        for row in range(std_px.shape[1]):
            if not np.isfinite(std_px[pair, row]):
                continue
            lens = lenses[pair, 0], lenses[pair, 1], lenses[pair, 2]
            xy_a, xy_b = offsets_a[pair, row], offsets_b[pair, row]
            xa, ya, scale_a, bend_a = _undistort(xy_a, lens, radius_factor, focal_px)
            xb, yb, scale_b, bend_b = _undistort(xy_b, lens, radius_factor, focal_px)
            ray_a, ray_b = (xa, ya, 1.0), (xb, yb, 1.0)
            line_b = _multiply(matrix, ray_a)
            line_a = _multiply(matrix.T, ray_b)
            norm = math.sqrt(line_b[0] ** 2 + line_b[1] ** 2 + line_a[0] ** 2 + line_a[1] ** 2)
            factor = focal_px / std_px[pair, row] / max(norm, 1e-12)
            error = factor * (xb * line_b[0] + yb * line_b[1] + line_b[2])
            # A rotation vector w changes the constraint by ``ray_b . (shift x (w x rotated))``.
            rotated = _multiply(rotation, ray_a)
            by_rotation = _cross(rotated, _cross(ray_b, (shift[0], shift[1], shift[2])))
            by_translation = _cross(rotated, ray_b)
            slopes[0], slopes[1], slopes[2] = by_rotation
            for k in range(2):
                axis = tangents[pair, k]
                slopes[3 + k] = 0.0
                for i in range(3):
                    slopes[3 + k] += axis[i] * by_translation[i]
                slopes[5 + k] = -(line_a[k] * scale_a + line_b[k] * scale_b)
            slopes[7] = -bend_a * (line_a[0] * xa + line_a[1] * ya)
            slopes[7] -= bend_b * (line_b[0] * xb + line_b[1] * yb)
            weight = 1.0 / (1.0 + error**2)
            cost[pair] += math.log1p(error**2)
            for i in range(8):
                gradient[pair, i] += weight * factor * slopes[i] * error
                for j in range(8):
                    hessian[pair, i, j] += weight * factor**2 * slopes[i] * slopes[j]


@helper()
def _undistort(
    offset: Float64, lens: tuple[float, float, float], radius_factor: float, focal_px: float
) -> tuple[float, float, float, float]:
    """Undistort an offset from the image center by the division model.

    The undistorted offset is ``d / (1 + c r^2)`` with the distorted offset d from the principal
    point, its length r in radii, and the coefficient c (Fitzgibbon, CVPR 2001).

    Returns:
        x and y of the ray with z = 1, and minus their derivatives by the principal point (equal for
        x and y) and by the coefficient (relative to x and y).
    """
    x, y = offset[0] - lens[0], offset[1] - lens[1]
    squared = (x**2 + y**2) * radius_factor
    divisor = max(1.0 + lens[2] * squared, MIN_DIVISOR)
    scale = 1.0 / (divisor * focal_px)
    return x * scale, y * scale, scale, squared / divisor


@helper()
def _multiply(matrix: Float64, v: tuple[float, float, float]) -> tuple[float, float, float]:
    """Multiply a (3, 3) matrix by the vector ``v`` and return the product as a tuple."""
    return (
        matrix[0, 0] * v[0] + matrix[0, 1] * v[1] + matrix[0, 2] * v[2],
        matrix[1, 0] * v[0] + matrix[1, 1] * v[1] + matrix[1, 2] * v[2],
        matrix[2, 0] * v[0] + matrix[2, 1] * v[1] + matrix[2, 2] * v[2],
    )


@helper()
def _cross(
    a: tuple[float, float, float], b: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the cross product of two vectors."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _exclude_images(by_pair: Float64, images: Int64) -> float:
    """Return the log-likelihood of all pairs, without the pairs of the most contradicted images.

    Images are excluded greedily while an exclusion increases the log-likelihood.

    Args:
        by_pair: (p,) log-likelihood of each pair, at most about 0.
        images: (p, 2) indices of the images of each pair.
    """
    remaining, penalty = by_pair.copy(), 0.0
    while True:
        by_image = np.bincount(images.ravel(), np.repeat(remaining, 2))
        worst = int(np.argmin(by_image))
        if by_image[worst] >= -MAX_IMAGE_EVIDENCE:
            return float(remaining.sum()) - penalty
        remaining[(images == worst).any(axis=1)] = 0.0
        penalty += MAX_IMAGE_EVIDENCE


def _cross_matrices(vectors: Float64) -> Float64:
    """Return the matrices (p, 3, 3) of the cross products with vectors (p, 3)."""
    matrices: Float64 = np.cross(vectors[:, None], np.eye(3)).transpose(0, 2, 1)
    return matrices


def _log_likelihood(costs: Float64, all_costs: Float64, matches: _Matches) -> Float64:
    """Return the profile log-likelihood (k,) of the values of a shared parameter.

    The noise variance of each pair is unknown, so that its profile likelihood is a power of its
    cost. Each pair is an outlier with the log-odds ``-MAX_EVIDENCE``, and all pairs of each image
    are outliers with the log-odds ``-MAX_IMAGE_EVIDENCE``.

    Args:
        costs: (k, p) costs of the pairs at the values.
        all_costs: (g, p) costs of the pairs at the whole grid, whose minimum is the reference.
        matches: Matches of the pairs.
    """
    counts = matches.counts
    floor = counts * MIN_NOISE_PX**2
    smallest = np.minimum(all_costs.min(axis=0), costs.min(axis=0))
    freedom = np.maximum(counts - NUM_PARAMETERS, 0.0)
    evidence = 0.5 * freedom * np.log((costs + floor) / (smallest + floor))
    by_pair = np.logaddexp(-evidence, -MAX_EVIDENCE)
    return np.array([_exclude_images(row, matches.images) for row in by_pair])
