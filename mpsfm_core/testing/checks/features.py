"""Contract checks of providers that detect and describe features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mpsfm_core.data import Features, Float32, Float64, Int64, UInt8, View
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped, CheckUndecided

PIXEL_TOLERANCE = 0.25
"""Largest accepted shift of keypoints in pixels, or in multiples of the keypoint std if ``std_px``
exceeds one. Integer pixel centers shift keypoints by 0.5 pixels, but the shift is 0.00 for SIFT and
at most 0.08 for XFeat."""
LARGE_SIZE = (4096, 256)
"""Width and height in pixels of a view as wide as phone photos. Networks limit the longer side; the
small height limits the run time."""
_CORNER_SIZE = (704, 128)
"""Width and height in pixels of the two textured corners of the large view. The distance of both
corners is a multiple of 64 pixels, so that both look alike to a network with a stride."""
_MIN_MUTUAL = 30
"""Smallest number of mutual nearest neighbors from which two equal parts of a view are compared.
Networks with random weights have fewer."""
_MAX_PART_SHIFT_PX = 2.0
"""Largest accepted shift in pixels, or in median absolute deviations, between the keypoints of two
equal parts of a view. The shift is at most 0.5 pixels for tested detectors."""
_ROUNDING_STEPS_PX = np.array([1.0, 2.0, 4.0, 8.0])
"""Steps in pixels to which positions at the end of a large view must not be rounded. Half precision
has steps of 2 pixels above 2048."""
_ROUNDING_TOLERANCE = 0.01
"""Largest distance from a multiple of a step, relative to the step."""
_MAX_FAILING_UNIQUE_RATIO = 0.5
"""Largest ratio of different features or matches that fails. If every feature is returned twice,
the ratio is 0.5."""
_BLOB_STD_PX = 4.0
"""Std in pixels of the Gaussian blob of a view with one or few keypoints."""
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
_MIN_LARGE_RATIO = 0.1
"""Smallest accepted ratio of keypoints in each textured corner of the large view."""
_MAX_SCALING_SHIFT_PX = 1.0
"""Largest accepted shift, to the same side in x and y, of the keypoints of the large view against
those of a view of a quarter of the size. Integer pixel centers that are scaled from 1024 to 4096
pixels shift keypoints by 1.5 pixels, but the shift is at most 0.6 pixels for tested detectors."""
_SCALING_RADIUS_PX = 2.0
"""Largest distance in pixels of the large view between two shifts of keypoints that count as
equal."""
_CONTINUED_SIZES = ((211, 149), (768, 576), (403, 611))
"""Widths and heights of the larger views in ``check_features_other_sizes``."""
_MAX_SHIFT_PX = 32.0
"""Largest shift of keypoints that a vote of their offsets detects."""
_MIN_STRONG_RATIO = 0.7
"""Smallest accepted ratio of the numbers of keypoints with high and with low contrast."""
_NUM_VOTING = 500
"""Largest number of keypoints whose offsets vote for a shift."""
_MIN_RANK_CORRELATION = 0.15
"""Smallest accepted rank correlation between the scores of the same pixels in two views."""
_MAX_SCALE_RATIO = 1.5
"""Largest accepted ratio between the scales of the same pixels in two views."""
_MIN_COVERING = 40
"""Minimum number of keypoints for which the coverage of a view is checked."""
_MIN_COVERED_CELLS = 7
_MIN_SIDE_RATIO = 0.05
"""Smallest accepted ratio of keypoints in the outer third of each side of a textured view. The
ratio in an outer third is 0.33 for evenly spread keypoints, and 0.2 for SIFT."""
_MIN_ORDER = 0.4
"""Smallest accepted probability that a keypoint with contrast has a higher score than one without.
Meaningless scores give a probability of 0.5, inverted scores a probability of 0."""
_SCALE_RANGE = (1.4, 2.8)
"""Accepted range of the ratio of keypoint scales in a view and in a view of half the size."""
_MAX_STD_FACTOR = 3.0
"""Largest accepted ratio of the measured keypoint error and ``std_px``, which is 0.03 for SIFT."""
_MAX_ERROR_PX = 6.0
"""Keypoint distance in pixels above which a descriptor match counts as wrong instead of
inaccurate."""
_MIN_CORRECT_RATIO = 0.3
"""Smallest accepted ratio of correct descriptor matches (mutual nearest neighbors within three
standard deviations of the true position). The ratio of correct matches is 0.6 for SIFT and 0.01 for
shuffled descriptors."""


def check_features_axes(case: ContractCase) -> str:
    """Require keypoints (x, y) inside the textured part of views of six sizes.

    The textured part is a rectangle in one corner of a landscape, portrait, odd-sized or narrow
    view.
    Keypoints with swapped x and y are outside of the rectangle. Keypoints of a resized, padded,
    cropped or rotated image that are not mapped back to the view are outside as well.
    """
    case.require_truth("image", "prepared")
    width, height = case.example.camera.size
    ratios = []
    for size, is_upper_right in (
        ((width, height), True),
        ((height, width), False),
        ((211, 149), True),
        ((149, 211), False),
        ((width // 2, 2 * height), False),
        ((2 * width, height // 2), True),
    ):
        example = case.example.sized(*size)
        view, part = _blank_outside(example.view, upper_right=is_upper_right)
        ratios.append(_require_in_part(case, example, view, part))
    return f"{min(ratios):.0%} of the keypoints are on the textured part"


def check_features_coverage(case: ContractCase) -> str:
    """Require keypoints in all parts of a fully textured view.

    Keypoints that are limited to the first rows, to the center or to one tile leave the rest of
    every image without matches.
    """
    case.require_truth("image", "prepared")
    return _require_coverage(case.run(case.example), case.example.camera.size)


def check_features_scores(case: ContractCase) -> str:
    """Require higher scores where the texture has more contrast.

    A limit on the number of features has to keep the features with the highest scores, so that most
    keypoints are in the half of the view with more contrast.
    """
    case.require_truth("image", "prepared")
    size = 2 * case.example.camera.width, 2 * case.example.camera.height
    view = _continue_by_reflection(case.example.view, size)
    half = view.camera.width // 2
    image = view.image.astype(np.float64)
    image[:, :half] = 128 + 0.25 * (image[:, :half] - 128)
    view = replace(view, image=image.round().astype(np.uint8))
    features: Features = case.run_on_view(view, case.example)
    counts = [int((side * (features.keypoints[:, 0] - half) > 8).sum()) for side in (-1, 1)]
    if counts[1] < _MIN_STRONG_RATIO * counts[0]:
        raise CheckFailed(
            f"{counts[0]} keypoints are in the half of a view with a quarter of the contrast, and "
            f"{counts[1]} in the other half: a limit has to keep the best keypoints"
        )
    if features.scores is None:
        raise CheckSkipped("the features have no scores")
    x = features.keypoints[:, 0]
    weak, strong = features.scores[x < half - 8], features.scores[x > half + 8]
    if min(len(weak), len(strong)) < _MIN_COUNT:
        return f"{len(strong)} keypoints with, {len(weak)} without contrast"
    better = order_probability(strong, weak)
    if better < _MIN_ORDER:
        raise CheckFailed(
            f"keypoints without contrast have higher scores: mean {weak.mean():.3g}, "
            f"{strong.mean():.3g} with contrast"
        )
    return f"score {weak.mean():.3g} without, {strong.mean():.3g} with contrast"


def check_features_scales(case: ContractCase) -> str:
    """Require keypoint scales in pixels, which halve in a view of half the size."""
    case.require_truth("image")
    width, height = case.example.camera.size
    features: Features = case.run(case.example)
    if features.scales is None:
        raise CheckSkipped("the features have no scales")
    if np.ptp(features.scales) < 0.01 * features.scales.mean():
        raise CheckSkipped("all features have the same scale")
    small_features: Features = case.run(case.example.sized(width // 2, height // 2))
    if small_features.scales is None:
        raise CheckSkipped("the features of a smaller view have no scales")
    distance = np.linalg.norm(
        2 * small_features.keypoints[:, None] - features.keypoints[None], axis=2
    )
    pairs = []
    for row in np.flatnonzero(distance.min(axis=1) < _SAME_KEYPOINT_PX):
        near = np.flatnonzero(distance[row] < _SAME_KEYPOINT_PX)
        pairs.append(features.scales[near] / small_features.scales[row])
    if len(pairs) < _MIN_COUNT:
        raise CheckSkipped(f"only {len(pairs)} keypoints repeat in a view of half the size")
    # A keypoint can have features of several scales, one of which must be twice the scale in the
    # view of half the size.
    best = np.array([ratio[np.abs(np.log(ratio / 2)).argmin()] for ratio in pairs])
    factor = float(np.median(best))
    if not _SCALE_RANGE[0] < factor < _SCALE_RANGE[1]:
        raise CheckFailed(f"scales are {factor:.2g} times those in a view of half the size")
    return f"scales are {factor:.2g} times those in a view of half the size"


def check_features_std(case: ContractCase) -> str:
    """Require a ``std_px`` that is not far below the measured error of matched keypoints.

    A ``std_px`` that is measured in pixels of a reduced image is too small.
    """
    case.require_truth("image")
    first, second = case.run(case.example), case.run(case.example.partner)
    rows, columns = _mutual_nearest(first, second)
    true = case.example.correspondences(case.example.partner, first.keypoints[rows])
    offset = (second.keypoints[columns] - true.xy_b)[true.visible]
    offset = offset[np.linalg.norm(offset, axis=1) < _MAX_ERROR_PX * max(1.0, first.std_px)]
    if len(offset) < 2 * _MIN_COUNT:
        raise CheckUndecided(f"only {len(offset)} keypoints match, too few to measure std_px")
    # The median absolute deviation of a normal distribution is 0.67 of its std.
    error = float(np.median(np.abs(offset)) / 0.6745)
    factor = error / float(np.hypot(first.std_px, second.std_px))
    if factor > _MAX_STD_FACTOR:
        raise CheckFailed(f"keypoint errors are {factor:.2g} times the declared std_px")
    return f"errors are {factor:.2g} times std_px"


def check_features_pixel_convention(case: ContractCase) -> str:
    """Require keypoints for which the center of the first pixel is (0.5, 0.5).

    If the view is rotated by 180 degrees, a keypoint (x, y) has to be found at (width - x, height -
    y). A wrong pixel convention shifts x and y of all keypoints by the same amount. The check fails
    with "cannot tell" for networks that shift keypoints only in x or only in y.
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
        raise CheckUndecided(f"the detector finds only {text} again in the rotated view")
    x, y = offsets.mean(axis=0)
    text = f"shifted by ({x:+.2f}, {y:+.2f}) px"
    limit = PIXEL_TOLERANCE * max(1.0, found.std_px)
    if max(abs(x), abs(y)) < limit:
        return f"keypoints are {text}"
    if min(abs(x), abs(y)) > limit and x * y > 0:
        raise CheckFailed(
            f"keypoints are {text}: the center of the first pixel has to be (0.5, 0.5)"
        )
    raise CheckUndecided(f"the detector is not symmetric, keypoints are {text}")


def check_features_large_view(case: ContractCase) -> str:
    """Require keypoints in pixels of a large view, even if the provider reduces the image.

    Only two opposite corners of the view of 4096 x 256 pixels have texture, which is the same in
    both. Both corners contain few keypoints if keypoints of a reduced image are not scaled back.
    All keypoints are shifted if they are scaled back with integer pixel centers. The shift is
    measured against the keypoints of a view of a quarter of the size. The features of both corners
    have to agree, which detects wrong offsets of tiles, wrong factors for one axis, descriptors of
    other pixels, and keypoints in half precision.
    """
    case.require_truth("image")
    import cv2  # The import is local, because pytest loads this module when it collects tests.

    width, height = LARGE_SIZE
    part_width, part_height = _CORNER_SIZE
    tile = cv2.resize(case.example.view.image, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    row = (tile.shape[0] - part_height) // 2
    image = np.full((height, width, 3), 128, np.uint8)
    image[:part_height, :part_width] = tile[row : row + part_height, :part_width]
    image[-part_height:, -part_width:] = image[:part_height, :part_width]
    view = View("large.png", image, case.example.camera.resized(width, height))
    features = case.run_on_view(view, case.example)
    _require_enough(features)
    margin = 3 * features.std_px
    keypoints = features.keypoints
    size = np.array([part_width, part_height]) + margin
    first = (keypoints <= size).all(axis=1)
    last = (keypoints >= np.array(LARGE_SIZE) - size).all(axis=1)
    ratios = [float(part.mean()) for part in (first, last)]
    if min(ratios) < _MIN_LARGE_RATIO or sum(ratios) < _MIN_INSIDE_RATIO:
        x, y = keypoints.max(axis=0)
        raise CheckFailed(
            f"the textured corners of a {width} x {height} view have {ratios[0]:.0%} and "
            f"{ratios[1]:.0%} of the keypoints, the largest are x = {x:.0f}, y = {y:.0f}: scale "
            f"the keypoints of a reduced image back"
        )
    small: Features = case.run(case.example)
    corner = np.array(LARGE_SIZE) - _CORNER_SIZE
    in_first_part = 4 * small.keypoints - (0, row)
    _require_no_scaling_shift(keypoints, [in_first_part, in_first_part + corner])
    _require_four_times_the_scales(features, small, in_first_part)
    second = features.select((keypoints >= corner).all(axis=1))
    first_part = features.select((keypoints <= _CORNER_SIZE).all(axis=1))
    _require_equal_parts(first_part, replace(second, keypoints=second.keypoints - corner))
    return f"{sum(ratios):.0%} of {len(features)} keypoints are on the textured corners"


def check_features_descriptors(case: ContractCase) -> str:
    """Require that descriptors belong to their keypoints.

    Mutual nearest neighbors between two views of a scene have to be the same surface points. Most
    keypoints must not have the position and descriptor of another one, which no ratio test accepts.
    """
    case.require_truth("image", "prepared")
    features: Features = case.run(case.example)
    require_unique(np.hstack([features.keypoints, features.descriptors]), "features")
    width, height = case.example.camera.size
    portrait = case.example.partner.crop(width // 5, 0, 3 * width // 5, height)
    texts = [_require_same_points(case, b) for b in (case.example.partner, portrait)]
    return texts[0]


def check_features_dimension(case: ContractCase) -> str:
    """Require the same descriptor length for every view.

    The descriptor array (0, d) of a view without keypoints must have the same length d. Other views
    show one blob and one corner, where detectors find one or few keypoints.
    """
    flat = np.zeros_like(case.example.view.image)
    outputs = [
        case.run_on_view(replace(case.example.view, image=image), case.example)
        for image in (case.example.view.image, flat, *_simple_images(case.example.camera.size))
    ]
    some, none = outputs[:2]
    lengths = {features.descriptors.shape[1] for features in outputs}
    if len(lengths) > 1:
        raise CheckFailed(f"descriptors have {' and '.join(map(str, sorted(lengths)))} values")
    return f"{len(some)} keypoints with {lengths.pop()} values; {len(none)} on a flat view"


def check_features_other_sizes(case: ContractCase) -> str:
    """Require the features of a part of a view in the same part of larger views.

    A view of 192 x 144 pixels is continued by its reflection to three larger sizes, which contain
    the view up to four times. Keypoints, descriptors, scores and scales of the copies have to agree
    with those of the view alone. The check detects wrong scaling, padding and cropping at these
    sizes, and arrays in different order if there are many keypoints.
    """
    case.require_truth("image")
    alone: Features = case.run(case.example)
    _require_enough(alone)
    texts: list[str] = []
    correlations: list[float] = []
    for size in _CONTINUED_SIZES:
        continued = _continue_by_reflection(case.example.view, size)
        features: Features = case.run_on_view(continued, case.example)
        where = "of a {} x {} view".format(*size)
        try:
            _require_coverage(features, size)
        except CheckSkipped:
            pass
        except CheckFailed as failed:
            raise CheckFailed(f"{failed} {where}") from failed
        _require_symmetric(case, features, size)
        pairs = []
        for corner in _copies(case.example.camera.size, size):
            found = features.keypoints - corner
            inside = ((found >= 0) & (found <= case.example.camera.size)).all(axis=1)
            rows = np.flatnonzero(inside)
            peak = _find_shift(found[rows], alone.keypoints, 1.0)
            if peak is None:
                continue
            if np.abs(peak).max() > PIXEL_TOLERANCE * max(2.0, features.std_px):
                x, y = peak
                raise CheckFailed(
                    f"keypoints {where} are shifted by ({x:+.1f}, {y:+.1f}) px at "
                    f"({corner[0]}, {corner[1]})"
                )
            pairs.append(_pair_nearest(found, rows, alone.keypoints))
        rows, columns = np.concatenate([np.empty((0, 2), np.int64), *pairs]).T
        if len(rows) < 2 * _MIN_COUNT:
            continue
        _require_same_values(features.select(rows), alone, columns, where)
        texts.append(f"{len(rows)} keypoints {where} agree")
        correlations.append(_correlate_scores(features.select(rows), alone.select(columns)))
        if correlations[-1] < _MIN_RANK_CORRELATION <= correlations[0] / 4:
            raise CheckFailed(
                f"scores {where} and scores of the same pixels in a part of the view have a rank "
                f"correlation of {correlations[-1]:.2f}"
            )
    if not texts:
        raise CheckSkipped("too few keypoints of the view repeat in larger views")
    return texts[-1]


CHECKS = (
    check_features_axes,
    check_features_pixel_convention,
    check_features_coverage,
    check_features_large_view,
    check_features_other_sizes,
    check_features_descriptors,
    check_features_dimension,
    check_features_scores,
    check_features_scales,
    check_features_std,
)


def _require_coverage(features: Features, size: tuple[int, int]) -> str:
    """Require keypoints in most of nine equal parts of a fully textured view."""
    _require_enough(features)
    cells = (features.keypoints / size * 3).astype(int).clip(0, 2)
    counts = np.zeros((3, 3), dtype=int)
    np.add.at(counts, (cells[:, 1], cells[:, 0]), 1)
    covered = int((counts > 0).sum())
    halves = [counts[:, 0], counts[:, 2], counts[0], counts[2]]
    smallest = min(float(part.sum()) for part in halves) / len(features)
    if len(features) < _MIN_COVERING:
        raise CheckSkipped(f"{len(features)} keypoints are too few to cover a view")
    if covered < _MIN_COVERED_CELLS or smallest < _MIN_SIDE_RATIO:
        raise CheckFailed(
            f"keypoints cover {covered} of 9 parts of a fully textured view, and only "
            f"{smallest:.0%} are in an outer third"
        )
    return f"keypoints cover {covered} of 9 parts"


def _require_same_points(case: ContractCase, other: Example) -> str:
    """Require that mutual nearest neighbors of descriptors are keypoints of the same points."""
    a: Features = case.run(case.example)
    b: Features = case.run(other)
    _require_enough(a)
    _require_enough(b)
    rows, columns = _mutual_nearest(a, b)
    true = case.example.correspondences(other, a.keypoints[rows])
    distance = np.linalg.norm(b.keypoints[columns] - true.xy_b, axis=1)
    right = (distance < 3 * max(1.0, a.std_px, b.std_px))[true.visible]
    if len(right) < _MIN_COUNT:
        raise CheckUndecided(f"the descriptors have only {len(right)} mutual nearest neighbors")
    if right.mean() < _MIN_CORRECT_RATIO:
        raise CheckFailed(f"only {right.mean():.0%} of the nearest descriptors are the same point")
    return f"{right.mean():.0%} of the nearest descriptors are the same point"


def _require_no_scaling_shift(keypoints: Float64, expected: Sequence[Float64]) -> None:
    """Require that keypoints are not shifted to one side against expected positions.

    Args:
        keypoints: (n, 2) keypoints of a large view in pixels.
        expected: (m, 2) positions of keypoints in each part of the large view, from a small view.
    """
    found = [_find_shift(keypoints, part, _SCALING_RADIUS_PX) for part in expected]
    if any(shift is None for shift in found):
        return
    shifts = np.array(found)
    if max(shifts.min(), -shifts.max()) > _MAX_SCALING_SHIFT_PX:
        x, y = shifts.mean(axis=0)
        raise CheckFailed(
            f"keypoints of a large view are shifted by ({x:+.1f}, {y:+.1f}) px: scale positions "
            "for which the center of the first pixel is (0.5, 0.5)"
        )


def _require_four_times_the_scales(large: Features, small: Features, expected: Float64) -> None:
    """Require that keypoint scales are in pixels of the large view, not of a reduced one."""
    if large.scales is None or small.scales is None:
        return
    distance = np.linalg.norm(large.keypoints[:, None] - expected[None], axis=2)
    ratios = [large.scales[row] / small.scales[near] for row, near in enumerate(distance < 4.0)]
    # A keypoint can have features of several scales, one of which must be four times as large.
    best = [float(r[np.abs(np.log(r / 4)).argmin()]) for r in ratios if len(r)]
    if len(best) < 2 * _MIN_COUNT:
        return
    factor = float(np.median(best))
    if abs(np.log(factor / 4)) > np.log(2 * _MAX_SCALE_RATIO) / 2:
        raise CheckFailed(
            f"scales in a view of four times the size are {factor:.2g} times as large"
        )


def _require_equal_parts(first: Features, second: Features) -> None:
    """Require equal features in two parts of a view with the same texture.

    Args:
        first: Features of the first part.
        second: Features of the second part, with positions relative to that part.
    """
    if min(len(first), len(second)) < _MIN_COUNT:
        return
    rows, columns = _mutual_nearest(first, second)
    offset = second.keypoints[columns] - first.keypoints[rows]
    shift = np.median(offset, axis=0) if len(rows) else np.zeros(2)
    is_equal = (np.abs(offset - shift) <= _MAX_ERROR_PX).all(axis=1)
    if len(rows) >= _MIN_MUTUAL and is_equal.mean() < _MIN_CORRECT_RATIO:
        raise CheckFailed(
            f"only {is_equal.mean():.0%} of the descriptors in two equal parts of a large view "
            "belong to the same keypoint"
        )
    if is_equal.sum() >= max(_MIN_COUNT, len(rows) / 2):
        deviation = np.median(np.abs(offset - shift), axis=0)
        if (np.abs(shift) > np.maximum(_MAX_PART_SHIFT_PX, 2 * deviation)).any():
            raise CheckFailed(
                f"the keypoints of two equal parts of a large view differ by ({shift[0]:+.1f}, "
                f"{shift[1]:+.1f}) px"
            )
    for axis, name in enumerate("xy"):
        steps = [_rounding_step(part.keypoints[:, axis]) for part in (first, second)]
        if steps[1] > steps[0]:
            raise CheckFailed(
                f"{name} of the keypoints at the end of a large view is rounded to {steps[1]:.2g} "
                f"px, at the start to {steps[0]:.2g} px"
            )


def _rounding_step(values: Float64) -> float:
    """Return the largest step in pixels of which all differences are multiples, or 0."""
    ratios = (values - values[0])[:, None] / _ROUNDING_STEPS_PX
    is_rounded = (np.abs(ratios - ratios.round()) < _ROUNDING_TOLERANCE).all(axis=0)
    return float(np.max(_ROUNDING_STEPS_PX, where=is_rounded, initial=0.0))


def _simple_images(size: tuple[int, int]) -> list[UInt8]:
    """Return images (h, w, 3) of one Gaussian blob, and of one corner between four squares."""
    width, height = size
    y, x = np.mgrid[:height, :width] + 0.5
    blob = np.exp(-((x - width / 2) ** 2 + (y - height / 2) ** 2) / 2 / _BLOB_STD_PX**2)
    corner = (x < width / 2) == (y < height / 2)
    return [
        np.repeat((60 + 120 * part)[..., None], 3, axis=2).astype(np.uint8)
        for part in (blob, corner)
    ]


def _continue_by_reflection(view: View, size: tuple[int, int]) -> View:
    """Enlarge a view to the right and downwards by mirror images of itself."""
    width, height = size
    padding = (0, height - view.camera.height), (0, width - view.camera.width), (0, 0)
    image = np.pad(view.image, padding, mode="symmetric")
    return View(
        f"{width}x{height}/{view.name}", image, replace(view.camera, width=width, height=height)
    )


def _copies(part: tuple[int, int], size: tuple[int, int]) -> list[Int64]:
    """Return the corners of the unmirrored copies of a part in a view continued by reflection."""
    columns, rows = (range(0, s - p + 1, 2 * p) for p, s in zip(part, size, strict=True))
    return [np.array([x, y]) for y in rows for x in columns]


def _find_shift(found: Float64, expected: Float64, radius: float) -> Float64 | None:
    """Find the shift (2,) that most keypoints have in common, or None if there is none.

    Args:
        found: (n, 2) keypoints of a large view.
        expected: (m, 2) expected keypoints.
        radius: Largest distance of shifts that count as equal.
    """
    found = found[:: -(-len(found) // _NUM_VOTING) or 1]
    x, y = found.T[:, :, None] - expected.T[:, None]
    near = (np.abs(x) < _MAX_SHIFT_PX) & (np.abs(y) < _MAX_SHIFT_PX)
    offsets = np.stack([x[near], y[near]], axis=1)
    if not len(offsets):
        return None
    # Each offset votes for its cell and the eight cells around it.
    cells = np.floor((offsets + _MAX_SHIFT_PX) / radius).astype(int)
    num_cells = int(2 * _MAX_SHIFT_PX / radius) + 3
    indices = np.ravel_multi_index((cells[:, 0], cells[:, 1]), (num_cells, num_cells))
    counts = np.bincount(indices, minlength=num_cells**2).reshape(num_cells, num_cells)
    votes = _sum_of_three(_sum_of_three(counts).T).T
    best = np.unravel_index(int(votes.argmax()), votes.shape)
    chance = 9 * len(offsets) / (2 * _MAX_SHIFT_PX / radius) ** 2
    # Six standard deviations of the number of random votes, of which the largest is taken.
    significant = chance + 6 * np.sqrt(chance) + _MIN_COUNT
    least = max(_MIN_REPEATED_RATIO * min(len(found), len(expected)), 2 * chance, significant)
    if votes[best] < least:
        return None
    center = (np.array(best) - 0.5) * radius - _MAX_SHIFT_PX
    near = np.abs(offsets - center).max(axis=1) <= 1.5 * radius
    shift: Float64 = np.median(offsets[near], axis=0)
    return shift


def _sum_of_three(counts: Int64) -> Int64:
    """Add to each row the two rows before it."""
    total: Int64 = counts.copy()
    total[1:] += counts[:-1]
    total[2:] += counts[:-2]
    return total


def _pair_nearest(found: Float64, rows: Int64, expected: Float64) -> Int64:
    """Return index pairs (n, 2) of the keypoints ``found[rows]`` and of unique expected ones."""
    distance = np.linalg.norm(found[rows, None] - expected[None], axis=2)
    near = distance < 1.0
    # Keypoints with several features at one position belong to several pairs.
    i, j = np.nonzero(near & (near.sum(axis=1) == 1)[:, None] & (near.sum(axis=0) == 1))
    pairs: Int64 = np.stack([rows[i], j], axis=1)
    return pairs


def _require_same_values(features: Features, alone: Features, rows: Int64, where: str) -> None:
    """Require similar descriptors and scales of features and of ``alone[rows]``."""
    x, y = features.descriptors.astype(np.float64), alone.descriptors.astype(np.float64)
    distance = (y**2).sum(1)[None] - 2 * x @ y.T
    right = float((distance.argmin(axis=1) == rows).mean())
    if right < _MIN_CORRECT_RATIO:
        raise CheckFailed(
            f"only {right:.0%} of the descriptors {where} are most similar to those of the same "
            "pixels in a part of the view"
        )
    if features.scales is not None and alone.scales is not None:
        factor = float(np.median(features.scales / alone.scales[rows]))
        if abs(np.log(factor)) > np.log(_MAX_SCALE_RATIO):
            raise CheckFailed(f"scales {where} are {factor:.2g} times those of the same pixels")


def _correlate_scores(first: Features, second: Features) -> float:
    """Return the rank correlation of the scores of equal pixels, or 0 for equal scores."""
    if first.scores is None or second.scores is None:
        return 0.0
    if min(np.ptp(first.scores), np.ptp(second.scores)) == 0:
        return 0.0
    return float(np.corrcoef(_rank(first.scores), _rank(second.scores))[0, 1])


def _require_symmetric(case: ContractCase, features: Features, size: tuple[int, int]) -> None:
    """Require symmetric keypoints of a point-symmetric view if the detector is symmetric.

    Scaling keypoints with integer pixel centers shifts all keypoints of a reduced large view.
    """
    view = case.example.view
    if any(side % (2 * part) for side, part in zip(size, view.camera.size, strict=True)):
        return
    turned = replace(view, image=np.ascontiguousarray(view.image[::-1, ::-1]))
    small, rotated = case.run(case.example), case.run_on_view(turned, case.example)
    asymmetry = _find_shift(small.keypoints, np.array(view.camera.size) - rotated.keypoints, 1.0)
    shift = _find_shift(features.keypoints, np.array(size) - features.keypoints, 1.0)
    limit = 2 * PIXEL_TOLERANCE * max(1.0, features.std_px)
    if asymmetry is None or shift is None or np.abs(asymmetry).max() > limit:
        return
    if np.abs(shift).max() > limit:
        x, y = shift / 2
        raise CheckFailed(
            f"keypoints of a {size[0]} x {size[1]} view are shifted by ({x:+.2f}, {y:+.2f}) px"
        )


def _rank(values: Float32) -> Int64:
    """Return the rank of each value."""
    return values.argsort(kind="stable").argsort(kind="stable")


def _blank_outside(view: View, *, upper_right: bool) -> tuple[View, tuple[int, int, int, int]]:
    """Blank a view except for one corner; return the view and the corner's rectangle."""
    width, height = view.camera.size
    left, top, right, bottom = int(0.45 * width), 0, width, int(0.45 * height)
    if not upper_right:
        left, top, right, bottom = 0, height - bottom, width - left, height
    image = np.full_like(view.image, 128)
    image[top:bottom, left:right] = view.image[top:bottom, left:right]
    return replace(view, image=image), (left, top, right, bottom)


def _require_in_part(
    case: ContractCase, example: Example, view: View, part: tuple[int, int, int, int]
) -> float:
    """Require that keypoints are in a part (left, top, right, bottom) of the view."""
    features = case.run_on_view(view, example)
    _require_enough(features)
    margin = 3 * features.std_px

    def ratio(keypoints: Float64) -> float:
        inside = (keypoints >= np.array(part[:2]) - margin) & (
            keypoints <= np.array(part[2:]) + margin
        )
        return float(inside.all(axis=1).mean())

    found = ratio(features.keypoints)
    if found < _MIN_INSIDE_RATIO:
        reason = ": x and y are swapped" if ratio(features.keypoints[:, ::-1]) > found else ""
        width, height = view.camera.size
        raise CheckFailed(
            f"only {found:.0%} of the keypoints are on the textured part of a {width} x {height} "
            f"view{reason}"
        )
    return found


def require_unique(rows: Float64, name: str) -> None:
    """Require that more than half of the rows differ from each other."""
    ratio = len(np.unique(rows, axis=0)) / max(len(rows), 1)
    if len(rows) and ratio <= _MAX_FAILING_UNIQUE_RATIO:
        raise CheckFailed(f"only {ratio:.0%} of the {name} are different")


def order_probability(high: Float32, low: Float32) -> float:
    """Return the probability that a value of the first sample exceeds one of the second sample."""
    difference = high[:, None].astype(np.float64) - low[None]
    return float((difference > 0).mean() + 0.5 * (difference == 0).mean())


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
