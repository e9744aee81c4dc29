"""Contract checks of providers that detect and describe features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import Features, Float64, Int64, View
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

PIXEL_TOLERANCE = 0.25
"""Largest accepted shift of keypoints in pixels, or in multiples of the keypoint std if ``std_px``
exceeds one. Integer pixel centers shift keypoints by 0.5 pixels, but the shift is 0.00 for SIFT and
at most 0.08 for XFeat."""
LARGE_SIZE = (4096, 3072)
"""Width and height in pixels of a view with 12.6 megapixels, the size of phone photos."""
_SAME_KEYPOINT_PX = 2.5
"""Largest distance in pixels between a keypoint and its repetition in the rotated view. A
half-pixel mistake in x and y moves a keypoint and its repetition apart by 1.4 pixels."""
_MIN_REPEATED_RATIO = 0.2
"""Smallest ratio of keypoints that must be found again in the rotated view. The ratio of repeated
keypoints is 0.85 for SIFT, 0.28 for XFeat, and below 0.15 for DISK."""
_MIN_COUNT = 8
_MIN_INSIDE_RATIO = 0.8
"""Smallest accepted ratio of keypoints on the textured part of a view. Some keypoints are outside
of the textured part because detectors respond to its border."""
_MIN_CORRECT_RATIO = 0.3
"""Smallest accepted ratio of correct descriptor matches (mutual nearest neighbors within three
standard deviations of the true position). The ratio of correct matches is 0.6 for SIFT and 0.01 for
shuffled descriptors."""


def check_features_axes(case: ContractCase) -> str:
    """Require keypoints (x, y) in the textured part of the view.

    The textured part is a low and wide area in the upper right corner, so that keypoints with
    swapped x and y are outside.
    """
    case.require_truth("image", "prepared")
    view = case.example.view
    height, width = view.image.shape[:2]
    left, bottom = int(0.45 * width), int(0.45 * height)
    image = np.full_like(view.image, 128)
    image[:bottom, left:] = view.image[:bottom, left:]
    found = case.run_on_view(replace(view, image=image), case.example)
    _require_enough(found)
    margin = 3 * found.std_px
    x, y = found.keypoints.T
    inside = float(((x >= left - margin) & (y <= bottom + margin)).mean())
    if inside < _MIN_INSIDE_RATIO:
        swapped = float(((y >= left - margin) & (x <= bottom + margin)).mean())
        reason = ": x and y are swapped" if swapped > inside else ""
        raise CheckFailed(
            f"only {inside:.0%} of the keypoints are on the textured part of the view{reason}"
        )
    return f"{inside:.0%} of the keypoints are on the textured part"


def check_features_pixel_convention(case: ContractCase) -> str:
    """Require keypoints for which the center of the first pixel is (0.5, 0.5).

    If the view is rotated by 180 degrees, a keypoint (x, y) has to be found at (width - x, height -
    y). A wrong pixel convention shifts x and y of all keypoints by the same amount. Some networks
    shift keypoints only in x or only in y; for such networks the check is skipped.
    """
    case.require_truth("image")
    view = case.example.view
    found: Features = case.run(case.example)
    turned = replace(view, image=np.ascontiguousarray(view.image[::-1, ::-1]))
    back = np.array(case.example.camera.size) - case.run_on_view(turned, case.example).keypoints
    _require_enough(found)
    radius = _SAME_KEYPOINT_PX * max(1.0, found.std_px)
    offsets = _offsets_to_nearest(found.keypoints, back, radius) / 2
    if len(offsets) < max(_MIN_COUNT, _MIN_REPEATED_RATIO * len(found)):
        text = f"{len(offsets)} of {len(found)} keypoints"
        raise CheckSkipped(
            f"the detector repeats only {text} in the rotated view, too few for this check"
        )
    x, y = offsets.mean(axis=0)
    text = f"shifted by ({x:+.2f}, {y:+.2f}) px"
    limit = PIXEL_TOLERANCE * max(1.0, found.std_px)
    if max(abs(x), abs(y)) < limit:
        return f"keypoints are {text}"
    if min(abs(x), abs(y)) > limit and x * y > 0:
        raise CheckFailed(
            f"keypoints are {text}: the center of the first pixel has to be (0.5, 0.5)"
        )
    raise CheckSkipped(f"the detector is not symmetric, keypoints are {text}")


def check_features_large_view(case: ContractCase) -> str:
    """Require keypoints in pixels of a large view, even if the provider reduces the image.

    Only the lower right corner of the view with 12.6 megapixels has texture.
    Keypoints of a reduced image that are not scaled back are outside of the textured corner.
    """
    case.require_truth("image")
    import cv2  # The import is local, because pytest loads this module when it collects tests.

    width, height = LARGE_SIZE
    left, top = 3 * width // 4, 3 * height // 4
    tile = cv2.resize(case.example.view.image, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    num_rows, num_columns = -(-(height - top) // tile.shape[0]), -(-(width - left) // tile.shape[1])
    texture = np.tile(tile, (num_rows, num_columns, 1))
    image = np.full((height, width, 3), 128, np.uint8)
    image[top:, left:] = texture[: height - top, : width - left]
    view = View("large.png", image, case.example.camera.resized(width, height))
    features = case.run_on_view(view, case.example)
    _require_enough(features)
    margin = 3 * features.std_px
    x, y = features.keypoints.T
    inside = float(((x >= left - margin) & (y >= top - margin)).mean())
    if inside < _MIN_INSIDE_RATIO:
        raise CheckFailed(
            f"only {inside:.0%} of the keypoints of a {width} x {height} view are on the textured "
            f"part, the largest are x = {x.max():.0f}, y = {y.max():.0f}: scale the keypoints of a "
            f"reduced image back"
        )
    return f"{inside:.0%} of {len(features)} keypoints are on the textured part"


def check_features_descriptors(case: ContractCase) -> str:
    """Require that descriptors belong to their keypoints.

    Mutual nearest neighbors between two views of a scene have to be the same surface points.
    """
    case.require_truth("image", "prepared")
    a: Features = case.run(case.example)
    b: Features = case.run(case.example.partner)
    _require_enough(a)
    _require_enough(b)
    rows, columns = _mutual_nearest(a, b)
    true = case.example.correspondences(case.example.partner, a.keypoints[rows])
    distance = np.linalg.norm(b.keypoints[columns] - true.xy_b, axis=1)
    right = (distance < 3 * max(1.0, a.std_px, b.std_px))[true.visible]
    if len(right) < _MIN_COUNT:
        raise CheckSkipped(f"the descriptors have only {len(right)} mutual nearest neighbors")
    if right.mean() < _MIN_CORRECT_RATIO:
        raise CheckFailed(f"only {right.mean():.0%} of the nearest descriptors are the same point")
    return f"{right.mean():.0%} of the nearest descriptors are the same point"


def check_features_dimension(case: ContractCase) -> str:
    """Require the same descriptor length for every view.

    Descriptors of a view without any keypoint must have this length too.
    """
    flat = replace(case.example.view, image=np.full_like(case.example.view.image, 128))
    some, none = case.run(case.example), case.run_on_view(flat, case.example)
    lengths = {features.descriptors.shape[1] for features in (some, none)}
    if len(lengths) > 1:
        raise CheckFailed(f"descriptors have {' and '.join(map(str, sorted(lengths)))} values")
    return f"{len(some)} keypoints with {lengths.pop()} values; {len(none)} on a flat view"


CHECKS = (
    check_features_axes,
    check_features_pixel_convention,
    check_features_large_view,
    check_features_descriptors,
    check_features_dimension,
)


def _require_enough(features: Features) -> None:
    """Require that the detector finds keypoints in a textured view."""
    if len(features) < _MIN_COUNT:
        raise CheckFailed(
            f"the detector finds only {len(features)} keypoints in a fully textured view"
        )


def _offsets_to_nearest(found: Float64, others: Float64, radius: float) -> Float64:
    """Return the differences (n, 2) between mutual nearest keypoints closer than ``radius``."""
    distance = np.linalg.norm(found[:, None] - others[None], axis=2)
    nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
    rows = np.flatnonzero(back[nearest] == np.arange(len(found)))
    rows = rows[distance[rows, nearest[rows]] < radius]
    offsets: Float64 = found[rows] - others[nearest[rows]]
    return offsets


def _mutual_nearest(a: Features, b: Features) -> tuple[Int64, Int64]:
    """Return the row indices of descriptors that are mutual nearest neighbors."""
    x, y = a.descriptors.astype(np.float64), b.descriptors.astype(np.float64)
    distance = (x**2).sum(1)[:, None] + (y**2).sum(1)[None] - 2 * x @ y.T
    nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
    rows = np.flatnonzero(back[nearest] == np.arange(len(nearest)))
    return rows, nearest[rows]
