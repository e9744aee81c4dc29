"""Camera providers, which estimate the focal length and gravity direction of a single image.

GeoCalib and similar networks calibrate a camera from the lines and the horizon of one image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from mpsfm_core.data import Float64, View
from mpsfm_core.data.errors import DataError
from mpsfm_core.providers.protocols import ProviderSpec
from mpsfm_core.providers.provider_kind import CheckedProvider, ProviderKind
from mpsfm_core.providers.validation import (
    name_violations,
    provider_errors,
    require_undeclared,
    revalidate,
)

MAX_RELATIVE_STD = 0.3
"""Largest accepted ratio of std to focal length in contract checks. A larger std says less than the
default focal length of a photo without EXIF."""
MAX_ERROR_STD = 4.0
"""Largest accepted error in multiples of the std, because 1 of 16 000 errors with a normal
distribution is larger."""
_SIZE_TOLERANCE = 0.1
"""Largest accepted relative deviation from twice the focal length in a view of twice the size."""
_ANGLE_RANGE_DEG = (5.0, 170.0)
"""Smallest and largest plausible angle of view."""
_GRAVITY_TOLERANCE_DEG = 3.0
_MIN_GRAVITY_STD_DEG = 0.1
"""Smallest plausible std of gravity; the error of networks is 0.4 to 2 degrees [GeoCalib]."""
_MIN_UNKNOWN_STD = 0.1
"""Smallest relative std of the focal length of a view that shows nothing."""
_RADIAL_TOLERANCE = 0.05


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """Camera parameters that a network estimates from one image, with standard deviations.

    Raises:
        DataError: A value is not finite, a std is not positive, or a value or its std is missing.
    """

    focal_px: float
    """Focal length in pixels of the view."""
    focal_std_px: float
    """Standard deviation of the focal length in pixels of the view."""
    radial: float | None = None
    """Radial distortion ``k1`` of COLMAP's camera model SIMPLE_RADIAL."""
    radial_std: float | None = None
    """Standard deviation of the radial distortion."""
    gravity: Float64 | None = None
    """Unit vector (3,) float64 of gravity in the camera frame, which points down: (0, 1, 0) for an
    upright camera."""
    gravity_std_deg: float | None = None
    """Standard deviation of the angle of gravity in degrees."""

    def __post_init__(self) -> None:
        for name in ("focal_px", "focal_std_px", "radial_std", "gravity_std_deg"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise DataError(name, f"must be positive and finite, got {value!r}")
        for value, std in (("radial", "radial_std"), ("gravity", "gravity_std_deg")):
            if (getattr(self, value) is None) != (getattr(self, std) is None):
                raise DataError(value, f"{value} and {std} must both be given or both be None")
        if self.radial is not None and not np.isfinite(self.radial):
            raise DataError("radial", f"must be finite, got {self.radial!r}")
        if self.gravity is not None:
            gravity = np.asarray(self.gravity)
            if gravity.shape != (3,) or not abs(np.linalg.norm(gravity) - 1) < 1e-3:
                raise DataError("gravity", f"must be a unit vector (3,), got {gravity}")


@runtime_checkable
class CameraProvider(Protocol):
    """Provider that calibrates the camera of a single image."""

    def calibrate(self, view: View) -> CameraPrior | None:
        """Estimate an image's focal length and, if possible, radial distortion and gravity.

        Args:
            view: Image. The estimate must not depend on ``view.camera``, which is a guess.

        Returns:
            Camera parameters with standard deviations, or None if the provider cannot estimate the
            focal length of the image.
        """
        ...


def run_camera(spec: ProviderSpec, provider: CameraProvider, view: View) -> CameraPrior | None:
    """Calibrate the camera of an image and validate the camera parameters."""
    with provider_errors(spec, view.name):
        return validate_camera(spec, view, provider.calibrate(view))


def validate_camera(spec: ProviderSpec, view: View, output: object) -> CameraPrior | None:
    """Validate the values and declared capabilities of camera parameters.

    Args:
        spec: Specification of the provider, with its capabilities.
        view: Image that the provider processed.
        output: Return value of the provider.

    Returns:
        The camera parameters, or None if the provider cannot estimate the focal length.

    Raises:
        ProviderOutputError: The output violates a rule of the interface. The error message names
            provider, image, field and rule.
    """
    with name_violations(spec, view.name):
        if output is None:
            return None
        prior = revalidate(output, CameraPrior, "output")
        for capability in ("radial", "gravity"):
            if getattr(prior, capability) is None:
                require_undeclared(spec, f"estimates-{capability}", capability)
        return prior


def compare_with_true_camera(
    case: CheckedProvider, example: Any, output: CameraPrior | None
) -> str:
    """Compare an estimated focal length with the true focal length of a synthetic view."""
    prior = _require_estimate(output)
    true_px = (example.camera.fx + example.camera.fy) / 2
    error = abs(prior.focal_px - true_px)
    text = f"the focal length is {prior.focal_px:.1f} px, the truth is {true_px:.1f} px"
    if error > MAX_ERROR_STD * prior.focal_std_px:
        raise DataError("focal_px", f"{text}, and the std is {prior.focal_std_px:.2g} px only")
    _require_true_gravity(prior, example)
    return f"{text}, with a std of {prior.focal_std_px:.1f} px"


def check_camera_focal(case: CheckedProvider) -> str:
    """Require that the estimated focal length in pixels is within 4 std of the true one.

    A view of half the width around the image center has the same focal length. A test network that
    decodes painted colors knows no focal length of a black view, so the provider has to return None
    or a std of at least 10 % for this view.
    """
    case.require_truth("painted", "prepared", "image")
    if case.truth_source == "painted":
        view = case.example.view
        black = replace(view, image=np.zeros_like(view.image))
        unknown: CameraPrior | None = case.run_on_view(black, case.example)
        if unknown is not None and unknown.focal_std_px < _MIN_UNKNOWN_STD * unknown.focal_px:
            raise DataError("focal_std_px", "is below 10 % for a black view")
    width, height = case.example.camera.size
    center = case.example.crop(width // 4, height // 4, width // 2, height // 2)
    compare_with_true_camera(case, center, case.run(center))
    return compare_with_true_camera(case, case.example, case.run(case.example))


def check_camera_std(case: CheckedProvider) -> str:
    """Require a std of at most 30 % of the focal length, in pixels of the view.

    A variance, a relative std or the std of an angle is no std in pixels.
    """
    small, large = (_require_estimate(case.run(example)) for example in _two_sizes(case))
    ratio = small.focal_std_px / small.focal_px
    if ratio > MAX_RELATIVE_STD:
        raise DataError("focal_std_px", f"is {ratio:.0%} of the focal length")
    growth = large.focal_std_px / small.focal_std_px / (large.focal_px / small.focal_px)
    if not 1 / 1.5 < growth < 1.5:
        raise DataError(
            "focal_std_px",
            f"is {ratio:.2%} of the focal length, and {ratio * growth:.2%} at twice the image size",
        )
    return f"std of {ratio:.1%}"


def check_camera_size(case: CheckedProvider) -> str:
    """Require twice the focal length for a view of twice the size, at a plausible angle of view.

    A network that resizes its input has to convert the focal length to pixels of the view.
    """
    small, large = (_require_estimate(case.run(example)) for example in _two_sizes(case))
    growth = large.focal_px / small.focal_px
    if abs(growth / 2 - 1) > _SIZE_TOLERANCE:
        raise DataError(
            "focal_px",
            f"is {small.focal_px:.1f} px, and {large.focal_px:.1f} px at twice the image size",
        )
    angle = float(np.rad2deg(2 * np.arctan(max(case.example.camera.size) / 2 / large.focal_px)))
    if not _ANGLE_RANGE_DEG[0] < angle < _ANGLE_RANGE_DEG[1]:
        raise DataError(
            "focal_px", f"{large.focal_px:.1f} px is an angle of view of {angle:.0f} degrees"
        )
    return f"angle of view {angle:.0f} degrees"


def check_camera_guess(case: CheckedProvider) -> None:
    """Require that the estimate does not depend on the camera of the view, which is a guess."""
    view = case.example.view
    guess = replace(view.camera, fx=2 * view.camera.fx, fy=2 * view.camera.fy)
    first = _require_estimate(case.run(case.example))
    second = _require_estimate(case.run_on_view(replace(view, camera=guess), case.example))
    if first.focal_px != second.focal_px:
        raise DataError(
            "focal_px",
            f"is {first.focal_px:.1f} px, and {second.focal_px:.1f} px if the camera of the view "
            f"has twice the focal length",
        )


def check_camera_mirror(case: CheckedProvider) -> str:
    """Require the same focal length, and gravity with negated x, for the mirrored view."""
    first, second = (_require_estimate(case.run(e)) for e in (case.example, case.example.mirror()))
    difference = abs(first.focal_px - second.focal_px)
    if difference > MAX_ERROR_STD * (first.focal_std_px + second.focal_std_px):
        raise DataError("focal_px", f"differs by {difference:.1f} px in the mirrored view")
    if first.gravity is None or second.gravity is None:
        return f"the focal length differs by {difference:.2g} px"
    angle = _angle_deg(first.gravity * (-1.0, 1.0, 1.0), second.gravity)
    if angle > max(2 * _GRAVITY_TOLERANCE_DEG, MAX_ERROR_STD * (first.gravity_std_deg or 0.0)):
        raise DataError("gravity", f"differs by {angle:.0f} degrees in the mirrored view")
    return f"gravity differs by {angle:.2g} degrees"


def check_camera_gravity(case: CheckedProvider) -> str:
    """Require gravity in the camera frame, which points down along y for an upright camera.

    The std of gravity is in degrees: no network knows gravity to 0.1 degrees.
    """
    case.require_capability("estimates-gravity")
    case.require_truth("painted", "prepared", "image")
    prior = _require_estimate(case.run(case.example))
    if prior.gravity_std_deg is not None and prior.gravity_std_deg < _MIN_GRAVITY_STD_DEG:
        raise DataError("gravity_std_deg", f"{prior.gravity_std_deg:.2g} is no std in degrees")
    return _require_true_gravity(prior, case.example)


def check_camera_radial(case: CheckedProvider) -> str:
    """Require a radial distortion near 0 for a view without distortion."""
    case.require_capability("estimates-radial")
    case.require_truth("painted", "prepared", "image")
    prior = _require_estimate(case.run(case.example))
    assert prior.radial is not None and prior.radial_std is not None
    if abs(prior.radial) > max(_RADIAL_TOLERANCE, MAX_ERROR_STD * prior.radial_std):
        raise DataError("radial", f"is {prior.radial:.3g} for a view without distortion")
    return f"k1 = {prior.radial:.3g}"


CHECKS = (
    check_camera_focal,
    check_camera_std,
    check_camera_size,
    check_camera_guess,
    check_camera_mirror,
    check_camera_gravity,
    check_camera_radial,
)


def _two_sizes(case: CheckedProvider) -> tuple[Any, Any]:
    width, height = case.example.camera.size
    return case.example.sized(width // 2, height // 2), case.example


def _require_true_gravity(prior: CameraPrior, example: Any) -> str:
    """Require that gravity, if a network estimates it, points along the true direction."""
    if prior.gravity is None or prior.gravity_std_deg is None:
        return "no gravity"
    true = -np.asarray(example.pose)[:, 2]
    angle = _angle_deg(prior.gravity, true)
    if angle > max(_GRAVITY_TOLERANCE_DEG, MAX_ERROR_STD * prior.gravity_std_deg):
        up = "; the vector points up" if _angle_deg(-prior.gravity, true) < angle / 3 else ""
        raise DataError("gravity", f"gravity is {angle:.0f} degrees off{up}")
    return f"gravity is {angle:.2g} degrees off"


def _require_estimate(output: CameraPrior | None) -> CameraPrior:
    if output is None:
        raise DataError("focal_px", "cannot tell: the provider returns no focal length")
    return output


def _angle_deg(first: Float64, second: Float64) -> float:
    return float(np.rad2deg(np.arccos(np.clip(first @ second, -1, 1))))


_MODEL = """\
import numpy as np

from mpsfm_core import Options
from mpsfm_core.providers.kinds.camera import CameraPrior


class ${Class}Options(Options):
    weights: str  # a path, or hf://ORG/REPO@REVISION/FILE, https://..., package:...
    sha256: str | None = None


class $Class:
    def __init__(self, options, context):
        self._network = Network(context.resolve_weights(options.weights, options.sha256))

    def calibrate(self, view):
        focal, gravity = self._network(view.image / 255)  # in pixels of the view; unit vector
        if not focal > 0:
            return None  # the image shows too little
        return CameraPrior(focal, 0.03 * focal, gravity=gravity, gravity_std_deg=2.0)


class Network:  # replace by your network; this example decodes a painted ground plane
    def __init__(self, path):
        with np.load(path) as weights:
            self._weights, self._bias = weights["weights"], weights["bias"]

    def __call__(self, rgb):
        height, width = rgb.shape[:2]
        y, x = np.mgrid[:height, :width] + 0.5 - np.array([height, width])[:, None, None] / 2
        decoded = rgb @ self._weights.T + self._bias  # depth, normal
        depth, normals = decoded[..., 0], decoded[..., 1:]
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
        low = normals[(depth > 0) & (y > height / 4)]
        normal = np.median(low, axis=0) if len(low) else np.array([0.0, -1.0, 0.0])
        normal /= np.linalg.norm(normal)
        ground = (depth > 0) & (normals @ normal > 0.995)
        if ground.sum() < 50:
            return 0.0, -normal
        # plane: n_x x + n_y y + n_z f = h / depth, with the unknown focal length f and h
        a = np.column_stack([np.full(ground.sum(), normal[2]), -1 / depth[ground]])
        b = -(normal[0] * x + normal[1] * y)[ground]
        return float(np.linalg.lstsq(a, b, rcond=None)[0][0]), -normal
"""

_PLUGIN = """\
from mpsfm_core import ProviderSpec, hookimpl
from mpsfm_core.providers import weights_from_option


@hookimpl
def mpsfm_providers():
    return [
        ProviderSpec(
            kind="camera",
            name="$name",
            factory="$module.model:$Class",
            options="$module.model:${Class}Options",
            capabilities=frozenset({"estimates-gravity"}),
            weights=weights_from_option("weights"),
            contract="$module.contract:contract",
            code_license="Apache-2.0",
        )
    ]
"""

_CONTRACT = '''\
import numpy as np

from mpsfm_core.testing import ContractSetup
from mpsfm_core.testing.painted_views import decoder


def contract(folder):
    """Write weights for which the network decodes the depth and normals of the test views."""
    weights, bias = decoder()
    np.savez(folder / "tiny.npz", weights=255 * weights, bias=bias)
    return ContractSetup(options={"weights": str(folder / "tiny.npz")}, truth_source="painted")
'''

_USAGE = """\
extends: fast-cpu
camera:
  use: $name
  options: {weights: weights.npz}
"""

KIND = ProviderKind(
    name="camera",
    title="Camera calibration",
    protocol=CameraProvider,
    checks=f"{__name__}:CHECKS",
    capabilities={
        "estimates-radial": "The camera provider estimates the radial distortion.",
        "estimates-gravity": "The camera provider estimates the direction of gravity.",
    },
    run=run_camera,
    data_types=(CameraPrior,),
    example_scene="centered",
    compare=compare_with_true_camera,
    template={
        "model.py": _MODEL,
        "plugin.py": _PLUGIN,
        "contract.py": _CONTRACT,
        "usage.yaml": _USAGE,
    },
)
