"""Tests of the helpers for provider plugins that run torch networks."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")


def test_skip_random_weights_draws_no_random_numbers_and_keeps_loaded_weights() -> None:
    from mpsfm_core.providers.torch_runtime import SkipRandomWeights

    def create() -> torch.nn.Module:
        return torch.nn.Sequential(torch.nn.Conv2d(3, 8, 3), torch.nn.BatchNorm2d(8))

    expected = create().eval()
    before = torch.get_rng_state()
    with SkipRandomWeights():
        network = create().eval()
        torch.nn.init.trunc_normal_(torch.empty(4))
    assert torch.equal(torch.get_rng_state(), before)
    network.load_state_dict(expected.state_dict())
    image = torch.ones(1, 3, 8, 8)
    assert torch.equal(network(image), expected(image))


def test_deterministic_algorithms_are_used_in_the_block_only() -> None:
    from mpsfm_core.providers.torch_runtime import deterministic_algorithms

    assert not torch.are_deterministic_algorithms_enabled()
    with pytest.raises(KeyError), deterministic_algorithms():
        assert torch.are_deterministic_algorithms_enabled()
        raise KeyError
    assert not torch.are_deterministic_algorithms_enabled()
