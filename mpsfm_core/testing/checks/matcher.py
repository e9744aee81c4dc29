"""Contract checks of sparse and dense matchers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import (
    Bool,
    DenseMatches,
    DepthPrior,
    Features,
    Float32,
    Float64,
    Int64,
    PinholeCamera,
    View,
)
from mpsfm_core.geometry import pixel_centers
from mpsfm_core.testing import map_errors
from mpsfm_core.testing.accuracy import (
    DEPTH_TOLERANCE,
    MATCH_TOLERANCE_STD,
    MIN_MATCHES,
    match_errors_px,
    match_points,
    point_matches,
)
from mpsfm_core.testing.checks.depth import RAY_TOLERANCE
from mpsfm_core.testing.checks.features import order_probability, require_unique
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import Example, outdoor_example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped, CheckUndecided, CheckUnmeasured
from mpsfm_core.testing.std_errors import require_depth_std

NUM_MANY_FEATURES = (4096, 600)
"""Numbers of features in two views that every sparse matcher has to accept. Networks limit the
number to 1024 or 2048; the time of a transformer grows with the square of the number."""
_MANY_SIZE = (320, 240)
"""Width and height in pixels of the views with many features. Both views have the same size,
because some matchers resize all views to one size and are not invariant to scale."""
_LARGE_FACTOR = 21
"""Factor of the size of views with 12 megapixels for sparse matchers, which see features only."""
_SMALL_SIZE, _WIDE_SIZE = (256, 192), (2048, 256)
"""Widths and heights in pixels of views below and above the input size of dense matchers. The
height of the wide view limits the run time."""
_MEDIUM_SIZES = (512, 384), (288, 384)
"""Widths and heights in pixels of two views that a network with an input of 320 pixels reduces by
different factors. A network with a square input also has different borders around these views."""
_MEDIUM_SHIFT = np.array([64.0, 48.0])
"""Position in pixels of the second medium view in the first."""
_SMALL_SHIFT = np.array([64.0, 0.0])
"""Position in pixels of the small view in the wide one."""
_WIDE_SHIFT = np.array([256.0, 0.0])
"""Position in pixels of the second wide view in the first, a multiple of the cells of a network
that reduces the wide view to 32 or 40 columns."""
_MIXED_TOLERANCE_PX = 0.3
"""Largest accepted shift of matches to the same side in x and y, in pixels or multiples of
``std_px``. Integer pixel centers shift matches by 0.5 pixels if one view is reduced to half the
size, and the shift is 0.0 for correct matchers."""
_TRIMMED_RATIO = 0.1
"""Ratio of the smallest and of the largest residuals that the mean shift of matches leaves out."""
_MIN_CELL_PX = 0.5
"""Smallest distance of different coordinates from which positions count as rounded to cells."""
_SHIFT_MAD_FACTOR = 4.0
"""Ratio of the smallest significant median shift of n matches to their median absolute deviation
divided by the square root of n. The ratio is at most 3.5 for correct matchers, and at least 4.4 for
positions with integer pixel centers."""
_SHIFT_STD_FACTOR = 3.5
"""Number of standard errors by which a shift has to differ from 0. If matches are rounded to cells
of 1 to 8 pixels at random places, 1 % of the matchers that return the centers of cells fail, and
70 % of those that return corners."""
_MIN_AGREEING_RATIO = 0.3
"""Smallest ratio of matches that agree on a scale and shift, from which both are compared with the
truth."""
_NUM_LINES = 200
"""Number of lines through two random matches, of which the best is taken."""
_NUM_FOREIGN = 40
"""Number of features of another scene in ``check_matcher_feature_order``."""
_MIN_SCORE_CORRELATION = 0.3
"""Smallest accepted correlation of the scores of matches if the features are in another order. The
correlation is 0 if the scores belong to other matches."""
_DENSE_FACTOR = 5
"""Factor of the size of the large views for dense matchers."""
_MAX_STD_FACTOR = 3.0
"""Largest accepted ratio of the measured match error and ``std_px``."""
_MAX_ERROR_PX = 8.0
"""Distance in pixels above which a match counts as wrong instead of inaccurate."""
MIN_COVERING = 40
"""Minimum number of matches for which the coverage of the views is checked."""
_MIN_COVERED_CELLS = 6
_MIN_SIDE_RATIO = 0.03
"""Smallest accepted ratio of matches in the outer quarter of each side of a view. The ratio is 0.25
for evenly spread matches."""
_MIN_BEST_ORDER = 0.9
"""Smallest probability that a returned match scores higher than one of an outer quarter without
matches, if the matcher returns only its best matches. The probability is 0.5 if the matcher returns
any matches, for example the first ones."""
_MIN_USED_RATIO = 0.9
"""Smallest accepted ratio of the largest feature index in a match and the number of features."""
_MAX_SCORE_LOSS = 0.01
"""Largest accepted excess of the mean score of unreliable matches over that of reliable ones. The
score excess is 0 for meaningless scores, and negative for all tested matchers."""
_MIN_FOREIGN_ORDER = 0.25
"""Smallest accepted probability that a correct match scores higher than a match of unrelated views.
Meaningless scores give a probability of 0.5."""
_MIN_CORRECT_RATIO_OF_HARD_PAIRS = 0.3
"""Smallest accepted ratio of correct matches for views of different sizes, which a matcher resizes
by different factors, and for many features, which are repeated. The ratio of correct matches is
near 0 if matched points are in pixels of the other view."""
_MIN_CORRECT_RATIO = 0.5
"""Smallest accepted ratio of correct matches for an image pair with a small baseline. The ratio of
correct matches is 0.99 for nearest neighbors of SIFT and 0.96 for LighterGlue."""


def check_matcher_sides(case: ContractCase) -> str:
    """Require that the first column of the matches belongs to the first view."""
    case.require_truth("image", "prepared")
    return _require_correct(case, case.example, case.example.partner)


def check_matcher_order(case: ContractCase) -> str:
    """Require that swapped input views swap the columns of the matches."""
    case.require_truth("image", "prepared")
    return _require_correct(case, case.example.partner, case.example)


def check_matcher_sizes(case: ContractCase) -> str:
    """Require correct matches of two views with different sizes.

    The second view is a wide, a portrait or a larger rectangle of a neighboring view, at the same
    scale. A dense matcher may resize all views to one size and fail for some of these pairs, but
    has to match at least one pair. The matches have to cover the overlap. Each rectangle is matched
    in one order, because the other three orders take another 7 % of the run time. The check
    ``matcher-order`` swaps the views.
    """
    case.require_truth("image")
    width, height = case.example.camera.size
    neighbor = case.example.partner
    wide = neighbor.crop(0, height // 8, width, 3 * height // 4)
    portrait = neighbor.crop(width // 4, 0, height // 2 + 13, height)
    larger = neighbor.crop(-3 * width // 4, -height // 4, 2 * width, 5 * height // 4)
    texts, failures = [], []
    pairs = (case.example, wide), (portrait, case.example), (case.example, larger)
    for pair in pairs:
        try:
            texts.append(_require_correct(case, *pair, _MIN_CORRECT_RATIO_OF_HARD_PAIRS))
            _require_covered_overlap(case, *pair)
        except CheckFailed as failed:
            failures.append(str(failed))
    if failures and (len(failures) == len(pairs) or not case.declares("dense")):
        raise CheckFailed(f"views of different sizes: {failures[0]}")
    return texts[0]


def check_matcher_mixed_sizes(case: ContractCase) -> str:
    """Require dense matches in pixels of each view if a network reduces one or both views.

    Two views of 256 x 192 and 2048 x 256 pixels, or of 512 x 384 and 288 x 384 pixels, show the
    same random texture. A matcher may fail for views of such different sizes. If most of its
    matches agree on a scale and shift, the scale has to be 1, and the shift the true one. Networks
    reduce both views by different factors, so that factors of the other view, of the other axis or
    of no view are wrong.
    """
    if not case.declares("dense"):
        raise CheckSkipped("sparse matches have no positions of their own")
    case.require_truth("image")
    texts = []
    for size_a, size_b, shift in (
        (_SMALL_SIZE, _WIDE_SIZE, -_SMALL_SHIFT),
        (_WIDE_SIZE, _SMALL_SIZE, _SMALL_SHIFT),
        (_WIDE_SIZE, _WIDE_SIZE, _WIDE_SHIFT),
        (*_MEDIUM_SIZES, _MEDIUM_SHIFT),
    ):
        matches = point_matches(case.run_on_views(_noise_views(shift, size_a, size_b)), None)
        texts.append(_require_true_scale(matches, shift, f"{size_a} and {size_b} pixels"))
    found = [text for text in texts if text]
    if not found:
        raise CheckUnmeasured("the matcher finds too few consistent matches of these views")
    return f"{len(found)} of {len(texts)} pairs: {found[0]}"


def check_matcher_coverage(case: ContractCase) -> str:
    """Require matches in all parts of two views that overlap by 90 %.

    The outer quarter of each side of both views has to contain matches. Overlapping windows must
    not return most matches several times.
    """
    case.require_truth("image", "prepared")
    a, b = case.example, case.example.partner
    matches = match_points(case, a, b, case.run(a))
    if len(matches) < MIN_COVERING:
        raise CheckSkipped(f"{len(matches)} matches are too few to cover a view")
    require_unique(np.hstack([matches.points_a, matches.points_b]), "matches")
    cells = (matches.points_a / a.camera.size * 3).astype(int).clip(0, 2)
    covered = len(np.unique(cells, axis=0))
    if covered < _MIN_COVERED_CELLS:
        raise CheckFailed(f"matches cover only {covered} of 9 parts of views that overlap by 90 %")
    positions = ((matches.points_a, a), (matches.points_b, b))
    outer = np.concatenate([_measure_outer_quarters(xy, view.camera) for xy, view in positions])
    if outer.min() < _MIN_SIDE_RATIO:
        raise CheckFailed(
            f"only {outer.min():.0%} of the matches are in the outer quarter of one side of a view"
        )
    return f"matches cover {covered} of 9 parts, {outer.min():.0%} are in each outer quarter"


def check_matcher_pixel_convention(case: ContractCase) -> str:
    """Require dense matches in COLMAP's pixel convention.

    A view is matched with its copy at half the size. The coordinates in the copy have to be half as
    large, which is wrong for integer pixel centers. A matcher that is not invariant to scale is
    checked with a copy of three quarters of the size and with a copy rotated by 180 degrees.
    """
    if not case.declares("dense"):
        raise CheckSkipped(
            "sparse matches have no positions of their own, only those of the keypoints"
        )
    case.require_truth("image", "prepared")
    width, height = case.example.camera.size
    counts: list[int] = []
    text = ""
    for numerator, denominator in ((1, 2), (3, 4)):
        ratio = denominator / numerator
        small = case.example.sized(
            width * numerator // denominator, height * numerator // denominator
        )
        matches = _match_examples(case, small, case.example)
        residual = matches.points_b - ratio * matches.points_a
        # If both views use integer pixel centers, match residuals are shifted by ``expected``
        # pixels. The larger copy repeats the check with the tolerance of the smaller one, because a
        # crop of both views to the stride of a network can cancel at one of the ratios.
        expected = 0.5 if text else 0.5 * (ratio - 1)
        where = f"between a view and its copy at {numerator}/{denominator} of the size"
        text = _describe_residual(residual, matches, expected, where, counts) or text
    if text:
        _require_no_shift_of_odd_sizes(case)
        return text
    if case.setup.prepare is None:
        matches = _match_rotated(case)
        residual = case.example.camera.size - matches.points_b - matches.points_a
        text = _describe_residual(
            residual,
            matches,
            1.0,
            "between a view and its copy rotated by 180 degrees",
            counts,
        )
        if text:
            return text
    raise CheckUnmeasured(
        f"the matcher is not invariant to scale: only {max(counts)} correct matches between a view "
        "and its scaled or rotated copies"
    )


def check_matcher_no_features(case: ContractCase) -> None:
    """Require that a matcher returns no matches if a view has no features."""
    if not case.declares("sparse"):
        raise CheckSkipped("the matcher needs no features")
    a, b = case.example, case.example.partner
    some = case.extract_features(a.view, b.view)
    none = _take_first(some[0], 0), _take_first(some[1], 0)
    for given in ((some[0], none[1]), (none[0], some[1]), none):
        found = case.run_on_views((a.view, b.view), given)
        if found.sparse is not None and len(found.sparse):
            raise CheckFailed(
                f"the matcher returns {len(found.sparse)} matches for a view without features"
            )


def check_matcher_few_features(case: ContractCase) -> None:
    """Require valid output for views with one or two features."""
    if not case.declares("sparse"):
        raise CheckSkipped("the matcher needs no features")
    a, b = case.example, case.example.partner
    some = case.extract_features(a.view, b.view)
    for count_a, count_b in ((1, 1), (2, 1), (1, len(some[1]))):
        given = _take_first(some[0], count_a), _take_first(some[1], count_b)
        case.run_on_views((a.view, b.view), given)


def check_matcher_many_features(case: ContractCase) -> str:
    """Require correct matches of 4096 and 600 features in views of 320 x 240 pixels.

    Real images have about 4096 features each. A fixed buffer or a size limit of the matching
    network must not end a run, and must not leave the last features without matches.
    """
    if not case.declares("sparse"):
        raise CheckSkipped("the matcher needs no features")
    shift = np.array([31.0, 17.0])
    views = _noise_views(shift, _MANY_SIZE, _MANY_SIZE)
    is_known = case.truth_source == "image"
    small_views = case.example.view, case.example.partner.view
    found = case.extract_features(
        *(views if is_known else small_views), max_count=NUM_MANY_FEATURES[0]
    )
    given = [_pad(*padded) for padded in zip(found, NUM_MANY_FEATURES, views, strict=True)]
    if not (len(given[0]) and len(given[1])):
        raise CheckSkipped("the detector finds no features to repeat")
    features = given[0], given[1]
    answer = case.run_on_views(views, features)
    rows = np.empty((0, 2), np.int64) if answer.sparse is None else answer.sparse.indices
    text = f"{len(rows)} matches of {len(given[0])} and {len(given[1])} features"
    if is_known:
        _require_many_correct(rows, features, shift)
    return text


def check_matcher_feature_order(case: ContractCase) -> str:
    """Require the same matches if the features are in another order and others are added.

    Features have no order. The second view gets further features from another scene, which have no
    match. Matches of features at the same position may differ, and wrong matches with low scores.
    Wrong matches with high scores must not become more. The scores of equal matches have to
    correlate.
    """
    if not case.declares("sparse"):
        raise CheckSkipped("the matcher needs no features")
    views = case.example.view, case.example.partner.view
    given = case.extract_features(*views)
    foreign = case.extract_features(outdoor_example("textured").view)[0]
    foreign = foreign.select(np.arange(min(_NUM_FOREIGN, len(foreign))))
    rng = np.random.default_rng(0)
    shuffled = [rng.permutation(len(features)) for features in given]
    pairs, scores, foreign_xy = [], [], np.empty((0, 2))
    for rows in ([np.arange(len(features)) for features in given], shuffled):
        first, second = (entry.select(row) for entry, row in zip(given, rows, strict=True))
        if rows is shuffled:
            second = _append(second, foreign)
            foreign_xy = second.keypoints[len(given[1]) :][::-1]
        answer = case.run_on_views(views, (first, second)).sparse
        assert answer is not None
        originals = rows[0], np.concatenate([rows[1], -1 - np.arange(len(foreign))])
        matched = np.stack([r[answer.indices[:, i]] for i, r in enumerate(originals)], axis=1)
        pairs.append(set(map(tuple, matched.tolist())))
        scores.append(dict(zip(map(tuple, matched.tolist()), answer.scores.tolist(), strict=True)))
    if case.truth_source == "image":
        _require_enough(len(pairs[0]))
    common = sorted(pairs[0] & pairs[1])
    values = [np.array([s[pair] for pair in common]) for s in scores]
    if len(common) >= MIN_COVERING and min(map(np.ptp, values)) > 1e-3:
        correlation = float(np.corrcoef(values[0], values[1])[0, 1])
        if correlation < _MIN_SCORE_CORRELATION:
            raise CheckFailed(
                "the scores of the same matches have a correlation of "
                f"{correlation:.2f} if the features are in another order"
            )
    changed = sorted(pairs[0] ^ pairs[1])
    text = f"{len(changed)} of {len(pairs[0])} matches differ if features are in another order"
    if changed and case.truth_source == "image":
        # Features at equal positions can replace each other in a match.
        rows, columns = np.array(changed).T
        xy = given[0].keypoints[rows], np.concatenate([given[1].keypoints, foreign_xy])[columns]
        found = DenseMatches(*xy, np.ones(len(changed), np.float32))
        errors = match_errors_px(case.example, case.example.partner, found)
        middle = float(np.median(list(scores[0].values())))
        sure = np.array([max(s.get(pair, 0.0) for s in scores) > middle for pair in changed])
        wrong = (errors > _MAX_ERROR_PX) & sure
        is_new = np.array([pair in pairs[1] for pair in changed])
        num_new, num_old = int((wrong & is_new).sum()), int((wrong & ~is_new).sum())
        if num_new > num_old:
            counts = f"{num_new} new ones and {num_old} of the others"
            raise CheckFailed(f"{text}, {counts} are wrong and have high scores")
    return text


def check_matcher_large_view(case: ContractCase) -> str:
    """Require correct matches of two large views.

    A sparse matcher receives the features of small views with keypoints and scales of views of 4032
    x 3024 pixels. A dense matcher receives two views of 960 x 720 pixels. The outer quarter of each
    side has to contain matches. A dense matcher may return only its best matches, if those in an
    outer quarter have lower scores.
    """
    case.require_truth("image")
    import cv2  # The import is local, because pytest loads this module when it collects tests.

    is_sparse = case.declares("sparse")
    factor = _LARGE_FACTOR if is_sparse else _DENSE_FACTOR
    examples = case.example, case.example.partner
    size = case.example.camera.width * factor, case.example.camera.height * factor
    a, b = (example.sized(*size) for example in examples)
    views = [
        View(large.name, cv2.resize(small.view.image, size), large.camera)
        for large, small in zip((a, b), examples, strict=True)
    ]
    features = None
    if is_sparse:
        small_views = (example.view for example in examples)
        given = case.extract_features(*small_views, max_count=NUM_MANY_FEATURES[0])
        features = _enlarge(given[0], factor), _enlarge(given[1], factor)
    # The provider is given, because comparing large views with those of other calls takes long.
    matches = point_matches(case.run_on_views(views, features, case.provider), features)
    _require_enough(len(matches))
    limit = factor * MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    right = match_errors_px(a, b, matches) < limit
    text = (
        f"{right.mean():.0%} of {len(matches)} matches of {size[0]} x {size[1]} views are correct"
    )
    if right.mean() < _MIN_CORRECT_RATIO_OF_HARD_PAIRS:
        raise CheckFailed(text)
    outer = _measure_outer_quarters(matches.points_a[right], a.camera)
    if right.sum() >= MIN_COVERING and outer.min() < _MIN_SIDE_RATIO:
        side = int(outer.argmin())
        if is_sparse or not _has_only_worse_matches(case, (a, b), views, matches, limit, side):
            raise CheckFailed(
                f"only {outer.min():.0%} of {text} and in the outer quarter of one side"
            )
    return text


def check_matcher_std(case: ContractCase) -> str:
    """Require a ``std_px`` of dense matches that is not far below their measured error.

    A ``std_px`` that is measured in pixels of a reduced image or of a feature map is too small.
    """
    if not case.declares("dense"):
        raise CheckSkipped("sparse matches have no positions of their own")
    case.require_truth("image", "prepared")
    a, b = case.example, case.example.partner
    matches = match_points(case, a, b, case.run(a))
    true = a.correspondences(b, matches.points_a)
    error = (matches.points_b - true.xy_b)[true.visible]
    error = error[np.abs(error).max(axis=1) < _MAX_ERROR_PX * max(1.0, matches.std_px)]
    if len(error) < 2 * MIN_MATCHES:
        raise CheckUndecided(f"only {len(error)} matches are correct, too few to measure std_px")
    # The median absolute deviation of a normal distribution is 0.67 of its std.
    factor = float(np.median(np.abs(error)) / 0.6745) / matches.std_px
    if factor > _MAX_STD_FACTOR:
        raise CheckFailed(f"matches are off by {factor:.2g} times the declared std_px")
    return f"errors are {factor:.2g} times std_px"


def check_matcher_scores(case: ContractCase) -> str:
    """Require higher scores of reliable matches than of unreliable ones.

    One half of the second view has strong noise. Matches in the noisy half and wrong matches must
    not have higher scores than the other matches. Matches with a view without texture or with
    another scene must not have higher scores than correct matches. Equal scores of all matches are
    allowed.
    """
    case.require_truth("image")
    a, b = case.example, case.example.partner
    samples = []
    for amplitude in (20, 40, 70):
        matches = _match_with_noise(case, a, b, amplitude)
        _require_enough(len(matches))
        if len(matches) and np.ptp(matches.scores) < 1e-3:
            text = f"all matches have the score {matches.scores[0]:.2f}"
            if not matches.scores.any():
                raise CheckFailed(f"{text}, which gives them no weight")
            return text
        errors = match_errors_px(a, b, matches)
        right = errors < MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
        noisy = matches.points_b[:, 0] < b.camera.width // 2
        clean, bad = right & ~noisy, ~right | noisy
        if min(clean.sum(), bad.sum()) >= MIN_MATCHES:
            samples.append((matches.scores[clean], matches.scores[bad]))
    if not samples:
        raise CheckUndecided("too few matches of reliable and unreliable points to compare scores")
    order = [order_probability(*pair) for pair in samples]
    better = float(np.mean(order))
    means = [float(np.mean([part[i].mean() for part in samples])) for i in (0, 1)]
    text = (
        f"reliable matches score {means[0]:.2f}, unreliable matches {means[1]:.2f}, and are "
        f"ranked higher in {better:.0%} of all comparisons"
    )
    if means[0] < means[1] - _MAX_SCORE_LOSS and better < 0.5:
        raise CheckFailed(text)
    _require_low_scores_of_unrelated(case, samples[0][0])
    return text


def check_matcher_pair_depth(case: ContractCase) -> str:
    """Require z-depth of the first view in ``depth_a`` and of the second in ``depth_b``.

    In further pairs, the first or the second view has twice the size of the other view. A variance
    has to be the square of the std that the test network reports.
    """
    if not case.declares("pair-depth"):
        raise CheckSkipped("the matcher does not declare 'pair-depth'")
    case.require_truth("painted", "prepared")
    a, b = case.example, case.example.partner
    width, height = a.camera.size
    larger = b.sized(2 * width, 2 * height)
    errors = [_require_own_depth(case, *pair) for pair in ((a, b), (a, larger), (larger, a))]
    return f"relative error {max(errors):.2g}"


CHECKS = (
    check_matcher_sides,
    check_matcher_order,
    check_matcher_sizes,
    check_matcher_mixed_sizes,
    check_matcher_coverage,
    check_matcher_pixel_convention,
    check_matcher_no_features,
    check_matcher_few_features,
    check_matcher_many_features,
    check_matcher_feature_order,
    check_matcher_large_view,
    check_matcher_std,
    check_matcher_scores,
    check_matcher_pair_depth,
)


def _require_correct(
    case: ContractCase, a: Example, b: Example, min_ratio: float = _MIN_CORRECT_RATIO
) -> str:
    """Require that most matches of two synthetic views are the same surface points."""
    matches = match_points(case, a, b, case.run_on_examples(a, b))
    _require_enough(len(matches))
    limit = MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    right = float((match_errors_px(a, b, matches) < limit).mean())
    if right < min_ratio:
        exchanged = replace(matches, points_a=matches.points_b, points_b=matches.points_a)
        swapped = float((match_errors_px(a, b, exchanged) < limit).mean())
        reason = ": the two sides are exchanged" if swapped > 2 * right else ""
        raise CheckFailed(f"only {right:.0%} of {len(matches)} matches are correct{reason}")
    return f"{right:.0%} of {len(matches)} matches are correct"


def _require_covered_overlap(case: ContractCase, a: Example, b: Example) -> None:
    """Require correct matches in all parts of the first view that the second view shows."""
    matches = match_points(case, a, b, case.run_on_examples(a, b))
    limit = MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    points = matches.points_a[match_errors_px(a, b, matches) < limit]
    x, y = (np.linspace(0, side, 16) + 0.5 for side in a.camera.size)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shown = grid[a.correspondences(b, grid).visible]
    if len(points) < 2 * MIN_MATCHES or not len(shown):
        return
    low, size = shown.min(axis=0), np.ptp(shown, axis=0)
    outer = _outer_quarters((points - low) / size)
    if not case.declares("dense"):
        (features,) = case.extract_features(b.view)
        given = b.correspondences(a, features.keypoints)
        # A quarter with hardly any features of the second view cannot contain matches.
        is_covered = _outer_quarters((given.xy_b[given.visible] - low) / size) > 2 * _MIN_SIDE_RATIO
        outer = np.where(is_covered, outer, 1.0)
    if outer.min() < _MIN_SIDE_RATIO:
        raise CheckFailed(
            f"only {outer.min():.0%} of the correct matches are in one outer quarter of the overlap"
        )


def _has_only_worse_matches(
    case: ContractCase,
    examples: tuple[Example, Example],
    views: Sequence[View],
    matches: DenseMatches,
    limit: float,
    side: int,
) -> bool:
    """Return whether a matcher leaves out matches of an outer quarter because of their scores.

    The other three quarters of the first view become gray, so that the matcher returns the matches
    of the outer quarter.

    Args:
        case: Matcher under test.
        examples: Synthetic views with the true correspondences.
        views: Views of the matches.
        matches: Returned matches of the views.
        limit: Largest error of a correct match in pixels.
        side: Number of the outer quarter, see :func:`_outer_quarters`.
    """
    first, second = views
    position = pixel_centers(*first.camera.size) / first.camera.size
    is_outer = _is_in_outer_quarters(position)[side]
    gray = first.image.mean(axis=(0, 1)).astype(np.uint8)
    image = np.where(is_outer[..., None], first.image, gray)
    masked = replace(first, name="outer-quarter.png", image=image)
    found = point_matches(case.run_on_views((masked, second), None, case.provider), None)
    right = match_errors_px(*examples, found) < limit
    right &= _is_in_outer_quarters(found.points_a / first.camera.size)[side]
    if right.sum() < MIN_MATCHES:
        return False
    return order_probability(matches.scores, found.scores[right]) > _MIN_BEST_ORDER


def _require_enough(count: int) -> None:
    """Require that the matcher finds matches between views that overlap."""
    if count < MIN_MATCHES:
        raise CheckFailed(
            f"the matcher finds only {count} matches between views that overlap by 90 %"
        )


def _measure_outer_quarters(xy: Float64, camera: PinholeCamera) -> Float64:
    """Return the ratios of points in the outer quarters of a view: left, top, right, bottom."""
    return _outer_quarters(xy / camera.size)


def _outer_quarters(position: Float64) -> Float64:
    """Return the ratios (4,) of positions (n, 2) in the outer quarters of the unit square."""
    ratios: Float64 = _is_in_outer_quarters(position).mean(axis=1)
    return ratios


def _is_in_outer_quarters(position: Float64) -> Bool:
    """Return which positions (..., 2) are in each outer quarter of the unit square, (4, ...)."""
    return np.concatenate([np.moveaxis(p, -1, 0) for p in (position < 0.25, position > 0.75)])


def _require_own_depth(case: ContractCase, a: Example, b: Example) -> float:
    """Require the z-depth of the view in the depth prior of each view of a pair."""
    depth = case.run_on_examples(a, b).depth
    error = max(_depth_error(depth.depth_a, a), _depth_error(depth.depth_b, b))
    if max(_depth_error(depth.depth_a, b), _depth_error(depth.depth_b, a)) < 0.5 * error:
        raise CheckFailed("depth_a and depth_b are swapped")
    for prior, example in ((depth.depth_a, a), (depth.depth_b, b)):
        power = map_errors.estimate_ray_exponent(prior, example)
        if abs(power) > RAY_TOLERANCE:
            raise CheckFailed(f"depth is proportional to z * (ray length / z) ** {power:.2f}")
    if error > DEPTH_TOLERANCE:
        raise CheckFailed(f"the depth of the image pair has a relative error of {error:.2g}")
    for prior, example in ((depth.depth_a, a), (depth.depth_b, b)):
        require_depth_std(prior, example)
    return error


def _depth_error(prior: DepthPrior, example: Example) -> float:
    """Return the 80 % quantile of relative depth errors, up to a factor if depth is not metric."""
    return map_errors.error_quantile(
        map_errors.log_errors(prior, example, any_scale=not prior.metric)
    )


def _enlarge(features: Features, factor: int) -> Features:
    """Return features with the keypoints and scales of a view of ``factor`` times the size."""
    scales = None if features.scales is None else np.float32(factor) * features.scales
    return replace(features, keypoints=factor * features.keypoints, scales=scales)


def _append(features: Features, others: Features) -> Features:
    """Return features, followed by other features at the same positions."""

    def join(a: Float32 | None, b: Float32 | None) -> Float32 | None:
        return None if a is None or b is None else np.concatenate([a, b])

    return Features(
        np.concatenate([features.keypoints, np.resize(features.keypoints, (len(others), 2))]),
        np.concatenate([features.descriptors, others.descriptors]),
        join(features.scores, others.scores),
        join(features.scales, others.scales),
        features.std_px,
    )


def _take_first(features: Features, count: int) -> Features:
    """Return the first ``count`` features of a view."""
    return features.select(np.arange(min(count, len(features))))


def _require_no_shift_of_odd_sizes(case: ContractCase) -> None:
    """Require unshifted matches between a view of 211 x 149 pixels and a smaller copy.

    The same applies to views in portrait format, which a matcher may rotate.
    """
    for small, large in (((158, 111), (211, 149)), ((111, 158), (149, 211))):
        a, b = case.example.sized(*small), case.example.sized(*large)
        matches = _match_examples(case, a, b)
        true = a.correspondences(b, matches.points_a)
        residual = (matches.points_b - true.xy_b)[true.visible]
        where = "between views of {} x {} and of {} x {} pixels".format(*small, *large)
        _describe_residual(residual, matches, 0.5, where, [])


def _describe_residual(
    residual: Float64, matches: DenseMatches, expected: float, where: str, counts: list[int]
) -> str:
    """Require a small median of match residuals (n, 2) in pixels, unless there are few matches."""
    std_px = matches.std_px
    radius = 4 * max(1.0, std_px)
    near = np.abs(residual).max(axis=1) < radius
    # A wrong crop or padding shifts all matches by the same amount, which may exceed the radius.
    equal = (
        np.abs(residual - np.median(residual, axis=0)).max(axis=1) < radius if len(near) else near
    )
    near = equal if equal.sum() > max(MIN_MATCHES, len(near) / 2) else near
    counts.append(int(near.sum()))
    if near.sum() < MIN_MATCHES:
        return ""
    shift, noise = _estimate_shift(residual[near], _is_rounded(matches))
    limit = max(0.4 * expected * max(1.0, std_px), noise.max())
    text = f"shifted by ({shift[0]:+.2f}, {shift[1]:+.2f}) px"
    if np.abs(shift).max() > limit:
        raise CheckFailed(f"matches {where} are {text}")
    return text


def _estimate_shift(residual: Float64, is_rounded: bool) -> tuple[Float64, Float64]:
    """Estimate the common shift of matches from their residuals (n, 2).

    The median of positions that a matcher rounds to cells is one of few values, even if the
    rounding is unbiased. The trimmed mean lies between these values.

    Args:
        residual: Residuals in pixels.
        is_rounded: True to use the trimmed mean, False to use the median.

    Returns:
        Shift in x and y, and the noise above which it differs from 0. The noise of the trimmed mean
        is a multiple of its standard error (Tukey & McLaughlin 1963).
    """
    if not is_rounded:
        middle = np.median(residual, axis=0)
        deviation = np.median(np.abs(residual - middle), axis=0)
        return middle, _SHIFT_MAD_FACTOR * deviation / np.sqrt(len(residual))
    ordered = np.sort(residual, axis=0)
    num_trimmed = int(_TRIMMED_RATIO * len(ordered))
    inner = ordered[num_trimmed : len(ordered) - num_trimmed]
    winsorized = ordered.clip(inner[0], inner[-1])
    error = winsorized.std(axis=0) * np.sqrt(len(ordered)) / len(inner)
    return inner.mean(axis=0), _SHIFT_STD_FACTOR * error


def _is_rounded(matches: DenseMatches) -> bool:
    """Return whether the x or y coordinates of one view are at least half a pixel apart."""
    for column in np.hstack([matches.points_a, matches.points_b]).T:
        steps = np.diff(np.unique(column.round(3)))
        if len(steps) and steps.min() >= _MIN_CELL_PX:
            return True
    return False


def _match_examples(case: ContractCase, a: Example, b: Example) -> DenseMatches:
    """Match two synthetic views, and leave out repeated matches, which are no measurements."""
    matches = match_points(case, a, b, case.run_on_examples(a, b))
    points = np.hstack([matches.points_a, matches.points_b])
    rows = np.unique(points, axis=0, return_index=True)[1]
    return DenseMatches(
        matches.points_a[rows], matches.points_b[rows], matches.scores[rows], matches.std_px
    )


def _match_rotated(case: ContractCase) -> DenseMatches:
    """Match the example view with a copy that is rotated by 180 degrees."""
    view = case.example.view
    rotated = replace(view, name="rotated.png", image=np.ascontiguousarray(view.image[::-1, ::-1]))
    return point_matches(case.run_on_views((view, rotated)), None)


def _require_low_scores_of_unrelated(case: ContractCase, correct: Float32) -> None:
    """Require that matches with unrelated views do not score higher than correct matches."""
    view = case.example.view
    flat = View("flat.png", np.full_like(view.image, 128), view.camera)
    foreign = outdoor_example("textured").view
    for what, other in (("without texture", flat), ("of another scene", foreign)):
        features = case.extract_features(view, other, max_count=NUM_MANY_FEATURES[0])
        answer = case.run_on_views((view, other), features)
        scores = point_matches(answer, features).scores
        if len(scores) >= MIN_MATCHES and order_probability(correct, scores) < _MIN_FOREIGN_ORDER:
            raise CheckFailed(
                f"{len(scores)} matches with a view {what} score {scores.mean():.2f}, correct "
                f"matches {correct.mean():.2f}"
            )


def _match_with_noise(case: ContractCase, a: Example, b: Example, amplitude: int) -> DenseMatches:
    """Match two views, the second of which has noise in its left half."""
    noise = np.random.default_rng(0).normal(0, amplitude, b.view.image.shape)
    noise[:, b.camera.width // 2 :] = 0
    image = np.clip(b.view.image + noise, 0, 255).astype(np.uint8)
    views = a.view, replace(b.view, name=f"noise-{amplitude}.png", image=image)
    features = case.extract_features(*views, max_count=NUM_MANY_FEATURES[0])
    answer = case.run_on_views(views, features)
    return point_matches(answer, features)


def _noise_views(
    shift: Float64, size_a: tuple[int, int], size_b: tuple[int, int]
) -> tuple[View, View]:
    """Return two views of one random texture.

    Args:
        shift: Position (x, y) of the second view in the first, in pixels.
        size_a: Width and height of the first view.
        size_b: Width and height of the second view.
    """
    import cv2  # The import is local, because pytest loads this module when it collects tests.

    corners = [np.maximum(sign * shift, 0).astype(int) for sign in (-1, 1)]
    ends = [corner + size for corner, size in zip(corners, (size_a, size_b), strict=True)]
    width, height = np.max(ends, axis=0).tolist()
    noise = np.random.default_rng(0).normal(size=(height, width, 3))
    fine, coarse = (cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (1.5, 5.0))
    image = np.clip(128 + 90 * (fine + coarse), 0, 255).astype(np.uint8)
    views = []
    for name, (left, top), (right, bottom) in zip("ab", corners, ends, strict=True):
        part = np.ascontiguousarray(image[top:bottom, left:right])
        camera = PinholeCamera(part.shape[1], part.shape[0], 1000.0, 900.0, 560.0, 470.0)
        views.append(View(f"noise/{name}.png", part, camera))
    return views[0], views[1]


def _require_true_scale(matches: DenseMatches, shift: Float64, where: str) -> str:
    """Require that matches between two views of equal scale have the true shift.

    Returns:
        Text with the ratio of correct matches, or "" if too few matches agree on a scale and shift.
    """
    if len(matches) < 2 * MIN_MATCHES:
        return ""
    limit = MATCH_TOLERANCE_STD * max(1.0, matches.std_px)
    axes = zip(matches.points_a.T, matches.points_b.T, strict=True)
    fits = [_fit_line(a, b, limit) for a, b in axes]
    agree = np.logical_and(*(fit.inliers for fit in fits))
    if agree.sum() < max(2 * MIN_MATCHES, _MIN_AGREEING_RATIO * len(matches)):
        return ""
    points = matches.points_a[agree]
    scales, offsets = np.array([(fit.scale, fit.offset) for fit in fits]).T
    error = scales * points + offsets - (points - shift)
    if np.quantile(np.abs(error), 0.9) > limit:
        raise CheckFailed(
            f"most matches of views of {where} have a scale of {scales[0]:.2g} and "
            f"{scales[1]:.2g} in x and y, up to "
            f"{np.abs(error).max():.0f} px off"
        )
    residual = (matches.points_b - matches.points_a + shift)[agree]
    middle, noise = _estimate_shift(residual, _is_rounded(matches))
    # Integer pixel centers shift matches by the same amount in x and y.
    smallest = max(middle.min(), -middle.max())
    if smallest > max(_MIXED_TOLERANCE_PX * max(1.0, matches.std_px), noise.max()):
        raise CheckFailed(
            f"matches of views of {where} are shifted by ({middle[0]:+.2f}, {middle[1]:+.2f}) px"
        )
    return f"{agree.mean():.0%} of {len(matches)} matches are correct"


class _Line(NamedTuple):
    """Line ``scale * a + offset`` through most points (a, b)."""

    scale: float
    offset: float
    inliers: Bool


def _fit_line(a: Float64, b: Float64, limit: float) -> _Line:
    """Fit a line to coordinates (n,) of matches, most of which are correct, by RANSAC."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(a), size=(2, _NUM_LINES))
    is_apart = np.abs(a[first] - a[second]) > 0.1 * np.ptp(a)
    first, second = first[is_apart], second[is_apart]
    scales = (b[first] - b[second]) / (a[first] - a[second])
    offsets = b[first] - scales * a[first]
    distance = np.abs(scales[:, None] * a + offsets[:, None] - b)
    inliers = distance[(distance < limit).sum(axis=1).argmax()] < limit
    scale, offset = np.polyfit(a[inliers], b[inliers], 1)
    return _Line(float(scale), float(offset), inliers)


def _require_many_correct(rows: Int64, features: tuple[Features, Features], shift: Float64) -> None:
    """Require that matches of two translated views are correct and use all features."""
    _require_enough(len(rows))
    a, b = (f.keypoints[rows[:, column]] for column, f in enumerate(features))
    limit = MATCH_TOLERANCE_STD * max(1.0, *(f.std_px for f in features))
    right = float((np.linalg.norm(a - shift - b, axis=1) < limit).mean())
    if right < _MIN_CORRECT_RATIO_OF_HARD_PAIRS:
        raise CheckFailed(f"only {right:.0%} of {len(rows)} matches of many features are correct")
    for column, name in enumerate(("first", "second")):
        used = float((rows[:, column].max() + 1) / len(features[column]))
        if len(rows) >= MIN_COVERING and used < _MIN_USED_RATIO:
            raise CheckFailed(f"the matches use only the first {used:.0%} of the {name} features")


def _pad(features: Features, count: int, view: View) -> Features:
    """Repeat features with small random changes, or drop features, to get ``count`` features."""
    if not len(features):
        return features
    rng = np.random.default_rng(0)
    extra = np.arange(max(count - len(features), 0)) % len(features)
    # The features are in random order, so that matches of any rows are equally likely.
    rows = rng.permutation(np.concatenate([np.arange(len(features)), extra]))[:count]
    keypoints = features.keypoints[rows] + rng.uniform(-0.5, 0.5, (len(rows), 2))
    descriptors = features.descriptors[rows]
    noise = 0.01 * descriptors.std() * rng.normal(size=descriptors.shape)
    # A matcher may select features by their scores, which SIFT does not return.
    scores = rng.random(len(rows), np.float32)
    return Features(
        np.clip(keypoints, 0, view.camera.size),
        (descriptors + noise).astype(np.float32),
        scores if features.scores is None else features.scores[rows],
        None if features.scales is None else features.scales[rows],
        features.std_px,
    )
