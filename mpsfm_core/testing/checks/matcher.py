"""Checks of matchers, sparse and dense."""

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
    match_errors,
    match_points,
)
from mpsfm_core.testing.checks.depth import RAY_TOLERANCE
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

SHIFT_TOLERANCE = 0.2
"""Of ``std_px`` or a pixel of the larger view; taking integers for pixel centres makes 0.5."""
_RIGHT_SHARE = 0.5
"""Of the matches of an easy pair. Ours: nearest neighbours of SIFT 0.99, LighterGlue 0.96."""


def check_matcher_sides(case: ContractCase) -> str:
    """The first column belongs to the first view, the second to the second: matches are where the
    same surface points are."""
    case.require_truth("image", "prepared")
    return _share_right(case, case.example, case.example.partner)


def check_matcher_order(case: ContractCase) -> str:
    """With the views exchanged, the columns are exchanged."""
    case.require_truth("image", "prepared")
    return _share_right(case, case.example.partner, case.example)


def check_matcher_pixel_convention(case: ContractCase) -> str:
    """Dense matches are in COLMAP pixels: between a view and the same one at half the size,
    x is halved exactly; with integers for pixel centres there is a shift."""
    if not case.declares("dense"):
        raise CheckSkipped("sparse: positions are the keypoints'")
    case.require_truth("image", "prepared")
    width, height = case.example.camera.size
    small, large = case.example.sized(width // 2, height // 2), case.example
    matches = match_points(case, small, large, case.run_on_pair(small, large))
    _enough(len(matches))
    residual = matches.points_b - 2 * matches.points_a
    near = np.abs(residual).max(axis=1) < 4 * max(1.0, matches.std_px)
    if near.sum() < MIN_MATCHES:
        raise CheckSkipped(f"only {near.sum()} matches between a view and its reduction")
    shift = np.median(residual[near], axis=0)
    limit = SHIFT_TOLERANCE * max(1.0, matches.std_px)
    text = f"shifted by ({shift[0]:+.2f}, {shift[1]:+.2f}) px"
    if np.abs(shift).max() > limit:
        raise CheckFailed(f"matches between a view and its reduction are {text}")
    return text


def check_matcher_no_features(case: ContractCase) -> None:
    """Views without features have no matches, and that is no error."""
    if not case.declares("sparse"):
        raise CheckSkipped("needs no features")
    a, b = case.example, case.example.partner
    some = case.features_of(a.view, b.view)
    none = _first(some[0], 0), _first(some[1], 0)
    for given in ((some[0], none[1]), (none[0], some[1]), none):
        found = validation.run_matcher(case.spec, case.provider, (a.view, b.view), given)
        if found.sparse is not None and len(found.sparse):
            raise CheckFailed(f"finds {len(found.sparse)} matches where a view has no features")


def check_matcher_few_features(case: ContractCase) -> None:
    """One or two features a view give an answer."""
    if not case.declares("sparse"):
        raise CheckSkipped("needs no features")
    a, b = case.example, case.example.partner
    some = case.features_of(a.view, b.view)
    for count_a, count_b in ((1, 1), (2, 1), (1, len(some[1]))):
        given = _first(some[0], count_a), _first(some[1], count_b)
        validation.run_matcher(case.spec, case.provider, (a.view, b.view), given)


def check_matcher_scores(case: ContractCase) -> str:
    """Scores tell good matches from bad ones: right matches have a higher mean score than wrong
    ones, where there are both."""
    case.require_truth("image", "prepared")
    a, b = case.example, case.example.partner
    matches = match_points(case, a, b, case.run(a))
    _enough(len(matches))
    right = match_errors(a, b, matches) < MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    if min(right.sum(), (~right).sum()) < MIN_MATCHES:
        return f"{right.sum()} right and {(~right).sum()} wrong matches: too few to compare"
    means = matches.scores[right].mean(), matches.scores[~right].mean()
    if means[0] < means[1]:
        raise CheckFailed(f"right matches score {means[0]:.2f}, wrong ones {means[1]:.2f}")
    return f"right matches score {means[0]:.2f}, wrong ones {means[1]:.2f}"


def check_matcher_pair_depth(case: ContractCase) -> str:
    """Pair depth is z, of view a in ``depth_a`` and of view b in ``depth_b``."""
    if not case.declares("pair-depth"):
        raise CheckSkipped("does not declare 'pair-depth'")
    case.require_truth("painted", "prepared")
    a, b = case.example, case.example.partner
    depth = case.run(a).depth
    for prior, example in ((depth.depth_a, a), (depth.depth_b, b)):
        power = map_errors.estimate_ray_exponent(prior, example)
        if abs(power) > RAY_TOLERANCE:
            raise CheckFailed(f"depth goes as z * (ray length / z) ** {power:.2f}")
    error = max(_depth_error(depth.depth_a, a), _depth_error(depth.depth_b, b))
    if max(_depth_error(depth.depth_a, b), _depth_error(depth.depth_b, a)) < 0.5 * error:
        raise CheckFailed("depth: the two sides are exchanged")
    if error > DEPTH_TOLERANCE:
        raise CheckFailed(f"depth has a relative error of {error:.2g}")
    return f"relative error {error:.2g}"


CHECKS = (
    check_matcher_sides,
    check_matcher_order,
    check_matcher_pixel_convention,
    check_matcher_no_features,
    check_matcher_few_features,
    check_matcher_scores,
    check_matcher_pair_depth,
)


def _share_right(case: ContractCase, a: Example, b: Example) -> str:
    matches = match_points(case, a, b, case.run_on_pair(a, b))
    _enough(len(matches))
    limit = MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    right = float((match_errors(a, b, matches) < limit).mean())
    if right < _RIGHT_SHARE:
        exchanged = replace(matches, points_a=matches.points_b, points_b=matches.points_a)
        swapped = float((match_errors(a, b, exchanged) < limit).mean())
        reason = ": the two sides are exchanged" if swapped > 2 * right else ""
        raise CheckFailed(f"only {right:.0%} of {len(matches)} matches are right{reason}")
    return f"{right:.0%} of {len(matches)} matches are right"


def _enough(count: int) -> None:
    if count < MIN_MATCHES:
        raise CheckFailed(f"finds only {count} matches between views that overlap by 90 %")


def _depth_error(prior: DepthPrior, example: Example) -> float:
    return map_errors.error_quantile(
        map_errors.log_errors(prior, example, any_scale=not prior.metric)
    )


def _first(features: Features, count: int) -> Features:
    return Features(
        features.keypoints[:count],
        features.descriptors[:count],
        None if features.scores is None else features.scores[:count],
        None if features.scales is None else features.scales[:count],
        features.std_px,
    )
