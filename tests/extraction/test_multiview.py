"""Tests of image groups of a multi-view network, and of their depth and poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core import DepthPrior, MultiViewPrior, View
from mpsfm_core.data.errors import ConfigError, DataError
from mpsfm_core.extraction.cache import Cache, pack, unpack
from mpsfm_core.extraction.priors.multiview import choose_groups
from mpsfm_core.geometry import compose, invert
from mpsfm_core.providers import ProviderSpec
from mpsfm_core.providers.provider_config import ProviderConfig

from .conftest import World


def test_choose_groups_joins_images_with_shared_matches() -> None:
    """Two groups of three images with matches, and one image without matches."""
    matches = {(0, 2): 90, (2, 4): 80, (0, 4): 70, (1, 3): 90, (3, 5): 60, (4, 5): 5}
    groups = choose_groups(7, matches, 3)
    assert [(sorted(group), own) for group, own in groups] == [
        ([0, 2, 4], 3),
        ([1, 3, 5], 3),
        ([6], 1),
    ]


def test_choose_groups_partitions_images_and_fills_small_groups() -> None:
    """A chain of seven images in groups of three; the last group is filled with shared images."""
    matches = {(i, i + 1): 100 - i for i in range(6)}
    groups = choose_groups(7, matches, 3)
    owned = [image for group, own in groups for image in group[:own]]
    assert sorted(owned) == list(range(7))
    assert all(len(group) == 3 and len(set(group)) == 3 for group, _ in groups)


def test_multiview_prior_of_group_is_cached(tmp_path: Path) -> None:
    depth = tuple(DepthPrior.from_arrays(np.full((2, 3), 1.0 + i)) for i in range(11))
    group = MultiViewPrior(depth, np.tile(np.eye(3, 4), (11, 1, 1)))
    cache = Cache(tmp_path)
    cache.store("multiview", "ab", group)
    found = cache.load("multiview", "ab", MultiViewPrior)
    assert found is not None and found.intrinsics is None
    assert [float(prior.depth[0, 0]) for prior in found.depth] == [1.0 + i for i in range(11)]
    assert unpack(MultiViewPrior, pack(MultiViewPrior(()))).depth == ()


def test_multiview_prior_of_wrong_shape_raises() -> None:
    depth = (DepthPrior.from_arrays(np.ones((2, 2))),)
    with pytest.raises(DataError, match=r"poses: array must have shape \(1, 3, 4\)"):
        MultiViewPrior(depth, np.zeros((2, 3, 4)))
    with pytest.raises(DataError, match="positive focal lengths"):
        MultiViewPrior(depth, intrinsics=np.zeros((1, 4)))


@pytest.fixture
def shown(world: World) -> list[list[str]]:
    """Add a ground-truth multi-view provider; return the list of views it received."""
    asked: list[list[str]] = []

    class TrueGroup:
        def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
            asked.append([view.name for view in views])
            depth = [world.truth.renderings[view.name].depth * 2 for view in views]
            poses = np.array([world.poses[view.name] for view in views])
            poses[:, :, 3] *= 2
            maps = tuple(DepthPrior.from_arrays(d, (0.05 * d) ** 2, metric=False) for d in depth)
            return MultiViewPrior(maps, poses)

    world.registry.add(
        ProviderSpec(
            "multiview",
            "truth",
            lambda options, context: TrueGroup(),
            capabilities=frozenset({"proposes-poses"}),
        ),
        version="1",
    )
    return asked


MULTIVIEW = {"multiview": ProviderConfig(use="truth"), "depth": ProviderConfig(use="multiview")}


def test_extract_with_multiview_sets_depth_groups_and_poses(
    world: World, shown: list[list[str]]
) -> None:
    problem = world.extract(**MULTIVIEW).problem
    (group,) = shown
    assert sorted(group) == sorted(world.names)
    assert {image.depth_group for image in problem.images} == {0}
    first, second = problem.images[:2]
    assert first.proposed_pose is not None and second.proposed_pose is not None
    rotation, translation = compose(second.proposed_pose, invert(*first.proposed_pose))
    true = [world.poses[image.name] for image in (first, second)]
    expected = compose((true[1][:, :3], true[1][:, 3]), invert(true[0][:, :3], true[0][:, 3]))
    np.testing.assert_allclose(rotation, expected[0], atol=1e-12)
    np.testing.assert_allclose(translation, 2 * expected[1], atol=1e-12)
    assert not first.depth.metric
    rendered = world.truth.renderings[first.name].depth
    assert np.median(first.depth.depth) == pytest.approx(2 * np.median(rendered), rel=0.02)


def test_multiview_second_run_uses_cache(world: World, shown: list[list[str]]) -> None:
    world.extract(**MULTIVIEW)
    shown.clear()
    problem = world.extract(**MULTIVIEW).problem
    assert not shown
    assert {image.depth_group for image in problem.images} == {0}


def test_depth_of_other_provider_has_no_group(world: World, shown: list[list[str]]) -> None:
    problem = world.extract(multiview=ProviderConfig(use="truth")).problem
    assert shown
    assert {(image.depth_group, image.proposed_pose) for image in problem.images} == {(None, None)}


def test_multiview_depth_uses_calibration_of_multiview_network(
    world: World, shown: list[list[str]]
) -> None:
    wide = {"relative_std": 0.5, "std_scale": 1.0, "std_floor": 0.0}
    blocks = {**MULTIVIEW, "multiview": ProviderConfig(use="truth", calibration=wide)}
    depth = world.extract(**blocks).problem.images[0].depth
    assert depth.variance is not None
    relative = np.sqrt(depth.variance[depth.valid]) / depth.depth[depth.valid]
    assert np.median(relative) == pytest.approx(0.5, rel=1e-3)


def test_failing_multiview_provider_gives_empty_depth(
    world: World, shown: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(options: object, context: object) -> object:
        class Failing:
            def predict_group(self, views: Sequence[View]) -> MultiViewPrior:
                raise RuntimeError("CUDA error")

        return Failing()

    world.registry.add(ProviderSpec("multiview", "failing", fail))
    blocks = {**MULTIVIEW, "multiview": ProviderConfig(use="failing")}
    runtime = world.config().runtime.model_copy(update={"on_error": "skip"})
    problem = world.extract(**blocks, runtime=runtime).problem
    assert not any(image.depth.valid.any() for image in problem.images)


def test_depth_from_multiview_without_network_is_a_config_error(tmp_path: Path) -> None:
    from mpsfm_core import load_config

    with pytest.raises(ConfigError, match=r"multiview: is needed by depth.use: multiview"):
        load_config("fast-cpu", ["depth.use=multiview", "normals.use=from-depth"])
