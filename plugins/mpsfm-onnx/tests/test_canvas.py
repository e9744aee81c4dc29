"""Tests of resizing, padding and cropping, and of output positions in the view."""

from __future__ import annotations

import numpy as np
import pytest
from mpsfm_onnx.canvas import Canvas
from mpsfm_onnx.description import FixedSize, ImageInput, SideSize

from mpsfm_core import PinholeCamera
from mpsfm_core.geometry import pixel_centers, scale_pixels

RULES = [
    FixedSize(mode="fixed", width=224, height=224),
    FixedSize(mode="fixed", width=1064, height=616, fit="pad"),
    FixedSize(mode="fixed", width=97, height=131, fit="pad"),
    SideSize(mode="longest", side=518, multiple_of=14),
    SideSize(mode="shortest", side=140, multiple_of=14, fit="pad"),
    SideSize(mode="longest", side=999, multiple_of=32, enlarge=False, fit="pad"),
]
VIEWS = [(640, 480), (333, 517), (101, 20), (1, 1)]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("stride", [1, 4, 7])
def test_cut_output_covers_the_view_exactly(rule, view, stride):
    """Check that a network output of input pixel positions is cut to the positions in the view."""
    canvas = Canvas.plan(rule, view)
    cells = tuple(max(1, side // stride) for side in canvas.size)
    positions = scale_pixels(pixel_centers(*cells), cells, canvas.size)  # canvas pixels
    cut = canvas.cut(positions.astype(np.float32))
    size = cut.shape[1], cut.shape[0]
    expected = scale_pixels(pixel_centers(*size), size, canvas.image) + canvas.offset
    # Interpolation is constant in the outer half of a border pixel.
    expected = expected.clip(positions.min(axis=(0, 1)), positions.max(axis=(0, 1)))
    np.testing.assert_allclose(cut, expected, rtol=1e-5)


@pytest.mark.parametrize("rule", RULES)
def test_plan_keeps_the_aspect_ratio_when_padding(rule):
    canvas = Canvas.plan(rule, (640, 480))
    assert all(o >= 0 for o in canvas.offset)
    assert all(o + i <= s for o, i, s in zip(canvas.offset, canvas.image, canvas.size, strict=True))
    if rule.fit == "pad":
        assert canvas.image[0] / canvas.image[1] == pytest.approx(640 / 480, rel=0.01)
    if isinstance(rule, SideSize):
        assert not any(side % rule.multiple_of for side in canvas.size)
        if not rule.enlarge:
            assert canvas.image == (640, 480)


def test_painted_image_is_padded_centred_and_normalised():
    rule = ImageInput(
        scale=1 / 255,
        mean=(0.1, 0.2, 0.3),
        std=(0.5, 0.25, 2.0),
        pad_value=(51.0, 102.0, 153.0),
        size=FixedSize(mode="fixed", width=40, height=30, fit="pad"),
    )
    image = np.full((10, 20, 3), (255, 0, 127), dtype=np.uint8)
    canvas = Canvas.plan(rule.size, (20, 10))
    assert (canvas.image, canvas.offset) == ((40, 20), (0, 5))
    tensor = canvas.paint(image, rule)
    assert tensor.shape == (1, 3, 30, 40) and tensor.dtype == np.float32
    inside = [(1 - 0.1) / 0.5, (0 - 0.2) / 0.25, (127 / 255 - 0.3) / 2]
    outside = [(0.2 - 0.1) / 0.5, (0.4 - 0.2) / 0.25, (0.6 - 0.3) / 2]
    for channel in range(3):
        np.testing.assert_allclose(tensor[0, channel, 5:25], inside[channel], rtol=1e-5)
        np.testing.assert_allclose(tensor[0, channel, :5], outside[channel], rtol=1e-5)
        np.testing.assert_allclose(tensor[0, channel, 25:], outside[channel], rtol=1e-5)


def test_other_layout_and_channel_order():
    rule = ImageInput(
        layout="NHWC",
        channels="BGR",
        size=FixedSize(mode="fixed", width=3, height=2),
    )
    image = np.full((2, 3, 3), (10, 20, 30), dtype=np.uint8)
    tensor = Canvas.plan(rule.size, (3, 2)).paint(image, rule)
    assert tensor.shape == (1, 2, 3, 3)
    assert tensor[0, 0, 0].tolist() == [30, 20, 10]


@pytest.mark.parametrize("interpolation", ["area", "linear"])
def test_resizing_does_not_move_the_image(interpolation):
    """Check that an image edge at x = 80 stays at x = 80 for all ways of resizing."""
    image = np.zeros((60, 200, 3), dtype=np.uint8)
    image[:, 80:] = 200
    for width, height in ((200, 60), (100, 60), (150, 45), (310, 90)):
        size = FixedSize(mode="fixed", width=width, height=height)
        rule = ImageInput(interpolation=interpolation, size=size)
        row = Canvas.plan(size, (200, 60)).paint(image, rule)[0, 0, 3]
        dark = (1 - row / 200).sum() * 200 / width
        assert dark == pytest.approx(80, abs=0.1 if interpolation == "area" else 0.35)


@pytest.mark.parametrize("stride", [1, 4])
def test_cropped_pixels_are_nan_and_others_keep_their_position(stride):
    """Check that cropped view pixels are NaN, and that other pixels keep their position."""
    size = SideSize(mode="longest", side=100, multiple_of=16, fit="crop")
    canvas = Canvas.plan(size, (200, 150))
    assert (canvas.size, canvas.image, canvas.offset) == ((96, 64), (100, 75), (-2, -5))
    image = np.zeros((150, 200, 3), dtype=np.uint8)
    image[..., 0] = np.arange(200)
    painted = canvas.paint(image, ImageInput(size=size))
    assert painted.shape == (1, 3, 64, 96)
    np.testing.assert_allclose(painted[0, 0, 0], 2 * (np.arange(96) + 2) + 0.5, atol=0.51)
    cells = (96 // stride, 64 // stride)
    positions = scale_pixels(pixel_centers(*cells), cells, canvas.size).astype(np.float32)
    cut = canvas.cut(positions)
    rows, columns = cut.shape[:2]
    xy = scale_pixels(pixel_centers(columns, rows), (columns, rows), (200, 150))
    outside = (xy[..., 0] < 4) | (xy[..., 0] > 196) | (xy[..., 1] < 10) | (xy[..., 1] > 138)
    np.testing.assert_array_equal(np.isnan(cut[..., 0]), outside)
    expected = canvas.from_view(xy[~outside], (200, 150))
    expected = expected.clip(positions.min(axis=(0, 1)), positions.max(axis=(0, 1)))
    np.testing.assert_allclose(cut[~outside], expected, rtol=1e-5)
    np.testing.assert_allclose(canvas.to_view(canvas.from_view(xy, (200, 150)), (200, 150)), xy)


def test_camera_of_network_input_is_scaled_with_the_image():
    canvas = Canvas.plan(FixedSize(mode="fixed", width=40, height=30, fit="pad"), (20, 10))
    camera = canvas.camera(PinholeCamera(20, 10, 15.0, 16.0, 9.0, 4.0))
    assert camera == PinholeCamera(40, 30, 30.0, 32.0, 18.0, 8.0 + 5)


@pytest.mark.parametrize(("rounding", "width"), [("nearest", 819), ("down", 818)])
def test_sides_are_rounded_as_the_networks_authors_do(rounding, width):
    """Check the rounding of 818.7 columns, the width of a 517 x 389 image on 616 rows."""
    size = FixedSize(mode="fixed", width=1064, height=616, fit="pad", rounding=rounding)
    assert Canvas.plan(size, (517, 389)).image == (width, 616)


@pytest.mark.parametrize("interpolation", ["smooth-cubic", "lanczos"])
def test_stripes_of_a_pixel_average_out_where_an_image_shrinks(interpolation):
    image = np.zeros((32, 96, 3), dtype=np.uint8)
    image[:, ::3] = 240
    rule = ImageInput(
        size=FixedSize(mode="fixed", width=32, height=32), interpolation=interpolation
    )
    painted = Canvas.plan(rule.size, (96, 32)).paint(image, rule)
    np.testing.assert_allclose(painted[..., 4:-4], 80, atol=8)
