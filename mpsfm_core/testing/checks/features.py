"""Checks of features providers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import Features, Float64, Int64
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

PIXEL_TOLERANCE = 0.25
"""Pixels, or of ``std_px`` where that is more; half of what taking integers for pixel centres
makes. Ours: SIFT has 0.00, XFeat (0.05, 0.08)."""
_SAME_PX = 2.5
"""Keypoints of the turned view nearer than this to one of the view are taken for the same: more
than the 1.4 pixels by which a half-pixel mistake in both directions moves them apart."""
_FOUND_AGAIN = 0.2
"""Of keypoints, in the turned view. Ours: SIFT 0.85, XFeat 0.28; DISK and ALIKED below 0.15."""
_FEWEST = 8
_INSIDE_SHARE = 0.8
"""Of keypoints on the textured part of a view. The rest may respond to its border."""
_RIGHT_SHARE = 0.3
"""Of mutual nearest neighbours that are right within three standard deviations. Ours, on the
view and its partner: SIFT 0.6, learned features 0.7 and more, shuffled descriptors 0.01."""


def check_features_axes(case: ContractCase) -> str:
    """Keypoints are (x, y): they lie where the view has texture, which here is a low and wide part
    in the upper right corner."""
    case.require_truth("image", "prepared")
    view = case.example.view
    height, width = view.image.shape[:2]
    left, bottom = int(0.45 * width), int(0.45 * height)
    image = np.full_like(view.image, 128)
    image[:bottom, left:] = view.image[:bottom, left:]
    found = case.run_on_view(replace(view, image=image), case.example)
    _enough(found)
    margin = 3 * found.std_px
    x, y = found.keypoints.T
    inside = float(((x >= left - margin) & (y <= bottom + margin)).mean())
    if inside < _INSIDE_SHARE:
        swapped = float(((y >= left - margin) & (x <= bottom + margin)).mean())
        reason = ": x and y are swapped" if swapped > inside else ""
        raise CheckFailed(f"only {inside:.0%} of the keypoints are where there is texture{reason}")
    return f"{inside:.0%} of the keypoints are where there is texture"


def check_features_pixel_convention(case: ContractCase) -> str:
    """The centre of the first pixel is (0.5, 0.5). In the view turned by 180 degrees a keypoint
    (x, y) lies at (width - x, height - y) only if that is so. A wrong convention shifts x and y
    alike; some networks have a bias of their own in one of them, and then the check is skipped."""
    case.require_truth("image")
    view = case.example.view
    found: Features = case.run(case.example)
    turned = replace(view, image=np.ascontiguousarray(view.image[::-1, ::-1]))
    back = np.array(case.example.camera.size) - case.run_on_view(turned, case.example).keypoints
    _enough(found)
    reach = _SAME_PX * max(1.0, found.std_px)
    offsets = _offsets(found.keypoints, back, reach) / 2
    if len(offsets) < max(_FEWEST, _FOUND_AGAIN * len(found)):
        text = f"{len(offsets)} of {len(found)} keypoints"
        raise CheckSkipped(f"finds only {text} again in the turned view: nothing can be said")
    x, y = offsets.mean(axis=0)
    text = f"shifted by ({x:+.2f}, {y:+.2f}) px"
    limit = PIXEL_TOLERANCE * max(1.0, found.std_px)
    if max(abs(x), abs(y)) < limit:
        return f"keypoints are {text}"
    if min(abs(x), abs(y)) > limit and x * y > 0:
        raise CheckFailed(f"keypoints are {text}: is the first pixel's centre (0, 0) somewhere?")
    raise CheckSkipped(f"the detector is not symmetric, keypoints are {text}: nothing can be said")


def check_features_descriptors(case: ContractCase) -> str:
    """Descriptors belong to their keypoints: mutual nearest neighbours between the view and the
    same scene from a little to the side are the same surface points."""
    case.require_truth("image", "prepared")
    a: Features = case.run(case.example)
    b: Features = case.run(case.example.partner)
    _enough(a)
    _enough(b)
    rows, columns = _mutual_nearest(a, b)
    true = case.example.correspondences(case.example.partner, a.keypoints[rows])
    distance = np.linalg.norm(b.keypoints[columns] - true.xy_b, axis=1)
    right = (distance < 3 * max(1.0, a.std_px, b.std_px))[true.visible]
    if len(right) < _FEWEST:
        raise CheckSkipped(f"only {len(right)} mutual nearest neighbours")
    if right.mean() < _RIGHT_SHARE:
        raise CheckFailed(f"only {right.mean():.0%} of the nearest descriptors are the same point")
    return f"{right.mean():.0%} of the nearest descriptors are the same point"


def check_features_dimension(case: ContractCase) -> str:
    """Descriptors have the same length for every view, also where nothing is found."""
    flat = replace(case.example.view, image=np.full_like(case.example.view.image, 128))
    some, none = case.run(case.example), case.run_on_view(flat, case.example)
    lengths = {features.descriptors.shape[1] for features in (some, none)}
    if len(lengths) > 1:
        raise CheckFailed(f"descriptors have {' and '.join(map(str, sorted(lengths)))} values")
    return f"{len(some)} keypoints with {lengths.pop()} values; {len(none)} on a flat view"


CHECKS = (
    check_features_axes,
    check_features_pixel_convention,
    check_features_descriptors,
    check_features_dimension,
)


def _enough(features: Features) -> None:
    if len(features) < _FEWEST:
        raise CheckFailed(f"finds only {len(features)} keypoints in a view full of texture")


def _offsets(found: Float64, others: Float64, reach: float) -> Float64:
    """Differences (n, 2) between points that are nearest to each other, within ``reach``."""
    distance = np.linalg.norm(found[:, None] - others[None], axis=2)
    nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
    rows = np.flatnonzero(back[nearest] == np.arange(len(found)))
    rows = rows[distance[rows, nearest[rows]] < reach]
    offsets: Float64 = found[rows] - others[nearest[rows]]
    return offsets


def _mutual_nearest(a: Features, b: Features) -> tuple[Int64, Int64]:
    x, y = a.descriptors.astype(np.float64), b.descriptors.astype(np.float64)
    distance = (x**2).sum(1)[:, None] + (y**2).sum(1)[None] - 2 * x @ y.T
    nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
    rows = np.flatnonzero(back[nearest] == np.arange(len(nearest)))
    return rows, nearest[rows]
