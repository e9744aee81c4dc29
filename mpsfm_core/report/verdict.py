"""Judge a run: good, doubtful, partial or failed, with the reasons for doubt.

Registered images are no proof: a model with look-alike places or a wrong focal length registers
them too. The doubts come from measured evidence (:mod:`mpsfm_core.results.evidence`).
``benchmarks.real_photos`` shows verdicts next to true pose errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from mpsfm_core.data.decisions import DoubtReason, GpsReason, Reason

Level = Literal["good", "doubtful", "partial", "failed"]

MIN_PAIR_INLIERS = 50
"""Inliers that make a verified pair evidence against a model [ours]."""
MAX_UNEXPLAINED_RATIO = 0.1
"""A pair is unexplained if its images share less than this share of its inliers as points
[ours]."""
MIN_UNEXPLAINED_PAIRS = 2
"""Unexplained pairs that make a model doubtful [ours]."""
MIN_ANGLE_DEG = 0.5
"""Median ray angle below which depth rests on the priors [ours]."""
MIN_POINTS = 30
"""Points that the pose of an image needs [COLMAP abs_pose_min_num_inliers]."""
MIN_EXPLAINED_RATIO = 0.2
"""Share of the matches of an image that the model explains [ours]."""


@dataclass(frozen=True)
class Doubt:
    """One reason for doubt."""

    reason: Reason
    images: tuple[str, ...] = field(default=())
    """Images that it concerns; empty if it concerns the whole model."""


@dataclass(frozen=True)
class Verdict:
    """Judgment of a run."""

    level: Level
    text: str
    """One sentence for users."""
    doubts: tuple[Doubt, ...] = field(default=())


def judge(summary: Mapping[str, Any]) -> Verdict:
    """Judge a run.

    Args:
        summary: Content of ``summary.json``.

    Returns:
        ``failed`` without a model; ``doubtful`` if the evidence is weak or contradicts the model;
        ``partial`` if images are missing; else ``good``.
    """
    images = summary["images"]
    num_registered, total = len(images["registered"]), images["total"]
    if summary["status"] != "success":
        return Verdict("failed", f"No model could be reconstructed from {_photos(total)}.")
    doubts = tuple(find_doubts(summary))
    registered = f"{num_registered} of {_photos(total)} registered"
    if doubts:
        return Verdict("doubtful", f"{registered}, but the model may be wrong.", doubts)
    if num_registered < total:
        return Verdict("partial", f"{registered}, {total - num_registered} missing.")
    return Verdict("good", f"All {_photos(total)} registered.")


def find_doubts(summary: Mapping[str, Any]) -> Iterator[Doubt]:
    """Yield the reasons to doubt the first model of a run."""
    yield from _unexplained_pairs(summary["pairs"]["all"])
    for reconstruction in summary["reconstructions"][:1]:
        yield from _weak_evidence(reconstruction["evidence"])
    place = summary.get("georeference") or {}
    if place.get("why_not", {}).get("code") == GpsReason.FEW_INLIERS.value:
        values = {name: place["why_not"][name] for name in GpsReason.FEW_INLIERS.fields}
        yield Doubt(DoubtReason.GPS_MISFIT.because(**values))
    guessed = tuple(
        name
        for name, image in summary["images"]["details"].items()
        if image["focal_length_from"] == "default" and not is_focal_refined(image)
        if name in summary["images"]["registered"]
    )
    if guessed:
        yield Doubt(DoubtReason.UNKNOWN_FOCAL_LENGTH.because(num_images=len(guessed)), guessed)


def is_focal_refined(image: Mapping[str, Any]) -> bool:
    """Return whether bundle adjustment determined the focal length of an image.

    Args:
        image: Entry of the image in ``images.details`` of ``summary.json``.
    """
    return "refined_focal_length_px" in image and "focal_length_reason" not in image


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
    """Yield the doubts about one model."""
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


def _photos(number: int) -> str:
    return f"{number} photo{'' if number == 1 else 's'}"
