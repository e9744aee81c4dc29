"""How the mapper takes back what went wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Bool, PinholeCamera
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.component import Component
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.maintenance import ModelMaintenance
from mpsfm_core.mapping.registration.incremental_registration import IncrementalRegistration
from mpsfm_core.mapping.registration.pose_estimation import select_distinct_poses
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture
def group() -> Component:
    """All of an exact scene is registered."""
    mapper = Mapper(
        make_mapping_problem(room_scene(), CAMERA, arc_poses(5, 14.0)),
        MapperOptions(),
        NullMappingEvents(),
    )
    mapper.reconstruct_component()
    assert mapper.component.scene.registered.all()
    return mapper.component


def turned(group: Component, image: int, degrees: float) -> None:
    """Turn a camera about its own centre."""
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    group.scene.rotations[image] = turn @ group.scene.rotations[image]
    group.scene.translations[image] = turn @ group.scene.translations[image]


def take_out(group: Component, *images: int) -> None:
    for image in images:
        group.scene.deregister(image)


def test_the_view_that_several_newcomers_contradict_goes_once(group: Component) -> None:
    take_out(group, 0, 4)
    group.maintenance.history.record_contradiction(3, 0)
    group.maintenance.history.record_contradiction(3, 4)
    group.maintenance.history.record_contradiction(1, 4)
    assert group.registration.deregister_contradicted_image()
    assert np.flatnonzero(~group.scene.registered).tolist() == [0, 3, 4]
    reason = group.maintenance.event_log.image_reasons["view_3.png"]
    assert reason == ImageReason.CONTRADICTED_BY_IMAGES.because(num_images=2)
    while group.registration.register_next_image(np.ones(5, dtype=np.bool_)):
        pass
    assert group.scene.registered[3], "it may come back"
    take_out(group, 0, 4)
    group.maintenance.history.record_contradiction(3, 0)
    group.maintenance.history.record_contradiction(3, 4)
    assert not group.registration.deregister_contradicted_image(), "but goes only once"


def test_one_newcomer_is_not_believed(group: Component) -> None:
    take_out(group, 4)
    group.maintenance.history.record_contradiction(3, 4)
    assert not group.registration.deregister_contradicted_image()
    assert group.scene.registered[3]


def test_newcomers_that_were_registered_since_blame_no_more(group: Component) -> None:
    group.maintenance.history.record_contradiction(3, 0)
    group.maintenance.history.record_contradiction(3, 4)
    assert not group.registration.deregister_contradicted_image()


def test_a_refused_pose_is_tried_again_only_in_another_scene(group: Component) -> None:
    pose = ScoredPose(np.eye(3), np.zeros(3), "PnP", 1.0, 30, 1.0)
    group.maintenance.history.reject_pose(2, pose, "it floats")
    assert group.maintenance.history.get_rejection(2, replace(pose, support=2.0)) == "it floats"
    assert group.maintenance.history.get_rejection(2, replace(pose, translation=np.ones(3))) is None
    assert group.maintenance.history.get_rejection(1, pose) is None
    group.maintenance.deregister([4], "to change the scene")
    assert group.maintenance.history.get_rejection(2, pose) is None


def test_of_poses_turned_little_the_best_supported_one_counts() -> None:
    def pose(degrees: float, support: float) -> ScoredPose:
        turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        return ScoredPose(turn, np.zeros(3), "PnP", support, 30, 1.0)

    poses = [pose(0, 1.0), pose(2, 3.0), pose(90, 2.0), pose(91, 0.5), pose(45, 0.1)]
    assert [found.support for found in select_distinct_poses(poses)] == [3.0, 2.0, 0.1]
    assert [found.support for found in select_distinct_poses(poses, 2)] == [3.0, 2.0]
    assert select_distinct_poses([]) == []


def test_a_pose_that_was_found_before_is_tried_once(
    group: Component, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best one of the last attempt is found again by the next search, but for rounding."""
    scene, history = group.scene, group.maintenance.history
    turn = Rotation.from_euler("y", 0.1, degrees=True).as_matrix()
    known = ScoredPose(turn @ scene.rotations[4], turn @ scene.translations[4], "PnP", 1.0, 30, 1.0)
    take_out(group, 4)
    history.clear()
    history.record_attempt(4, [3], known, searched=True)
    tried: list[ScoredPose] = []

    def contradicted(image: int, pose: ScoredPose, *rest: object, **more: object) -> str:
        tried.append(pose)
        return "it floats"

    monkeypatch.setattr(group.registration, "_extend_model", contradicted)
    assert group.registration._register_image(4, [3]) == "it floats"
    assert len(tried) == 1


def test_a_jump_that_contradicts_is_undone(group: Component) -> None:
    before = group.scene.snapshot()
    turned(group, 2, 25.0)
    group.maintenance._undo_jump(before)
    assert np.array_equal(group.scene.rotations, before.rotations)


def test_a_jump_to_a_better_state_stays(group: Component) -> None:
    right = group.scene.rotations.copy()
    turned(group, 2, 25.0)
    before = group.scene.snapshot()
    turned(group, 2, -25.0)
    group.maintenance._undo_jump(before)
    assert rotation_angle_deg(group.scene.rotations @ right.transpose(0, 2, 1)).max() < 1e-6


def test_an_undone_jump_takes_its_focal_lengths_with_it(group: Component) -> None:
    before = group.scene.snapshot()
    group.refiner.integrate([2])
    refined = group.scene.maps[2].depth.copy()
    turned(group, 2, 25.0)
    group.scene.set_focal(2, 300.0, 300.0)
    group.refiner.integrate([2])
    group.maintenance._undo_jump(before)
    assert group.scene.intrinsics[2].tolist() == [260.0, 260.0, 160.0, 120.0]
    assert group.scene.maps[2].camera == CAMERA.resized(*group.scene.maps[2].camera.size)
    group.refiner.integrate([2])
    np.testing.assert_allclose(group.scene.maps[2].depth, refined, rtol=1e-4)


@pytest.mark.parametrize("drift", [(0.3, 0.0, 0.0), (0.0, 0.0, 0.3)])
@pytest.mark.parametrize("settles", [True, False])
def test_an_image_that_only_drift_contradicts_is_registered(
    drift: tuple[float, float, float], settles: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image in the middle of a chain sees both halves, and these have drifted apart."""
    links = [(0, 1), (1, 2), (2, 3), (3, 4)]
    problem = make_mapping_problem(
        room_scene(), CAMERA, arc_poses(5, 14.0), links=links, declared_depth_std=0.02
    )
    mapper = Mapper(problem, MapperOptions(), NullMappingEvents())
    mapper.reconstruct_component()
    group = mapper.component
    scene = group.scene
    true_centers = scene.centers()
    take_out(group, 2)
    group.maintenance.history.clear()
    observed = np.flatnonzero(scene.tracks.point_of >= 0)
    far = scene.mask([3, 4])[scene.graph.image_of[observed]]
    scene.tracks.xyz[np.unique(scene.tracks.point_of[observed[far]])] += drift
    for image in (3, 4):
        scene.translations[image] -= scene.rotations[image] @ drift
    if not settles:
        monkeypatch.setattr(
            group.registration, "_register_contradicted_image", lambda available: False
        )
    registered = group.registration.register_next_image(np.ones(5, dtype=np.bool_))
    assert registered == scene.registered[2] == settles
    if settles:
        steps = np.linalg.norm(np.diff(scene.centers(), axis=0), axis=1)
        true_steps = np.linalg.norm(np.diff(true_centers, axis=0), axis=1)
        assert steps == pytest.approx(true_steps, rel=0.02)
    else:
        reason = group.maintenance.event_log.image_reasons["view_2.png"]
        assert reason.code is ImageReason.CONTRADICTS_IMAGE


class Few(IncrementalRegistration):
    """Registers ``limit`` images beside the first pair."""

    limit = 0

    def register_next_image(self, candidates: Bool, *, wide: bool = False) -> bool:
        self.limit -= 1
        return self.limit >= 0 and super().register_next_image(candidates, wide=wide)


class Critical(ModelMaintenance):
    """More than four images end as ``kept``."""

    kept = 9

    def check_all_images(self, limit: float, when: str) -> None:
        images = self.scene.registered_images()
        if len(images) > 4:
            self.deregister(images[self.kept :].tolist(), "contradicted at the end")


class Limited(Component):
    maintenance_type, registration_type = Critical, Few


@pytest.mark.parametrize(
    ("second_limit", "kept", "sizes"), [(9, 9, [6]), (9, 5, [5]), (9, 4, [4, 2]), (2, 9, [4, 2])]
)
def test_the_group_that_ends_larger_gets_the_images(
    second_limit: int, kept: int, sizes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(6, 14.0))
    options = MapperOptions.model_validate({"initialization": {"global_initialization": False}})
    mapper = Mapper(problem, options, NullMappingEvents())
    mapper.component_type = Limited
    monkeypatch.setattr(Critical, "kept", kept)
    monkeypatch.setattr(Few, "limit", 2)
    mapper.reconstruct_component()
    assert [len(model.images) for model in mapper.models] == [4]
    monkeypatch.setattr(Few, "limit", second_limit)
    mapper.reconstruct_component()
    assert [len(model.images) for model in mapper.models] == sizes
    images = [image.index for model in mapper.models for image in model.images]
    assert len(images) == len(set(images)) == 6 - mapper.unregistered.sum()
