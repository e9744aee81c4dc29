"""Checks of multi-view providers; those of depth maps apply to each of theirs as well."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import DepthPrior, Float64, MultiViewPrior
from mpsfm_core.geometry import (
    angle_between_deg,
    compose,
    invert,
    pixel_centers,
    rays,
    rotation_angle_deg,
    transform,
)
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.accuracy import DEPTH_TOLERANCE, require_small_shift
from mpsfm_core.testing.checks import depth as checks_depth
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

TURN_TOLERANCE_DEG = 1.0
"""Of the turn between two views. Ours: the views of the check are 4 and 8 degrees apart, so that an
inverted or mirrored pose is off by 8 and more."""
STEP_TOLERANCE = 0.1
"""Of the step between two views, in terms of its length: twice what depth may be off."""
FOCAL_TOLERANCE = 0.1
"""Of a focal length that the provider can know. A network's own grid instead of the view's, or one
side for the other, makes 0.25 and more here."""
_ENLARGED = (1.5, 2.7)
"""Focal length at twice the size over that at the size itself, for a network that guesses."""


def check_multiview_order(case: ContractCase) -> None:
    """The answer has the order of the views: with the views exchanged, the maps are exchanged."""
    case.require_truth("painted", "prepared", "image")
    examples = _group(case)[::-1]
    group = case.run_on_group(*examples)
    right = max(map(_spread, group.depth, examples))
    if max(map(_spread, group.depth[::-1], examples)) < 0.5 * right:
        raise CheckFailed("the maps come in another order than the views")


def check_multiview_own_axis(case: ContractCase) -> str:
    """The depth of each view is along its own optical axis, not along that of the first."""
    case.require_truth("painted", "prepared", "image")
    examples = _group(case)
    group = case.run_on_group(*examples)
    errors = list(map(_spread, group.depth, examples))
    if max(errors) > DEPTH_TOLERANCE:
        first = [
            _spread_of(p, e, _z_of_first(e, examples[0], p.shape))
            for p, e in _pairs(group, examples)
        ]
        reason = ": it is z of the first view" if max(first) < 0.5 * max(errors) else ""
        raise CheckFailed(
            f"the depth of view {int(np.argmax(errors)) + 1} of {len(errors)} is not proportional "
            f"to its z, relative error {max(errors):.2g}{reason}"
        )
    return f"relative error {max(errors):.2g}"


def check_multiview_one_unit(case: ContractCase) -> str:
    """The maps of a group share one unit: the mapper gives them one scale."""
    case.require_truth("painted", "prepared", "image")
    examples = _group(case)
    factors = _log_factors(case.run_on_group(*examples), examples)
    spread = float(np.ptp(factors))
    if spread > DEPTH_TOLERANCE:
        raise CheckFailed(f"the maps of one group differ in their unit, by {np.expm1(spread):.0%}")
    return f"units differ by {np.expm1(spread):.1%}"


def check_multiview_poses(case: ContractCase) -> str:
    """Poses are ``cam_from_group``, of cameras that look along z with y down."""
    poses, examples = _poses(case)
    worst = 0.0
    for index in range(1, len(examples)):
        found, true = _relative(poses, index), _relative(_true_poses(examples), index)
        turn = _turn(found, true)
        if turn > TURN_TOLERANCE_DEG:
            inverted = _turn(_relative(np.array([_inverse(p) for p in poses]), index), true)
            reason = ": they are group_from_cam" if inverted < TURN_TOLERANCE_DEG else ""
            raise CheckFailed(f"the turn between two views is off by {turn:.1f} degrees{reason}")
        if angle_between_deg(found[1], true[1]) > 10 * TURN_TOLERANCE_DEG:
            raise CheckFailed("the step from one view to the next goes another way")
        worst = max(worst, turn)
    return f"off by {worst:.2g} degrees"


def check_multiview_pose_unit(case: ContractCase) -> str:
    """The lengths of poses are in the unit of depth."""
    poses, examples = _poses(case)
    unit = float(np.exp(np.median(_log_factors(case.run_on_group(*examples), examples))))
    true = _relative(_true_poses(examples), len(examples) - 1)[1]
    found = _relative(poses, len(examples) - 1)[1]
    factor = float(np.linalg.norm(found) / np.linalg.norm(true)) / unit
    if abs(np.log(factor)) > STEP_TOLERANCE:
        raise CheckFailed(f"steps between views are {factor:.3g} times as long as depth says")
    return f"factor {factor:.3f}"


def check_multiview_intrinsics(case: ContractCase) -> str:
    """Intrinsics are in pixels of each view, not of the network's grid or of another view."""
    if not case.declares("proposes-intrinsics"):
        raise CheckSkipped("does not declare 'proposes-intrinsics'")
    width, height = case.example.camera.size
    examples = (case.example, case.example.sized(2 * width, 2 * height))
    found = case.run_on_group(*examples).intrinsics
    assert found is not None  # the validator saw to it
    if case.truth_source == "none":
        ratio = float(found[1, 0] / found[0, 0])
        if not _ENLARGED[0] < ratio < _ENLARGED[1]:
            raise CheckFailed(f"the focal length grows {ratio:.2g} times in a view twice as large")
        return "whether they are right is not known"
    true = np.array([example.camera.params for example in examples])
    off = np.abs(np.log(np.maximum(found, 1e-12) / true)).max(axis=0)
    for name, error in zip(("fx", "fy", "cx", "cy"), off.tolist(), strict=True):
        if error > FOCAL_TOLERANCE:
            raise CheckFailed(f"{name} is {np.expm1(error):.0%} off")
    return f"off by {np.expm1(off.max()):.1%}"


def check_multiview_alone(case: ContractCase) -> None:
    """One view is a group too: a photo that shares nothing with others is shown alone."""
    case.run_on_group(case.example)


def check_multiview_sizes(case: ContractCase) -> str:
    """Views of different sizes, high ones beside wide ones, are answered, each on its place."""
    width, height = case.example.camera.size
    examples = (
        case.example,
        case.example.partner.sized(height, width),
        case.example.sized(149, 107),
    )
    group = case.run_on_group(*examples)
    if case.truth_source == "none":
        return "whether it is right is not known"
    for prior, example in _pairs(group, examples):
        error = _spread(prior, example)
        if error > DEPTH_TOLERANCE:
            size = "{} x {}".format(*example.camera.size)
            raise CheckFailed(f"the {size} view beside others has a relative error of {error:.2g}")
        require_small_shift(
            case, example, map_errors.estimate_depth_shift(prior, example), prior.shape
        )
    return ""


CHECKS = (
    *checks_depth.OF_MAPS,
    check_multiview_order,
    check_multiview_own_axis,
    check_multiview_one_unit,
    check_multiview_poses,
    check_multiview_pose_unit,
    check_multiview_intrinsics,
    check_multiview_alone,
    check_multiview_sizes,
)


def _group(case: ContractCase) -> tuple[Example, ...]:
    return case.example, case.example.partner, case.example.partner.partner


def _pairs(group: MultiViewPrior, examples: tuple[Example, ...]) -> list[tuple[DepthPrior, Example]]:
    return list(zip(group.depth, examples, strict=True))


def _spread(prior: DepthPrior, example: Example) -> float:
    """Relative error after one factor, of 80 % of the pixels."""
    return map_errors.error_quantile(map_errors.log_errors(prior, example, any_scale=True))


def _spread_of(prior: DepthPrior, example: Example, expected: Float64) -> float:
    where = map_errors.select_comparable(prior.valid, example.truth(prior.shape)) & (expected > 0)
    error = np.log(prior.depth[where] / expected[where])
    return map_errors.error_quantile(error - np.median(error))


def _z_of_first(example: Example, first: Example, shape: tuple[int, int]) -> Float64:
    """How far in front of the first view the points lie that a view sees, on a grid over it."""
    rows, columns = shape
    grid = rays(example.camera.resized(columns, rows), pixel_centers(columns, rows))
    points = grid * example.truth(shape).depth[..., None]
    relative = compose(_split(first.pose), invert(*_split(example.pose)))
    z: Float64 = transform(*relative, points)[..., 2]
    return z


def _log_factors(group: MultiViewPrior, examples: tuple[Example, ...]) -> list[float]:
    errors = [map_errors.log_errors(p, e, any_scale=False) for p, e in _pairs(group, examples)]
    return [float(np.median(error)) for error in errors]


def _poses(case: ContractCase) -> tuple[Float64, tuple[Example, ...]]:
    if not case.declares("proposes-poses"):
        raise CheckSkipped("does not declare 'proposes-poses'")
    case.require_truth("prepared", "image")
    examples = _group(case)
    poses = case.run_on_group(*examples).poses
    assert poses is not None  # the validator saw to it
    return poses, examples


def _true_poses(examples: tuple[Example, ...]) -> Float64:
    return np.array([example.pose for example in examples])


def _split(pose: Float64) -> tuple[Float64, Float64]:
    return pose[:, :3], pose[:, 3]


def _inverse(pose: Float64) -> Float64:
    return np.column_stack(invert(*_split(pose)))


def _relative(poses: Float64, index: int) -> tuple[Float64, Float64]:
    """Of a view from the first one."""
    return compose(_split(poses[index]), invert(*_split(poses[0])))


def _turn(a: tuple[Float64, Float64], b: tuple[Float64, Float64]) -> float:
    return float(rotation_angle_deg(a[0].T @ b[0]))
