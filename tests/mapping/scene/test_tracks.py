"""Tests of observations, angles and filtering of all points and of a subset of the tracks."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import PinholeCamera
from mpsfm_core.mapping.options import TriangulationOptions
from mpsfm_core.mapping.refinement.filtering import filter_points
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.scene.tracks import Tracks
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 80.0, 60.0)
POSES = arc_poses(4, 8.0)


def random_tracks() -> Tracks:
    tracks = Tracks(500)
    tracks.xyz = np.zeros((90, 3))
    tracks.point_of = np.random.default_rng(0).integers(-1, 80, 500)
    return tracks


def posed_scene() -> Scene:
    scene = Scene(
        make_mapping_problem(room_scene(), CAMERA, POSES, points_per_view=60, map_width=40)
    )
    for image, pose in enumerate(POSES):
        scene.register(image, pose[:, :3], pose[:, 3])
        scene.maps[image].set_scale(1.0)
    complete_and_merge_tracks(scene, TriangulationOptions(), create=True)
    return scene


def test_observations_are_sorted_by_point_then_keypoint() -> None:
    tracks = random_tracks()
    keypoints = np.flatnonzero(tracks.point_of >= 0)
    expected = keypoints[np.argsort(tracks.point_of[keypoints], kind="stable")]
    np.testing.assert_array_equal(tracks.observations(), expected)


def test_observations_of_subset_are_those_of_its_points() -> None:
    tracks = random_tracks()
    points = np.array([7, 85, 3, 20])  # no keypoint observes point 85
    keypoints, rows = tracks.observations_of(points)
    np.testing.assert_array_equal(tracks.point_of[keypoints], points[rows])
    np.testing.assert_array_equal(rows, np.sort(rows))
    assert len(keypoints) == np.isin(tracks.point_of, points).sum()


def test_angles_of_subset_equal_those_of_all_points() -> None:
    scene = posed_scene()
    points = np.arange(0, len(scene.tracks.xyz), 3)[::-1]
    angles, lengths = scene.angles_deg_of(points)
    np.testing.assert_array_equal(angles, scene.track_angles_deg()[points])
    np.testing.assert_array_equal(lengths, scene.tracks.lengths()[points])


def test_filter_points_of_image_equals_filtering_all_points() -> None:
    """Moving one camera only affects points that its image observes, so filtering these
    suffices."""
    near, whole = posed_scene(), posed_scene()
    for scene in (near, whole):
        scene.translations[0] += [0.0, 0.03, 0.0]
    removed = filter_points(near, TriangulationOptions(), [0])
    assert removed == filter_points(whole, TriangulationOptions()) > 0
    np.testing.assert_array_equal(near.tracks.point_of, whole.tracks.point_of)
