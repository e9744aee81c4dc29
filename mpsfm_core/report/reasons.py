"""Render the typed reasons of a run into words and a remedy for users.

:mod:`mpsfm_core.data.decisions` defines the reasons. Terminal, report page and exceptions call
:func:`explain`, so that each reason has one text.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mpsfm_core.data.decisions import (
    CameraReason,
    ChoiceReason,
    DoubtReason,
    FrameReason,
    GpsReason,
    HookReason,
    ImageReason,
    KeyframeReason,
    PairReason,
    ProviderReason,
    Reason,
    ReasonCode,
    reason_from_json,
)

_ADD_OVERLAP = (
    "Take photos between this photo and its neighbors, each sharing about half of its view with "
    "the next, or try other features: --config robust."
)
_CHECK_DEPTH = (
    "Look at its matches and its prior depth below. Repeated structure (furniture, windows) or a "
    "wrong depth prior causes this. Add a photo from nearby, or use a better depth network."
)
_CHECK_MATCHES = (
    "Look at its matches below. If they lie on moving or repeated objects, add a photo from "
    "nearby. If they look right, give the true focal length with --intrinsics."
)
_CHECK_HOOK = "Test the plugin with mpsfm plugins check {plugin}."
_NO_REMEDY = ""


@dataclass(frozen=True)
class Explanation:
    """Explanation of a reason for users."""

    title: str
    """Short phrase without numbers; photos whose reasons have the same title are reported
    together."""
    text: str
    """Sentence about what happened to the photo, pair or run."""
    remedy: str
    """Next step for the user, empty if there is no remedy."""


_TEMPLATES: Mapping[ReasonCode, tuple[str, str, str]] = {
    ImageReason.NO_VERIFIED_MATCHES: (
        "no verified matches",
        "No match with any other photo passes geometric verification.",
        _ADD_OVERLAP + " Leave out blurred or very dark photos.",
    ),
    ImageReason.NO_REGISTERED_NEIGHBOR: (
        "matches only with unregistered photos",
        "It matches other photos, but none of them is registered.",
        "Add a photo that overlaps with these photos and with the registered ones.",
    ),
    ImageReason.NO_VALID_DEPTH: (
        "no valid depth",
        "The depth provider returned no valid depth.",
        "Check the mask, and the files or the network of the depth provider.",
    ),
    ImageReason.TOO_FEW_POINTS: (
        "too little overlap with the model",
        "Only {num_matches} matches have a 3D point; {min_matches} are needed.",
        _ADD_OVERLAP,
    ),
    ImageReason.NO_POSE: (
        "inconsistent matches",
        "Neither PnP nor the essential matrix gives a pose.",
        _CHECK_MATCHES,
    ),
    ImageReason.TOO_FEW_INLIERS: (
        "inconsistent matches",
        "Only {num_inliers} matches are inliers of its pose; {min_inliers} are needed.",
        _CHECK_MATCHES,
    ),
    ImageReason.LOW_INLIER_RATIO: (
        "inconsistent matches",
        "Only {inlier_ratio:.0%} of its matches are inliers of its pose; {min_inlier_ratio:.0%} "
        "are needed.",
        _CHECK_MATCHES,
    ),
    ImageReason.TOO_FEW_POINTS_AFTER_REFINEMENT: (
        "too few points after refinement",
        "Too few points had small reprojection errors after bundle adjustment.",
        _ADD_OVERLAP,
    ),
    ImageReason.LOST_POINTS: (
        "too few points after refinement",
        "It was registered, and lost its points in the {step}.",
        _ADD_OVERLAP,
    ),
    ImageReason.CONTRADICTS_IMAGE: (
        "contradicted by the depth of another photo",
        "At its pose, {violation_ratio:.0%} of the pixels contradict the depth of {other_image}.",
        _CHECK_DEPTH,
    ),
    ImageReason.CONTRADICTS_DEPTH: (
        "contradicted by the depth of another photo",
        "In the {step}, {violation_ratio:.0%} of its pixels contradict the depth of another photo.",
        _CHECK_DEPTH,
    ),
    ImageReason.CONTRADICTED_BY_IMAGES: (
        "contradicted by the depth of several photos",
        "{num_images} other photos contradict its depth at its pose.",
        _CHECK_DEPTH,
    ),
    ImageReason.MISREGISTERED: (
        "more matches against its pose than for it",
        "{num_matches} more matches contradict its pose than support it.",
        _CHECK_MATCHES,
    ),
    ImageReason.SPLIT_OFF: (
        "connected by one contradicted pair",
        "Only one pair of photos connected it to the model, and {num_matches} more matches "
        "contradict that pair.",
        _CHECK_MATCHES,
    ),
    ImageReason.DISCONNECTED: (
        "no points in common with the model",
        "After the {step}, it had no points in common with the largest part of the model.",
        _ADD_OVERLAP,
    ),
    ImageReason.CONNECTED_BY_DROPPED_IMAGE: (
        "connected only by a removed photo",
        "Only a photo that was removed in the {step} connected it to the model.",
        _ADD_OVERLAP,
    ),
    ImageReason.COMPONENT_TOO_SMALL: (
        "component too small",
        "Its component has only {num_images} photos; {min_images} are needed.",
        "Add photos of this place, or accept small components: --set mapping.min_model_size=2.",
    ),
    ImageReason.COMPONENT_LIMIT: (
        "too many components",
        "The photos form more components than are reconstructed ({max_components}).",
        "Add photos that connect the components, or raise mapping.max_components.",
    ),
    ImageReason.OTHER_COMPONENT: (
        "in another component",
        "It is registered in a model of its own, components/{component}: too few matches connect "
        "the two models.",
        "Add photos that overlap with both components.",
    ),
    ImageReason.NO_KNOWN_POSE: (
        "no known pose",
        "Known poses are fixed, and this photo has none.",
        "Leave out --set mapping.known_poses=fixed, or give its pose.",
    ),
    ImageReason.NOT_RECORDED: (
        "no recorded reason",
        "The run recorded no reason.",
        _ADD_OVERLAP,
    ),
    PairReason.TOO_FEW_MATCHES: (
        "too few matches",
        "{num_matches} matches; {min_matches} are needed.",
        _NO_REMEDY,
    ),
    PairReason.TOO_FEW_INLIERS: (
        "too few inliers",
        "Only {num_inliers} of {num_matches} matches are inliers.",
        _NO_REMEDY,
    ),
    PairReason.DEGENERATE: (
        "degenerate two-view geometry",
        "The two-view geometry is {geometry} ({num_inliers} of {num_matches} matches are inliers).",
        _NO_REMEDY,
    ),
    PairReason.EXPLAINED_BY_CHANCE: (
        "inliers explained by chance",
        "Random matches reach {num_inliers} inliers of {num_matches} as well.",
        _NO_REMEDY,
    ),
    PairReason.NO_RELATIVE_POSE: (
        "no relative pose",
        "The two-view geometry gives no relative pose.",
        _NO_REMEDY,
    ),
    ProviderReason.UNAVAILABLE: ("provider unavailable", "{detail}", "Run mpsfm doctor."),
    ProviderReason.INCOMPATIBLE: ("provider incompatible", "{detail}", "Run mpsfm doctor."),
    ProviderReason.NO_WEIGHTS: ("weights missing", "{detail}", "Run mpsfm doctor."),
    HookReason.LEFT_OUT: (
        "plugin hook left out",
        "The hook {hook} of the plugin {plugin} fails and is left out: {detail}.",
        _CHECK_HOOK,
    ),
    HookReason.PAIRS_IGNORED: (
        "selected pairs ignored",
        "The hook {hook} of the plugin {plugin}: {detail}.",
        _CHECK_HOOK,
    ),
    HookReason.NO_PAIRS: (
        "no pairs selected",
        "The hook {hook} of the plugin {plugin}: {detail}.",
        _CHECK_HOOK,
    ),
    ChoiceReason.CONFIGURED: ("configured", "as configured", _NO_REMEDY),
    ChoiceReason.FIRST_CHOICE: ("first choice", "the first choice", _NO_REMEDY),
    ChoiceReason.FALLBACK: ("fallback", "a fallback", _NO_REMEDY),
    GpsReason.TOO_FEW_POSITIONS: (
        "too few GPS positions",
        "{num_positions} registered photos have a GPS position; {min_positions} are needed.",
        _NO_REMEDY,
    ),
    GpsReason.TOO_LITTLE_SPREAD: (
        "GPS positions too close together",
        "GPS positions spread over {spread_m:.1f} m; their noise is {std_m:.1f} m.",
        _NO_REMEDY,
    ),
    GpsReason.INCONSISTENT: (
        "inconsistent GPS positions",
        "No alignment fits the GPS positions.",
        _NO_REMEDY,
    ),
    GpsReason.FEW_INLIERS: (
        "GPS positions contradict the model",
        "Only {num_inliers} of {num_positions} GPS positions fit the model.",
        _NO_REMEDY,
    ),
    KeyframeReason.FIRST: ("first frame", "The frame is the first of the video.", _NO_REMEDY),
    KeyframeReason.MOVED: (
        "the camera moved",
        "The tracked points moved by {motion_ratio:.0%} of the image diagonal since the previous "
        "keyframe.",
        _NO_REMEDY,
    ),
    KeyframeReason.LOST_OVERLAP: (
        "the view changed",
        "Only {tracked_ratio:.0%} of the points of the previous keyframe are still tracked.",
        _NO_REMEDY,
    ),
    KeyframeReason.UNTRACKED: (
        "no motion can be measured",
        "Only {num_tracks} points can be tracked, for example in front of a blank wall.",
        "Film surfaces with texture, and turn the camera slowly.",
    ),
    KeyframeReason.CUT: (
        "cut",
        "A cut separates the frame from the previous frame of the video.",
        _NO_REMEDY,
    ),
    FrameReason.TOO_FEW_TRACKS: (
        "too few tracked points",
        "{num_tracks} points can be tracked from the neighboring keyframes into the frame; "
        "{min_tracks} are needed.",
        "Film with less motion blur, and film surfaces with texture.",
    ),
    FrameReason.TOO_FEW_INLIERS: (
        "tracked points contradict each other",
        "{num_inliers} tracked points fit one pose of the frame; {min_inliers} are needed.",
        "Film with less motion blur, and avoid views that show mostly moving objects.",
    ),
    FrameReason.NO_KEYFRAME: (
        "no registered keyframe",
        "No keyframe of the same shot of the video is registered.",
        _ADD_OVERLAP,
    ),
    DoubtReason.UNEXPLAINED_PAIRS: (
        "matching photos that the model keeps apart",
        "{num_pairs} pairs of photos have many verified matches but share hardly any point, for "
        "example {image_a} and {image_b} with {num_matches} matches.",
        "Look at these matches below. If they are right, part of the model is wrong: add photos "
        "between these two, or give the true focal length with --intrinsics.",
    ),
    DoubtReason.CONTRADICTED_GROUP: (
        "a part of the model that matches contradict",
        "{num_matches} more matches contradict the place of {num_images} photos in the model than "
        "support it: places that look alike may be joined.",
        "Compare these photos with the photos that they match. Add photos between both parts of "
        "the model, from nearby places.",
    ),
    DoubtReason.DISCONNECTED: (
        "parts of the model share hardly any points",
        "The model has {num_parts} parts that share few points; {num_images} photos are outside of "
        "the largest part, and their position relative to it is uncertain.",
        "Add photos that overlap with both parts.",
    ),
    DoubtReason.LOW_PARALLAX: (
        "hardly any parallax",
        "The rays of half of the points meet at less than {angle_deg:.2g} degrees: the camera "
        "hardly moved, and depth comes from the depth network alone.",
        "Move sideways between photos instead of only turning or zooming.",
    ),
    DoubtReason.SCALE_FROM_DEPTH: (
        "distances from uncertain depth",
        "Matches alone determine the distances between panoramas or frames of the rig only to "
        "{scale_std_ratio:.0%}, and the depth maps only to {depth_std_ratio:.0%}.",
        "Take two or more panoramas per room that see each other, and one in each door.",
    ),
    DoubtReason.FEW_POINTS: (
        "poses from few points",
        "{num_images} photos see fewer than {min_points} points.",
        _ADD_OVERLAP,
    ),
    DoubtReason.FEW_EXPLAINED_MATCHES: (
        "most matches contradict the model",
        "The model explains less than {min_ratio:.0%} of the matches of {num_images} photos.",
        _CHECK_MATCHES,
    ),
    DoubtReason.GPS_MISFIT: (
        "GPS contradicts the model",
        "Only {num_inliers} of {num_positions} GPS positions fit the model.",
        "Check the photos whose positions do not fit: the model may be bent or folded there.",
    ),
    DoubtReason.UNKNOWN_FOCAL_LENGTH: (
        "unknown focal length",
        "The focal length of {num_images} photos is known to {std_ratio:.0%} only; a wrong focal "
        "length bends the whole model.",
        "Give it with --intrinsics, or use photos with EXIF as they come from the camera.",
    ),
    DoubtReason.UNCERTAIN_POSES: (
        "poses depend on an uncertain camera",
        "Cameras with another focal length, principal point or distortion fit the matches as well "
        "or better, and change the poses of {num_images} photos by up to {error_deg:.2g} degrees. "
        "Zoomed or cropped photos cause such errors, and so does little parallax.",
        "Use photos as they come from the camera, or give the true camera with --intrinsics.",
    ),
    DoubtReason.CONTRADICTORY_DEPTH: (
        "contradictory depth",
        "The depth of two frames differs by {num_stds:.2g} standard deviations at common points, "
        "for example behind a door. Without depth, the poses of {num_images} photos have errors of "
        "up to {error_deg:.2g} degrees.",
        "Take more photos or panoramas in between, so that neighboring frames share more points.",
    ),
    DoubtReason.PARTIAL_COVERAGE: (
        "keypoints in a part of the photos only",
        "The features provider {provider} finds keypoints only in the upper left "
        "{width_ratio:.0%} x {height_ratio:.0%} of all {num_images} photos: keypoints may be in "
        "pixels of a reduced photo.",
        "Test the provider with mpsfm plugins check {provider}.",
    ),
    DoubtReason.FOCAL_LENGTH_FROM_ONE_IMAGE: (
        "focal length from one image",
        "The photo matches only {image} of the model, which hardly tells its unknown focal length "
        "from its distance: the pose may be wrong by far more than its covariance.",
        "Give the focal length of the photo with --intrinsics, or add photos of this place to the "
        "model.",
    ),
    DoubtReason.DEPTH_CONTRADICTS_MODEL: (
        "depth contradicts the model",
        "Matches support the pose, but {violation_ratio:.0%} of the depth map contradict the depth "
        "of {other_image}: the photo may show a place that looks like this one.",
        "Compare the photo with the matched images of the model.",
    ),
    DoubtReason.CAMERA_JUMP: (
        "the camera of the video jumps",
        "Between the frames {image_a} and {image_b}, the camera moves far too fast, and they share "
        "few points: places that look alike may be joined.",
        "Film the way between both places again, slowly and with textured surfaces in view.",
    ),
    DoubtReason.MEANINGLESS_SCORES: (
        "meaningless match scores",
        "The scores of the matcher {provider} are unrelated to its matches in {num_pairs} pairs of "
        "photos, or lower for inliers than for outliers: scores may be random or inverted.",
        "Test the matcher with mpsfm plugins check {provider}.",
    ),
    CameraReason.KNOWN: ("known focal length", "The focal length is given.", _NO_REMEDY),
    CameraReason.NOT_ESTIMATED: (
        "focal length not estimated",
        "Bundle adjustment did not estimate the focal length.",
        "Leave out --set mapping.refinement.refine_focal=false, or give the focal length with "
        "--intrinsics.",
    ),
    CameraReason.TOO_FEW_IMAGES: (
        "too few photos",
        "Only {num_images} photos are registered; {min_images} are needed to estimate a focal "
        "length.",
        "Add photos, or give the focal length with --intrinsics.",
    ),
    CameraReason.NOT_OBSERVABLE: (
        "focal length not observable",
        "The photos leave a standard deviation of {focal_length_std_ratio:.0%} of the focal "
        "length.",
        "Add photos from other directions, or give the focal length with --intrinsics.",
    ),
    CameraReason.OUT_OF_RANGE: (
        "implausible focal length",
        "Bundle adjustment ends at a 35 mm equivalent of {equivalent_mm:.1f} mm, which no lens "
        "has.",
        "Give the focal length with --intrinsics.",
    ),
    CameraReason.DISTORTION_NOT_ESTIMATED: (
        "distortion not estimated",
        "Bundle adjustment estimates the radial distortion only if the focal length is refined.",
        "Give the camera with --intrinsics if its lens distorts.",
    ),
    CameraReason.DISTORTION_NOT_OBSERVABLE: (
        "distortion not observable",
        "The photos do not separate radial distortion from other errors; the standard deviation "
        "of the radial distortion is {radial_std:.2f}.",
        "Give the camera with --intrinsics if its lens distorts.",
    ),
    CameraReason.DISTORTION_OUT_OF_RANGE: (
        "implausible distortion",
        "Bundle adjustment ends at a radial distortion of {radial:.2f}, which the camera model "
        "SIMPLE_RADIAL does not describe.",
        "Give the camera with --intrinsics.",
    ),
    CameraReason.PARAMETER_NOT_OBSERVABLE: (
        "camera parameter not observable",
        "The photos leave a standard deviation of {std:.3g} of the camera parameter {parameter}.",
        "Choose a camera model with fewer parameters with --camera-model.",
    ),
    CameraReason.PARAMETER_OUT_OF_RANGE: (
        "implausible camera parameter",
        "Bundle adjustment ends at the implausible value {value:.3g} of the camera parameter "
        "{parameter}.",
        "Choose a camera model with fewer parameters with --camera-model.",
    ),
}


def explain(reason: Reason) -> Explanation:
    """Render a reason as title, text and remedy for users."""
    title, text, remedy = _TEMPLATES[reason.code]
    values = {name: _readable(value) for name, value in reason.values.items()}
    return Explanation(title, text.format(**values), remedy.format(**values))


def explain_image(stored: Mapping[str, Any]) -> Explanation:
    """Explain why an image is not registered, from the reason stored in ``summary.json``."""
    return explain(reason_from_json(ImageReason, stored))


def explain_pair(stored: Mapping[str, Any]) -> Explanation:
    """Explain why an image pair was dropped, from the reason stored in ``summary.json``."""
    return explain(reason_from_json(PairReason, stored))


def explain_camera(stored: Mapping[str, Any]) -> Explanation:
    """Explain why an intrinsic parameter is not refined, from the reason in ``summary.json``."""
    return explain(reason_from_json(CameraReason, stored))


def explain_provider(stored: Mapping[str, Any]) -> Explanation:
    """Explain why a provider was not used, from the reason stored in ``summary.json``."""
    return explain(reason_from_json(ProviderReason, stored))


def explain_hook(stored: Mapping[str, Any]) -> Explanation:
    """Explain why a plugin's hook is doubtful, from the reason stored in ``summary.json``."""
    return explain(reason_from_json(HookReason, stored))


def explain_gps(stored: Mapping[str, Any]) -> Explanation:
    """Explain why a model is not georeferenced, from the reason stored in ``summary.json``."""
    return explain(reason_from_json(GpsReason, stored))


def _readable(value: str | int | float) -> str | int | float:
    """Replace the hyphens in names of mapping steps by spaces; return other values unchanged."""
    return value.replace("-", " ") if isinstance(value, str) and value in _STEPS else value


_STEPS = (
    "local-refinement",
    "global-refinement",
    "re-registration",
    "component-split",
    "global-initialization",
    "final-check",
)
