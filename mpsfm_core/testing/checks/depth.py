"""Checks of depth providers, and of wrappers around them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from mpsfm_core.data import DepthPrior, NormalPrior
from mpsfm_core.providers import validation
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.accuracy import DEPTH_TOLERANCE, NORMALS_TOLERANCE_DEG, require_small_shift
from mpsfm_core.testing.checks.maps import (
    require_monotonic_calibration,
    require_reported_std,
    require_true_validity,
    swap_painted_channels,
)
from mpsfm_core.testing.contract_case import ContractCase, depth_in, describe_difference
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.painted_views import RELATIVE_STD, read_depth

RAY_TOLERANCE = 0.25
"""Power of ray length over z. Ours: a painted view has 0.002, the length of the ray 1."""
FLIP_TOLERANCE = 0.3
"""Relative describe_difference for networks whose truth is not known (a network is not exactly
symmetric; a map that is turned or cut on one side differs by more on the slanted wall)."""
FOCAL_FACTOR = 1.5
"""Of the second camera in the check of the intrinsics."""
_FOCAL_RANGE = (1.2, 1.9)
"""Of depth for a focal length 1.5 times as long: a canonical camera has 1.5 exactly, a network
that is told the camera something near it; 1 means that it is ignored, 0.67 that it is inverted."""

_TURNS: Mapping[str, Callable[[Any], Any]] = MappingProxyType(
    {
        "mirrored": lambda a: a[:, ::-1],
        "upside down": lambda a: a[::-1],
        "turned by 180 degrees": lambda a: a[::-1, ::-1],
        "transposed (x and y are swapped)": lambda a: a.T,
    }
)


def check_depth_is_z(case: ContractCase) -> str:
    """Depth is z along the optical axis, not the length of the ray; seen on a wide angle, where
    rays in the corners are 1.3 times as long as their z."""
    case.require_truth("painted", "prepared", "image")
    power = map_errors.estimate_ray_exponent(_ask(case), case.example)
    if abs(power) > RAY_TOLERANCE:
        kind = "the length of the ray" if abs(power - 1) < RAY_TOLERANCE else "something else"
        raise CheckFailed(f"is {kind}: it goes as z * (ray length / z) ** {power:.2f}")
    return f"z * (ray length / z) ** {power:.3f}"


def check_depth_scale(case: ContractCase) -> str:
    """Depth called metric is in metres; other depth is right up to one factor."""
    case.require_truth("painted", "prepared", "image")
    prior = _ask(case)
    errors = map_errors.log_errors(prior, case.example, any_scale=not prior.metric)
    factor = float(np.exp(np.median(errors)))
    if abs(np.log(factor)) > DEPTH_TOLERANCE:
        raise CheckFailed(f"is called metric and is {factor:.3g} times too large")
    spread = map_errors.error_quantile(errors - np.median(errors))
    if spread > DEPTH_TOLERANCE:
        raise CheckFailed(f"is not proportional to z: relative error {spread:.2g}")
    return f"factor {factor:.3f}, relative error {spread:.2g}"


def check_depth_channel_order(case: ContractCase) -> None:
    """The network gets RGB, not BGR."""
    case.require_truth("painted")
    prior = _ask(case)
    truth = case.example.truth(prior.shape)
    right = _spread(prior, truth.depth, truth.smooth)
    swapped = read_depth(swap_painted_channels(case.example, prior.shape))
    if _spread(prior, swapped, truth.smooth & (swapped > 0)) < right:
        raise CheckFailed("follows the blue channel where it should follow the red one")


def check_depth_pixel_convention(case: ContractCase) -> str:
    """The value at [row, col] belongs to the pixel centre (col + 0.5, row + 0.5): no half-pixel
    shift, no corner-aligned resizing, no border cut off or left on, and the whole view covered."""
    case.require_truth("painted", "prepared", "image")
    prior = _ask(case)
    shift = map_errors.estimate_depth_shift(prior, case.example)
    return require_small_shift(case, case.example, shift, prior.shape)


def check_depth_orientation(case: ContractCase) -> None:
    """Rows go down and columns to the right: the map is not transposed, mirrored or turned."""
    case.require_truth("painted", "prepared", "image")
    prior = _ask(case)
    right = _spread_of(prior, case.example)
    for what, turn in _TURNS.items():
        turned = DepthPrior.from_arrays(turn(prior.depth), valid=turn(prior.valid))
        if _spread_of(turned, case.example) < 0.5 * right:
            raise CheckFailed(f"the map is {what}")


def check_depth_validity(case: ContractCase) -> str:
    """Pixels without a surface (sky) are not valid, those with one are."""
    case.require_truth("painted", "prepared")
    prior = _ask(case)
    return require_true_validity(prior.valid, case.example.truth(prior.shape))


def check_depth_flip(case: ContractCase) -> str:
    """The mirrored view has the mirrored depth."""
    prior, mirrored = _ask(case), depth_in(case.run(case.example.mirror()))
    if prior.shape != mirrored.shape:
        raise CheckFailed(f"has shape {mirrored.shape} on the mirrored view, else {prior.shape}")
    both = prior.valid & mirrored.valid[:, ::-1] & case.example.truth(prior.shape).smooth
    if not both.any():
        raise CheckFailed("has no pixel that is valid in the view and in the mirrored one")
    ratio = np.log(prior.depth[both] / mirrored.depth[:, ::-1][both].astype(np.float64))
    found = map_errors.error_quantile(ratio)
    limit = FLIP_TOLERANCE if case.truth_source == "none" else DEPTH_TOLERANCE
    if found > limit:
        raise CheckFailed(f"differs by {found:.1%} on the mirrored view, {limit:.0%} is allowed")
    return f"relative describe_difference {found:.2g}"


def check_depth_same_in_larger_view(case: ContractCase) -> str:
    """The same scene with twice the pixels and twice the focal length has the same depth: who
    resizes the image resizes the intrinsics too."""
    case.require_truth("painted", "prepared", "image")
    width, height = case.example.camera.size
    large = case.example.sized(2 * width, 2 * height)
    small, prior = _ask(case), depth_in(case.run(large))
    medians = [
        float(np.median(map_errors.log_errors(p, e, any_scale=False)))
        for p, e in ((small, case.example), (prior, large))
    ]
    factor = float(np.exp(medians[1] - medians[0]))
    if abs(np.log(factor)) > DEPTH_TOLERANCE:
        raise CheckFailed(f"grows {factor:.3g} times when image and intrinsics are enlarged twice")
    return f"factor {factor:.3f}"


def check_depth_intrinsics(case: ContractCase) -> str:
    """Depth that depends on the focal length grows with it: an object that looks the same through
    a longer lens is farther away."""
    if not case.declares("intrinsics-aware"):
        raise CheckSkipped("does not declare 'intrinsics-aware'")
    camera = case.example.camera
    longer = replace(camera, fx=FOCAL_FACTOR * camera.fx, fy=FOCAL_FACTOR * camera.fy)
    prior = _ask(case)
    changed = depth_in(case.run_on_view(replace(case.example.view, camera=longer), case.example))
    both = prior.valid & changed.valid
    if not both.any():
        raise CheckFailed("has no pixel that is valid with both focal lengths")
    factor = float(np.median(changed.depth[both] / prior.depth[both]))
    if not _FOCAL_RANGE[0] < factor < _FOCAL_RANGE[1]:
        raise CheckFailed(
            f"changes by {factor:.2f} for a focal length {FOCAL_FACTOR} times as long"
        )
    return f"factor {factor:.2f} for {FOCAL_FACTOR} times the focal length"


def check_depth_variance(case: ContractCase) -> str:
    """The variance is one: the square of the std that the stand-in reports, in metres squared."""
    case.require_truth("painted", "prepared")
    if case.spec.kind == "wrapper":
        raise CheckSkipped("a wrapper may change the variance")
    prior = _ask(case)
    if prior.variance is None:
        raise CheckSkipped("has no variance")
    truth = case.example.truth(prior.shape)
    where = map_errors.select_comparable(prior.valid, truth)
    expected = RELATIVE_STD * prior.depth[where].astype(np.float64)
    return require_reported_std(prior.variance[where], expected)


def check_depth_calibration(case: ContractCase) -> None:
    """The declared calibration gives every valid pixel a positive variance, and a larger one for a
    larger scale of the std: what the network says of itself is not lost or out of range."""
    require_monotonic_calibration(case, _ask(case))


def check_depth_joint(case: ContractCase) -> str:
    """``predict_joint`` gives the depth of ``predict``, and normals that are right."""
    if not case.declares("joint-normals"):
        raise CheckSkipped("does not declare 'joint-normals'")
    case.prepare(case.example)
    depth, normals = validation.run_joint(case.spec, case.provider, case.example.view)
    changed = describe_difference(_ask(case), depth)
    if changed:
        raise CheckFailed(f"predict_joint gives another depth than predict: {changed}")
    return _joint_normals(case, normals)


def check_depth_focal(case: ContractCase) -> str:
    """``estimate_focal`` gives a focal length in pixels of the view, and for an enlarged view one
    so many times as long."""
    if not case.declares("estimates-focal"):
        raise CheckSkipped("does not declare 'estimates-focal'")
    width, height = case.example.camera.size
    examples = (case.example, case.example.sized(2 * width, 2 * height))
    found = []
    for example in examples:
        case.prepare(example)
        focal = validation.run_focal(case.spec, case.provider, example.view)
        if focal is None:
            raise CheckSkipped("cannot tell the focal length with these options")
        found.append(focal)
    if not 1.5 < found[1] / found[0] < 2.7:
        raise CheckFailed(f"estimates {found[0]:.0f} px, and {found[1]:.0f} px at twice the size")
    return f"{found[0]:.0f} px, the truth is {case.example.camera.fx:.0f} px"


OF_MAPS = (
    check_depth_is_z,
    check_depth_scale,
    check_depth_channel_order,
    check_depth_orientation,
    check_depth_pixel_convention,
    check_depth_validity,
    check_depth_flip,
    check_depth_same_in_larger_view,
    check_depth_intrinsics,
    check_depth_variance,
    check_depth_calibration,
)
"""Of any depth map, whatever it was seen with."""

CHECKS = (*OF_MAPS, check_depth_joint, check_depth_focal)


def _ask(case: ContractCase) -> DepthPrior:
    return depth_in(case.run(case.example))


def _joint_normals(case: ContractCase, normals: NormalPrior) -> str:
    if case.truth_source == "none":
        return "whether the normals are right is not known"
    angle = map_errors.error_quantile(map_errors.angle_errors_deg(normals, case.example))
    if angle > NORMALS_TOLERANCE_DEG:
        raise CheckFailed(f"its normals are {angle:.0f} degrees off")
    return f"normals off by {angle:.2g} degrees"


def _spread(prior: DepthPrior, expected: Any, where: Any) -> float:
    """Median relative deviation from an expected map, after one factor."""
    both = prior.valid & where
    if not both.any():
        return np.inf
    error = np.log(prior.depth[both] / expected[both])
    return float(np.median(np.abs(error - np.median(error))))


def _spread_of(prior: DepthPrior, example: Example) -> float:
    truth = example.truth(prior.shape)
    return _spread(prior, truth.depth, truth.valid)
