"""Whether an answer is right, by kind, where the provider can know the truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpsfm_core.data import DenseMatches, Features, Float64, PairMatches
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.contract_case import ContractCase, depth_in
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.map_errors import MapShift
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

DEPTH_TOLERANCE = 0.05
"""Relative error of 80 % of the pixels. Ours: a painted view has 0.5 %, and interpolation adds as
much; a stand-in of a network that resizes has room, a wrong unit or quantity has not."""
NORMALS_TOLERANCE_DEG = 5.0
"""Of 80 % of the pixels. Ours: a painted view has 0.7 degrees, planes fitted to exact depth 1."""
MASK_TOLERANCE = 0.05
"""Share of pixels, two pixels and more away from the border of the surface."""
MATCH_TOLERANCE_STD = 3.0
"""Median distance from the true position, in ``std_px``; at least 3 pixels."""
SHIFT_TOLERANCE_PX = 0.25
"""Of the view, or of the map where its pixels are larger. Half of the shift that taking integers
for pixel centres makes. Ours: right resizing stays below 0.1, also at half and a quarter size."""
MIN_MATCHES = 8
"""Fewer say nothing."""


def compare_with_truth(case: ContractCase, example: Example, answer: Any) -> str:
    """Raise ``CheckFailed`` unless the answer is right; a remark if nobody can tell."""
    unknown = case.truth_source == "none" or case.kind in ("features", "retrieval")
    if unknown or (case.kind == "matcher" and case.truth_source == "painted"):
        return "answered; whether it is right is not known"
    if case.kind in ("depth", "multiview"):
        answer = depth_in(answer)
        scale_free = not answer.metric or case.declares("intrinsics-aware")
        errors = map_errors.log_errors(answer, example, any_scale=scale_free)
        error = _limit("relative error", map_errors.error_quantile(errors), DEPTH_TOLERANCE)
        return f"{error}, {_placed(case, example, map_errors.estimate_depth_shift(answer, example), answer)}"
    if case.kind == "normals":
        angles = map_errors.angle_errors_deg(answer, example)
        error = _limit("angle in degrees", map_errors.error_quantile(angles), NORMALS_TOLERANCE_DEG)
        return f"{error}, {_placed(case, example, map_errors.estimate_normals_shift(answer, example), answer)}"
    if case.kind == "mask":
        truth = example.truth()
        wrong = (answer != truth.valid)[truth.edge_free]
        share = float(wrong.mean()) if wrong.size else 0.0
        if share > MASK_TOLERANCE:
            raise CheckFailed(f"{share:.0%} of the pixels have the wrong value")
        return f"{share:.1%} of the pixels have the wrong value"
    return _judge_matches(case, example, answer)


def require_small_shift(
    case: ContractCase, example: Example, shift: MapShift, shape: tuple[int, int]
) -> str:
    """Raise ``CheckFailed`` if a map of this shape is shifted by too much, ``CheckSkipped`` if it
    is too coarse to know.

    For providers that see, only the shift in the centre counts: estimates from neighbourhoods are
    biased where the surface bends, which looks like stretching.
    """
    width, height = example.camera.size
    cell = max(1.0, width / shape[1], height / shape[0])
    limit = SHIFT_TOLERANCE_PX * cell
    if shift.std > limit / 2:
        raise CheckSkipped(f"a map of {shape[1]} x {shape[0]} is too coarse to see a shift")
    text = f"shifted by ({shift.x:+.2f}, {shift.y:+.2f}) px"
    found = max(abs(shift.x), abs(shift.y)) if case.truth_source == "image" else shift.largest
    if found > limit:
        border = f"and by another ({shift.stretch_x:+.2f}, {shift.stretch_y:+.2f}) px at the border"
        raise CheckFailed(f"content is {text} of the view {border}; {limit:.2f} is allowed")
    return text


def match_points(case: ContractCase, a: Example, b: Example, answer: PairMatches) -> DenseMatches:
    """The matches as pairs of positions: the dense ones, or the keypoints of the sparse ones."""
    if answer.dense is not None:
        return answer.dense
    assert answer.sparse is not None
    found: tuple[Features, Features] = case.features_of(a.view, b.view)
    rows = answer.sparse.indices
    return DenseMatches(
        found[0].keypoints[rows[:, 0]],
        found[1].keypoints[rows[:, 1]],
        answer.sparse.scores,
        max(f.std_px for f in found),
    )


def match_errors(a: Example, b: Example, matches: DenseMatches) -> Float64:
    """Distances (n,) in pixels of the matches' points in b from where they belong, infinite where
    b does not show what a shows."""
    true = a.correspondences(b, matches.points_a)
    distance = np.linalg.norm(matches.points_b - true.xy_b, axis=1)
    errors: Float64 = np.where(true.visible, distance, np.inf)
    return errors


def _judge_matches(case: ContractCase, example: Example, answer: PairMatches) -> str:
    other = example.partner
    matches = match_points(case, example, other, answer)
    if len(matches) < MIN_MATCHES:
        return f"only {len(matches)} matches; whether they are right is not known"
    limit = MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    median = float(np.median(match_errors(example, other, matches)))
    return _limit("median distance in pixels", median, limit)


def _placed(case: ContractCase, example: Example, shift: MapShift, answer: Any) -> str:
    try:
        return require_small_shift(case, example, shift, answer.shape)
    except CheckSkipped as skipped:
        return str(skipped)


def _limit(what: str, found: float, limit: float) -> str:
    if not found <= limit:
        raise CheckFailed(f"{what} {found:.3g}, at most {limit:.3g} is allowed")
    return f"{what} {found:.2g}"
