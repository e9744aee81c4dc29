"""Tests of the matchers with small ONNX networks whose warp is known."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_roma.matcher import DenseMatcher, SparseMatcher
from mpsfm_roma.options import DenseOptions, SparseOptions

from mpsfm_core import Features, PinholeCamera, View
from mpsfm_core.data.errors import ConfigError, ProviderError

ROWS, COLUMNS = 28, 42
"""Height and width in pixels of the network input and of the warp."""
SHIFT = np.array([0.2, -0.1])
"""Translation of normalized positions from view a to view b, after scaling by 0.8."""
SCALE = 0.8

CONSTANT = """
roma (float[b,3,h,w] im_A, float[b,3,h,w] im_B) => (float[b,h,w2,4] warp, float[b,h,w2] certainty) {
    warp = Identity (known_warp)
    certainty = Identity (known_certainty)
}
"""


def grid():
    x, y = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (COLUMNS, ROWS))
    return np.stack(np.meshgrid(x, y), axis=-1)


def view_of(width, height, name):
    image = np.zeros((height, width, 3), dtype=np.uint8)
    return View(name, image, PinholeCamera(width, height, 90.0, 90.0, width / 2, height / 2))


A, B = view_of(120, 80, "a.png"), view_of(60, 100, "b.png")


def b_from_a(xy):
    """Convert pixels of view a to pixels of view b by the known warp."""
    return ((xy / A.camera.size * 2 - 1) * SCALE + SHIFT + 1) / 2 * B.camera.size


@pytest.fixture
def options(write_onnx):
    """Return a function that writes a model of the known warp and returns its options."""

    def make(symmetric=True, certainty=None, **more):
        there = np.concatenate([grid(), grid() * SCALE + SHIFT], axis=-1)
        warp = there
        if symmetric:
            back = np.concatenate([(grid() - SHIFT) / SCALE, grid()], axis=-1)
            warp = np.concatenate([there, back], axis=1)
        if certainty is None:
            certainty = np.full(warp.shape[:2], 0.7)
        arrays = {"known_warp": warp[None], "known_certainty": np.asarray(certainty)[None]}
        model = write_onnx(CONSTANT, **arrays)
        return {"model": str(model), "height": ROWS, "width": COLUMNS, **more}

    return make


def features_at(keypoints):
    return Features(np.asarray(keypoints, dtype=np.float64), np.zeros((len(keypoints), 1), "f4"))


@pytest.mark.parametrize("symmetric", [False, True])
def test_dense_positions_in_pixels_of_views_of_other_sizes(options, symmetric, context):
    matcher = DenseMatcher(DenseOptions(**options(symmetric, cell=1)), context)
    found = matcher.match(A, B).dense
    np.testing.assert_allclose(found.points_b, b_from_a(found.points_a), atol=1e-4)
    # The warp positions in view a are pixel centers. Targets outside of view b yield no match.
    first = (pixel + 0.5 for pixel in (0, 0))
    np.testing.assert_allclose(found.points_a[0], np.array([*first]) * (120 / 42, 80 / 28))
    inside = (np.abs(grid() * SCALE + SHIFT) <= 1).all(axis=-1).sum()
    back = (np.abs((grid() - SHIFT) / SCALE) <= 1).all(axis=-1).sum()
    assert len(found) == inside + (back if symmetric else 0)
    np.testing.assert_allclose(found.scores, 0.7, rtol=1e-6)


def test_thinning_keeps_the_best_of_each_cell(options, context):
    certainty = np.random.default_rng(0).uniform(0, 1, (ROWS, COLUMNS))
    made = options(False, certainty, cell=5, min_certainty=0.97)
    found = DenseMatcher(DenseOptions(**made), context).match(A, B).dense
    inside = (np.abs(grid() * SCALE + SHIFT) <= 1).all(axis=-1)
    expected = []
    for top in range(0, ROWS, 5):
        for left in range(0, COLUMNS, 5):
            cell = (certainty * inside)[top : top + 5, left : left + 5]
            row, column = np.unravel_index(cell.argmax(), cell.shape)
            if cell[row, column] > 0.97:
                expected.append(((left + column + 0.5) * 120 / 42, (top + row + 0.5) * 80 / 28))
    assert 10 < len(expected) < 54
    np.testing.assert_allclose(found.points_a, expected, atol=1e-6)


@pytest.mark.parametrize("symmetric", [False, True])
def test_sparse_matches_are_keypoints_within_reach(options, symmetric, context):
    rng = np.random.default_rng(1)
    xy_a = rng.uniform((10, 10), (60, 70), (12, 2)).round(2)
    xy_b = b_from_a(xy_a)
    xy_b[:8] += rng.uniform(-0.4, 0.4, (8, 2))
    xy_b[8:] += (7.0, 0.0)  # too far
    order = rng.permutation(12)
    matcher = SparseMatcher(SparseOptions(**options(symmetric, snap_px=0.8)), context)
    found = matcher.match(A, B, features_at(xy_a), features_at(xy_b[order])).sparse
    pairs = sorted((int(i), int(order[j])) for i, j in found.indices)
    assert pairs == [(i, i) for i in range(8)]


def test_of_two_keypoints_the_nearer_one_is_matched(options, context):
    xy_a = np.array([[40.0, 40.0], [40.4, 40.0]])
    xy_b = b_from_a(xy_a[1:] + 0.01)
    matcher = SparseMatcher(SparseOptions(**options()), context)
    found = matcher.match(A, B, features_at(xy_a), features_at(xy_b)).sparse
    assert found.indices.tolist() == [[1, 0]]


def test_uncertain_keypoints_have_no_match(options, context):
    certainty = np.full((ROWS, COLUMNS), 0.04)
    matcher = SparseMatcher(SparseOptions(**options(False, certainty)), context)
    some = features_at([(40.0, 40.0)])
    there = features_at(b_from_a(some.keypoints))
    assert len(matcher.match(A, B, some, there).sparse) == 0


def test_network_input_is_normalized(write_onnx, context):
    """Check the color normalization by a model whose certainty is the first view's red channel."""
    text = """
    roma (float[b,3,h,w] one, float[b,3,h,w] two) => (float[b,h,w,4] warp, float[b,h,w] sure) {
        warp = Identity (known_warp)
        red = Gather <axis = 1> (one, first)
        scaled = Mul (red, std)
        sure = Add (scaled, mean)
    }
    """
    warp = np.concatenate([grid(), grid()], axis=-1)[None]
    model = write_onnx(text, known_warp=warp, first=np.array(0), std=[0.229], mean=[0.485])
    options = DenseOptions(
        model=str(model),
        height=ROWS,
        width=COLUMNS,
        inputs=("one", "two"),
        outputs=("warp", "sure"),
    )
    image = np.full((80, 120, 3), (153, 9, 9), dtype=np.uint8)
    view = View("a.png", image, A.camera)
    scores = DenseMatcher(options, context).match(view, B).dense.scores
    np.testing.assert_allclose(scores, 0.6, rtol=1e-5)


def test_errors_say_what_is_missing(options, write_onnx, context):
    with pytest.raises(ProviderError, match="choose a features provider"):
        SparseMatcher(SparseOptions(**options()), context).match(A, B)
    with pytest.raises(ConfigError, match=r"RoMa needs inputs \['image0', 'image1'\]"):
        DenseMatcher(DenseOptions(**options(inputs=("image0", "image1"))), context)
