"""Whether an answer is right, by kind, where the provider can know the truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpsfm_core.data import DenseMatches, Features, Float64, PairMatches
from mpsfm_core.testing import measure
from mpsfm_core.testing.case import Case
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.outcome import CheckFailed

DEPTH_TOLERANCE = 0.05
"""Median relative error. Ours: a painted view has 0.3 %, and interpolation adds as much; a
stand-in of a network that resizes has room, a wrong unit or quantity has not."""
NORMALS_TOLERANCE_DEG = 5.0
"""Median angle. Ours: a painted view has 0.3 degrees; planes fitted to exact depth 0.5."""
MASK_TOLERANCE = 0.05
"""Share of pixels, two pixels and more away from the border of the surface."""
MATCH_TOLERANCE = 3.0
"""Median distance from the true position, in ``std_px``; at least 3 pixels."""
FEWEST_MATCHES = 8


def judge(case: Case, example: Example, answer: Any) -> str:
    """Raise ``CheckFailed`` unless the answer is right; a remark if nobody can tell."""
    unknown = case.knows == "nothing" or case.kind in ("features", "retrieval")
    if unknown or (case.kind == "matcher" and case.knows == "painted"):
        return "answered; whether it is right is not known"
    if case.kind == "depth":
        scale_free = not answer.metric or case.can("intrinsics-aware")
        errors = measure.log_errors(answer, example, any_scale=scale_free)
        return _limit("median relative error", np.abs(errors), DEPTH_TOLERANCE)
    if case.kind == "normals":
        angles = measure.angles_deg(answer, example)
        return _limit("median angle in degrees", angles, NORMALS_TOLERANCE_DEG)
    if case.kind == "mask":
        truth = example.truth()
        wrong = (answer != truth.valid)[truth.edge_free]
        share = float(wrong.mean()) if wrong.size else 0.0
        if share > MASK_TOLERANCE:
            raise CheckFailed(f"{share:.0%} of the pixels have the wrong value")
        return f"{share:.1%} of the pixels have the wrong value"
    return _judge_matches(case, example, answer)


def match_points(case: Case, a: Example, b: Example, answer: PairMatches) -> DenseMatches:
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


def _judge_matches(case: Case, example: Example, answer: PairMatches) -> str:
    other = example.partner
    matches = match_points(case, example, other, answer)
    if len(matches) < FEWEST_MATCHES:
        return f"only {len(matches)} matches; whether they are right is not known"
    limit = MATCH_TOLERANCE * max(1.0, matches.std_px)
    return _limit("median distance in pixels", match_errors(example, other, matches), limit)


def _limit(what: str, errors: Float64, limit: float) -> str:
    median = float(np.median(errors))
    if not median <= limit:
        raise CheckFailed(f"{what} {median:.3g}, at most {limit:.3g} is allowed")
    return f"{what} {median:.2g}"
