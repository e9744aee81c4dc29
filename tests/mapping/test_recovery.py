"""How the mapper takes back what went wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Bool, PinholeCamera
from mpsfm_core.geometry import rotation_angle_deg
from mpsfm_core.mapping.events import Silent
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.registration import AbsolutePose
from mpsfm_core.testing.problems import mapping_problem
from mpsfm_core.testing.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture
def mapper() -> Mapper:
    """All of an exact scene is registered."""
    mapper = Mapper(
        mapping_problem(room_scene(), CAMERA, arc_poses(5, 14.0)), MapperOptions(), Silent()
    )
    mapper.reconstruct_next()
    assert mapper.scene.registered.all()
    return mapper


def turned(mapper: Mapper, image: int, degrees: float) -> None:
    """Turn a camera about its own centre."""
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    mapper.scene.rotations[image] = turn @ mapper.scene.rotations[image]
    mapper.scene.translations[image] = turn @ mapper.scene.translations[image]


def take_out(mapper: Mapper, *images: int) -> None:
    for image in images:
        mapper.scene.deregister(image)


def test_the_view_that_several_newcomers_contradict_goes_once(mapper: Mapper) -> None:
    take_out(mapper, 0, 4)
    mapper.attempts.blame(3, 0)
    mapper.attempts.blame(3, 4)
    mapper.attempts.blame(1, 4)
    assert mapper._displace()
    assert np.flatnonzero(~mapper.scene.registered).tolist() == [0, 3, 4]
    assert "2 other images contradict" in mapper.image_reasons["view_3.png"]
    while mapper._register_next(np.ones(5, dtype=np.bool_)):
        pass
    assert mapper.scene.registered[3], "it may come back"
    take_out(mapper, 0, 4)
    mapper.attempts.blame(3, 0)
    mapper.attempts.blame(3, 4)
    assert not mapper._displace(), "but goes only once"


def test_one_newcomer_is_not_believed(mapper: Mapper) -> None:
    take_out(mapper, 4)
    mapper.attempts.blame(3, 4)
    assert not mapper._displace()
    assert mapper.scene.registered[3]


def test_newcomers_that_were_registered_since_blame_no_more(mapper: Mapper) -> None:
    mapper.attempts.blame(3, 0)
    mapper.attempts.blame(3, 4)
    assert not mapper._displace()


def test_a_refused_pose_is_tried_again_only_in_another_scene(mapper: Mapper) -> None:
    pose = AbsolutePose(np.eye(3), np.zeros(3), "PnP", 1.0, 30, 1.0)
    mapper.attempts.refuse(2, pose, "it floats")
    assert mapper.attempts.refusal(2, replace(pose, support=2.0)) == "it floats"
    assert mapper.attempts.refusal(2, replace(pose, translation=np.ones(3))) is None
    assert mapper.attempts.refusal(1, pose) is None
    mapper._drop([4], "to change the scene")
    assert mapper.attempts.refusal(2, pose) is None


def test_a_jump_that_contradicts_is_undone(mapper: Mapper) -> None:
    before = mapper.scene.snapshot()
    turned(mapper, 2, 25.0)
    mapper._undo_jump(before)
    assert np.array_equal(mapper.scene.rotations, before.rotations)


def test_a_jump_to_a_better_state_stays(mapper: Mapper) -> None:
    right = mapper.scene.rotations.copy()
    turned(mapper, 2, 25.0)
    before = mapper.scene.snapshot()
    turned(mapper, 2, -25.0)
    mapper._undo_jump(before)
    assert rotation_angle_deg(mapper.scene.rotations @ right.transpose(0, 2, 1)).max() < 1e-6


def test_an_undone_jump_takes_its_focal_lengths_with_it(mapper: Mapper) -> None:
    before = mapper.scene.snapshot()
    mapper.refiner.integrate([2])
    refined = mapper.scene.maps[2].depth.copy()
    turned(mapper, 2, 25.0)
    mapper.scene.set_focal(2, 300.0, 300.0)
    mapper.refiner.integrate([2])
    mapper._undo_jump(before)
    assert mapper.scene.intrinsics[2].tolist() == [260.0, 260.0, 160.0, 120.0]
    assert mapper.scene.maps[2].camera == CAMERA.resized(*mapper.scene.maps[2].camera.size)
    mapper.refiner.integrate([2])
    np.testing.assert_allclose(mapper.scene.maps[2].depth, refined, rtol=1e-4)


@pytest.mark.parametrize("drift", [(0.3, 0.0, 0.0), (0.0, 0.0, 0.3)])
@pytest.mark.parametrize("settles", [True, False])
def test_an_image_that_only_drift_contradicts_is_registered(
    drift: tuple[float, float, float], settles: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image in the middle of a chain sees both halves, and these have drifted apart."""
    links = [(0, 1), (1, 2), (2, 3), (3, 4)]
    problem = mapping_problem(
        room_scene(), CAMERA, arc_poses(5, 14.0), links=links, declared_depth_std=0.02
    )
    mapper = Mapper(problem, MapperOptions(), Silent())
    mapper.reconstruct_next()
    scene = mapper.scene
    true_centers = scene.centers()
    take_out(mapper, 2)
    mapper.attempts.forget()
    observed = np.flatnonzero(scene.tracks.point_of >= 0)
    far = scene.mask([3, 4])[scene.graph.image_of[observed]]
    scene.tracks.xyz[np.unique(scene.tracks.point_of[observed[far]])] += drift
    for image in (3, 4):
        scene.translations[image] -= scene.rotations[image] @ drift
    if not settles:
        monkeypatch.setattr(mapper, "_reconsider", lambda available: False)
    registered = mapper._register_next(np.ones(5, dtype=np.bool_))
    assert registered == scene.registered[2] == settles
    if settles:
        steps = np.linalg.norm(np.diff(scene.centers(), axis=0), axis=1)
        true_steps = np.linalg.norm(np.diff(true_centers, axis=0), axis=1)
        assert steps == pytest.approx(true_steps, rel=0.02)
    else:
        assert "contradict the depth" in mapper.image_reasons["view_2.png"]


class Limited(Mapper):
    """Registers ``limit`` images beside the first pair; more than four end as ``kept``."""

    limit = 0
    kept = 9

    def _register_next(self, available: Bool) -> bool:
        self.limit -= 1
        return self.limit >= 0 and super()._register_next(available)

    def _check_all(self) -> None:
        images = self.scene.registered_images()
        if len(images) > 4:
            self._drop(images[self.kept :].tolist(), "contradicted at the end")


@pytest.mark.parametrize(
    ("second_limit", "kept", "sizes"), [(9, 9, [6]), (9, 5, [5]), (9, 4, [4, 2]), (2, 9, [4, 2])]
)
def test_the_group_that_ends_larger_gets_the_images(
    second_limit: int, kept: int, sizes: list[int]
) -> None:
    problem = mapping_problem(room_scene(), CAMERA, arc_poses(6, 14.0))
    mapper = Limited(problem, MapperOptions(), Silent())
    mapper.limit, mapper.kept = 2, kept
    mapper.reconstruct_next()
    assert [len(model.images) for model in mapper.models] == [4]
    mapper.limit = second_limit
    mapper.reconstruct_next()
    assert [len(model.images) for model in mapper.models] == sizes
    images = [image.index for model in mapper.models for image in model.images]
    assert len(images) == len(set(images)) == 6 - mapper.left.sum()
