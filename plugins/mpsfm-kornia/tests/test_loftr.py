"""Tests of LoFTR with random weights: loading, and match positions compared with kornia."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.feature import LoFTR

from mpsfm_core.data.errors import WeightsError


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """Save a randomly initialized LoFTR in the file format of the published weights."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = LoFTR(pretrained=None).eval()
    path = tmp_path_factory.mktemp("loftr") / "loftr.ckpt"
    state = {f"matcher.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state}, path)
    return path, network


def test_positions_and_scores(make, blocks, checkpoint):
    path, network = checkpoint
    matcher = make("matcher", "loftr", weights=str(path), resize=128, match_threshold=0.0)
    other = type(blocks)("b.png", np.roll(blocks.image, 9, axis=1).copy(), blocks.camera)
    dense = matcher.match(blocks, other).dense
    assert len(dense) > 0
    assert dense.std_px == 1.0  # half of a network pixel of 2 view pixels

    halves = [v.image.reshape(96, 2, 128, 2, 3).mean(axis=(1, 3)) / 255 for v in (blocks, other)]
    gray = [torch.tensor(half @ (0.299, 0.587, 0.114)).float()[None, None] for half in halves]
    network.coarse_matching.thr = 0.0
    with torch.inference_mode():
        expected = network({"image0": gray[0], "image1": gray[1]})
    key = np.lexsort(dense.points_a.T)
    reference = expected["keypoints0"].numpy() * 2.0
    order = np.lexsort(reference.T)
    np.testing.assert_allclose(dense.points_a[key], reference[order], atol=1e-6)
    np.testing.assert_allclose(
        dense.points_b[key], expected["keypoints1"].numpy()[order] * 2.0, atol=1e-2
    )
    np.testing.assert_allclose(
        dense.scores[key], expected["confidence"].numpy()[order], rtol=1e-3, atol=1e-7
    )


def test_masked_pixels_have_no_matches(make, blocks, checkpoint):
    matcher = make("matcher", "loftr", weights=str(checkpoint[0]), resize=128, match_threshold=0.0)
    mask = np.zeros((192, 256), dtype=bool)
    mask[:, :120] = True
    masked = type(blocks)(blocks.name, blocks.image, blocks.camera, mask)
    dense = matcher.match(masked, blocks).dense
    assert 0 < len(dense) < len(matcher.match(blocks, blocks).dense)
    assert dense.points_a[:, 0].max() < 120


def test_default_weights_are_a_pinned_download(make):
    with pytest.raises(WeightsError, match=r"hf://kornia/loftr@.*downloads are switched off"):
        make("matcher", "loftr")
