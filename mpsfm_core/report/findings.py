"""Collect findings for users about wrong or doubtful parts of a run, with next steps."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mpsfm_core.data.decisions import DoubtReason, ImageReason
from mpsfm_core.report.reasons import (
    explain,
    explain_camera,
    explain_hook,
    explain_image,
    explain_pair,
    explain_provider,
)
from mpsfm_core.report.verdict import (
    MAX_SCALE_STD_RATIO,
    combine_stds,
    find_scale_stds,
    is_focal_refined,
    judge,
)

Level = Literal["bad", "warning", "note"]
_ORDER: tuple[Level, ...] = ("bad", "warning", "note")
_MAX_FOCAL_CHANGE = 0.1
"""Minimum relative change of a refined focal length that is reported to the user."""

_FILES = "files"
"""Name of the depth provider that reads depth maps from files."""
_NETWORKLESS = {"flat", "from-depth"}
"""Names of the depth providers that use no neural network."""


@dataclass(frozen=True)
class Finding:
    """Finding about a run for users."""

    level: Level
    """Severity of the finding."""
    title: str
    """Title of the finding in one line."""
    text: str
    """Description of the finding in sentences."""
    remedy: str = ""
    """Next step for the user, empty if there is no remedy."""
    images: tuple[str, ...] = field(default=())
    """Names of the images that the finding concerns."""


def findings(summary: Mapping[str, Any]) -> list[Finding]:
    """Collect all findings of a run, most severe first.

    Args:
        summary: content of ``summary.json``.
    """
    collected = [
        *_failure(summary),
        *_doubts(summary),
        *_hooks(summary),
        *_left_out(summary),
        *_missing(summary),
        *_unconfirmed(summary),
        *_providers(summary),
        *_scale(summary),
        *_distances(summary),
        *_focal_lengths(summary),
        *_distortions(summary),
        *_weak(summary),
    ]
    return sorted(collected, key=lambda finding: _ORDER.index(finding.level))


def _failure(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding about the cause of a failed run."""
    if summary["status"] == "success":
        return
    pairs = summary["pairs"]
    if not pairs["verified"]:
        kinds = Counter(
            explain_pair(pair["dropped"]).title for pair in pairs["all"] if "dropped" in pair
        )
        causes = ", ".join(f"{kind} in {_count(n, 'pair')}" for kind, n in kinds.most_common())
        yield Finding(
            "bad",
            "No two photos could be matched",
            f"{_count(pairs['matched'], 'pair')} of photos were compared, none could be verified: "
            f"{causes or 'no pair was proposed'}.",
            "Photos must overlap: about half of each should be in the next. Check that they are "
            "sharp and of one place, and that --intrinsics belongs to them. With little overlap "
            "try --config robust; with walls without texture --config dense.",
        )
        return
    starts = [
        explain_image(pair["cannot_start"]) for pair in pairs["all"] if "cannot_start" in pair
    ]
    usual, count = Counter(start.text for start in starts).most_common(1)[0] if starts else ("", 0)
    yield Finding(
        "bad",
        "Photos match, but no pair can start the reconstruction",
        f"{pairs['verified']} of {_count(pairs['matched'], 'pair')} of photos could be verified, "
        f"but none can start a reconstruction. In {_count(count, 'pair')}: {usual}",
        "Look at the matches and at the prior depth of these photos below. Depth that is wrong "
        "(glass, mirrors, a weak network) or a wrong focal length does this: try another depth "
        "network (mpsfm config show default lists them), or give --intrinsics. More "
        "photos of the same place help in any case.",
    )


def _hooks(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield one finding for each plugin hook that was left out or returned doubtful values."""
    for stored in summary.get("hooks", ()):
        explained = explain_hook(stored)
        title = f"{explained.title[:1].upper()}{explained.title[1:]}"
        yield Finding("warning", title, explained.text, explained.remedy)


def _doubts(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield one finding for each reason to doubt the model."""
    for doubt in judge(summary).doubts:
        explained = explain(doubt.reason)
        title = f"{explained.title[:1].upper()}{explained.title[1:]}"
        text = explained.text
        if doubt.reason.code == DoubtReason.UNKNOWN_FOCAL_LENGTH:
            reason = summary["images"]["details"][doubt.images[0]].get("focal_length_reason")
            text = f"{text} {explain_camera(reason).text}" if reason else text
        yield Finding("warning", title, text, explained.remedy, doubt.images)


def _left_out(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding about images that were left out before the reconstruction."""
    faults = summary["images"].get("left_out", {})
    if faults:
        first, fault = next(iter(faults.items()))
        example = fault if len(faults) == 1 else f"For example {first}: {fault}"
        yield Finding(
            "warning",
            f"{_count(len(faults), 'photo')} could not be used",
            f"{example[:1].upper()}{example[1:]}.",
            "Replace or remove the photo or its mask.",
            tuple(faults),
        )


def _missing(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield one finding for each reason why images are unregistered."""
    by_title = defaultdict(list)
    for name, reason in summary["images"]["unregistered"].items():
        by_title[explain_image(reason).title].append((name, explain_image(reason)))
    failed = summary["status"] != "success"
    # The finding about the cause of a failed run already explains why these images are
    # unregistered.
    if failed:
        implied = {ImageReason.NO_REGISTERED_NEIGHBOR}
        if not summary["pairs"]["verified"]:
            implied.add(ImageReason.NO_VERIFIED_MATCHES)
        for code in implied:
            by_title.pop(explain(code.because()).title, None)
    for kind, members in sorted(by_title.items(), key=lambda item: -len(item[1])):
        names = tuple(name for name, _ in members)
        first = members[0][1]
        alike = all(explained.text == first.text for _, explained in members)
        text = first.text if alike else f"For example {names[0]}: {first.text}"
        title = f"{_count(len(names), 'photo')} missing: {kind}"
        level: Level = "note" if failed else "warning"
        yield Finding(level, title, text, "" if failed else first.remedy, names)


def _unconfirmed(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding about tentatively registered images."""
    names = tuple(summary["images"]["unconfirmed"])
    if names:
        yield Finding(
            "warning",
            f"{_count(len(names), 'photo')} placed without proof",
            "Their matches fit best there (mapping.register_tentatively). Nothing confirms that.",
            "Check their poses before you use them.",
            names,
        )


def _providers(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield findings about fallbacks that replaced configured providers."""
    for provider in summary["providers"]:
        passed = provider["passed_over"]
        if provider["name"] in _NETWORKLESS and provider["block"] == "depth":
            yield Finding(
                "warning",
                "No depth network was used",
                "Constant depth was used, so photos must overlap as much as for other programs.",
                "pip install mpsfm-compact, or see mpsfm doctor.",
            )
        elif passed:
            reasons = ", ".join(
                f"{name} ({explain_provider(why).title})" for name, why in passed.items()
            )
            yield Finding(
                "note",
                f"{provider['block']}: {provider['name']} replaced {', '.join(passed)}",
                f"Preferred providers were not available: {reasons}.",
                "mpsfm doctor lists what is missing and how to install it.",
            )


def describe_scale(summary: Mapping[str, Any], component: int = 0) -> tuple[str, str]:
    """Describe the unit of a reconstruction, and where its scale comes from.

    Depth maps of a network that agree with each other do not prove the metric scale, because the
    network may not know the kind of scene. The description of the scale therefore names the source,
    such as a network or GPS.

    Args:
        summary: Content of ``summary.json``.
        component: Index of the reconstruction, 0 for the largest.
    """
    metric = summary["reconstructions"][component]["metric_scale"]
    if metric is None:
        return "unknown", "no depth is metric"
    source = f"{metric['num_images']} {metric['by']}, spread {metric['spread']:.0%}"
    if not metric["trusted"]:
        return "uncertain", f"one unit is about {metric['metres_per_unit']:.3g} m by {source}"
    if metric["by"] != "depth maps":
        return "meters", f"by {source}"
    (depth,) = [entry["name"] for entry in summary["providers"] if entry["block"] == "depth"]
    origin = "given by the depth files" if depth == _FILES else f"predicted by {depth}"
    return "meters", f"as {origin}: {source}"


def _scale(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding if the metric scale is unknown or uncertain."""
    for reconstruction in summary["reconstructions"][:1]:
        metric = reconstruction["metric_scale"]
        if metric is None:
            yield Finding(
                "note",
                "The scale is unknown",
                "No depth in meters was used: only ratios of distances are right.",
                "Use a metric depth provider (mpsfm plugins list).",
            )
        elif not metric["trusted"]:
            yield Finding(
                "warning",
                "The scale is uncertain",
                f"By the depth maps of {_count(metric['num_images'], 'photo')}, one unit is about "
                f"{metric['metres_per_unit']:.3g} m, with a spread of {metric['spread']:.0%}.",
                "Measure one distance, or use a better metric depth network.",
            )


def _distances(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding if precise depth alone determines the distances between frames of rigs."""
    for reconstruction in summary["reconstructions"][:1]:
        stds = find_scale_stds(reconstruction)
        if stds is not None and combine_stds(*stds) <= MAX_SCALE_STD_RATIO:
            yield Finding(
                "note",
                "The distances between panoramas or frames of the rig come from depth",
                f"Matches alone determine them only to {min(stds[0], 1.0):.0%}; the depth maps "
                f"have a standard deviation of {stds[1]:.0%}.",
                "Take two or more panoramas per room that see each other, and one in each door.",
            )


def _focal_lengths(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield findings about estimated and strongly refined focal lengths."""
    details = summary["images"]["details"]
    refined = {
        name: (image["focal_length_px"], image.get("refined_focal_length_px"))
        for name, image in details.items()
    }
    guessed = [
        name
        for name, image in details.items()
        if image["focal_length_from"] == "default" and is_focal_refined(image)
    ]
    if guessed:
        changes = [refined[name][1] / refined[name][0] - 1 for name in guessed]
        std_ratios = [
            details[name]["focal_length_std_px"] / refined[name][1]
            for name in guessed
            if "focal_length_std_px" in details[name]
        ]
        std = f" Its standard deviation is at most {max(std_ratios):.1%}." if std_ratios else ""
        yield Finding(
            "note",
            f"The focal length of {_count(len(guessed), 'photo')} was estimated from the photos",
            "EXIF and --intrinsics give none. Bundle adjustment changed the initial guess by "
            f"{_range(changes)}.{std}",
            "Give it with --intrinsics if you know it.",
            tuple(guessed),
        )
    far = [
        name
        for name, (before, after) in refined.items()
        if details[name]["focal_length_from"] != "default"
        if after and abs(after / before - 1) > _MAX_FOCAL_CHANGE
    ]
    if far:
        changes = [refined[name][1] / refined[name][0] - 1 for name in far]
        sources = sorted({details[name]["focal_length_from"] for name in far})
        yield Finding(
            "note",
            f"The focal length of {_count(len(far), 'photo')} changed much",
            f"Bundle adjustment changed the values from {' and '.join(sources)} by "
            f"{_range(changes)}. The photos may be cropped or zoomed.",
            "If you know the true one, give it with --intrinsics.",
            tuple(far),
        )


def _range(changes: Sequence[float]) -> str:
    """Return minimum and maximum of relative changes as text, such as ``+3% to +8%``."""
    ends = dict.fromkeys(f"{change:+.0%}" for change in (min(changes), max(changes)))
    return " to ".join(ends)


def _distortions(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding about images with estimated radial distortion."""
    details = summary["images"]["details"]
    refined = {
        name: (image["radial_distortion"], image["radial_distortion_std"])
        for name, image in details.items()
        if "radial_distortion" in image and "radial_distortion_reason" not in image
    }
    if refined:
        radials, stds = zip(*refined.values(), strict=True)
        models = " and ".join(
            dict.fromkeys(details[name].get("camera_model", "SIMPLE_RADIAL") for name in refined)
        )
        span = " to ".join(dict.fromkeys(f"{value:+.3f}" for value in (min(radials), max(radials))))
        yield Finding(
            "note",
            f"The radial distortion of {_count(len(refined), 'photo')} was estimated",
            f"The coefficient k1 of COLMAP's {models} is {span}. Its standard deviation is at "
            f"most {max(stds):.3f}.",
            "Give the camera with --intrinsics if you know it.",
            tuple(refined),
        )


def _weak(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding about images with verified matches to only one other image."""
    partners = partner_counts(summary)
    weak = tuple(name for name in summary["images"]["registered"] if partners[name] == 1)
    if weak and len(summary["images"]["registered"]) > 2:
        yield Finding(
            "note",
            f"{_count(len(weak), 'photo')} connected to only one other photo",
            "Nothing else confirms their poses.",
            "Check them first if something looks wrong; add a photo from nearby.",
            weak,
        )


def weakest(summary: Mapping[str, Any], max_images: int = 3) -> list[tuple[str, int]]:
    """Return the registered images with the fewest verified matches, and their match counts."""
    registered = set(summary["images"]["registered"])
    matches = Counter(dict.fromkeys(summary["images"]["registered"], 0))
    for pair in summary["pairs"]["all"]:
        if "inliers" in pair and registered.issuperset(pair["images"]):
            matches.update(dict.fromkeys(pair["images"], pair["inliers"]))
    return sorted(matches.items(), key=lambda item: item[1])[
        : min(max_images, len(registered) // 2)
    ]


def partner_counts(summary: Mapping[str, Any]) -> Counter[str]:
    """Count for each registered image the registered images with verified matches to it."""
    registered = set(summary["images"]["registered"])
    return Counter(
        name
        for pair in summary["pairs"]["all"]
        if "inliers" in pair and registered.issuperset(pair["images"])
        for name in pair["images"]
    )


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"
