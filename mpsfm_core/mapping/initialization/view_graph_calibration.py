"""Estimation of guessed focal lengths from the verified matches of all image pairs.

The relative pose of two images with one known camera has five parameters, but their fundamental
matrix has seven. Therefore the matches of an image pair constrain a focal length that both images
share (view graph calibration; Sweeney et al., "Optimizing the Viewing Graph for
Structure-from-Motion", ICCV 2015). For each focal length of a grid, the relative poses of all pairs
are refined to the smallest robust Sampson errors. The sum over the pairs is the profile likelihood
of the focal length. The lens of each pair has a shift of the principal point and a radial
distortion with zero-mean priors, because both would bias the focal length. In contrast to focal
lengths from fundamental matrices, the likelihood is flat for critical motions, and needs no
selection of pairs.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Bool, Float64, Int64, MappingImage, MappingProblem, VerifiedPair
from mpsfm_core.mapping.initialization.refined_focal_lengths import (
    MIN_FOCAL_CHANGE,
    estimate_relative_poses,
)
from mpsfm_core.mapping.refinement.self_calibration import PRINCIPAL_POINT_PRIOR_STD
from mpsfm_core.mapping.registration.pose_hypotheses import FOCAL_STEP, sample_focal_lengths

MAX_PAIRS, MAX_MATCHES = 20, 100
"""Number of image pairs with most matches, and approximate number of matches of each pair, that
estimate a focal length; the run time is proportional to both. [ours]"""
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


def calibrate_view_graph(problem: MappingProblem, seed: int) -> MappingProblem:
    """Return the problem with guessed focal lengths that are estimated from image pairs.

    A camera takes the estimate if the focal length changes by a factor of ``MIN_FOCAL_CHANGE`` or
    more. The priors on focal lengths stay the same, because bundle adjustment uses the same
    matches. Fisheye cameras keep their guess.

    Args:
        problem: Mapping problem with guessed focal lengths.
        seed: Seed of RANSAC for the relative poses of images with a changed focal length.
    """
    pairs_of_camera = defaultdict(list)
    for pair in problem.pairs:
        image_a, image_b = problem.images[pair.image_a], problem.images[pair.image_b]
        is_guessed = not (image_a.focal_known or image_a.camera_model.is_fisheye)
        if is_guessed and image_a.shared_camera == image_b.shared_camera:
            pairs_of_camera[image_a.shared_camera].append(pair)
    cameras = {}
    for shared_camera, pairs in pairs_of_camera.items():
        camera = shared_camera[1]
        ratio = estimate_shared_focal(problem, pairs) / camera.fx
        if abs(np.log(ratio)) >= np.log(MIN_FOCAL_CHANGE):
            cameras[shared_camera] = replace(camera, fx=camera.fx * ratio, fy=camera.fy * ratio)
    if not cameras:
        return problem
    is_changed = np.array(
        [not i.focal_known and i.shared_camera in cameras for i in problem.images]
    )
    images = tuple(
        image.with_camera(cameras[image.shared_camera]) if changed else image
        for image, changed in zip(problem.images, is_changed, strict=True)
    )
    return estimate_relative_poses(replace(problem, images=images), is_changed, seed)


def estimate_shared_focal(problem: MappingProblem, pairs: Sequence[VerifiedPair]) -> float:
    """Estimate the guessed focal length that the images of all given pairs share.

    Args:
        problem: Mapping problem with verified relative poses.
        pairs: Image pairs of one camera; the ``MAX_PAIRS`` pairs with most matches are used.

    Returns:
        Maximum of the posterior of the focal length, as ``fx`` in pixels, or the guessed focal
        length if the evidence against the guess is below ``MIN_EVIDENCE``.
    """
    pairs = sorted(pairs, key=lambda pair: -len(pair.matches))[:MAX_PAIRS]
    image = problem.images[pairs[0].image_a]
    matches = _collect_matches(problem, pairs)
    poses = _RelativePoses.of(pairs)
    coarse = sample_focal_lengths(image)
    start = int(np.argmin(np.abs(np.log(coarse / image.camera.fx))))
    costs = np.full((len(coarse), len(pairs)), np.inf)
    solutions = [poses] * len(coarse)
    # A pose follows the focal length to the next one. Both directions avoid local minima.
    for order in (range(start, -1, -1), range(len(coarse)), range(len(coarse) - 1, -1, -1)):
        poses = solutions[order[0]]
        for row in order:
            poses, cost = _refine_poses(poses, matches, coarse[row])
            is_better = cost < costs[row]
            solutions[row] = poses = poses.where(is_better, solutions[row])
            costs[row] = np.minimum(cost, costs[row])
    posterior = _log_posterior(image, coarse, costs, costs, matches)
    best = int(np.argmax(posterior))
    if posterior[best] - posterior[start] < MIN_EVIDENCE:
        return image.camera.fx
    low_px, high_px = coarse[best] / FOCAL_STEP, coarse[best] * FOCAL_STEP
    fine = np.geomspace(low_px, high_px, NUM_FINE_STEPS + 1)
    fine_costs = np.array([_refine_poses(solutions[best], matches, focal)[1] for focal in fine])
    posterior = _log_posterior(image, fine, fine_costs, costs, matches)
    return float(fine[np.argmax(posterior)])


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
    steps = [max(1, len(pair.matches) // MAX_MATCHES) for pair in pairs]
    chosen = [pair.matches[::step] for pair, step in zip(pairs, steps, strict=True)]
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
    poses: _RelativePoses, matches: _Matches, focal_px: float
) -> tuple[_RelativePoses, Float64]:
    """Minimize the Cauchy loss of the Sampson errors by Levenberg-Marquardt.

    Returns:
        The refined relative poses, and the cost (p,) of each pair.
    """
    damping = np.full(len(matches.std_px), 1e-3)
    prior = matches.lens_stds**-2
    diagonal_prior = np.diag([0.0] * 5 + prior.tolist())
    errors, jacobian = _linearize(poses, matches, focal_px)
    cost = np.log1p(errors**2).sum(axis=1) + poses.lenses**2 @ prior
    for _ in range(NUM_ITERATIONS):
        weighted = jacobian / (1.0 + errors**2)[:, None]
        hessian = weighted @ jacobian.transpose(0, 2, 1) + diagonal_prior
        gradient = np.einsum("pkm,pm->pk", weighted, errors)
        gradient[:, 5:] += prior * poses.lenses
        diagonal = np.einsum("pii->pi", hessian) + 1e-9
        hessian += (damping[:, None] * diagonal)[:, :, None] * np.eye(8)
        moved = poses.moved(-np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0])
        moved_errors, moved_jacobian = _linearize(moved, matches, focal_px)
        moved_cost = np.log1p(moved_errors**2).sum(axis=1) + moved.lenses**2 @ prior
        decrease = cost - moved_cost
        is_better = decrease > 0
        poses = moved.where(is_better, poses)
        errors = np.where(is_better[:, None], moved_errors, errors)
        jacobian = np.where(is_better[:, None, None], moved_jacobian, jacobian)
        damping = np.where(is_better, damping / 5, damping * 10)
        cost = np.minimum(cost, moved_cost)
        if (np.abs(decrease) <= MIN_DECREASE * cost).all():
            break
    return poses, cost


def _linearize(
    poses: _RelativePoses, matches: _Matches, focal_px: float
) -> tuple[Float64, Float64]:
    """Measure and differentiate the Sampson errors of all matches.

    Returns:
        Sampson errors (p, m) in standard deviations of the keypoints, and their derivatives (p, 8,
        m) by rotation, translation direction and lens, with constant norms of the gradients.
    """
    rays_a, by_lens_a = _undistort(matches.offsets_a, poses.lenses, matches.radius, focal_px)
    rays_b, by_lens_b = _undistort(matches.offsets_b, poses.lenses, matches.radius, focal_px)
    rotated = rays_a @ poses.rotations.transpose(0, 2, 1)
    essential = _cross_matrices(poses.translations) @ poses.rotations
    lines_b = rays_a @ essential.transpose(0, 2, 1)
    lines_a = rays_b @ essential
    norms = np.sqrt((lines_b[..., :2] ** 2).sum(axis=2) + (lines_a[..., :2] ** 2).sum(axis=2))
    slopes = focal_px / matches.std_px / np.maximum(norms, 1e-12)
    # ``x_b . (t x (w x q))`` is linear in the rotation vector w: ``w . (q x (x_b x t))``.
    normals = np.cross(rays_b, poses.translations[:, None])
    by_rotation = np.cross(rotated, normals).transpose(0, 2, 1)
    by_translation = poses.tangents() @ np.cross(rotated, rays_b).transpose(0, 2, 1)
    by_lens = np.einsum("pmi,pkmi->pkm", lines_a[..., :2], by_lens_a)
    by_lens += np.einsum("pmi,pkmi->pkm", lines_b[..., :2], by_lens_b)
    jacobian = np.concatenate([by_rotation, by_translation, by_lens], axis=1)
    return slopes * (rays_b * lines_b).sum(axis=2), jacobian * slopes[:, None]


def _undistort(
    offsets: Float64, lenses: Float64, radius_px: float, focal_px: float
) -> tuple[Float64, Float64]:
    """Undistort offsets from the image center by the division model.

    The undistorted offset is ``d / (1 + c r^2)`` with the distorted offset d from the principal
    point, its length r in units of ``radius_px``, and the coefficient c (Fitzgibbon, CVPR 2001).

    Returns:
        Rays (p, m, 3) with z = 1, and the derivatives (p, 3, m, 2) of their x and y by the lens.
    """
    shifted = offsets - lenses[:, None, :2]
    squared = (shifted**2).sum(axis=2, keepdims=True) / radius_px**2
    divisor = np.maximum(1.0 + lenses[:, None, 2:] * squared, MIN_DIVISOR)
    rays = np.concatenate([shifted / divisor / focal_px, np.ones_like(squared)], axis=2)
    by_center = -np.eye(2)[None, :, None] / (divisor * focal_px)[:, None]
    by_coefficient = -rays[:, None, :, :2] * (squared / divisor)[:, None]
    return rays, np.concatenate([by_center, by_coefficient], axis=1)


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


def _log_posterior(
    image: MappingImage,
    focals: Float64,
    costs: Float64,
    all_costs: Float64,
    matches: _Matches,
) -> Float64:
    """Return the log-posterior (k,) of focal lengths.

    The noise variance of each pair is unknown, so that its profile likelihood is a power of its
    cost. Each pair is an outlier with the log-odds ``-MAX_EVIDENCE``, and all pairs of each image
    are outliers with the log-odds ``-MAX_IMAGE_EVIDENCE``.

    Args:
        image: Image with the prior of the focal length.
        focals: (k,) focal lengths in pixels.
        costs: (k, p) costs of the pairs at the focal lengths.
        all_costs: (g, p) costs of the pairs at the whole grid, whose minimum is the reference.
        matches: Matches of the pairs.
    """
    counts = matches.counts
    floor = counts * MIN_NOISE_PX**2
    smallest = np.minimum(all_costs.min(axis=0), costs.min(axis=0))
    freedom = np.maximum(counts - NUM_PARAMETERS, 0.0)
    evidence = 0.5 * freedom * np.log((costs + floor) / (smallest + floor))
    by_pair = np.logaddexp(-evidence, -MAX_EVIDENCE)
    log_likelihood = np.array([_exclude_images(row, matches.images) for row in by_pair])
    deviations = np.log(focals / image.focal_prior_px) / image.focal_log_std
    posterior: Float64 = log_likelihood - 0.5 * deviations**2
    return posterior
