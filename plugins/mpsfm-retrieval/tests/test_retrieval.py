"""Tests of global descriptors against independent computations and on a real scene."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from mpsfm_retrieval.appearance import Appearance
from mpsfm_retrieval.network import GlobalNetwork
from mpsfm_retrieval.options import AppearanceOptions, NetworkOptions

from mpsfm_core import PinholeCamera, View
from mpsfm_core.extraction.options import PairOptions
from mpsfm_core.extraction.pairs.pairing import retrieval_pairs
from mpsfm_core.providers.builtin.options import SiftOptions
from mpsfm_core.providers.builtin.sift import Sift

FORMS = {
    "vector": ("float[b,d] out", "out = Flatten (mean)"),
    "tokens": (
        "float[b,t,d] out",
        "one = Reshape (mean, row) two = Sub (one, one) out = Concat <axis = 1> (one, two)",
    ),
    "map": ("float[b,d,h,w] out", "two = Sub (mean, mean) out = Concat <axis = 3> (mean, two)"),
}


def view_of(image, mask=None):
    height, width = image.shape[:2]
    return View(
        "a.png", image, PinholeCamera(width, height, 90.0, 90.0, width / 2, height / 2), mask
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("network", ["dinov2", "eigenplaces", "netvlad"])
def test_forms_of_the_output(form, network, write_onnx, context):
    """Check a mean-color descriptor as output vector, as first of two tokens, and as map."""
    signature, body = FORMS[form]
    text = f"net (float[b,3,h,w] image) => ({signature}) {{"
    text += f" mean = GlobalAveragePool (image) {body} }}"
    arrays = {"row": np.array([1, 1, 3])} if form == "tokens" else {}
    options = NetworkOptions(model=str(write_onnx(text, **arrays)), network=network)
    colour = np.array([200, 100, 30])
    image = np.broadcast_to(colour, (60, 100, 3)).astype(np.uint8)
    found = GlobalNetwork(options, context).describe(view_of(image))
    expected = colour / 255
    if network != "netvlad":
        expected = (expected - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=3e-4)


SIZES = {"dinov2": (336, 196), "eigenplaces": (512, 512), "netvlad": (100, 60)}


@pytest.mark.parametrize("network", SIZES)
def test_sizes(network, write_onnx, context):
    text = """
    net (float[b,3,h,w] image) => (float[b,d] out) {
        shape = Shape <start = 2> (image)
        number = Cast <to = 1> (shape)
        out = Reshape (number, row)
    }
    """
    model = write_onnx(text, row=np.array([1, 2]))
    options = NetworkOptions(model=str(model), network=network)
    found = GlobalNetwork(options, context).describe(view_of(np.zeros((60, 100, 3), np.uint8)))
    expected = np.array(SIZES[network][::-1])
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), rtol=1e-6)


def textured(seed):
    noise = np.random.default_rng(seed).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    return cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)


class TestAppearance:
    def test_approximates_the_mean_kernel_of_all_pairs_of_features(self, context):
        """Compare the cosine of two mean random features with that of the exact mean kernel."""
        first, second = textured(0), textured(0)
        second[:, 160:] = textured(1)[:, 160:]
        options = AppearanceOptions(dimensions=50_000, color_share=0, max_keypoints=60)
        views = [view_of(image) for image in (first, second)]
        vectors = [Appearance(options, context).describe(view) for view in views]
        sift = Sift(SiftOptions(max_keypoints=60, resize=640, first_octave=0), context)
        descriptors = [sift.extract(view).descriptors.astype(np.float64) for view in views]

        def kernel(x, y):
            squared = 2 - 2 * x @ y.T  # of unit descriptors
            return np.exp(-15.0 * squared).mean()

        a, b = descriptors
        exact = kernel(a, b) / np.sqrt(kernel(a, a) * kernel(b, b))
        assert 0.1 < exact < 0.8
        assert vectors[0] @ vectors[1] == pytest.approx(exact, abs=0.08)

    def test_unit_and_seeded(self, context):
        view = view_of(textured(0))
        first = Appearance(AppearanceOptions(), context).describe(view)
        assert np.linalg.norm(first) == pytest.approx(1, rel=1e-5)
        other = type(context)(resolve_weights=context.resolve_weights, seed=1)
        assert not np.allclose(first, Appearance(AppearanceOptions(), other).describe(view))

    def test_masked_pixels_are_ignored(self, context):
        image, mask = textured(0), np.ones((240, 320), dtype=np.bool_)
        mask[:, 160:] = False
        changed = image.copy()
        changed[:, 200:] = textured(5)[:, 200:]
        provider = Appearance(AppearanceOptions(), context)
        same = provider.describe(view_of(image, mask)) @ provider.describe(view_of(changed, mask))
        apart = provider.describe(view_of(image)) @ provider.describe(view_of(changed))
        assert same > 0.97 > apart

    def test_descriptor_of_view_without_features_is_color_only(self, context):
        flat = view_of(np.full((60, 80, 3), 90, dtype=np.uint8))
        vector = Appearance(AppearanceOptions(), context).describe(flat)
        assert vector @ vector == pytest.approx(0.3)

    def test_neighbours_on_an_arc_of_photos(self, shared_data, context):
        """Check that the most similar images of the fountain scene are neighbors on its arc."""
        folder = shared_data / "data" / "fountain" / "images"
        provider = Appearance(AppearanceOptions(), context)
        vectors = []
        for path in sorted(folder.iterdir()):
            image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
            vectors.append(provider.describe(view_of(image)))
        pairs = retrieval_pairs(vectors, PairOptions(mode="retrieval", top_k=2))
        near = [pair for pair in pairs if pair[1] - pair[0] <= 2]
        assert len(vectors) == 11 and len(near) >= 0.8 * len(pairs)
        assert {(i, i + 1) for i in range(10)} <= set(pairs)
