"""Photos that are shown to a multi-view network together, and what the mapper gets of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core import DepthPrior, MultiViewPrior, View
from mpsfm_core.data.errors import ConfigError, DataError
from mpsfm_core.extraction.cache import Cache, pack, unpack
from mpsfm_core.extraction.priors.multiview import choose_groups, consecutive_groups
from mpsfm_core.geometry import compose, invert
from mpsfm_core.providers import ProviderSpec
from mpsfm_core.providers.provider_config import ProviderConfig

from .conftest import World


def test_groups_hold_what_sees_the_same() -> None:
    """Two rooms of three photos, and one photo that shares nothing."""
    matches = {(0, 2): 90, (2, 4): 80, (0, 4): 70, (1, 3): 90, (3, 5): 60, (4, 5): 5}
    groups = choose_groups(7, matches, 3)
    assert [(sorted(group), own) for group, own in groups] == [
        ([0, 2, 4], 3),
        ([1, 3, 5], 3),
        ([6], 1),
    ]


def test_every_image_is_in_one_group_and_small_groups_are_filled() -> None:
    """A chain of seven in groups of three: the last group borrows what it shares most with."""
    matches = {(i, i + 1): 100 - i for i in range(6)}
    groups = choose_groups(7, matches, 3)
    owned = [image for group, own in groups for image in group[:own]]
    assert sorted(owned) == list(range(7))
    assert all(len(group) == 3 and len(set(group)) == 3 for group, _ in groups)


def test_groups_in_turn() -> None:
    assert consecutive_groups([3, 5, 7, 9, 11], 2) == [(3, 5), (7, 9), (11,)]


def test_the_cache_keeps_a_group(tmp_path: Path) -> None:
    depth = tuple(DepthPrior.from_arrays(np.full((2, 3), 1.0 + i)) for i in range(11))
    group = MultiViewPrior(depth, np.tile(np.eye(3, 4), (11, 1, 1)))
    cache = Cache(tmp_path)
    cache.store("multiview", "ab", group)
    found = cache.load("multiview", "ab", MultiViewPrior)
    assert found is not None and found.intrinsics is None
    assert [float(prior.depth[0, 0]) for prior in found.depth] == [1.0 + i for i in range(11)]
    assert unpack(MultiViewPrior, pack(MultiViewPrior(()))).depth == ()


def test_a_group_checks_itself() -> None:
    depth = (DepthPrior.from_arrays(np.ones((2, 2))),)
    with pytest.raises(DataError, match=r"poses: must have shape \(1, 3, 4\)"):
        MultiViewPrior(depth, np.zeros((2, 3, 4)))
    with pytest.raises(DataError, match="positive focal lengths"):
        MultiViewPrior(depth, intrinsics=np.zeros((1, 4)))


@pytest.fixture
def shown(world: World) -> list[list[str]]:
    """Adds a multi-view provider that knows the scene; the views that it was shown."""
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
        )
    )
    return asked


MULTIVIEW = {"multiview": ProviderConfig(use="truth"), "depth": ProviderConfig(use="multiview")}


def test_the_mapper_gets_depth_groups_and_poses(world: World, shown: list[list[str]]) -> None:
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


def test_a_second_run_asks_nothing_and_the_report_names_the_groups(
    world: World, shown: list[list[str]]
) -> None:
    world.extract(**MULTIVIEW)
    shown.clear()
    report = world.extract(**MULTIVIEW).report
    assert not shown
    assert [sorted(group) for group in report["groups"]] == [sorted(world.names)]


def test_other_depth_takes_no_scale_of_a_group(world: World, shown: list[list[str]]) -> None:
    problem = world.extract(multiview=ProviderConfig(use="truth")).problem
    assert shown
    assert {(image.depth_group, image.proposed_pose) for image in problem.images} == {(None, None)}


def test_the_calibration_is_that_of_the_network(world: World, shown: list[list[str]]) -> None:
    wide = {"relative_std": 0.5, "std_scale": 1.0, "std_floor": 0.0}
    blocks = {**MULTIVIEW, "multiview": ProviderConfig(use="truth", calibration=wide)}
    depth = world.extract(**blocks).problem.images[0].depth
    assert depth.variance is not None
    relative = np.sqrt(depth.variance[depth.valid]) / depth.depth[depth.valid]
    assert np.median(relative) == pytest.approx(0.5, rel=1e-3)


def test_a_provider_that_fails_leaves_depth_unknown(
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


def test_depth_of_a_network_that_nobody_names(tmp_path: Path) -> None:
    from mpsfm_core import load_config

    with pytest.raises(ConfigError, match=r"multiview: is needed by depth.use: multiview"):
        load_config("fast-cpu", ["depth.use=multiview", "normals.use=from-depth"])
