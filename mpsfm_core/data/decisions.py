"""Machine-readable reasons for decisions about images, image pairs and priors.

A reason consists of a code, such as ``too-few-inliers``, and the values of its fields.
``summary.json`` stores a reason as ``{"code": ..., field: ...}``. Only
:mod:`mpsfm_core.report.reasons` renders a reason into words and a remedy.
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
    """Base class of enumerations of reason codes, such as :class:`ImageReason`."""

    fields: tuple[str, ...]

    def __new__(cls, code: str, *fields: str) -> ReasonCode:
        """Create a reason code from its text in `summary.json` and the names of its fields."""
        member = object.__new__(cls)
        member._value_ = code
        member.fields = fields
        return member

    def because(self, **values: Value) -> Reason:
        """Build a :class:`Reason` from this code and a value for each of its fields."""
        return Reason(self, values)


class ImageReason(ReasonCode):
    """Reasons why an image is not registered, or why a pair cannot be the initial pair."""

    NO_VERIFIED_MATCHES = ("no-verified-matches",)
    NO_REGISTERED_NEIGHBOR = ("no-registered-neighbor",)
    NO_VALID_DEPTH = ("no-valid-depth",)
    TOO_FEW_POINTS = ("too-few-points", "num_matches", "min_matches")
    """Too few keypoints of the image match a keypoint with a 3D point to estimate a pose."""
    NO_POSE = ("no-pose",)
    """Pose estimation from 2D-3D matches fails for the image."""
    TOO_FEW_INLIERS = ("too-few-inliers", "num_inliers", "min_inliers")
    LOW_INLIER_RATIO = ("low-inlier-ratio", "inlier_ratio", "min_inlier_ratio")
    TOO_FEW_POINTS_AFTER_REFINEMENT = ("too-few-points-after-refinement",)
    LOST_POINTS = ("lost-points", "step")
    """The image lost its 3D points in the step ``local-refinement``, ``global-refinement``,
    ``re-registration`` or ``component-split`` of the mapper."""
    CONTRADICTS_IMAGE = ("contradicts-image", "violation_ratio", "other_image")
    """The depth map of another image contradicts the pose of the image. The ratio
    ``violation_ratio`` of the pixels has inconsistent depth."""
    CONTRADICTS_DEPTH = ("contradicts-depth", "violation_ratio", "step")
    """The depth maps of other images contradict the pose of the image in a check of all images.

    The ratio ``violation_ratio`` of the pixels has inconsistent depth. The mapper checks all
    images in ``step``, which is ``global-initialization`` or ``final-check``.
    """
    CONTRADICTED_BY_IMAGES = ("contradicted-by-images", "num_images")
    MISREGISTERED = ("misregistered", "num_matches")
    """The matches that contradict the pose outnumber the supporting matches by ``num_matches``."""
    SPLIT_OFF = ("split-off", "num_matches")
    """Only one image pair connects the image to the model, and the matches that contradict the pair
    outnumber its inliers by ``num_matches``."""
    DISCONNECTED = ("disconnected", "step")
    """No chain of shared 3D points connects the image to the largest part of the model after
    ``step``."""
    CONNECTED_BY_DROPPED_IMAGE = ("connected-by-dropped-image", "step")
    COMPONENT_TOO_SMALL = ("component-too-small", "num_images", "min_images")
    COMPONENT_LIMIT = ("component-limit", "max_components")
    OTHER_COMPONENT = ("other-component", "component")
    """The image is registered in another component (model), in folder components/<component>."""
    NO_KNOWN_POSE = ("no-known-pose",)
    """The user gives fixed camera poses, but no pose for this image."""
    NOT_RECORDED = ("not-recorded",)


class PairReason(ReasonCode):
    """Reasons why geometric verification drops an image pair."""

    TOO_FEW_MATCHES = ("too-few-matches", "num_matches", "min_matches")
    TOO_FEW_INLIERS = ("too-few-inliers", "num_inliers", "num_matches")
    DEGENERATE = ("degenerate", "num_inliers", "num_matches", "geometry")
    """COLMAP classifies the two-view geometry as degenerate, watermark or undefined."""
    EXPLAINED_BY_CHANCE = ("explained-by-chance", "num_inliers", "num_matches")
    """Random matches between the images would have as many inliers (a-contrario test)."""
    NO_RELATIVE_POSE = ("no-relative-pose",)


class ProviderReason(ReasonCode):
    """Reasons why a fallback network replaces the preferred network for a kind of prior."""

    UNAVAILABLE = ("unavailable", "detail")
    """The plugin of the network is missing or broken, or rejects the configured options."""
    INCOMPATIBLE = ("incompatible", "detail")
    """The network cannot be combined with the other configured networks."""
    NO_WEIGHTS = ("no-weights", "detail")


class HookReason(ReasonCode):
    """Reasons why a run ignores a plugin's hook or distrusts the hook's return value."""

    LEFT_OUT = ("hook-left-out", "plugin", "hook", "detail")
    """The hook raises an exception or returns an unusable value, and is not called again."""
    PAIRS_IGNORED = ("pairs-ignored", "plugin", "hook", "detail")
    """A pair filter selects pairs that are no candidates, which the run ignores."""
    NO_PAIRS = ("no-pairs-selected", "plugin", "hook", "detail")
    """A pair filter selects none of the candidate pairs."""


class ChoiceReason(ReasonCode):
    """Reasons why the configuration selects a network for a kind of prior."""

    CONFIGURED = ("configured",)
    FIRST_CHOICE = ("first-choice",)
    FALLBACK = ("fallback",)


class CameraReason(ReasonCode):
    """Reasons why bundle adjustment does not refine focal length or distortion of a camera."""

    KNOWN = ("known",)
    """The focal length is known from the user's input."""
    NOT_ESTIMATED = ("not-estimated",)
    """Refinement of focal lengths is disabled, or the image was registered tentatively."""
    TOO_FEW_IMAGES = ("too-few-images", "num_images", "min_images")
    """Only ``num_images`` images are registered, which is fewer than ``min_images``."""
    NOT_OBSERVABLE = ("not-observable", "focal_length_std_ratio")
    """The images do not constrain the focal length, whose relative std is
    ``focal_length_std_ratio``."""
    OUT_OF_RANGE = ("out-of-range", "equivalent_mm")
    """The refined focal length is implausible for any lens; its 35 mm equivalent is
    ``equivalent_mm``."""
    DISTORTION_NOT_ESTIMATED = ("distortion-not-estimated",)
    """Distortion is not refined because its refinement is disabled or the focal length is fixed."""
    DISTORTION_NOT_OBSERVABLE = ("distortion-not-observable", "radial_std")
    """The images do not constrain the radial distortion, whose std is ``radial_std``."""
    DISTORTION_OUT_OF_RANGE = ("distortion-out-of-range", "radial")
    """The refined coefficient ``radial`` is implausible for SIMPLE_RADIAL."""
    PARAMETER_NOT_OBSERVABLE = ("parameter-not-observable", "parameter", "std")
    """The images do not constrain the intrinsic parameter, whose std is ``std``."""
    PARAMETER_OUT_OF_RANGE = ("parameter-out-of-range", "parameter", "value")
    """The refined ``value`` of the intrinsic parameter is implausible."""


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
    """Some image pairs have many verified matches but share hardly any 3D point in the model."""
    CONTRADICTED_GROUP = ("contradicted-group", "num_images", "num_matches")
    """The poses of ``num_images`` images relative to the other images are probably wrong, because
    ``num_matches`` more matches contradict than support them."""
    DISCONNECTED = ("disconnected", "num_parts", "num_images")
    """The model falls into parts that share few 3D points, and ``num_images`` images are outside
    the largest part."""
    LOW_PARALLAX = ("low-parallax", "angle_deg")
    """The viewing rays of most 3D points are nearly parallel, so only the depth priors determine
    the depth of these points."""
    SCALE_FROM_DEPTH = ("scale-from-depth", "scale_std_ratio", "depth_std_ratio")
    """The matches determine the distances between frames of rigs up to the relative standard
    deviation ``scale_std_ratio``, and depth priors up to ``depth_std_ratio``."""
    FEW_POINTS = ("few-points", "num_images", "min_points")
    """``num_images`` images observe fewer than ``min_points`` 3D points."""
    FEW_EXPLAINED_MATCHES = ("few-explained-matches", "num_images", "min_ratio")
    """The model explains less than the ratio ``min_ratio`` of the matches of ``num_images``
    images."""
    GPS_MISFIT = ("gps-misfit", "num_inliers", "num_positions")
    """Only ``num_inliers`` of ``num_positions`` GPS positions fit the camera centers."""
    UNKNOWN_FOCAL_LENGTH = ("unknown-focal-length", "num_images", "std_ratio")
    """The relative std of the guessed focal length of ``num_images`` images is up to
    ``std_ratio``."""
    UNCERTAIN_POSES = ("uncertain-poses", "num_images", "error_deg")
    """Other focal lengths, principal points and distortions fit the matches as well or better. They
    change the relative poses of ``num_images`` images by up to ``error_deg`` degrees."""
    CONTRADICTORY_DEPTH = ("contradictory-depth", "num_images", "num_stds", "error_deg")
    """The depth of two frames of rigs differs by ``num_stds`` standard deviations at common points.
    Matches alone leave errors of up to ``error_deg`` degrees in the poses of ``num_images``
    images."""
    PARTIAL_COVERAGE = ("partial-coverage", "provider", "num_images", "width_ratio", "height_ratio")
    """The keypoints of a features provider cover only the upper left part of all images, up to the
    ratios ``width_ratio`` and ``height_ratio`` of the image size."""
    FOCAL_LENGTH_FROM_ONE_IMAGE = ("focal-length-from-one-image", "image")
    """The unknown focal length and the pose of a localized photo result from matches with a single
    image of the model."""
    DEPTH_CONTRADICTS_MODEL = ("depth-contradicts-model", "violation_ratio", "other_image")
    """At the pose of a localized photo, the ratio ``violation_ratio`` of its depth map contradicts
    the depth of an image of the model."""
    CAMERA_JUMP = ("camera-jump", "image_a", "image_b")
    """The camera of a video jumps between two successive keyframes, which share few 3D points."""
    MEANINGLESS_SCORES = ("meaningless-scores", "provider", "num_pairs")
    """The match scores of a matcher are unrelated to the matches, or lower for inliers than for
    outliers."""


class KeyframeReason(ReasonCode):
    """Reasons why a frame of a video is a keyframe."""

    FIRST = ("first",)
    MOVED = ("moved", "motion_ratio")
    """The tracked points moved by ``motion_ratio`` of the image diagonal in the median."""
    LOST_OVERLAP = ("lost-overlap", "tracked_ratio")
    """Only the share ``tracked_ratio`` of the points of the previous keyframe is still tracked."""
    UNTRACKED = ("untracked", "num_tracks")
    """Too few points are tracked to measure the motion of the camera."""
    CUT = ("cut",)
    """A cut separates the frame from the previous frame, so that a new shot starts."""


class FrameReason(ReasonCode):
    """Reasons why a frame of a video has no pose, or why its pose is interpolated."""

    TOO_FEW_TRACKS = ("too-few-tracks", "num_tracks", "min_tracks")
    """Too few points of the neighboring keyframes are tracked into the frame."""
    TOO_FEW_INLIERS = ("too-few-inliers", "num_inliers", "min_inliers")
    """Too few tracked points fit one pose."""
    NO_KEYFRAME = ("no-keyframe",)
    """No keyframe of the same shot is registered."""


@dataclass(frozen=True)
class Reason:
    """Reason for a decision, consisting of a code and the values of its fields."""

    code: ReasonCode
    values: Mapping[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the reason has a value for each field of its code, and no other values."""
        if set(self.values) != set(self.code.fields):
            wanted = ", ".join(self.code.fields) or "no field"
            raise DataError(
                self.code.value,
                f"a reason with this code needs the values {wanted}, got {', '.join(self.values)}",
            )

    def to_json(self) -> dict[str, Value]:
        """Convert the reason to the dictionary in ``summary.json``."""
        return {"code": self.code.value, **self.values}


def reason_from_json(codes: type[Code], stored: Mapping[str, Any]) -> Reason:
    """Restore a reason from the output of :meth:`Reason.to_json`.

    Args:
        codes: Enumeration in which the reason code is looked up, such as :class:`ImageReason`.
        stored: Dictionary with the reason code and the values of its fields.

    Raises:
        DataError: The reason code is unknown, or a field of the reason is missing.
    """
    values = {name: value for name, value in stored.items() if name != "code"}
    try:
        code = codes(stored["code"])
    except (KeyError, ValueError) as error:
        raise DataError("reason", f"reason has no known code: {stored}") from error
    return Reason(code, values)
