"""Tests of both sky masks on synthetic images, and of the network on a real image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from mpsfm_sky.network import SkyNetwork
from mpsfm_sky.options import SimpleSkyOptions, SkyOptions
from mpsfm_sky.simple import SimpleSky

from mpsfm_core import PinholeCamera, View
from mpsfm_core.data.errors import ConfigError

BLUE = (
    "sky (float[1,3,h,w] image) => (float[1,1,h,w] d0) "
    "{ blue = Gather <axis = 1> (image, two) a = Mul (blue, std) d0 = Add (a, mean) }"
)
"""Network whose sky probability is the blue channel of the image."""
NORMALISED = {"skyseg": (0.225, 0.406), "skysegsmall": (1.0, 0.0)}


def view_of(image):
    height, width = image.shape[:2]
    return View("a.png", image, PinholeCamera(width, height, 90.0, 90.0, width / 2, height / 2))


@pytest.fixture
def landscape():
    """Create an image with a blue gradient above a textured skyline, and its sky mask."""
    rng = np.random.default_rng(0)
    height, width = 240, 360
    skyline = (110 + 40 * np.sin(np.arange(width) / 30)).astype(int)
    sky = np.arange(height)[:, None] < skyline
    image = rng.integers(30, 120, (height, width, 3))
    image[..., 2] //= 2
    shade = np.linspace(0, 60, height)[:, None, None] + [90, 150, 180]
    image = np.where(sky[..., None], shade, image).astype(np.uint8)
    image[190:230, 100:140] = (60, 90, 200)
    cv2.ellipse(image, (250, 40), (40, 15), 0, 0, 360, (235, 238, 240), -1)
    return cv2.GaussianBlur(image, (3, 3), 0), sky


class TestNetwork:
    @pytest.mark.parametrize("network", NORMALISED)
    def test_pixels_up_to_the_threshold_are_kept(self, network, write_onnx, context):
        std, mean = NORMALISED[network]
        model = write_onnx(BLUE, two=np.array([2]), std=np.float32(std), mean=np.float32(mean))
        image = np.zeros((60, 100, 3), dtype=np.uint8)
        image[:25, :, 2] = 200
        image[25:, :, 2] = 60
        for threshold, rows in ((0.5, 25), (0.2, 60), (0.9, 0)):
            options = SkyOptions(model=str(model), network=network, threshold=threshold)
            mask = SkyNetwork(options, context).mask(view_of(image))
            assert mask.dtype == np.bool_
            np.testing.assert_array_equal(mask, np.arange(60)[:, None] >= np.full(100, rows))

    def test_model_with_other_tensors_raises(self, write_onnx, context):
        text = "two (float[1] a, float[1] b) => (float[1] c) { c = Add (a, b) }"
        with pytest.raises(ConfigError, match="a sky network needs inputs"):
            SkyNetwork(SkyOptions(model=str(write_onnx(text))), context)

    def test_mask_of_real_photo_covers_the_sky(self, shared_data, context):
        """Check an image of the fountain scene with sky at the upper right (0.8 % of pixels)."""
        model = shared_data / "models" / "skysegsmall_384.onnx"
        provider = SkyNetwork(SkyOptions(model=str(model), network="skysegsmall"), context)
        path = shared_data / "data" / "fountain" / "images" / "0010.jpg"
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        sky = ~provider.mask(view_of(image))
        height, width = sky.shape
        assert 0.004 < sky.mean() < 0.012
        assert sky[2, int(0.95 * width)] and not sky[height // 3 :].any()
        assert not sky[:, : width // 2].any()


class TestSimple:
    def test_finds_the_skyline(self, landscape, context):
        image, sky = landscape
        before = image.copy()
        found = ~SimpleSky(SimpleSkyOptions(), context).mask(view_of(image))
        assert (found & sky).sum() / (found | sky).sum() > 0.93
        assert not found[190:230, 100:140].any()  # sky seen through a door is not masked
        np.testing.assert_array_equal(image, before)

    @pytest.mark.parametrize("size", [(1, 1), (3, 200), (200, 3), (1000, 700)])
    def test_mask_has_the_size_of_any_view(self, size, context):
        image = np.full((size[1], size[0], 3), 20, dtype=np.uint8)
        mask = SimpleSky(SimpleSkyOptions(), context).mask(view_of(image))
        assert mask.shape == (size[1], size[0]) and mask.all()

    def test_no_sky_upside_down_or_at_dusk(self, landscape, context):
        image, _ = landscape
        provider = SimpleSky(SimpleSkyOptions(), context)
        assert provider.mask(view_of(np.ascontiguousarray(image[::-1]))).all()
        assert provider.mask(view_of((image[..., ::-1] // 3).copy())).all()
