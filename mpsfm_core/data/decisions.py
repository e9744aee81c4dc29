"""Typed reasons of the decisions that a run makes about images, pairs and providers.

A reason has a code and the fields that the code declares. ``summary.json`` stores a reason as
``{"code": ..., field: ...}``. Only :mod:`mpsfm_core.report.reasons` renders a reason into words and
a remedy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, TypeVar

from mpsfm_core.data.errors import DataError

Value = str | int | float
Code = TypeVar("Code", bound="ReasonCode")


class ReasonCode(Enum):
    """Base class of reason codes; a member has a text code and the names of its fields."""

    fields: tuple[str, ...]

    def __new__(cls, code: str, *fields: str) -> ReasonCode:
        """Create a reason code from its text code and the names of its fields."""
        member = object.__new__(cls)
        member._value_ = code
        member.fields = fields
        return member

    def because(self, **values: Value) -> Reason:
        """Build a reason from the code and ``values`` for exactly the fields of the code."""
        return Reason(self, values)


class ImageReason(ReasonCode):
    """Reasons why an image is not registered, or why a pair cannot initialize a component."""

    NO_VERIFIED_MATCHES = ("no-verified-matches",)
    NO_REGISTERED_NEIGHBOR = ("no-registered-neighbor",)
    NO_VALID_DEPTH = ("no-valid-depth",)
    TOO_FEW_POINTS = ("too-few-points", "num_matches", "min_matches")
    """Too few matches of the image have a 3D point to estimate a pose from."""
    NO_POSE = ("no-pose",)
    """No pose estimator returns a pose for the image."""
    TOO_FEW_INLIERS = ("too-few-inliers", "num_inliers", "min_inliers")
    LOW_INLIER_RATIO = ("low-inlier-ratio", "inlier_ratio", "min_inlier_ratio")
    TOO_FEW_POINTS_AFTER_REFINEMENT = ("too-few-points-after-refinement",)
    LOST_POINTS = ("lost-points", "step")
    """The image lost its 3D points in ``step``: local-refinement, global-refinement,
    re-registration or component-split."""
    CONTRADICTS_IMAGE = ("contradicts-image", "violation_ratio", "other_image")
    """The depth of another image contradicts the pose at the ratio ``violation_ratio`` of
    pixels."""
    CONTRADICTS_DEPTH = ("contradicts-depth", "violation_ratio", "step")
    """The ratio ``violation_ratio`` of pixels contradicts the depth of other images in a global
    check.

    The value of ``step`` is global-initialization or final-check.
    """
    CONTRADICTED_BY_IMAGES = ("contradicted-by-images", "num_images")
    MISREGISTERED = ("misregistered", "num_matches")
    """By ``num_matches``, more matches contradict the pose than support the pose."""
    SPLIT_OFF = ("split-off", "num_matches")
    """One pair connects the image to the model, and ``num_matches`` more matches contradict the
    connection."""
    DISCONNECTED = ("disconnected", "step")
    """After ``step``, no chain of common points connects the image to the largest part of the
    model."""
    CONNECTED_BY_DROPPED_IMAGE = ("connected-by-dropped-image", "step")
    COMPONENT_TOO_SMALL = ("component-too-small", "num_images", "min_images")
    COMPONENT_LIMIT = ("component-limit", "max_components")
    OTHER_COMPONENT = ("other-component", "component")
    """The image is registered in another component, in the folder components/<component>."""
    NO_KNOWN_POSE = ("no-known-pose",)
    """The run fixes known poses, and the image has no known pose."""
    NOT_RECORDED = ("not-recorded",)


class PairReason(ReasonCode):
    """Reasons why geometric verification drops an image pair."""

    TOO_FEW_MATCHES = ("too-few-matches", "num_matches", "min_matches")
    TOO_FEW_INLIERS = ("too-few-inliers", "num_inliers", "num_matches")
    DEGENERATE = ("degenerate", "num_inliers", "num_matches", "geometry")
    """COLMAP classifies the two-view geometry as degenerate, watermark or undefined."""
    EXPLAINED_BY_CHANCE = ("explained-by-chance", "num_inliers", "num_matches")
    """Random matches would have as many inliers (a-contrario test)."""
    NO_RELATIVE_POSE = ("no-relative-pose",)


class ProviderReason(ReasonCode):
    """Reasons why the configuration uses a fallback instead of a preferred provider."""

    UNAVAILABLE = ("unavailable", "detail")
    """The plugin is missing or broken, or rejects the options."""
    INCOMPATIBLE = ("incompatible", "detail")
    """The provider cannot be combined with the other chosen providers."""
    NO_WEIGHTS = ("no-weights", "detail")


class ChoiceReason(ReasonCode):
    """Reasons why a block of the configuration uses its provider."""

    CONFIGURED = ("configured",)
    FIRST_CHOICE = ("first-choice",)
    FALLBACK = ("fallback",)


class CameraReason(ReasonCode):
    """Reasons why bundle adjustment does not refine the focal length of a camera."""

    KNOWN = ("known",)
    """The focal length is given."""
    NOT_ESTIMATED = ("not-estimated",)
    """Refinement is switched off, or the image was registered tentatively."""
    TOO_FEW_IMAGES = ("too-few-images", "num_images", "min_images")
    """Only ``num_images`` images are registered in the model."""
    NOT_OBSERVABLE = ("not-observable", "focal_length_std_ratio")
    """The images do not constrain the focal length, whose relative std is
    ``focal_length_std_ratio``."""
    OUT_OF_RANGE = ("out-of-range", "equivalent_mm")
    """No lens has the refined focal length, whose 35 mm equivalent is ``equivalent_mm``."""


class GpsReason(ReasonCode):
    """Reasons why a reconstruction is not aligned with the GPS positions of its images."""

    TOO_FEW_POSITIONS = ("too-few-positions", "num_positions", "min_positions")
    TOO_LITTLE_SPREAD = ("too-little-spread", "spread_m", "std_m")
    INCONSISTENT = ("inconsistent",)
    """No similarity transform fits the GPS positions."""
    FEW_INLIERS = ("few-inliers", "num_inliers", "num_positions")


class DoubtReason(ReasonCode):
    """Reasons to doubt a reconstruction although its images are registered."""

    UNEXPLAINED_PAIRS = ("unexplained-pairs", "num_pairs", "image_a", "image_b", "num_matches")
    """Verified pairs whose images share hardly any point in the model."""
    DISCONNECTED = ("disconnected", "num_parts", "num_images")
    """Parts of the model share no points, and ``num_images`` images are outside the largest
    part."""
    LOW_PARALLAX = ("low-parallax", "angle_deg")
    """The rays of most points are nearly parallel, so the depth priors alone give the depth."""
    FEW_POINTS = ("few-points", "num_images", "min_points")
    """``num_images`` images observe fewer than ``min_points`` 3D points."""
    FEW_EXPLAINED_MATCHES = ("few-explained-matches", "num_images", "min_ratio")
    """``num_images`` images have mostly matches that contradict the model."""
    GPS_MISFIT = ("gps-misfit", "num_inliers", "num_positions")
    UNKNOWN_FOCAL_LENGTH = ("unknown-focal-length", "num_images")
    """``num_images`` images have a guessed focal length that bundle adjustment did not refine."""


@dataclass(frozen=True)
class Reason:
    """Reason of a decision: a code and the values of the code's fields."""

    code: ReasonCode
    values: Mapping[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the values have exactly the fields of the code."""
        if set(self.values) != set(self.code.fields):
            wanted = ", ".join(self.code.fields) or "no field"
            raise DataError(self.code.value, f"needs {wanted}, got {', '.join(self.values)}")

    def to_json(self) -> dict[str, Value]:
        """Convert the reason to the dictionary in ``summary.json``."""
        return {"code": self.code.value, **self.values}


def reason_from_json(codes: type[Code], stored: Mapping[str, Any]) -> Reason:
    """Restore a reason from the output of :meth:`Reason.to_json`.

    Args:
        codes: Enumeration that contains the reason code.
        stored: Dictionary with the code and the values of its fields.

    Raises:
        DataError: The code is unknown, or its fields are incomplete.
    """
    values = {name: value for name, value in stored.items() if name != "code"}
    try:
        code = codes(stored["code"])
    except (KeyError, ValueError) as error:
        raise DataError("reason", f"has no known code: {stored}") from error
    return Reason(code, values)
