"""Contract checks of multi-view providers, in addition to the checks of depth maps."""

from __future__ import annotations

from dataclasses import replace

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
from mpsfm_core.testing.std_errors import require_depth_std

ROTATION_TOLERANCE_DEG = 1.0
"""Largest accepted error of a predicted relative rotation in degrees. The views of the test are
rotated by 4 and 8 degrees relative to the first, so an inverted or mirrored pose has an error of at
least 8 degrees."""
BASELINE_TOLERANCE = 0.1
"""Largest accepted relative error of the baseline between two views, twice the depth tolerance."""
FOCAL_TOLERANCE = 0.1
"""Largest accepted relative error of a focal length or principal point whose ground truth is known.
A wrong pixel grid or swapped axes cause a relative error of at least 0.25."""
_PRINCIPAL_TOLERANCE_PX = 0.25
"""Largest accepted error of a principal point that a provider reads from a file. Integer pixel
centers cause an error of 0.5 pixels."""
_GROUP_SIZES = (2, 5, 9)
"""Numbers of views in the groups with which multi-view providers are tested."""
_FOCAL_RATIO_RANGE = (1.5, 2.7)
"""Accepted range for the ratio of the focal lengths that a provider estimates for a view of twice
the size and for the original view."""


def check_multiview_order(case: ContractCase) -> None:
    """Require that the output depth maps have the order of the input views."""
    case.require_truth("painted", "prepared", "image")
    examples = _make_group(case)[::-1]
    group = case.run_on_examples(*examples)
    right = max(map(_scale_free_error, group.depth, examples))
    if max(map(_scale_free_error, group.depth[::-1], examples)) < 0.5 * right:
        raise CheckFailed("the order of the maps differs from the order of the views")


def check_multiview_own_axis(case: ContractCase) -> str:
    """Require depth along the optical axis of each view, not of the first view."""
    case.require_truth("painted", "prepared", "image")
    examples = _make_group(case)
    group = case.run_on_examples(*examples)
    errors = list(map(_scale_free_error, group.depth, examples))
    if max(errors) > DEPTH_TOLERANCE:
        first = [
            _median_free_error(p, e, _depth_from_first_view(e, examples[0], p.shape))
            for p, e in _pairs(group, examples)
        ]
        reason = ": it is z of the first view" if max(first) < 0.5 * max(errors) else ""
        raise CheckFailed(
            f"the depth of view {int(np.argmax(errors)) + 1} of {len(errors)} is not proportional "
            f"to its z-depth, relative error {max(errors):.2g}{reason}"
        )
    return f"relative error {max(errors):.2g}"


def check_multiview_one_unit(case: ContractCase) -> str:
    """Require one common unit for all depth maps that are predicted for a group of views.

    The mapper estimates only one metric scale for all depth maps of a group of views.
    """
    case.require_truth("painted", "prepared", "image")
    examples = _make_group(case)
    factors = _log_factors(case.run_on_examples(*examples), examples)
    spread = float(np.ptp(factors))
    if spread > DEPTH_TOLERANCE:
        raise CheckFailed(f"the units of the maps in one group differ by {np.expm1(spread):.0%}")
    return f"units differ by {np.expm1(spread):.1%}"


def check_multiview_poses(case: ContractCase) -> str:
    """Require correct poses ``cam_from_group`` in camera frames with x right, y down, z forward."""
    poses, examples = _predict_poses(case)
    worst = 0.0
    for index in range(1, len(examples)):
        found, true = _relative(poses, index), _relative(_true_poses(examples), index)
        rotation_error = _rotation_error_deg(found, true)
        if rotation_error > ROTATION_TOLERANCE_DEG:
            inverted = _rotation_error_deg(
                _relative(np.array([_inverse(p) for p in poses]), index), true
            )
            reason = ": they are group_from_cam" if inverted < ROTATION_TOLERANCE_DEG else ""
            raise CheckFailed(
                f"the rotation between two views is off by {rotation_error:.1f} degrees{reason}"
            )
        if angle_between_deg(found[1], true[1]) > 10 * ROTATION_TOLERANCE_DEG:
            raise CheckFailed(
                "the translation between two views has another direction than the true one"
            )
        worst = max(worst, rotation_error)
    return f"off by {worst:.2g} degrees"


def check_multiview_pose_unit(case: ContractCase) -> str:
    """Require that predicted translations have the unit of the predicted depth."""
    poses, examples = _predict_poses(case)
    unit = float(np.exp(np.median(_log_factors(case.run_on_examples(*examples), examples))))
    factors = []
    for index in range(1, len(examples)):
        found, true = (_relative(p, index)[1] for p in (poses, _true_poses(examples)))
        factors.append(float(np.linalg.norm(found) / np.linalg.norm(true)) / unit)
    factor = max(factors, key=lambda value: abs(np.log(value)))
    if abs(np.log(factor)) > BASELINE_TOLERANCE:
        raise CheckFailed(
            f"predicted translations are {factor:.3g} times as long as the unit of depth implies"
        )
    return f"factor {factor:.3f}"


def check_multiview_intrinsics(case: ContractCase) -> str:
    """Require predicted intrinsics in pixels of each view.

    The check ``multiview-intrinsics`` detects intrinsics in pixels of the network's input image or
    of another view.
    """
    if not case.declares("proposes-intrinsics"):
        raise CheckSkipped("the provider does not declare 'proposes-intrinsics'")
    width, height = case.example.camera.size
    common = case.example.with_common_camera()
    sizes = ((2 * width, 2 * height), (height, width))
    # Networks that estimate a focal length expect the same angle of view in portrait format.
    examples: tuple[Example, ...] = (common, common.sized(*sizes[0]), common.turned())
    if case.truth_source == "prepared":
        examples = (case.example, *(case.example.sized(*size) for size in sizes))
    found = case.run_on_examples(*examples).intrinsics
    assert found is not None  # The validator requires the predicted intrinsics.
    if case.truth_source == "none":
        ratio = float(found[1, 0] / found[0, 0])
        if not _FOCAL_RATIO_RANGE[0] < ratio < _FOCAL_RATIO_RANGE[1]:
            raise CheckFailed(f"the focal length grows {ratio:.2g} times in a view twice as large")
        return "the true intrinsics are unknown"
    true = np.array([example.camera.params for example in examples])
    off = np.abs(np.log(np.maximum(found, 1e-12) / true)).max(axis=0)
    for name, error in zip(("fx", "fy", "cx", "cy"), off.tolist(), strict=True):
        if error > FOCAL_TOLERANCE:
            raise CheckFailed(f"the predicted {name} is {np.expm1(error):.0%} off")
    if case.truth_source == "prepared":
        shift = (found - true)[:, 2:]
        if np.abs(shift).max() > _PRINCIPAL_TOLERANCE_PX:
            raise CheckFailed(
                f"the predicted principal point is up to {np.abs(shift).max():.2g} px off"
            )
    return f"off by {np.expm1(off.max()):.1%}"


def check_multiview_group_sizes(case: ContractCase) -> str:
    """Require accurate output for groups of 2, 5 and 9 views of different sizes.

    A group in a reconstruction is an image with the images that overlap it.
    """
    views, width, height = [case.example], *case.example.camera.size
    for index in range(1, max(_GROUP_SIZES)):
        neighbor = views[-1].partner if index % 4 else case.example
        cropped = neighbor.crop(8 * (index % 3), 6 * (index % 2), width - 24, height - 6)
        if index > 3:  # The near half of the view has a smaller median depth.
            cropped = neighbor.crop(0, height // 2, width - 24, height // 2)
        views.append(replace(cropped if index % 2 else neighbor, name=f"{index}/{neighbor.name}"))
    worst = 0.0
    for size in _GROUP_SIZES:
        examples = tuple(views[:size])
        group = case.run_on_examples(*examples)
        if case.truth_source == "none":
            continue
        for index, (prior, example) in enumerate(_pairs(group, examples)):
            error = _scale_free_error(prior, example)
            worst = max(worst, error)
            if error > DEPTH_TOLERANCE:
                raise CheckFailed(
                    f"view {index + 1} of a group of {size} has a relative error of {error:.2g}"
                )
            if case.truth_source in ("painted", "prepared"):
                require_depth_std(prior, example)
        spread = float(np.ptp(_log_factors(group, examples)))
        if spread > DEPTH_TOLERANCE:
            raise CheckFailed(f"the units of the maps in a group of {size} differ")
        if case.truth_source != "painted":
            _require_true_cameras(group, examples)
    return f"relative error {worst:.2g}" if worst else "the truth is unknown"


def check_multiview_alone(case: ContractCase) -> None:
    """Require valid output for a group of one view.

    A run calls the multi-view network with one view if an image overlaps no other image.
    """
    case.run_on_examples(case.example)


def check_multiview_sizes(case: ContractCase) -> str:
    """Require accurate output for a group of landscape and portrait views."""
    width, height = case.example.camera.size
    examples = (
        case.example,
        case.example.partner.sized(height, width),
        case.example.sized(149, 107),
    )
    group = case.run_on_examples(*examples)
    if case.truth_source == "none":
        return "the truth is unknown"
    for prior, example in _pairs(group, examples):
        error = _scale_free_error(prior, example)
        if error > DEPTH_TOLERANCE:
            size = "{} x {}".format(*example.camera.size)
            raise CheckFailed(
                f"the {size} view in a group of other sizes has a relative error of {error:.2g}"
            )
        require_small_shift(
            case, example, map_errors.estimate_depth_shift(prior, example), prior.shape
        )
    return ""


CHECKS = (
    *checks_depth.MAP_CHECKS,
    check_multiview_order,
    check_multiview_own_axis,
    check_multiview_one_unit,
    check_multiview_poses,
    check_multiview_pose_unit,
    check_multiview_intrinsics,
    check_multiview_group_sizes,
    check_multiview_alone,
    check_multiview_sizes,
)


def _make_group(case: ContractCase) -> tuple[Example, ...]:
    """Return three synthetic views that overlap."""
    return case.example, case.example.partner, case.example.partner.partner


def _require_true_cameras(group: MultiViewPrior, examples: tuple[Example, ...]) -> None:
    """Require correct poses and intrinsics of all views of a group, if the group has any."""
    for index in range(1, len(examples)) if group.poses is not None else ():
        assert group.poses is not None
        error = _rotation_error_deg(
            _relative(group.poses, index), _relative(_true_poses(examples), index)
        )
        if error > ROTATION_TOLERANCE_DEG:
            raise CheckFailed(
                f"the rotation of view {index + 1} of a group of {len(examples)} is off by "
                f"{error:.1f} degrees"
            )
    if group.intrinsics is not None:
        true = np.array([example.camera.params for example in examples])
        # The principal point of a cropped view may be 0, so its error is compared with fx.
        errors = (np.abs(group.intrinsics - true) / true[:, :1]).max(axis=1)
        if errors.max() > FOCAL_TOLERANCE:
            raise CheckFailed(
                f"the intrinsics of view {int(errors.argmax()) + 1} of a group of {len(examples)} "
                f"are off by {errors.max():.0%} of the focal length"
            )


def _pairs(
    group: MultiViewPrior, examples: tuple[Example, ...]
) -> list[tuple[DepthPrior, Example]]:
    """Pair each predicted depth map with the synthetic view that it belongs to."""
    return list(zip(group.depth, examples, strict=True))


def _scale_free_error(prior: DepthPrior, example: Example) -> float:
    """Return the 80 % quantile of relative depth errors after removing a common factor."""
    return map_errors.error_quantile(map_errors.log_errors(prior, example, any_scale=True))


def _median_free_error(prior: DepthPrior, example: Example, expected: Float64) -> float:
    """Return the 80 % quantile of relative errors of depth compared with expected depth (h, w)."""
    where = map_errors.select_comparable(prior.valid, example.truth(prior.shape)) & (expected > 0)
    error = np.log(prior.depth[where] / expected[where])
    return map_errors.error_quantile(error - np.median(error))


def _depth_from_first_view(example: Example, first: Example, shape: tuple[int, int]) -> Float64:
    """Return z-depths (h, w) in the first view of the surface points seen by another view."""
    rows, columns = shape
    grid = rays(example.camera.resized(columns, rows), pixel_centers(columns, rows))
    points = grid * example.truth(shape).depth[..., None]
    relative = compose(_split(first.pose), invert(*_split(example.pose)))
    z: Float64 = transform(*relative, points)[..., 2]
    return z


def _log_factors(group: MultiViewPrior, examples: tuple[Example, ...]) -> list[float]:
    """Return the logarithm of the unit of each predicted depth map in meters."""
    errors = [map_errors.log_errors(p, e, any_scale=False) for p, e in _pairs(group, examples)]
    return [float(np.median(error)) for error in errors]


def _predict_poses(case: ContractCase) -> tuple[Float64, tuple[Example, ...]]:
    """Return predicted poses (n, 3, 4) of a group of synthetic views, and the views."""
    if not case.declares("proposes-poses"):
        raise CheckSkipped("the provider does not declare 'proposes-poses'")
    case.require_truth("prepared", "image")
    examples = _make_group(case)
    poses = case.run_on_examples(*examples).poses
    assert poses is not None  # The validator requires the predicted poses.
    return poses, examples


def _true_poses(examples: tuple[Example, ...]) -> Float64:
    return np.array([example.pose for example in examples])


def _split(pose: Float64) -> tuple[Float64, Float64]:
    return pose[:, :3], pose[:, 3]


def _inverse(pose: Float64) -> Float64:
    return np.column_stack(invert(*_split(pose)))


def _relative(poses: Float64, index: int) -> tuple[Float64, Float64]:
    """Return the true pose of a view relative to the first view."""
    return compose(_split(poses[index]), invert(*_split(poses[0])))


def _rotation_error_deg(a: tuple[Float64, Float64], b: tuple[Float64, Float64]) -> float:
    """Return the angle in degrees between two rotation matrices."""
    return float(rotation_angle_deg(a[0].T @ b[0]))
