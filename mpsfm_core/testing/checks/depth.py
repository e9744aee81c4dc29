"""Contract checks of depth providers, of wrappers around them, and of all other depth maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from mpsfm_core.data import DepthPrior, NormalPrior
from mpsfm_core.providers.kinds.depth import run_focal, run_joint
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.accuracy import (
    DEPTH_TOLERANCE,
    NORMALS_TOLERANCE_DEG,
    require_local_depth,
    require_small_shift,
)
from mpsfm_core.testing.checks.maps import (
    require_monotonic_calibration,
    require_true_validity,
    swap_painted_channels,
)
from mpsfm_core.testing.contract_case import ContractCase, describe_difference, first_depth
from mpsfm_core.testing.examples import Example, distant_example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.painted_views import read_depth
from mpsfm_core.testing.std_errors import STD_FACTOR, require_depth_std, require_normals_std

RAY_TOLERANCE = 0.25
"""Largest accepted exponent p in ``depth = z * (ray length / z) ** p``, which is 0 for z-depth and
1 for ray length. The depth of correct providers has an exponent of 0.002 on synthetic views."""
FLIP_TOLERANCE = 0.3
"""Largest accepted relative depth difference between a view and the mirrored or enlarged view if
the ground truth is unknown. Trained networks are not exactly symmetric, but wrongly rotated or
cropped depth maps cause larger differences."""
FOCAL_FACTOR = 1.5
"""Ratio of the two focal lengths for which ``check_depth_intrinsics`` compares depth."""
_FOCAL_RANGE = (1.2, 1.9)
"""Accepted range of the depth ratio between two cameras whose focal lengths have the ratio 1.5. A
network with a canonical camera model has a depth ratio of 1.5. A depth ratio of 1 means that the
network ignores the focal length, and 0.67 that depth shrinks instead of growing."""

_DEPTH_UNITS = (0.1, 9.0)
"""Factors by which the depth of a test network changes in ``check_depth_range``: the depth of the
example view is 0.2 to 0.9 m and 15 to 84 m."""
_MIN_NEAR_RATIO = 0.5
"""Smallest accepted ratio of pixels that remain valid if all surfaces are nearer."""
_FOCAL_GROWTH = (1.5, 2.7)
"""Accepted range of the ratio between the focal lengths that a provider estimates for a view of
twice the size and for the view."""
_MAX_FOCAL_FACTOR = 1.2
"""Largest accepted ratio between the estimated and the true focal length."""
_ANGLE_RANGE_DEG = (1.0, 170.0)
"""Range of plausible horizontal angles of view in degrees, from telephoto to ultra-wide lenses."""

_ORIENTATIONS: Mapping[str, Callable[[Any], Any]] = MappingProxyType(
    {
        "mirrored": lambda a: a[:, ::-1],
        "upside down": lambda a: a[::-1],
        "rotated by 180 degrees": lambda a: a[::-1, ::-1],
        "transposed (x and y are swapped)": lambda a: a.T,
    }
)


def check_depth_is_z(case: ContractCase) -> str:
    """Require z-depth along the optical axis, not the length of the viewing ray.

    The synthetic view has a wide angle, so that the ray length is 1.3 times z in its corners.
    """
    case.require_truth("painted", "prepared", "image")
    power = map_errors.estimate_ray_exponent(_run(case), case.example)
    if abs(power) > RAY_TOLERANCE:
        kind = "the length of the ray" if abs(power - 1) < RAY_TOLERANCE else "something else"
        raise CheckFailed(f"depth is {kind}: proportional to z * (ray length / z) ** {power:.2f}")
    return f"z * (ray length / z) ** {power:.3f}"


def check_depth_scale(case: ContractCase) -> str:
    """Require metric depth in meters, and other depth that is correct up to one factor per map."""
    case.require_truth("painted", "prepared", "image")
    prior = _run(case)
    errors = map_errors.log_errors(prior, case.example, any_scale=not prior.metric)
    factor = float(np.exp(np.median(errors)))
    if abs(np.log(factor)) > DEPTH_TOLERANCE:
        raise CheckFailed(f"depth is declared metric and is {factor:.3g} times the true depth")
    spread = map_errors.error_quantile(errors - np.median(errors))
    if spread > DEPTH_TOLERANCE:
        raise CheckFailed(f"depth is not proportional to z: relative error {spread:.2g}")
    return f"factor {factor:.3f}, relative error {spread:.2g}"


def check_depth_channel_order(case: ContractCase) -> None:
    """Require that the network receives RGB, not BGR."""
    case.require_truth("painted")
    prior = _run(case)
    truth = case.example.truth(prior.shape)
    right = _median_deviation(prior, truth.depth, truth.smooth)
    swapped = read_depth(swap_painted_channels(case.example, prior.shape))
    if _median_deviation(prior, swapped, truth.smooth & (swapped > 0)) < right:
        raise CheckFailed(
            "the network receives BGR instead of RGB: the output follows the blue channel"
        )


def check_depth_pixel_convention(case: ContractCase) -> str:
    """Require that the value at [row, col] belongs to the point (col + 0.5, row + 0.5).

    The check ``depth-pixel-convention`` detects half-pixel shifts, corner-aligned resizing, cropped
    or padded borders, and depth maps that do not cover the whole view.
    """
    case.require_truth("painted", "prepared", "image")
    prior = _run(case)
    shift = map_errors.estimate_depth_shift(prior, case.example)
    return require_small_shift(case, case.example, shift, prior.shape)


def check_depth_orientation(case: ContractCase) -> None:
    """Require that rows of the map go down and columns go right in the view.

    The check ``depth-orientation`` detects transposed, mirrored and rotated depth maps.
    """
    case.require_truth("painted", "prepared", "image")
    prior = _run(case)
    right = _median_deviation_from_truth(prior, case.example)
    for what, turn in _ORIENTATIONS.items():
        turned = DepthPrior.from_arrays(turn(prior.depth), valid=turn(prior.valid))
        if _median_deviation_from_truth(turned, case.example) < 0.5 * right:
            raise CheckFailed(f"the depth map is {what}")


def check_depth_validity(case: ContractCase) -> str:
    """Require that depth is valid at pixels with a surface and invalid at pixels of the sky."""
    case.require_truth("painted", "prepared")
    prior = _run(case)
    return require_true_validity(prior.valid, case.example.truth(prior.shape))


def check_depth_flip(case: ContractCase) -> str:
    """Require the mirrored depth for the mirrored view.

    Without ground truth, a larger difference is accepted.
    """
    prior, mirrored = _run(case), first_depth(case.run(case.example.mirror()))
    if prior.shape != mirrored.shape:
        raise CheckFailed(
            f"the depth map of the mirrored view has shape {mirrored.shape}, not {prior.shape}"
        )
    both = prior.valid & mirrored.valid[:, ::-1] & case.example.truth(prior.shape).smooth
    if not both.any():
        raise CheckFailed("no pixel is valid in both the view and the mirrored view")
    ratio = np.log(prior.depth[both] / mirrored.depth[:, ::-1][both].astype(np.float64))
    if not (prior.metric and mirrored.metric):
        ratio -= np.median(ratio)  # Each depth map that is not metric has its own unit.
    found = map_errors.error_quantile(ratio)
    limit = FLIP_TOLERANCE if case.truth_source == "none" else DEPTH_TOLERANCE
    if found > limit:
        raise CheckFailed(
            f"depth of the mirrored view differs by {found:.1%}, {limit:.0%} is allowed"
        )
    return f"relative difference {found:.2g}"


def check_depth_same_in_larger_view(case: ContractCase) -> str:
    """Require the same depth for a view of twice the size with twice the focal length.

    A provider that resizes the image has to scale the intrinsics by the same factor.
    """
    case.require_truth("painted", "prepared", "image")
    width, height = case.example.camera.size
    large = case.example.sized(2 * width, 2 * height)
    small, prior = _run(case), first_depth(case.run(large))
    if not (small.metric and prior.metric):
        raise CheckSkipped("depth that is not metric has a different unit in every depth map")
    medians = [
        float(np.median(map_errors.log_errors(p, e, any_scale=False)))
        for p, e in ((small, case.example), (prior, large))
    ]
    factor = float(np.exp(medians[1] - medians[0]))
    if abs(np.log(factor)) > DEPTH_TOLERANCE:
        raise CheckFailed(
            f"depth grows {factor:.3g} times for a view of twice the size and focal length"
        )
    return f"factor {factor:.3f}"


def check_depth_intrinsics(case: ContractCase) -> str:
    """Require that depth of an ``intrinsics-aware`` provider grows with the focal length.

    An object with the same image size through a longer lens is farther away.
    """
    if not case.declares("intrinsics-aware"):
        raise CheckSkipped("the provider does not declare 'intrinsics-aware'")
    camera = case.example.camera
    longer = replace(camera, fx=FOCAL_FACTOR * camera.fx, fy=FOCAL_FACTOR * camera.fy)
    prior = _run(case)
    changed = first_depth(case.run_on_view(replace(case.example.view, camera=longer), case.example))
    both = prior.valid & changed.valid
    if not both.any():
        raise CheckFailed("no pixel of the depth map is valid for both focal lengths")
    factor = float(np.median(changed.depth[both] / prior.depth[both]))
    if factor == 1 and case.declares("joint-normals"):
        raise CheckSkipped("only the normals depend on the intrinsics")
    if not _FOCAL_RANGE[0] < factor < _FOCAL_RANGE[1]:
        raise CheckFailed(
            f"depth changes {factor:.2f} times if the focal length grows {FOCAL_FACTOR} times"
        )
    if prior.variance is not None and changed.variance is not None:
        std = float(np.sqrt(np.median(changed.variance[both] / prior.variance[both])))
        if not 1 / STD_FACTOR < std / factor < STD_FACTOR:
            raise CheckFailed(
                f"depth grows {factor:.2f} times with the focal length, but its std {std:.2f} times"
            )
    return f"factor {factor:.2f} for {FOCAL_FACTOR} times the focal length"


def check_depth_variance(case: ContractCase) -> str:
    """Require a depth variance in m^2, the square of the std that the test network reports."""
    case.require_truth("painted", "prepared")
    if case.spec.kind == "wrapper":
        raise CheckSkipped("a wrapper may change the variance")
    prior = _run(case)
    if prior.variance is None:
        raise CheckSkipped("has no variance")
    text = require_depth_std(prior, case.example)
    mirrored = case.example.mirror()
    require_depth_std(first_depth(case.run(mirrored)), mirrored)
    return text


def check_depth_calibration(case: ContractCase) -> None:
    """Require a positive calibrated variance at every valid pixel.

    The calibrated variance has to grow with ``std_scale`` and with the variance of the network.
    """
    require_monotonic_calibration(case, _run(case))


def check_depth_range(case: ContractCase) -> str:
    """Require accurate output for near and distant surfaces, from 0.3 to 75 m.

    The check ``depth-range`` detects clipped, saturated and quantized depth. A test network is
    constructed with the weights for depth of 0.1 and of 9 times the size, and its output has to
    change by this factor at each pixel. The plugin may reject distant pixels.
    """
    case.require_truth("painted", "prepared", "image")
    if case.truth_source == "painted":
        return " and ".join(_require_proportional_depth(case, factor) for factor in _DEPTH_UNITS)
    example = distant_example("textured")
    prior = first_depth(case.run(example))
    truth = example.truth(prior.shape)
    where = map_errors.select_comparable(prior.valid, truth)
    errors = np.log(prior.depth[where].astype(np.float64) / truth.depth[where])
    if not prior.metric:
        errors -= np.median(errors)
    depth = truth.depth[where]
    for name, near, far in (("near", 0, 1), ("middle", 1, 30), ("distant", 30, np.inf)):
        part = errors[(depth >= near) & (depth < far)]
        total = (truth.smooth & (truth.depth >= near) & (truth.depth < far)).sum()
        if len(part) < 0.5 * total:
            raise CheckFailed(f"only {len(part)} of {total} {name} pixels are valid")
        error = map_errors.error_quantile(part)
        if error > DEPTH_TOLERANCE:
            raise CheckFailed(f"the relative error of {name} depth is {error:.2g}")
    return f"relative error {map_errors.error_quantile(errors):.2g}"


def check_depth_edges(case: ContractCase) -> str:
    """Require at each pixel a depth between the smallest and the largest true depth nearby.

    Depth at pixels without a surface must not leak into neighboring pixels. Networks whose input
    contains a depth of 0 there may mix both, files and wrappers may not.
    """
    case.require_truth("painted", "prepared")
    return require_local_depth(case, case.example, _run(case))


def check_depth_joint(case: ContractCase) -> str:
    """Require that ``predict_joint`` returns the depth of ``predict`` and correct normals."""
    if not case.declares("joint-normals"):
        raise CheckSkipped("the provider does not declare 'joint-normals'")
    width, height = case.example.camera.size
    sizes = (height, width), (149, 107), (3 * width, 3 * height), (5 * height, 5 * width)
    texts = []
    for example in (case.example, *(case.example.sized(*size) for size in sizes)):
        case.prepare(example)
        depth, normals = run_joint(case.spec, case.provider, example.view)
        changed = describe_difference(first_depth(case.run(example)), depth)
        if changed:
            raise CheckFailed(f"predict_joint and predict return different depth: {changed}")
        texts.append(_compare_joint_normals(case, example, normals))
    _require_equal_masked_depth(case)
    return texts[0]


def check_depth_focal(case: ContractCase) -> str:
    """Require that ``estimate_focal`` returns a focal length in pixels of the view.

    If the view has twice the size, the estimated focal length has to be about twice as long. The
    estimate must not depend on the camera of the view, which is a guess.
    """
    if not case.declares("estimates-focal"):
        raise CheckSkipped("the provider does not declare 'estimates-focal'")
    width, height = case.example.camera.size
    common = case.example.with_common_camera()
    larger = (common.sized(factor * width, factor * height) for factor in (2, 7))
    low = common.crop(0, height // 4, width, height // 2)
    examples = (common, *larger, common.turned(), low)
    found = []
    for example in examples:
        case.prepare(example)
        focal = run_focal(case.spec, case.provider, example.view)
        if focal is None:
            raise CheckSkipped(
                "the provider estimates no focal length with the options of the ContractSetup"
            )
        found.append(focal)
    if not _FOCAL_GROWTH[0] < found[1] / found[0] < _FOCAL_GROWTH[1]:
        raise CheckFailed(
            f"the estimated focal length is {found[0]:.0f} px, and {found[1]:.0f} px at twice the "
            f"image size"
        )
    longer = replace(common.camera, fx=2 * common.camera.fx, fy=2 * common.camera.fy)
    guessed = run_focal(case.spec, case.provider, replace(common.view, camera=longer))
    if guessed is None or abs(np.log(guessed / found[0])) > np.log(_MAX_FOCAL_FACTOR):
        raise CheckFailed(
            f"the estimated focal length is {found[0]:.0f} px, and {guessed or 0:.0f} px if the "
            "camera of the view has twice the focal length"
        )
    angle = float(np.rad2deg(2 * np.arctan(width / 2 / found[0])))
    if not _ANGLE_RANGE_DEG[0] < angle < _ANGLE_RANGE_DEG[1]:
        raise CheckFailed(
            f"the estimated focal length of {found[0]:.0f} px is an angle of view of {angle:.0f} "
            f"degrees"
        )
    text = f"{found[0]:.0f} px, the truth is {examples[0].camera.fx:.0f} px"
    for focal, example in zip(found, examples, strict=True) if case.truth_source != "none" else ():
        if abs(np.log(focal / example.camera.fx)) > np.log(_MAX_FOCAL_FACTOR):
            size = "{} x {}".format(*example.camera.size)
            raise CheckFailed(
                f"the estimated focal length of a {size} view is {focal:.0f} px, the truth is "
                f"{example.camera.fx:.0f} px"
            )
    return text


MAP_CHECKS = (
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
    check_depth_range,
    check_depth_edges,
)
"""Contract checks of depth maps, which both depth providers and multi-view providers have to
pass."""

CHECKS = (*MAP_CHECKS, check_depth_joint, check_depth_focal)


def _run(case: ContractCase) -> DepthPrior:
    """Return the validated depth prior of a synthetic view."""
    return first_depth(case.run(case.example))


def _require_proportional_depth(case: ContractCase, factor: float) -> str:
    """Require that the depth of each pixel changes by the factor of the test network's depth."""
    prior, changed = _run(case), first_depth(case.run_in_depth_unit(factor))
    if changed.shape != prior.shape:
        raise CheckFailed(f"the depth map has shape {changed.shape} instead of {prior.shape}")
    both = prior.valid & changed.valid
    if factor < 1 and both.sum() < _MIN_NEAR_RATIO * prior.valid.sum():
        raise CheckFailed(f"only {both.sum()} of {prior.valid.sum()} near pixels are valid")
    if not both.any():
        return f"no pixel is valid at {factor:g} times the distance"
    ratios = changed.depth[both] / prior.depth[both].astype(np.float64)
    if prior.metric and np.abs(ratios - 1).max() < 1e-3:
        raise CheckSkipped("the test network does not use the weights of painted_views.decoder()")
    unit = factor if prior.metric else float(np.median(ratios))
    error = float(np.quantile(np.abs(np.log(ratios / unit)), 0.98))
    if error > DEPTH_TOLERANCE:
        far = np.abs(np.log(ratios / unit)) > DEPTH_TOLERANCE
        raise CheckFailed(
            f"if all surfaces are {factor:g} times as far, depth changes {ratios[far].min():.2g} "
            f"to {ratios[far].max():.2g} times"
        )
    if prior.variance is not None and changed.variance is not None:
        stds = np.sqrt(changed.variance[both].astype(np.float64) / prior.variance[both]) / unit
        if np.abs(np.log(np.quantile(stds, (0.1, 0.5, 0.9)))).max() > np.log(STD_FACTOR):
            raise CheckFailed(
                f"if all surfaces are {factor:g} times as far, the std changes "
                f"{np.median(stds) * unit:.2g} times"
            )
    return f"relative error {error:.2g} at {factor:g} times the distance"


def _require_equal_masked_depth(case: ContractCase) -> None:
    """Require that ``predict_joint`` treats the mask of a view as ``predict`` does."""
    mask = np.ones(case.example.view.image.shape[:2], np.bool_)
    mask[:, : case.example.camera.width // 2] = False
    view = replace(case.example.view, mask=mask)
    case.prepare(case.example)
    depth = run_joint(case.spec, case.provider, view)[0]
    changed = describe_difference(first_depth(case.run_on_view(view, case.example)), depth)
    if changed:
        raise CheckFailed(f"predict_joint and predict differ for a view with a mask: {changed}")


def _compare_joint_normals(case: ContractCase, example: Example, normals: NormalPrior) -> str:
    """Require that normals of ``predict_joint`` agree with the ground truth, if it is known."""
    if case.truth_source == "none":
        return "the true normals are unknown"
    angle = map_errors.error_quantile(map_errors.angle_errors_deg(normals, example))
    if angle > NORMALS_TOLERANCE_DEG:
        raise CheckFailed(f"the normals of predict_joint are {angle:.0f} degrees off")
    if case.truth_source in ("painted", "prepared"):
        require_normals_std(normals, example)
    return f"normals off by {angle:.2g} degrees"


def _median_deviation(prior: DepthPrior, expected: Any, where: Any) -> float:
    """Return the median relative deviation of depth from expected depth, up to a common factor."""
    both = prior.valid & where
    if not both.any():
        return np.inf
    error = np.log(prior.depth[both] / expected[both])
    return float(np.median(np.abs(error - np.median(error))))


def _median_deviation_from_truth(prior: DepthPrior, example: Example) -> float:
    """Return the median relative deviation from the true depth, up to a common factor."""
    truth = example.truth(prior.shape)
    return _median_deviation(prior, truth.depth, truth.valid)
