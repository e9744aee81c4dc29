"""Checks of normals providers, and of wrappers around them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from mpsfm_core.data import Float64, NormalPrior
from mpsfm_core.geometry import angle_between_deg
from mpsfm_core.testing import measure
from mpsfm_core.testing.accuracy import NORMALS_TOLERANCE_DEG, accept_shift
from mpsfm_core.testing.case import Case
from mpsfm_core.testing.checks.maps import (
    accept_calibration,
    accept_std,
    accept_validity,
    painted_backwards,
)
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.painting import NORMALS_STD, read_normals

FLIP_TOLERANCE_DEG = 15.0
"""For networks whose truth is not known."""

_AXES: Mapping[str, tuple[int, int, int]] = MappingProxyType(
    {
        "they have y up and z backward (OpenGL): negate y and z": (1, -1, -1),
        "they point away from the camera: negate them": (-1, -1, -1),
        "x is negated": (-1, 1, 1),
        "y is negated": (1, -1, 1),
        "z is negated": (1, 1, -1),
    }
)


def check_normals_frame(case: Case) -> str:
    """Normals are in the camera frame: x right, y down, z forward; not in the world's, not in
    OpenGL's, not with a sign or an axis exchanged."""
    case.needs("painted", "told", "seen")
    prior = _ask(case)
    angle = measure.typical(measure.angles_deg(prior, case.main))
    if angle > NORMALS_TOLERANCE_DEG:
        raise CheckFailed(f"normals are {angle:.0f} degrees off{_explanation(prior, case)}")
    return f"angle {angle:.2f} degrees"


def check_normals_channel_order(case: Case) -> None:
    """The network gets RGB, not BGR."""
    case.needs("painted")
    prior = _ask(case)
    truth = case.main.truth(prior.shape)
    swapped = read_normals(painted_backwards(case.main, prior.shape))
    where = prior.valid & truth.smooth
    angles = [_angle(prior.normals[where], values[where]) for values in (truth.normals, swapped)]
    if angles[1] < angles[0]:
        raise CheckFailed("follows the channels in the order blue, green, red")


def check_normals_pixel_convention(case: Case) -> str:
    """The value at [row, col] belongs to the pixel centre (col + 0.5, row + 0.5)."""
    case.needs("painted", "told", "seen")
    prior = _ask(case)
    shift = measure.normals_shift(prior, case.main)
    return accept_shift(case, case.main, shift, prior.shape)


def check_normals_validity(case: Case) -> str:
    """Pixels without a surface are not valid, those with one are; for providers that can tell
    (painted views have a normal everywhere)."""
    case.needs("told")
    prior = _ask(case)
    return accept_validity(prior.valid, case.main.truth(prior.shape))


def check_normals_flip(case: Case) -> str:
    """The mirrored view has the mirrored normals: mirrored in the map, and x negated."""
    prior, mirrored = _ask(case), case.ask(case.main.mirror())
    if prior.shape != mirrored.shape:
        raise CheckFailed(f"has shape {mirrored.shape} on the mirrored view, else {prior.shape}")
    both = prior.valid & mirrored.valid[:, ::-1] & case.main.truth(prior.shape).smooth
    if not both.any():
        raise CheckFailed("has no pixel that is valid in the view and in the mirrored one")
    back = mirrored.normals[:, ::-1] * (-1.0, 1.0, 1.0)
    angle = _angle(prior.normals[both], back[both])
    limit = FLIP_TOLERANCE_DEG if case.knows == "nothing" else NORMALS_TOLERANCE_DEG
    if angle > limit:
        raise CheckFailed(f"differs by {angle:.0f} degrees on the mirrored view")
    return f"angle {angle:.2g} degrees"


def check_normals_same_in_larger_view(case: Case) -> str:
    """The same scene with twice the pixels and twice the focal length has the same normals."""
    case.needs("painted", "told", "seen")
    width, height = case.main.camera.size
    large = case.main.sized(2 * width, 2 * height)
    angle = measure.typical(measure.angles_deg(case.ask(large), large))
    if angle > NORMALS_TOLERANCE_DEG:
        raise CheckFailed(f"normals are {angle:.0f} degrees off in an enlarged view")
    return f"angle {angle:.2f} degrees"


def check_normals_variance(case: Case) -> str:
    """The variance is one: the square of the angular std that the stand-in reports, in rad^2."""
    case.needs("painted", "told")
    if case.spec.kind == "wrapper":
        raise CheckSkipped("a wrapper may change the variance")
    prior = _ask(case)
    if prior.variance is None:
        raise CheckSkipped("has no variance")
    where = measure.comparable(prior.valid, case.main.truth(prior.shape))
    return accept_std(prior.variance[where], np.full(int(where.sum()), NORMALS_STD))


def check_normals_calibration(case: Case) -> None:
    """The declared calibration gives every valid pixel a positive variance, and a larger one for a
    larger scale of the std."""
    accept_calibration(case, _ask(case))


CHECKS = (
    check_normals_frame,
    check_normals_channel_order,
    check_normals_pixel_convention,
    check_normals_validity,
    check_normals_flip,
    check_normals_same_in_larger_view,
    check_normals_variance,
    check_normals_calibration,
)


def _ask(case: Case) -> NormalPrior:
    prior: NormalPrior = case.ask(case.main)
    return prior


def _angle(found: Any, expected: Any) -> float:
    if not len(found):
        raise CheckFailed("has no valid normals where the truth is known")
    return measure.typical(angle_between_deg(found.astype(np.float64), expected))


def _explanation(prior: NormalPrior, case: Case) -> str:
    """What turns the normals into the true ones, if it is a known mistake."""
    truth = case.main.truth(prior.shape)
    where = prior.valid & truth.smooth
    found, expected = prior.normals[where].astype(np.float64), truth.normals[where]
    for text, signs in _AXES.items():
        if _angle(found * signs, expected) < NORMALS_TOLERANCE_DEG:
            return f": {text}"
    camera_from_world: Float64 = case.main.pose[:, :3]
    if _angle(found @ camera_from_world.T, expected) < NORMALS_TOLERANCE_DEG:
        return ": they are in the world's frame"
    return ""
