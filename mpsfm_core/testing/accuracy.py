"""Comparison of a provider's output with the ground truth, for each kind of provider.

Each tolerance is several times larger than the error of a correct provider on synthetic views, and
several times smaller than the error of the mistakes to detect.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mpsfm_core.data import Bool, DenseMatches, DepthPrior, Features, Float64, PairMatches
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.contract_case import ContractCase, first_depth
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.map_errors import MapShift
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped, CheckUndecided
from mpsfm_core.testing.std_errors import require_depth_std, require_normals_std

DEPTH_TOLERANCE = 0.05
"""Tolerance for the 80 % quantile of the relative depth error. Correct providers have a relative
depth error of 0.005 on synthetic views. A wrong unit, or ray length instead of z-depth, causes a
far larger depth error."""
NORMALS_TOLERANCE_DEG = 5.0
"""Tolerance in degrees for the 80 % quantile of the angle between predicted and true normals. On
synthetic views the normals of correct providers are off by 0.7 degrees, and planes fitted to true
depth by 1 degree."""
MASK_TOLERANCE = 0.05
"""Largest accepted ratio of wrong mask pixels, among pixels at least two pixels away from the
border of a surface."""
_MASK_SHIFT_PX = 6
"""Largest shift in pixels of the true mask to which a provider's mask is compared."""
_MASK_GAIN = 0.7
"""Ratio of wrong pixels of a mask after and before shifting the true mask, below which the mask
counts as shifted."""
_MIN_HOLE_PIXELS = 100
MATCH_TOLERANCE_STD = 3.0
"""Largest accepted median distance of matches from their true positions, in multiples of the
keypoint std ``std_px`` or of one pixel, whichever is larger."""
SHIFT_TOLERANCE_PX = 0.25
"""Largest accepted shift of a depth or normal map, in pixels of the view, or of the map if its
pixels are larger. Integer pixel centers shift a map by 0.5 pixels; correct resizing to half and a
quarter of the size shifts a map by less than 0.1."""
_MAX_OUTSIDE_RATIO = 0.02
"""Largest accepted ratio of pixels whose depth differs from that of all surfaces nearby, for a test
network. The ratio is 0 for providers that resize neither view nor depth."""
VALIDITY_TOLERANCE = 0.05
"""Where a view shows no surface, such as sky, a depth map should be invalid. This is the largest
accepted ratio of such pixels that are valid, without pixels near edges. Padding and blur in a
network make some of them valid."""
MAX_INVALID_RATIO = 0.4
"""Largest accepted ratio of pixels with a surface that are invalid. A provider may reject pixels
that are distant, near an edge or uncertain."""
MIN_MATCHES = 8
"""Smallest number of matches whose accuracy is compared with the ground truth."""


def compare_with_truth(case: ContractCase, example: Example, answer: Any) -> str:
    """Compare the output of a provider with the ground truth.

    Args:
        case: Provider under test.
        example: Synthetic view from which the provider computed the output.
        answer: Validated answer.

    Returns:
        Text with the measured error, or with the remark that the ground truth is unknown.

    Raises:
        CheckFailed: the error exceeds the tolerance of the provider's kind.
    """
    compare = case.description.compare
    if compare is not None and case.truth_source != "none":
        return compare(case, example, answer)
    unknown = case.truth_source == "none" or case.kind in ("features", "retrieval")
    if unknown or (case.kind == "matcher" and case.truth_source == "painted"):
        return "valid output; accuracy not measured without ground truth"
    if case.kind in ("depth", "multiview"):
        answer = first_depth(answer)
        scale_free = not answer.metric or case.declares("intrinsics-aware")
        errors = map_errors.log_errors(answer, example, any_scale=scale_free)
        quantile = map_errors.error_quantile(errors)
        error = _require_at_most("relative error", quantile, DEPTH_TOLERANCE)
        shift = map_errors.estimate_depth_shift(answer, example)
        if case.truth_source in ("painted", "prepared"):
            require_local_depth(case, example, answer)
            _require_valid_surfaces(answer, example)
            if case.spec.kind != "wrapper":
                require_depth_std(answer, example)
        return f"{error}, {_describe_shift(case, example, shift, answer)}"
    if case.kind == "normals":
        quantile = map_errors.error_quantile(map_errors.angle_errors_deg(answer, example))
        error = _require_at_most("angle in degrees", quantile, NORMALS_TOLERANCE_DEG)
        shift = map_errors.estimate_normals_shift(answer, example)
        if case.spec.kind != "wrapper" and case.truth_source in ("painted", "prepared"):
            require_normals_std(answer, example)
        return f"{error}, {_describe_shift(case, example, shift, answer)}"
    if case.kind == "mask":
        truth = example.truth()
        wrong = (answer != truth.valid)[truth.edge_free]
        wrong_ratio = float(wrong.mean()) if wrong.size else 0.0
        if wrong_ratio > MASK_TOLERANCE:
            raise CheckFailed(f"in the mask {wrong_ratio:.0%} of the pixels have the wrong value")
        _require_mask_not_shifted(answer, example)
        return f"{wrong_ratio:.1%} of the pixels have the wrong value"
    return _compare_matches(case, example, answer)


def _require_valid_surfaces(prior: DepthPrior, example: Example) -> None:
    """Require that depth is valid at most pixels with a surface, and at few others."""
    truth = example.truth(prior.shape)
    empty = truth.edge_free & ~truth.valid
    if empty.any() and prior.valid[empty].mean() > VALIDITY_TOLERANCE:
        raise CheckFailed(
            f"{prior.valid[empty].mean():.0%} of the pixels without surface are valid"
        )
    if truth.smooth.any() and 1 - prior.valid[truth.smooth].mean() > MAX_INVALID_RATIO:
        raise CheckFailed(
            f"{1 - prior.valid[truth.smooth].mean():.0%} of the pixels with a surface are not valid"
        )


def require_local_depth(case: ContractCase, example: Example, prior: DepthPrior) -> str:
    """Require that the depth of nearly all valid pixels occurs nearby in the view.

    Raises:
        CheckFailed: too many pixels have a depth that no surface nearby has.
    """
    is_painted = case.truth_source == "painted"
    ratio = map_errors.measure_outside_local_range(
        prior,
        example,
        any_scale=not prior.metric or case.declares("intrinsics-aware"),
        mixes_with_zero=is_painted,
    )
    limit = _MAX_OUTSIDE_RATIO if is_painted else _MAX_OUTSIDE_RATIO / 4
    if ratio > limit:
        raise CheckFailed(f"{ratio:.1%} of the valid pixels have a depth that no surface near has")
    return f"{ratio:.1%} of the valid pixels have a depth that no surface near has"


def require_small_shift(
    case: ContractCase, example: Example, shift: MapShift, shape: tuple[int, int]
) -> str:
    """Require that the content of a map is not shifted relative to the view.

    For providers with ``truth_source="image"`` only the shift at the center of the map is checked.
    Normals estimated from pixel neighborhoods are biased on curved surfaces, which has the same
    effect as a stretched map.

    Args:
        case: Provider under test.
        example: Synthetic view that shows the true content of the map.
        shift: Estimated shift.
        shape: Height and width of the depth or normal map.

    Returns:
        Text with the measured shift of the map in pixels.

    Raises:
        CheckFailed: the shift exceeds :data:`SHIFT_TOLERANCE_PX`.
        CheckSkipped: the map is too coarse to measure a shift.
    """
    width, height = example.camera.size
    map_pixel_px = max(1.0, width / shape[1], height / shape[0])
    limit = SHIFT_TOLERANCE_PX * map_pixel_px
    if shift.std > limit / 2:
        raise CheckSkipped(f"a map of {shape[1]} x {shape[0]} is too coarse to measure a shift")
    text = f"shifted by ({shift.x:+.2f}, {shift.y:+.2f}) px"
    central = max(abs(shift.x), abs(shift.y))
    largest = central if case.truth_source == "image" else shift.largest
    if largest > limit:
        border = f"and by another ({shift.stretch_x:+.2f}, {shift.stretch_y:+.2f}) px at the border"
        raise CheckFailed(
            f"the content of the map is {text} of the view {border}; {limit:.2f} px are allowed"
        )
    return text


def match_points(case: ContractCase, a: Example, b: Example, answer: PairMatches) -> DenseMatches:
    """Return matches as pixel coordinates, which for sparse matches are their keypoints."""
    features = None if answer.dense is not None else case.extract_features(a.view, b.view)
    return point_matches(answer, features)


def point_matches(answer: PairMatches, features: tuple[Features, Features] | None) -> DenseMatches:
    """Return matches as pixel coordinates, which for sparse matches are their keypoints."""
    if answer.dense is not None:
        return answer.dense
    assert answer.sparse is not None and features is not None
    rows = answer.sparse.indices
    return DenseMatches(
        features[0].keypoints[rows[:, 0]],
        features[1].keypoints[rows[:, 1]],
        answer.sparse.scores,
        max(f.std_px for f in features),
    )


def match_errors_px(a: Example, b: Example, matches: DenseMatches) -> Float64:
    """Return the distance (n,) in pixels of each match from its true position in view b.

    The error of a match is infinite if view b does not show the matched surface point.
    """
    true = a.correspondences(b, matches.points_a)
    distance = np.linalg.norm(matches.points_b - true.xy_b, axis=1)
    errors: Float64 = np.where(true.visible, distance, np.inf)
    return errors


def require_correct_matches(case: ContractCase, answer: PairMatches) -> None:
    """Require that most matches of the example view and its partner are correct.

    Raises:
        CheckFailed: more than half of the matches are wrong.
    """
    if case.truth_source not in ("image", "prepared"):
        return
    matches = match_points(case, case.example, case.example.partner, answer)
    limit = MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    is_wrong = match_errors_px(case.example, case.example.partner, matches) > limit
    if len(matches) >= MIN_MATCHES and is_wrong.mean() > 0.5:
        raise CheckFailed(f"{is_wrong.mean():.0%} of {len(matches)} matches are wrong")


def _compare_matches(case: ContractCase, example: Example, answer: PairMatches) -> str:
    partner = example.partner
    matches = match_points(case, example, partner, answer)
    if len(matches) < MIN_MATCHES:
        raise CheckUndecided(f"only {len(matches)} matches, too few to compare with the truth")
    limit = MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    median = float(np.median(match_errors_px(example, partner, matches)))
    return _require_at_most("median distance in pixels", median, limit)


def _require_mask_not_shifted(mask: Bool, example: Example) -> None:
    """Require that no shifted true mask fits the output mask much better at the holes.

    A mask that excludes a margin around each hole fits the true mask best. A mask of a coarse
    network fits the true and the shifted masks about equally well.
    """
    truth = example.truth().valid
    hole = replace(example, holes=False).truth().valid & ~truth
    num_pixels = int(hole.sum())
    steps = range(-_MASK_SHIFT_PX, _MASK_SHIFT_PX + 1)
    if num_pixels < _MIN_HOLE_PIXELS:
        return
    near = np.zeros_like(hole)
    for y in steps:
        for x in steps:
            near |= np.roll(hole, (y, x), axis=(0, 1))
    # Exclude pixels near the sky, because a shifted copy of the mask also shifts the border of the
    # sky.
    near &= replace(example, holes=False).truth().edge_free
    wrong = {
        (x, y): int((mask != np.roll(truth, (y, x), axis=(0, 1)))[near].sum())
        for x in steps
        for y in steps
    }
    x, y = min(wrong, key=lambda step: (wrong[step], abs(step[0]) + abs(step[1])))
    gain = wrong[0, 0] - wrong[x, y]
    if wrong[x, y] < _MASK_GAIN * wrong[0, 0] and gain > np.sqrt(num_pixels):
        raise CheckFailed(f"the mask is shifted by ({x:+d}, {y:+d}) px")


def _describe_shift(case: ContractCase, example: Example, shift: MapShift, answer: Any) -> str:
    try:
        return require_small_shift(case, example, shift, answer.shape)
    except CheckSkipped as skipped:
        return str(skipped)


def _require_at_most(quantity: str, value: float, limit: float) -> str:
    if not value <= limit:
        raise CheckFailed(f"the {quantity} is {value:.3g}, at most {limit:.3g} is allowed")
    return f"{quantity} {value:.2g}"
