"""Judge a run as good, doubtful, partial or failed, with reasons for doubt.

A wrong model, for example with look-alike places or a wrong focal length, also registers images.
Doubts about a model come from measured evidence (:mod:`mpsfm_core.results.evidence`).
The benchmark ``benchmarks.real_photos`` compares verdicts with true pose errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from mpsfm_core.data.decisions import DoubtReason, GpsReason, Reason, reason_from_json

Level = Literal["good", "doubtful", "partial", "failed"]

MIN_PAIR_INLIERS = 50
"""Minimum number of inliers of a verified pair that counts as evidence against a model [ours]."""
MAX_UNEXPLAINED_RATIO = 0.1
"""Share of explained inliers of an image pair below which the model does not explain the pair
[ours]."""
MIN_UNEXPLAINED_PAIRS = 2
"""Minimum number of unexplained image pairs that make a model doubtful [ours]."""
MIN_ANGLE_DEG = 0.5
"""Median triangulation angle in degrees below which depth comes from the priors alone [ours]."""
MAX_SCALE_STD_RATIO = 0.1
"""Relative standard deviation of the distances between frames of rigs, from matches and depth,
above which the model is doubtful [tuned: benchmarks.panoramas]."""
MIN_POINTS = 30
"""Minimum number of 3D points that support the pose of an image [COLMAP
abs_pose_min_num_inliers]."""
MAX_FOCAL_STD_RATIO = 0.15
"""Relative standard deviation of a focal length above which the focal length is unknown [tuned:
benchmarks.mixed_cameras, benchmarks.verdicts]."""
MAX_POSE_ERROR_DEG = 2.0
"""Predicted relative pose error in degrees above which a pose is uncertain [largest error of a good
model in benchmarks.verdicts]."""
MAX_DEPTH_DISAGREEMENT = 2.0
"""Difference of the depth of two frames of rigs at common points, in standard deviations, above
which depth does not support relative poses [95 % of a normal distribution]."""
MIN_EXPLAINED_RATIO = 0.2
"""Minimum share of the matches of an image that the model must explain [ours]."""


@dataclass(frozen=True)
class Doubt:
    """Reason for doubt about a model, with the affected images."""

    reason: Reason
    images: tuple[str, ...] = field(default=())
    """Names of the images that the doubt concerns, empty if the doubt concerns the whole model."""


@dataclass(frozen=True)
class Verdict:
    """Verdict about a run for users."""

    level: Level
    text: str
    """Verdict in one sentence for users."""
    doubts: tuple[Doubt, ...] = field(default=())


def judge(summary: Mapping[str, Any]) -> Verdict:
    """Judge a run from its summary.

    Args:
        summary: content of ``summary.json``.

    Returns:
        The verdict of the run. The level is ``failed`` without a model, ``doubtful`` if the
        evidence is weak or contradicts the model, ``partial`` if images are not registered, and
        otherwise ``good``. A failed run has the doubts about its providers, which may be the cause.
    """
    images = summary["images"]
    num_registered, total = len(images["registered"]), images["total"]
    if summary["status"] != "success":
        text = f"No model could be reconstructed from {_photos(total)}."
        return Verdict("failed", text, tuple(_recorded_doubts(summary)))
    doubts = tuple(find_doubts(summary))
    registered = f"{num_registered} of {_photos(total)} registered"
    if doubts:
        return Verdict("doubtful", f"{registered}, but the model may be wrong.", doubts)
    if num_registered < total:
        return Verdict("partial", f"{registered}, {total - num_registered} missing.")
    return Verdict("good", f"All {_photos(total)} registered.")


def find_doubts(summary: Mapping[str, Any]) -> Iterator[Doubt]:
    """Yield the reasons to doubt the providers and the first model of a run."""
    yield from _recorded_doubts(summary)
    yield from _unexplained_pairs(_sum_over_frames(summary))
    for reconstruction in summary["reconstructions"][:1]:
        yield from _weak_evidence(reconstruction["evidence"])
        yield from _uncertain_distances(reconstruction)
        yield from _contradictory_depth(reconstruction["evidence"])
    place = summary.get("georeference") or {}
    if place.get("why_not", {}).get("code") == GpsReason.FEW_INLIERS.value:
        values = {name: place["why_not"][name] for name in GpsReason.FEW_INLIERS.fields}
        yield Doubt(DoubtReason.GPS_MISFIT.because(**values))
    registered = summary["images"]["registered"]
    details = {name: summary["images"]["details"][name] for name in registered}
    ratios = {name: _focal_std_ratio(image) for name, image in details.items()}
    guessed = {name: ratio for name, ratio in ratios.items() if ratio > MAX_FOCAL_STD_RATIO}
    if guessed:
        reason = DoubtReason.UNKNOWN_FOCAL_LENGTH.because(
            num_images=len(guessed), std_ratio=round(max(guessed.values()), 3)
        )
        yield Doubt(reason, tuple(guessed))


def _recorded_doubts(summary: Mapping[str, Any]) -> Iterator[Doubt]:
    """Yield the doubts that a run recorded, such as those about its providers."""
    for stored in summary.get("doubts", ()):
        yield Doubt(reason_from_json(DoubtReason, stored))


def _focal_std_ratio(image: Mapping[str, Any]) -> float:
    """Return the relative standard deviation of the focal length of an image.

    Args:
        image: entry of the image in ``images.details`` of ``summary.json``.

    Returns:
        Standard deviation relative to the focal length. Without a stated standard deviation, 1 for
        an unrefined default focal length, and else 0.
    """
    if "focal_length_std_px" in image:
        focal_px = image.get("refined_focal_length_px", image["focal_length_px"])
        return float(image["focal_length_std_px"] / focal_px)
    is_guess = image["focal_length_from"] == "default" and not is_focal_refined(image)
    return 1.0 if is_guess else 0.0


def is_focal_refined(image: Mapping[str, Any]) -> bool:
    """Return whether bundle adjustment refined the focal length of an image successfully.

    Args:
        image: entry of the image in ``images.details`` of ``summary.json``.
    """
    return "refined_focal_length_px" in image and "focal_length_reason" not in image


def _sum_over_frames(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the verified pairs; all pairs between two frames of a rig are summed to one pair."""
    pairs: list[Mapping[str, Any]] = summary["pairs"]["all"]
    reconstructions = summary["reconstructions"]
    frames = reconstructions[0]["evidence"].get("frames") if reconstructions else None
    if not frames:
        return pairs
    first_of = {name: frame[0] for frame in frames for name in frame}
    sums: dict[tuple[str, ...], dict[str, Any]] = {}
    for pair in pairs:
        if "explained" in pair:
            names = tuple(sorted(first_of.get(name, name) for name in pair["images"]))
            total = sums.setdefault(names, {"images": names, "inliers": 0, "explained": 0})
            total["inliers"] += pair["inliers"]
            total["explained"] += pair["explained"]
    return list(sums.values())


def _unexplained_pairs(pairs: list[Mapping[str, Any]]) -> Iterator[Doubt]:
    """Yield a doubt if well-matched pairs share hardly any point of the model."""
    unexplained = [
        pair
        for pair in pairs
        if "explained" in pair and pair["inliers"] >= MIN_PAIR_INLIERS
        if pair["explained"] < MAX_UNEXPLAINED_RATIO * pair["inliers"]
    ]
    if len(unexplained) >= MIN_UNEXPLAINED_PAIRS:
        worst = max(unexplained, key=lambda pair: pair["inliers"])
        names = tuple(dict.fromkeys(name for pair in unexplained for name in pair["images"]))
        reason = DoubtReason.UNEXPLAINED_PAIRS.because(
            num_pairs=len(unexplained),
            image_a=worst["images"][0],
            image_b=worst["images"][1],
            num_matches=worst["inliers"],
        )
        yield Doubt(reason, names)


def _weak_evidence(evidence: Mapping[str, Any]) -> Iterator[Doubt]:
    """Yield doubts from connectivity, parallax, points, pose errors and explained matches."""
    contradicted = evidence.get("contradicted_group")
    if contradicted:
        names = tuple(contradicted["images"])
        reason = DoubtReason.CONTRADICTED_GROUP.because(
            num_images=len(names), num_matches=contradicted["margin"]
        )
        yield Doubt(reason, names)
    parts = evidence["parts"]
    if len(parts) > 1:
        apart = tuple(name for part in parts[1:] for name in part)
        reason = DoubtReason.DISCONNECTED.because(num_parts=len(parts), num_images=len(apart))
        yield Doubt(reason, apart)
    angle = evidence["median_angle_deg"]
    if angle is not None and angle < MIN_ANGLE_DEG:
        yield Doubt(DoubtReason.LOW_PARALLAX.because(angle_deg=angle))
    few = tuple(name for name, image in evidence["images"].items() if image["points"] < MIN_POINTS)
    if few:
        reason = DoubtReason.FEW_POINTS.because(num_images=len(few), min_points=MIN_POINTS)
        yield Doubt(reason, few)
    errors = {
        name: image.get("pose_error_deg") or 0.0 for name, image in evidence["images"].items()
    }
    uncertain = tuple(name for name, error in errors.items() if error > MAX_POSE_ERROR_DEG)
    if uncertain:
        reason = DoubtReason.UNCERTAIN_POSES.because(
            num_images=len(uncertain), error_deg=max(errors.values())
        )
        yield Doubt(reason, uncertain)
    unexplained = tuple(
        name
        for name, image in evidence["images"].items()
        if image["explained_ratio"] < MIN_EXPLAINED_RATIO
    )
    if unexplained:
        reason = DoubtReason.FEW_EXPLAINED_MATCHES.because(
            num_images=len(unexplained), min_ratio=MIN_EXPLAINED_RATIO
        )
        yield Doubt(reason, unexplained)


def find_scale_stds(reconstruction: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the relative std of distances between frames of rigs by matches, and by depth.

    The depth errors of one frame are taken as equal, so many points do not reduce them.

    Args:
        reconstruction: entry of ``reconstructions`` of ``summary.json``.

    Returns:
        Both standard deviations, or None if matches alone determine the distances.
    """
    by_matches = reconstruction["evidence"].get("relative_scale_std")
    if by_matches is None or by_matches <= MAX_SCALE_STD_RATIO:
        return None
    return by_matches, reconstruction["median_relative_depth_std"] or 1.0


def combine_stds(first: float, second: float) -> float:
    """Return the standard deviation of the weighted mean of two independent measurements."""
    return float(1 / np.hypot(1 / first, 1 / second))


def _uncertain_distances(reconstruction: Mapping[str, Any]) -> Iterator[Doubt]:
    """Yield a doubt if neither matches nor depth determine the distances between frames."""
    stds = find_scale_stds(reconstruction)
    if stds is not None and combine_stds(*stds) > MAX_SCALE_STD_RATIO:
        by_matches, by_depth = (round(min(std, 1.0), 3) for std in stds)
        reason = DoubtReason.SCALE_FROM_DEPTH.because(
            scale_std_ratio=by_matches, depth_std_ratio=by_depth
        )
        yield Doubt(reason)


def _contradictory_depth(evidence: Mapping[str, Any]) -> Iterator[Doubt]:
    """Yield a doubt if depth contradicts itself where matches do not determine the poses."""
    disagreement = evidence.get("depth_disagreement")
    if disagreement is None or disagreement <= MAX_DEPTH_DISAGREEMENT:
        return
    errors = {
        name: image.get("match_pose_error_deg") or 0.0 for name, image in evidence["images"].items()
    }
    uncertain = tuple(name for name, error in errors.items() if error > MAX_POSE_ERROR_DEG)
    if uncertain:
        reason = DoubtReason.CONTRADICTORY_DEPTH.because(
            num_images=len(uncertain), num_stds=disagreement, error_deg=max(errors.values())
        )
        yield Doubt(reason, uncertain)


def _photos(number: int) -> str:
    return f"{number} photo{'' if number == 1 else 's'}"
