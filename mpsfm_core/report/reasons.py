"""The reasons that a run records, in plain words and with what to do about each."""

from __future__ import annotations

import re
from dataclasses import dataclass

NO_MATCH = "no verified match with another image"
NOTHING_TO_HOLD_ON = "nothing that it matches could be registered"

_MORE_OVERLAP = (
    "Take photos between it and its neighbours, each sharing about half of its view with the next; "
    "or let other features try: --config robust."
)
_LOOK_ALIKE = (
    "Look at its matches and its prior depth below. Matches on look-alike places (repeated "
    "furniture, windows) or wrong depth do this. A photo from nearby, or a better depth network, "
    "settles it."
)


@dataclass(frozen=True)
class Explanation:
    """``kind``: photos with the same are told of together. ``plain``: what happened. ``remedy``:
    what to do."""

    kind: str
    plain: str
    remedy: str


_IMAGES: tuple[tuple[str, str, str, str], ...] = (
    (
        NO_MATCH,
        "nothing in common with another photo",
        "No match with any other photo is geometrically possible.",
        _MORE_OVERLAP + " A blurred or very dark photo matches nothing: leave it out.",
    ),
    (
        NOTHING_TO_HOLD_ON,
        "in common only with photos that are missing too",
        "There are matches with other photos, but none of those has a place in the reconstruction.",
        "Add a photo that overlaps both with these and with the registered ones.",
    ),
    (
        r"its depth is valid nowhere",
        "no depth",
        "The depth provider gives no valid depth.",
        "Look at the mask and at the files or the network of the depth provider.",
    ),
    (
        r"(?P<have>\d+) matches have a 3D point, (?P<need>\d+) are needed",
        "too little in common with the reconstructed part",
        "Only {have} matches are points of the reconstruction; {need} are needed.",
        _MORE_OVERLAP,
    ),
    (
        r"(?P<have>\d+) matches support its pose, (?P<need>\d+) are needed"
        r"|(?P<share>[\d.]+%) of the matches support its pose, not .*"
        r"|neither PnP nor an essential matrix gives a pose|nothing gives a pose",
        "matches that do not agree",
        "The matches do not agree on one place where the camera could have stood.",
        "Look at its matches below. If they lie on moving or repeated things, add a photo from "
        "nearby; if they look right, give the true focal length (--intrinsics).",
    ),
    (
        r"too few points are left after refinement|lost its points .*",
        "a place that did not hold",
        "There was a place, but too few points fitted once everything was refined.",
        _MORE_OVERLAP,
    ),
    (
        r"(at the end )?(?P<share>[\d.]+%) of the pixels contradict (the depth of (?P<other>.+)"
        r"|another view's)",
        "in contradiction to another photo",
        "Where the matches put it, {share} of what the photo sees contradicts what another sees.",
        _LOOK_ALIKE,
    ),
    (
        r"(?P<count>\d+) other images contradict its depth",
        "in contradiction to other photos",
        "{count} other photos contradict what the photo sees where its matches put it.",
        _LOOK_ALIKE,
    ),
    (
        r"held to the rest only by an image that was dropped at the end",
        "held only by a photo that was dropped",
        "The only link to the others was a photo that was dropped in the end.",
        _MORE_OVERLAP,
    ),
    (
        r"only (?P<have>\d+) images are connected, (?P<need>\d+) are wanted",
        "in a group that is too small",
        "Only {have} photos hang together here; {need} are asked for.",
        "Add photos of this place, or accept small groups: --set mapping.min_model_size=2.",
    ),
    (
        r"not connected to the others; in components/(?P<number>\d+)",
        "in a reconstruction of its own",
        "The group was reconstructed (components/{number}), but what it matches in the others does "
        "not suffice to join them.",
        "Add photos that overlap with both groups.",
    ),
    (
        r"not tried: there are (?P<count>\d+) groups",
        "not tried",
        "The photos fall apart into more groups than are tried ({count}).",
        "Add photos that link the groups, or raise mapping.max_components.",
    ),
    (
        r"has no known pose, and known poses are fixed",
        "no known pose",
        "Poses were given and kept fixed, and there is none for this photo.",
        "Leave out --set mapping.known_poses=fixed, or give its pose.",
    ),
)

_PAIRS: tuple[tuple[str, str], ...] = (
    (r"\d+ matches, at least \d+ are needed", "too few matches"),
    (r"\d+ inliers of \d+ matches fit by chance", "matches that fit by chance alone"),
    (r"\d+ inliers of \d+ matches( \(.+\))?", "matches that are geometrically impossible"),
    (r"no relative pose", "no relative pose"),
)


def explain(reason: str) -> Explanation:
    """What the recorded reason of a missing image means; an unknown one stands for itself."""
    for pattern, kind, plain, remedy in _IMAGES:
        found = re.fullmatch(pattern, reason)
        if found:
            values = {key: value for key, value in found.groupdict().items() if value}
            return Explanation(kind, plain.format(**values), remedy)
    return Explanation("another reason", reason[:1].upper() + reason[1:] + ".", _MORE_OVERLAP)


def pair_kind(reason: str) -> str:
    """The recorded reason of a dropped pair, without its numbers."""
    found = (kind for pattern, kind in _PAIRS if re.fullmatch(pattern, reason))
    return next(found, reason)
