"""Tests of the pose AUC with hand-computed cases and an independent implementation."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from mpsfm_core.evaluation.pose_auc import (
    CONVENTIONS,
    Pose,
    exact_area,
    histogram_area,
    interpolated_area,
    pose_auc,
    pose_errors_deg,
)

PAPER, COLMAP, VGGT = CONVENTIONS["paper"], CONVENTIONS["colmap"], CONVENTIONS["vggt"]


def rotated_y(degrees: float, center: tuple[float, float, float]) -> Pose:
    rotation = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return rotation, -rotation @ np.array(center)


def random_poses(rng: np.random.Generator, count: int) -> dict[str, Pose]:
    rotations = Rotation.random(count, rng=rng).as_matrix()
    return {f"{i}.jpg": (rotations[i], rng.normal(size=3)) for i in range(count)}


def disturbed(rng: np.random.Generator, truth: dict[str, Pose]) -> dict[str, Pose]:
    """Return poses with errors of 0.1 to 50 degrees in another frame; some are missing."""
    frame, scale = Rotation.random(rng=rng).as_matrix(), rng.uniform(0.1, 10)
    poses = {}
    for name, (rotation, translation) in truth.items():
        size = np.radians(10 ** rng.uniform(-1, 1.7))
        turn = Rotation.from_rotvec(rng.normal(size=3) * size).as_matrix()
        shifted = scale * (translation + size * rng.normal(size=3))
        if rng.random() > 0.15:
            poses[name] = (turn @ rotation @ frame, shifted)
    return poses


def independent_errors(
    estimated: dict[str, Pose], truth: dict[str, Pose], ordered: bool, folded: bool
) -> list[float]:
    """Compute pose errors independently, for each pair with 4 x 4 matrices and quaternions."""

    def matrix(pose: Pose) -> np.ndarray:
        return np.block([[pose[0], pose[1][:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])

    def relative(poses: dict[str, Pose], a: str, b: str) -> np.ndarray:
        return matrix(poses[b]) @ np.linalg.inv(matrix(poses[a]))

    pairs = itertools.permutations(truth, 2) if ordered else itertools.combinations(truth, 2)
    errors = []
    for a, b in pairs:
        if a not in estimated or b not in estimated:
            errors.append(180.0)
            continue
        have, want = relative(estimated, a, b), relative(truth, a, b)
        turn = Rotation.from_matrix(have[:3, :3]) * Rotation.from_matrix(want[:3, :3]).inv()
        t_have, t_want = have[:3, 3], want[:3, 3]
        cosine = t_have @ t_want / np.linalg.norm(t_have) / np.linalg.norm(t_want)
        direction = np.degrees(np.arccos(np.clip(abs(cosine) if folded else cosine, -1, 1)))
        errors.append(max(np.degrees(turn.magnitude()), direction))
    return errors


def independent_exact(errors: list[float], threshold: int) -> float:
    """Integrate the recall curve, a step function, segment by segment."""
    edges = [0.0, *sorted(e for e in errors if e < threshold), float(threshold)]
    recalls = [sum(e <= left for e in errors) / len(errors) for left in edges[:-1]]
    areas = [r * (b - a) for r, a, b in zip(recalls, edges[:-1], edges[1:], strict=True)]
    return sum(areas) / threshold


def independent_interpolated(errors: list[float], threshold: int) -> float:
    """Integrate the recall curve by trapezoids like COLMAP's benchmark script."""
    xs, ys = [0.0], [0.0]
    for rank, error in enumerate(sorted(errors)):
        if error <= threshold:
            xs.append(error)
            ys.append((rank + 1) / len(errors))
    return float(np.trapezoid([*ys, ys[-1]], x=[*xs, threshold]) / threshold)


def independent_histogram(errors: list[float], threshold: int) -> float:
    recalls = [
        sum(e < end or (e == end == threshold) for e in errors) / len(errors)
        for end in range(1, threshold + 1)
    ]
    return sum(recalls) / threshold


@pytest.mark.parametrize(
    ("convention", "area"),
    [
        (PAPER, independent_exact),
        (COLMAP, independent_interpolated),
        (VGGT, independent_histogram),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_pose_auc_matches_independent_implementation(convention, area) -> None:
    rng = np.random.default_rng(7)
    for _ in range(200):
        truth = random_poses(rng, int(rng.integers(2, 6)))
        estimated = disturbed(rng, truth)
        errors = pose_errors_deg(estimated, truth, convention)
        expected = independent_errors(estimated, truth, convention.ordered, convention.folded)
        np.testing.assert_allclose(errors, expected, atol=2e-5)
        for threshold, value in pose_auc(errors, convention).items():
            assert value == pytest.approx(area(list(errors), threshold), abs=1e-12)


def test_pose_errors_match_hand_computed_case() -> None:
    # Three cameras in a row with a distance of 1 m look along z. The estimated third camera is
    # rotated by 2 degrees about y. The estimated second camera is 1 m in front of the first instead
    # of 1 m to the right.
    truth = {name: rotated_y(0, (x, 0, 0)) for x, name in enumerate("abc")}
    estimated = dict(truth, b=rotated_y(0, (0, 0, 1)), c=rotated_y(2, (2, 0, 0)))
    errors = pose_errors_deg(estimated, truth, PAPER)
    # The direction between a and b has an error of 90 degrees in both orders. The rotation between
    # a and c has an error of 2 degrees, and so has the direction to a in the frame of c. The
    # baseline between b and c is (2, 0, -1) instead of (1, 0, 0). Its error is atan(1/2) in the
    # frame of b, and 2 degrees more in the frame of c.
    tilt = np.degrees(np.arctan(0.5))
    expected = {"ab": 90, "ac": 2, "ba": 90, "bc": tilt + 2, "ca": 2, "cb": tilt}
    assert errors == pytest.approx(list(expected.values()), abs=1e-9)
    auc = pose_auc(errors, PAPER)
    assert auc[1] == 0
    assert auc[5] == pytest.approx((2 * (1 - 2 / 5)) / 6)
    assert auc[20] == pytest.approx((2 * (1 - 2 / 20)) / 6)


def test_areas_match_hand_computed_values() -> None:
    errors = np.array([0.5, 1.0, 1.5, 2.0, 180.0])
    assert exact_area(errors, 2) == pytest.approx((1.5 + 1.0 + 0.5 + 0.0) / 5 / 2)
    # The triangle and trapezoids have the area 0.05 + 0.15 + 0.25 + 0.35 = 0.8 over 2 degrees.
    assert interpolated_area(errors, 2) == pytest.approx(0.4)
    # The recall is 0.2 below 1 degree and 0.8 up to 2 degrees.
    assert histogram_area(errors, 2) == pytest.approx((0.2 + 0.8) / 2)


def test_exact_area_integrates_recall_curve() -> None:
    errors = np.random.default_rng(0).exponential(4, size=40)
    for threshold in (1, 5, 20):
        inside = sorted(errors[errors < threshold])
        integral, _ = quad(lambda x: (errors <= x).mean(), 0, threshold, points=inside, limit=500)
        assert exact_area(errors, threshold) == pytest.approx(integral / threshold, abs=1e-9)


def test_pose_auc_is_invariant_to_similarity() -> None:
    rng = np.random.default_rng(1)
    truth = random_poses(rng, 6)
    frame = Rotation.random(rng=rng).as_matrix()
    moved = {name: (r @ frame, 3.7 * (t + r @ [1.0, 2.0, 3.0])) for name, (r, t) in truth.items()}
    for convention in CONVENTIONS.values():
        auc = pose_auc(pose_errors_deg(moved, truth, convention), convention)
        assert list(auc.values()) == pytest.approx([1, 1, 1], abs=1e-6)


def test_folded_convention_ignores_translation_sign() -> None:
    truth = {"a": rotated_y(0, (0, 0, 0)), "b": rotated_y(0, (1, 0, 0))}
    mirrored = {"a": rotated_y(0, (0, 0, 0)), "b": rotated_y(0, (-1, 0, 0))}
    assert pose_errors_deg(mirrored, truth, PAPER) == pytest.approx([0, 0])
    assert pose_errors_deg(mirrored, truth, COLMAP) == pytest.approx([180, 180])


def test_unregistered_image_fails_its_pairs() -> None:
    truth = random_poses(np.random.default_rng(2), 4)
    estimated = {name: truth[name] for name in list(truth)[:3]}
    errors = pose_errors_deg(estimated, truth, PAPER)
    assert (errors == 180).sum() == 6
    assert pose_auc(errors, PAPER)[5] == pytest.approx(0.5, abs=1e-6)


def test_pose_auc_without_registration_is_zero() -> None:
    truth = random_poses(np.random.default_rng(3), 3)
    errors = pose_errors_deg({}, truth, VGGT)
    assert list(errors) == [180.0] * 3
    assert pose_auc(errors, VGGT) == {1: 0.0, 5: 0.0, 20: 0.0}
    with pytest.raises(ValueError, match="no image pairs"):
        pose_auc(np.zeros(0), PAPER)
