"""Tests of the vismatch providers with networks whose output is known."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from mpsfm_core import Features, PinholeCamera, ProviderContext, View
from mpsfm_core.data.errors import ConfigError

torch = pytest.importorskip("torch")

from mpsfm_vismatch import matcher, roma  # noqa: E402
from mpsfm_vismatch.options import (  # noqa: E402
    CollectionOptions,
    RomaDenseOptions,
    SnapOptions,
)
from mpsfm_vismatch.stand_in import Warping  # noqa: E402

A = np.array([[0.0, 0.0], [10.0, 5.0], [99.0, 20.0]])
B = np.array([[4.0, 3.0], [14.0, 8.0], [199.0, 20.0]])


class Known:
    """Network that returns the matches ``A`` and ``B``, and records its input images."""

    confidences: Any = np.array([0.25, 1.5, 0.5], dtype=np.float32)
    shown: tuple[Any, ...] = ()

    def __init__(self, device: str, max_num_keypoints: int) -> None:
        pass

    def __call__(self, *images: Any) -> dict[str, Any]:
        type(self).shown = images
        noise = torch.rand(1).item() + np.random.rand()
        return {
            "all_kpts0": np.empty((0, 2)),
            "matched_kpts0": A + noise * 1e-3,
            "matched_kpts1": B,
            "matched_confidences": self.confidences,
        }


class LoftrLike(Known):
    """Network without scores."""

    confidences = None


NETWORK = "known_networks:Known"


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("known_networks")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    vars(module).update(Known=Known, LoftrLike=LoftrLike)


def view(width: int, height: int) -> View:
    image = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return View("a.png", image, PinholeCamera(width, height, 90, 90, width / 2, height / 2))


def test_positions_in_pixels_of_views_of_other_sizes(context: ProviderContext) -> None:
    options = CollectionOptions(network=NETWORK, resize=100)
    found = matcher.DenseMatcher(options, context).match(view(200, 60), view(100, 40)).dense
    assert [tuple(image.shape) for image in Known.shown] == [(3, 30, 100), (3, 40, 100)]
    assert 0 <= Known.shown[0].min() <= Known.shown[0].max() <= 1
    # The network's pixel centers are integers, and matches outside of the second view are dropped.
    np.testing.assert_allclose(found.points_a, (A[:2] + 0.5) * 2, atol=4e-3)
    np.testing.assert_allclose(found.points_b, B[:2] + 0.5)
    assert found.scores.tolist() == [0.25, 1.0] and found.std_px == 1.0


def test_matches_are_deterministic(context: ProviderContext) -> None:
    made = matcher.DenseMatcher(CollectionOptions(network=NETWORK), context)
    first, again = (made.match(view(200, 60), view(200, 60)).dense for _ in range(2))
    np.testing.assert_array_equal(first.points_a, again.points_a)


def test_keypoints_near_matched_positions(context: ProviderContext) -> None:
    options = SnapOptions(network=NETWORK, snap_px=1.0)
    a = np.array([[50.0, 50.0], [10.6, 5.4], [0.5, 0.5]])
    b = np.array([[14.0, 9.0], [30.0, 3.0]])
    given = (Features(xy, np.zeros((len(xy), 1), "f4")) for xy in (a, b))
    made = matcher.SparseMatcher(options, context)
    found = made.match(view(200, 60), view(200, 60), *given).sparse
    assert found.indices.tolist() == [[1, 0]] and found.scores.tolist() == [1.0]
    none = Features(np.empty((0, 2)), np.empty((0, 1), "f4"))
    assert not len(made.match(view(200, 60), view(200, 60), none, none).sparse)


def test_missing_scores_are_one(context: ProviderContext) -> None:
    options = CollectionOptions(network=NETWORK.replace("Known", "LoftrLike"))
    found = matcher.DenseMatcher(options, context).match(view(200, 60), view(200, 60)).dense
    assert found.scores.tolist() == [1.0, 1.0, 1.0]


def test_network_of_another_kind_raises(context: ProviderContext) -> None:
    with pytest.raises(
        ConfigError, match=r"Known' has none of the attributes roma_model, matcher, model"
    ):
        roma.DenseMatcher(RomaDenseOptions(network=NETWORK), context)


def test_warp_equals_that_of_the_network(context: ProviderContext) -> None:
    options = RomaDenseOptions(network="mpsfm_vismatch.stand_in:Warping", min_certainty=0.5)
    shown = view(112, 84)
    found = roma.DenseMatcher(options, context).match(shown, shown).dense
    np.testing.assert_allclose(found.points_a, found.points_b, atol=1e-4)
    assert Warping.symmetric and len(found) > 100
