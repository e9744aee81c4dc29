"""Comparison of the fused cross attention with kornia's, per block and for whole LightGlue."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from kornia.feature import LightGlue
from kornia.feature.lightglue import CrossBlock
from mpsfm_kornia.attention import FusedCrossBlock, fuse_cross_attention
from mpsfm_kornia.lightglue import _LIGHTERGLUE, _LIGHTGLUE, LIGHTGLUE_256

from mpsfm_core import View


@pytest.fixture(autouse=True)
def seeded():
    with torch.random.fork_rng(), torch.inference_mode():
        torch.manual_seed(0)
        yield


@pytest.mark.parametrize(("dimension", "heads"), [(96, 1), (256, 4)])
@pytest.mark.parametrize("counts", [(70, 33), (1, 5)])
def test_fused_block_equals_kornia_block(dimension, heads, counts):
    block = CrossBlock(dimension, heads, flash=True).eval()
    x0, x1 = (3 * torch.randn(1, count, dimension) for count in counts)
    for found, expected in zip(FusedCrossBlock(block)(x0, x1), block(x0, x1), strict=True):
        np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("architecture", [_LIGHTERGLUE, _LIGHTGLUE, LIGHTGLUE_256])
def test_state_and_other_networks_stay(architecture):
    """Check that the fused blocks keep tensor names, and do not affect other networks."""
    network = LightGlue(None, **architecture).eval()
    other, before = copy.deepcopy(network), dict(network.state_dict())
    fuse_cross_attention(network)
    assert network.state_dict().keys() == before.keys()
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())
    assert type(other.transformers[0].cross_attn) is CrossBlock


@pytest.mark.parametrize(
    ("features", "matcher"),
    [("xfeat", "lighterglue"), ("aliked", "lightglue-aliked"), ("disk", "lightglue-disk")],
)
def test_fused_lightglue_with_published_weights_equals_kornia(make, blocks, features, matcher):
    """Check that LightGlue returns the same matches, and scores within 1e-4, in float64."""
    turned = View("b.png", np.roll(blocks.image, (8, 24), (0, 1)), blocks.camera)
    detector, matcher = make("features", features), make("matcher", matcher)
    data = {
        f"image{i}": {
            name: tensor.double()
            for name, tensor in matcher._input(view, detector.extract(view)).items()
        }
        for i, view in enumerate((blocks, turned))
    }
    ours = matcher._network.double()
    theirs = copy.deepcopy(ours)
    for layer in theirs.transformers:
        block = CrossBlock(layer.self_attn.embed_dim, layer.self_attn.num_heads, flash=True)
        block.load_state_dict(layer.cross_attn.state_dict())
        layer.cross_attn = block.double().eval()
    found, expected = ours(data), theirs(data)
    assert len(expected["matches"][0]) > 40
    np.testing.assert_array_equal(found["matches"][0], expected["matches"][0])
    np.testing.assert_allclose(found["scores"][0], expected["scores"][0], atol=1e-4)
