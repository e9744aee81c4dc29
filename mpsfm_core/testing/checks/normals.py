"""Contract checks of normals providers and of wrappers around them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from mpsfm_core.data import DepthPrior, Float64, NormalPrior
from mpsfm_core.geometry import angle_between_deg
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.accuracy import NORMALS_TOLERANCE_DEG, require_small_shift
from mpsfm_core.testing.checks.maps import (
    require_monotonic_calibration,
    require_true_validity,
    swap_painted_channels,
)
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import tilted_example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.painted_views import read_normals
from mpsfm_core.testing.std_errors import require_normals_std

_MIN_POSITIVE_Z = 0.1
"""Smallest z component of normals in ``check_normals_away_from_axis``, larger than the error of
encoded colors."""
_MEANINGLESS_DEPTH = 7.0
"""Depth in meters at invalid pixels, which a provider must ignore."""
FLIP_TOLERANCE_DEG = 15.0
"""Largest accepted angle in degrees between normals of a view and of the mirrored view if the
ground truth is unknown. Trained networks are not exactly symmetric."""

_AXES: Mapping[str, tuple[int, int, int]] = MappingProxyType(
    {
        "they have y up and z backward (OpenGL): negate y and z": (1, -1, -1),
        "they point away from the camera: negate them": (-1, -1, -1),
        "x is negated": (-1, 1, 1),
        "y is negated": (1, -1, 1),
        "z is negated": (1, 1, -1),
    }
)


def check_normals_frame(case: ContractCase) -> str:
    """Require normals in the camera frame: x right, y down, z forward.

    If a sign change or the rotation to the world frame explains the error, the message names the
    mistake.
    """
    case.require_truth("painted", "prepared", "image")
    prior = _run(case)
    angle = map_errors.error_quantile(map_errors.angle_errors_deg(prior, case.example))
    if angle > NORMALS_TOLERANCE_DEG:
        raise CheckFailed(f"the normals are {angle:.0f} degrees off{_explain_error(prior, case)}")
    return f"angle {angle:.2f} degrees"


def check_normals_channel_order(case: ContractCase) -> None:
    """Require that the network receives RGB, not BGR."""
    case.require_truth("painted")
    prior = _run(case)
    truth = case.example.truth(prior.shape)
    swapped = read_normals(swap_painted_channels(case.example, prior.shape))
    where = prior.valid & truth.smooth
    angles = [
        _angle_error_deg(prior.normals[where], values[where]) for values in (truth.normals, swapped)
    ]
    if angles[1] < angles[0]:
        raise CheckFailed(
            "the network receives BGR instead of RGB: the normals follow the wrong channels"
        )


def check_normals_pixel_convention(case: ContractCase) -> str:
    """Require that the value at [row, col] belongs to the point (col + 0.5, row + 0.5)."""
    case.require_truth("painted", "prepared", "image")
    prior = _run(case)
    shift = map_errors.estimate_normals_shift(prior, case.example)
    return require_small_shift(case, case.example, shift, prior.shape)


def check_normals_validity(case: ContractCase) -> str:
    """Require that normals are valid at pixels with a surface and invalid at pixels of the sky.

    The check requires ``truth_source="prepared"``, because painted views encode a normal at every
    pixel.
    """
    case.require_truth("prepared")
    prior = _run(case)
    return require_true_validity(prior.valid, case.example.truth(prior.shape))


def check_normals_flip(case: ContractCase) -> str:
    """Require mirrored normals with negated x for the mirrored view.

    Without ground truth, a larger difference is accepted.
    """
    prior, mirrored = _run(case), case.run(case.example.mirror())
    if prior.shape != mirrored.shape:
        raise CheckFailed(
            f"the normal map of the mirrored view has shape {mirrored.shape}, not {prior.shape}"
        )
    both = prior.valid & mirrored.valid[:, ::-1] & case.example.truth(prior.shape).smooth
    if not both.any():
        raise CheckFailed("no pixel is valid in both the view and the mirrored view")
    back = mirrored.normals[:, ::-1] * (-1.0, 1.0, 1.0)
    angle = _angle_error_deg(prior.normals[both], back[both])
    limit = FLIP_TOLERANCE_DEG if case.truth_source == "none" else NORMALS_TOLERANCE_DEG
    if angle > limit:
        raise CheckFailed(f"normals of the mirrored view differ by {angle:.0f} degrees")
    return f"angle {angle:.2g} degrees"


def check_normals_same_in_larger_view(case: ContractCase) -> str:
    """Require the same normals for a view of twice the size with twice the focal length."""
    case.require_truth("painted", "prepared", "image")
    width, height = case.example.camera.size
    large = case.example.sized(2 * width, 2 * height)
    angle = map_errors.error_quantile(map_errors.angle_errors_deg(case.run(large), large))
    if angle > NORMALS_TOLERANCE_DEG:
        raise CheckFailed(f"the normals are {angle:.0f} degrees off in an enlarged view")
    return f"angle {angle:.2f} degrees"


def check_normals_away_from_axis(case: ContractCase) -> str:
    """Require normals whose z component is positive, as those of a floor at the image border.

    The test network is constructed with weights for colors that encode x, y and z of the normal. A
    normal faces the camera if its dot product with the viewing ray is negative, so z may be
    positive. A normal must not be negated, changed or dropped because of its z component.
    """
    case.require_truth("painted")
    import cv2  # The import is local, because pytest loads this module when it collects tests.

    prior, truth = case.run_with_normal_colors(tilted_example())
    if prior.shape != truth.valid.shape:
        raise CheckSkipped("the map has another size than the view")
    toward = truth.valid & (truth.normals[..., 2] < -_MIN_POSITIVE_Z) & prior.valid
    angle = _angle_error_deg(prior.normals[toward], truth.normals[toward])
    if angle > NORMALS_TOLERANCE_DEG:
        raise CheckSkipped("the test network does not use the weights of painted_views.decoder()")
    is_away = (truth.normals[..., 2] > _MIN_POSITIVE_Z).astype(np.uint8)
    away = cv2.erode(is_away, np.ones((5, 5), np.uint8)) > 0
    kept = away & prior.valid
    if kept.sum() < away.sum() / 2:
        raise CheckFailed(f"only {kept.sum()} of {away.sum()} normals with positive z are valid")
    angle = _angle_error_deg(prior.normals[kept], truth.normals[kept])
    if angle > NORMALS_TOLERANCE_DEG:
        raise CheckFailed(f"normals with positive z are {angle:.0f} degrees off")
    return f"angle {angle:.2f} degrees"


def check_normals_depth_input(case: ContractCase) -> str:
    """Require the same normals for depth in another unit and for a depth map of half the size.

    The normals must not depend on depth and variance at invalid pixels. The check applies to
    providers that declare ``needs-depth``.
    """
    case.require_capability("needs-depth")
    case.require_truth("painted", "prepared", "image")
    example = case.example
    truth, small = (
        example.truth(),
        example.truth(tuple(-(-n // 2) for n in example.truth().valid.shape)),
    )
    depths = {
        "of ten times the size": DepthPrior.from_arrays(
            10 * truth.depth, (0.2 * truth.depth) ** 2, metric=False
        ),
        "of a smaller map": DepthPrior.from_arrays(small.depth, (0.02 * small.depth) ** 2),
    }
    worst = 0.0
    for what, depth in depths.items():
        prior = case.run_on_view(example.view, example, case.provider, depth)
        angle = map_errors.error_quantile(map_errors.angle_errors_deg(prior, example))
        if angle > NORMALS_TOLERANCE_DEG:
            raise CheckFailed(f"the normals are {angle:.0f} degrees off for depth {what}")
        worst = max(worst, angle)
    _require_no_use_of_invalid_depth(case)
    return f"angle {worst:.2f} degrees"


def check_normals_variance(case: ContractCase) -> str:
    """Require a variance in rad^2, the square of the angular std that the test network reports."""
    case.require_truth("painted", "prepared")
    if case.spec.kind == "wrapper":
        raise CheckSkipped("a wrapper may change the variance")
    prior = _run(case)
    if prior.variance is None:
        raise CheckSkipped("has no variance")
    return require_normals_std(prior, case.example)


def check_normals_calibration(case: ContractCase) -> None:
    """Require a positive calibrated variance at every valid pixel.

    The calibrated variance has to grow with ``std_scale`` and with the variance of the network.
    """
    require_monotonic_calibration(case, _run(case))


CHECKS = (
    check_normals_frame,
    check_normals_channel_order,
    check_normals_pixel_convention,
    check_normals_validity,
    check_normals_flip,
    check_normals_same_in_larger_view,
    check_normals_away_from_axis,
    check_normals_depth_input,
    check_normals_variance,
    check_normals_calibration,
)


def _require_no_use_of_invalid_depth(case: ContractCase) -> None:
    """Require equal valid normals if depth and variance at invalid pixels change."""
    example = case.example
    case.prepare(example)
    given: DepthPrior = case.make_auxiliary_input(example.view, example)
    if given.variance is None or given.valid.all():
        return
    first, second = (
        case.run_on_view(example.view, example, case.provider, depth)
        for depth in (
            given,
            replace(
                given,
                depth=np.where(given.valid, given.depth, np.float32(_MEANINGLESS_DEPTH)),
                variance=np.where(given.valid, given.variance, np.float32(1)),
            ),
        )
    )
    both = first.valid & second.valid if first.shape == second.shape else np.zeros(1, np.bool_)
    changed = 1 - both.sum() / max(first.valid.sum(), second.valid.sum(), 1)
    if both.any():
        changed += float((first.normals[both] != second.normals[both]).mean())
    if changed > 0:
        raise CheckFailed(
            f"{changed:.2%} of the normals depend on the meaningless depth at invalid pixels"
        )


def _run(case: ContractCase) -> NormalPrior:
    prior: NormalPrior = case.run(case.example)
    return prior


def _angle_error_deg(found: Any, expected: Any) -> float:
    """Return the 80 % quantile of the angle in degrees between predicted and true normals."""
    if not len(found):
        raise CheckFailed("the normal map is invalid wherever the true normals are known")
    return map_errors.error_quantile(angle_between_deg(found.astype(np.float64), expected))


def _explain_error(prior: NormalPrior, case: ContractCase) -> str:
    """Describe the mistake that explains the error of the normals, or return ""."""
    truth = case.example.truth(prior.shape)
    where = prior.valid & truth.smooth
    found, expected = prior.normals[where].astype(np.float64), truth.normals[where]
    for text, signs in _AXES.items():
        if _angle_error_deg(found * signs, expected) < NORMALS_TOLERANCE_DEG:
            return f": {text}"
    camera_from_world: Float64 = case.example.pose[:, :3]
    if _angle_error_deg(found @ camera_from_world.T, expected) < NORMALS_TOLERANCE_DEG:
        return ": they are in the world's frame"
    return ""
