"""Contract checks of sparse and dense matchers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import DepthPrior, Features
from mpsfm_core.providers import validation
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.accuracy import (
    DEPTH_TOLERANCE,
    MATCH_TOLERANCE_STD,
    MIN_MATCHES,
    match_errors_px,
    match_points,
)
from mpsfm_core.testing.checks.depth import RAY_TOLERANCE
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

SHIFT_TOLERANCE = 0.2
"""Largest accepted shift of matches in pixels of the larger view, or in multiples of the keypoint
std if ``std_px`` exceeds one. Integer pixel centers shift matches by 0.5 pixels."""
NUM_MANY_FEATURES = 4096
"""Number of features per view that every sparse matcher has to accept."""
_MIN_CORRECT_RATIO = 0.5
"""Smallest accepted ratio of correct matches for an image pair with a small baseline. The ratio of
correct matches is 0.99 for nearest neighbors of SIFT and 0.96 for LighterGlue."""


def check_matcher_sides(case: ContractCase) -> str:
    """Require that the first column of the matches belongs to the first view."""
    case.require_truth("image", "prepared")
    return _require_correct(case, case.example, case.example.partner)


def check_matcher_order(case: ContractCase) -> str:
    """Require that swapped input views swap the columns of the matches."""
    case.require_truth("image", "prepared")
    return _require_correct(case, case.example.partner, case.example)


def check_matcher_pixel_convention(case: ContractCase) -> str:
    """Require dense matches in COLMAP's pixel convention.

    If a view is matched with its copy at half the size, the matched coordinates in the copy are
    exactly half as large. Matched coordinates with integer pixel centers differ from half the
    coordinates.
    """
    if not case.declares("dense"):
        raise CheckSkipped(
            "sparse matches have no positions of their own, only those of the keypoints"
        )
    case.require_truth("image", "prepared")
    width, height = case.example.camera.size
    small, large = case.example.sized(width // 2, height // 2), case.example
    matches = match_points(case, small, large, case.run_on_pair(small, large))
    _require_enough(len(matches))
    residual = matches.points_b - 2 * matches.points_a
    near = np.abs(residual).max(axis=1) < 4 * max(1.0, matches.std_px)
    if near.sum() < MIN_MATCHES:
        raise CheckSkipped(
            f"only {near.sum()} matches between a view and its copy at half the size"
        )
    shift = np.median(residual[near], axis=0)
    limit = SHIFT_TOLERANCE * max(1.0, matches.std_px)
    text = f"shifted by ({shift[0]:+.2f}, {shift[1]:+.2f}) px"
    if np.abs(shift).max() > limit:
        raise CheckFailed(f"matches between a view and its copy at half the size are {text}")
    return text


def check_matcher_no_features(case: ContractCase) -> None:
    """Require that a matcher returns no matches if a view has no features."""
    if not case.declares("sparse"):
        raise CheckSkipped("the matcher needs no features")
    a, b = case.example, case.example.partner
    some = case.extract_features(a.view, b.view)
    none = _take_first(some[0], 0), _take_first(some[1], 0)
    for given in ((some[0], none[1]), (none[0], some[1]), none):
        found = validation.run_matcher(case.spec, case.provider, (a.view, b.view), given)
        if found.sparse is not None and len(found.sparse):
            raise CheckFailed(
                f"the matcher returns {len(found.sparse)} matches for a view without features"
            )


def check_matcher_few_features(case: ContractCase) -> None:
    """Require valid output for views with one or two features."""
    if not case.declares("sparse"):
        raise CheckSkipped("the matcher needs no features")
    a, b = case.example, case.example.partner
    some = case.extract_features(a.view, b.view)
    for count_a, count_b in ((1, 1), (2, 1), (1, len(some[1]))):
        given = _take_first(some[0], count_a), _take_first(some[1], count_b)
        validation.run_matcher(case.spec, case.provider, (a.view, b.view), given)


def check_matcher_many_features(case: ContractCase) -> str:
    """Require valid output for 4096 features per view.

    Real images have about 4096 features. A fixed buffer or a size limit of the matching network
    must not end a run.
    """
    if not case.declares("sparse"):
        raise CheckSkipped("the matcher needs no features")
    a, b = case.example, case.example.partner
    features = case.extract_features(a.view, b.view)
    if not (len(features[0]) and len(features[1])):
        raise CheckSkipped("the detector finds no features to repeat")
    many = _repeat(features[0], a), _repeat(features[1], b)
    answer = validation.run_matcher(case.spec, case.provider, (a.view, b.view), many)
    num_matches = 0 if answer.sparse is None else len(answer.sparse)
    return f"{num_matches} matches of {NUM_MANY_FEATURES} features"


def check_matcher_scores(case: ContractCase) -> str:
    """Require a higher mean score of correct matches than of wrong ones.

    This check is skipped unless the matcher returns enough correct and wrong matches.
    """
    case.require_truth("image", "prepared")
    a, b = case.example, case.example.partner
    matches = match_points(case, a, b, case.run(a))
    _require_enough(len(matches))
    right = match_errors_px(a, b, matches) < MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    if min(right.sum(), (~right).sum()) < MIN_MATCHES:
        return f"{right.sum()} right and {(~right).sum()} wrong matches: too few to compare"
    means = matches.scores[right].mean(), matches.scores[~right].mean()
    if means[0] < means[1]:
        raise CheckFailed(f"correct matches score {means[0]:.2f}, wrong matches {means[1]:.2f}")
    return f"correct matches score {means[0]:.2f}, wrong matches {means[1]:.2f}"


def check_matcher_pair_depth(case: ContractCase) -> str:
    """Require z-depth of the first view in ``depth_a`` and of the second in ``depth_b``."""
    if not case.declares("pair-depth"):
        raise CheckSkipped("the matcher does not declare 'pair-depth'")
    case.require_truth("painted", "prepared")
    a, b = case.example, case.example.partner
    depth = case.run(a).depth
    for prior, example in ((depth.depth_a, a), (depth.depth_b, b)):
        power = map_errors.estimate_ray_exponent(prior, example)
        if abs(power) > RAY_TOLERANCE:
            raise CheckFailed(f"depth is proportional to z * (ray length / z) ** {power:.2f}")
    error = max(_depth_error(depth.depth_a, a), _depth_error(depth.depth_b, b))
    if max(_depth_error(depth.depth_a, b), _depth_error(depth.depth_b, a)) < 0.5 * error:
        raise CheckFailed("depth_a and depth_b are swapped")
    if error > DEPTH_TOLERANCE:
        raise CheckFailed(f"the depth of the image pair has a relative error of {error:.2g}")
    return f"relative error {error:.2g}"


CHECKS = (
    check_matcher_sides,
    check_matcher_order,
    check_matcher_pixel_convention,
    check_matcher_no_features,
    check_matcher_few_features,
    check_matcher_many_features,
    check_matcher_scores,
    check_matcher_pair_depth,
)


def _require_correct(case: ContractCase, a: Example, b: Example) -> str:
    """Require that most matches of two synthetic views are the same surface points."""
    matches = match_points(case, a, b, case.run_on_pair(a, b))
    _require_enough(len(matches))
    limit = MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    right = float((match_errors_px(a, b, matches) < limit).mean())
    if right < _MIN_CORRECT_RATIO:
        exchanged = replace(matches, points_a=matches.points_b, points_b=matches.points_a)
        swapped = float((match_errors_px(a, b, exchanged) < limit).mean())
        reason = ": the two sides are exchanged" if swapped > 2 * right else ""
        raise CheckFailed(f"only {right:.0%} of {len(matches)} matches are correct{reason}")
    return f"{right:.0%} of {len(matches)} matches are correct"


def _require_enough(count: int) -> None:
    """Require that the matcher finds matches between views that overlap."""
    if count < MIN_MATCHES:
        raise CheckFailed(
            f"the matcher finds only {count} matches between views that overlap by 90 %"
        )


def _depth_error(prior: DepthPrior, example: Example) -> float:
    """Return the 80 % quantile of relative depth errors, up to a factor if depth is not metric."""
    return map_errors.error_quantile(
        map_errors.log_errors(prior, example, any_scale=not prior.metric)
    )


def _take_first(features: Features, count: int) -> Features:
    """Return the first ``count`` features of a view."""
    return Features(
        features.keypoints[:count],
        features.descriptors[:count],
        None if features.scores is None else features.scores[:count],
        None if features.scales is None else features.scales[:count],
        features.std_px,
    )


def _repeat(features: Features, example: Example) -> Features:
    """Repeat features with small random changes until there are NUM_MANY_FEATURES."""
    rows = np.arange(NUM_MANY_FEATURES) % len(features)
    rng = np.random.default_rng(0)
    keypoints = features.keypoints[rows] + rng.uniform(-1, 1, (len(rows), 2))
    descriptors = features.descriptors[rows]
    noise = 0.01 * descriptors.std() * rng.normal(size=descriptors.shape)
    return Features(
        np.clip(keypoints, 0, example.camera.size),
        (descriptors + noise).astype(np.float32),
        None if features.scores is None else features.scores[rows],
        None if features.scales is None else features.scales[rows],
        features.std_px,
    )
