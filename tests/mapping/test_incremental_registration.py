"""Tests of incremental registration: rollback, rejections, drift and competing components."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.mapping.component import Component
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.registration.pose_estimation import select_distinct_poses
from mpsfm_core.mapping.registration.pose_support import ScoredPose
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture
def component() -> Component:
    """Return a component with all images of a noise-free scene registered."""
    mapper = Mapper(
        make_mapping_problem(room_scene(), CAMERA, arc_poses(5, 14.0)),
        MapperOptions(),
        NullMappingEvents(),
    )
    mapper.reconstruct_component()
    assert mapper.component.scene.registered.all()
    return mapper.component


def deregister(component: Component, *images: int) -> None:
    for image in images:
        component.scene.deregister(image)


def test_image_contradicted_by_several_images_is_deregistered_once(component: Component) -> None:
    deregister(component, 0, 4)
    component.maintenance.history.record_contradiction(3, 0)
    component.maintenance.history.record_contradiction(3, 4)
    component.maintenance.history.record_contradiction(1, 4)
    assert component.registration.deregister_contradicted_image()
    assert np.flatnonzero(~component.scene.registered).tolist() == [0, 3, 4]
    reason = component.maintenance.event_log.image_reasons["view_3.png"]
    assert reason == ImageReason.CONTRADICTED_BY_IMAGES.because(num_images=2)
    while component.registration.register_next_image(np.ones(5, dtype=np.bool_)):
        pass
    assert component.scene.registered[3], "may be registered again"
    deregister(component, 0, 4)
    component.maintenance.history.record_contradiction(3, 0)
    component.maintenance.history.record_contradiction(3, 4)
    assert not component.registration.deregister_contradicted_image(), "is deregistered once"


def test_image_contradicted_by_one_image_stays(component: Component) -> None:
    deregister(component, 4)
    component.maintenance.history.record_contradiction(3, 4)
    assert not component.registration.deregister_contradicted_image()
    assert component.scene.registered[3]


def test_contradictions_of_registered_images_do_not_count(component: Component) -> None:
    component.maintenance.history.record_contradiction(3, 0)
    component.maintenance.history.record_contradiction(3, 4)
    assert not component.registration.deregister_contradicted_image()


def test_rejected_pose_is_allowed_again_after_scene_changes(component: Component) -> None:
    pose = ScoredPose(np.eye(3), np.zeros(3), "PnP", 1.0, 30, 1.0)
    component.maintenance.history.reject_pose(2, pose, "it floats")
    assert component.maintenance.history.get_rejection(2, replace(pose, support=2.0)) == "it floats"
    assert (
        component.maintenance.history.get_rejection(2, replace(pose, translation=np.ones(3)))
        is None
    )
    assert component.maintenance.history.get_rejection(1, pose) is None
    component.maintenance.deregister([4], "to change the scene")
    assert component.maintenance.history.get_rejection(2, pose) is None


def test_select_distinct_poses_keeps_best_supported_of_close_poses() -> None:
    def pose(degrees: float, support: float) -> ScoredPose:
        turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        return ScoredPose(turn, np.zeros(3), "PnP", support, 30, 1.0)

    poses = [pose(0, 1.0), pose(2, 3.0), pose(90, 2.0), pose(91, 0.5), pose(45, 0.1)]
    assert [found.support for found in select_distinct_poses(poses)] == [3.0, 2.0, 0.1]
    assert [found.support for found in select_distinct_poses(poses, 2)] == [3.0, 2.0]
    assert select_distinct_poses([]) == []


def test_pose_close_to_last_pose_is_tried_once(
    component: Component, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next search returns the best pose of the last attempt up to rounding."""
    scene, history = component.scene, component.maintenance.history
    turn = Rotation.from_euler("y", 0.1, degrees=True).as_matrix()
    known = ScoredPose(turn @ scene.rotations[4], turn @ scene.translations[4], "PnP", 1.0, 30, 1.0)
    deregister(component, 4)
    history.clear()
    history.record_attempt(4, [3], known, searched=True)
    tried: list[ScoredPose] = []

    def contradicted(image: int, pose: ScoredPose, *rest: object, **more: object) -> str:
        tried.append(pose)
        return "it floats"

    monkeypatch.setattr(component.registration, "_extend_model", contradicted)
    assert component.registration._register_image(4, [3]) == "it floats"
    assert len(tried) == 1


def test_rollback_restores_focal_length_and_refined_depth(component: Component) -> None:
    before = component.maintenance.state()
    component.refiner.integrate([2])
    refined = component.scene.maps[2].depth.copy()
    component.scene.set_intrinsics(2, np.array([300.0, 300.0, 160.0, 120.0]), np.zeros(4))
    component.refiner.integrate([2])
    component.maintenance.restore(before)
    assert component.scene.intrinsics[2].tolist() == [260.0, 260.0, 160.0, 120.0]
    assert component.scene.maps[2].camera == CAMERA.resized(*component.scene.maps[2].camera.size)
    component.refiner.integrate([2])
    np.testing.assert_allclose(component.scene.maps[2].depth, refined, rtol=1e-4)


@pytest.mark.parametrize("drift", [(0.3, 0.0, 0.0), (0.0, 0.0, 0.3)])
@pytest.mark.parametrize("is_refined", [True, False])
def test_image_contradicted_by_drift_is_registered_after_global_refinement(
    drift: tuple[float, float, float], is_refined: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An image overlaps both halves of a scene, which have drifted apart since the refinement."""
    links = [(0, 1), (1, 2), (2, 3), (1, 3), (3, 4)]
    problem = make_mapping_problem(
        room_scene(), CAMERA, arc_poses(5, 14.0), links=links, declared_depth_std=0.02
    )
    mapper = Mapper(problem, MapperOptions(), NullMappingEvents())
    mapper.reconstruct_component()
    component = mapper.component
    scene = component.scene
    true_centers = scene.centers()
    for image in (2, 4):
        deregister(component, image)
    component.maintenance.refine_globally()
    assert component.registration.register_next_image(scene.mask([4]))
    observed = np.flatnonzero(scene.tracks.point_of >= 0)
    far = scene.mask([3, 4])[scene.graph.image_of[observed]]
    scene.tracks.xyz[np.unique(scene.tracks.point_of[observed[far]])] += drift
    for image in (3, 4):
        scene.translations[image] -= scene.rotations[image] @ drift
    if not is_refined:
        monkeypatch.setattr(component.maintenance, "refine_new_images", lambda: False)
    registered = component.registration.register_next_image(scene.mask([2]))
    assert registered == scene.registered[2] == is_refined
    if is_refined:
        steps = np.linalg.norm(np.diff(scene.centers(), axis=0), axis=1)
        true_steps = np.linalg.norm(np.diff(true_centers, axis=0), axis=1)
        assert steps == pytest.approx(true_steps, rel=0.02)
    else:
        reason = component.maintenance.event_log.image_reasons["view_2.png"]
        assert reason.code is ImageReason.CONTRADICTS_IMAGE


def test_unchanged_model_is_not_refined_again_at_the_end(component: Component) -> None:
    maintenance = component.maintenance

    def count_refinements() -> int:
        return maintenance.event_log.report([]).counts["global refinement"]

    maintenance.deregister([4], ImageReason.NO_POSE.because())
    maintenance.refine_globally()
    component.register_images(component.scene.mask([4]))
    assert maintenance.refine_new_images()
    before = count_refinements()
    component.finalize()
    assert maintenance.is_checked and count_refinements() == before
    maintenance.deregister([4], ImageReason.NO_POSE.because())
    component.register_images(component.scene.mask([4]))
    component.finalize()
    assert component.scene.registered[4] and count_refinements() == before + 1


@pytest.mark.parametrize(("is_connected", "sizes"), [(True, [6]), (False, [4, 2])])
def test_larger_component_takes_images_of_smaller_one(is_connected: bool, sizes: list[int]) -> None:
    problem = make_mapping_problem(room_scene(), CAMERA, arc_poses(6, 14.0))
    if not is_connected:
        pairs = tuple(p for p in problem.pairs if (p.image_a < 4) == (p.image_b < 4))
        problem = replace(problem, pairs=pairs)
    options = MapperOptions(global_initialization=False)
    mapper = Mapper(problem, options, NullMappingEvents())
    mapper.unregistered[4:] = False
    mapper.reconstruct_component()
    assert [len(model.images) for model in mapper.models] == [4]
    mapper.unregistered[4:] = True
    mapper.reconstruct_component()
    assert [len(model.images) for model in mapper.models] == sizes
    images = [image.index for model in mapper.models for image in model.images]
    assert len(images) == len(set(images)) == 6 - mapper.unregistered.sum()
