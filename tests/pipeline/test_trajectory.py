"""Tests of the localization of all frames of a rendered video between keyframes with true poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera, UInt8
from mpsfm_core.data.decisions import FrameReason, KeyframeReason
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.panorama import make_panorama_camera
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.video import SelectedFrame, VideoSelection, read_frames
from mpsfm_core.inputs.view_cutting import ViewCutter, cut_images
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.pipeline.trajectory import localize_frames
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.trajectory import TrajectoryFrame
from mpsfm_core.support.jpeg import encode_jpeg
from mpsfm_core.testing.synthetic.problems import SyntheticNoise, render_mapping_image
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 80.0, 60.0)
POSES = [np.asarray(pose) for pose in arc_poses(12, 1.5)]
KEYFRAMES = (0, 4, 8, 10)
BLANK = 6


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a video of a turning camera, whose frame 6 is black."""
    path, scene = tmp_path_factory.mktemp("video") / "v.avi", room_scene()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 15, CAMERA.size)
    for number, pose in enumerate(POSES):
        frame = cv2.cvtColor(scene.render(CAMERA, pose).rgb, cv2.COLOR_RGB2BGR)
        writer.write(np.zeros_like(frame) if number == BLANK else frame)
    writer.release()
    return path


def build_part(
    folder: Path, camera: PinholeCamera, poses: Mapping[str, Float64]
) -> tuple[Reconstruction, OriginalImages]:
    """Return keyframes with given poses and true depth, and their images."""
    scene, rng = room_scene(), np.random.default_rng(0)
    images, registered = [], []
    for row, (name, pose) in enumerate(poses.items()):
        image = render_mapping_image(
            name, scene, camera, pose, np.zeros((0, 2)), 80, 0.01, 5.0, SyntheticNoise(), rng
        )
        images.append(image)
        points = np.zeros(0, np.int64)
        registered.append(
            RegisteredImage(row, name, camera, pose[:, :3], pose[:, 3], points, image.depth, 1.0)
        )
    part = Reconstruction(tuple(registered), np.zeros((0, 3)), np.zeros(0))
    loaded = load_images(folder, camera, names=list(poses))
    return part, OriginalImages(loaded, MappingProblem(tuple(images), ()))


def localize(
    video: Path,
    folder: Path,
    every: int = 1,
    numbers: Sequence[int] = KEYFRAMES,
    cut: int = len(POSES),
) -> list[TrajectoryFrame]:
    """Localize the frames of the video, of which the frame ``cut`` starts the second shot."""
    reason = KeyframeReason.FIRST.because()
    keyframes = tuple(SelectedFrame(n, n / 15, int(n >= cut), reason, 1.0, 1.0) for n in numbers)
    names = {frame.number: frame.name for frame in keyframes}
    for frame in read_frames(video, frozenset(names)):
        (folder / names[frame.number]).write_bytes(encode_jpeg(frame.image))
    part, originals = build_part(
        folder, CAMERA, {name: POSES[number] for number, name in names.items()}
    )
    selection = VideoSelection(keyframes, len(POSES), 1.0)
    return localize_frames(video, selection, [part], originals, every)


def test_all_frames_get_their_true_pose(video: Path, tmp_path: Path) -> None:
    frames = localize(video, tmp_path)
    assert [frame.number for frame in frames] == list(range(12))
    assert {frame.source for frame in frames} == {"keyframe", "tracked", "interpolated"}
    for frame, true in zip(frames, POSES, strict=True):
        assert frame.pose is not None and frame.covariance is not None
        error = np.linalg.norm(camera_center(*frame.pose) - camera_center(true[:, :3], true[:, 3]))
        is_blank = frame.number == BLANK
        assert error < (0.1 if is_blank else 0.03), frame.number
        turn = rotation_angle_deg(frame.pose[0] @ true[:, :3].T)
        assert turn < (1.0 if is_blank else 0.3), frame.number
    blank, before = frames[BLANK], frames[BLANK - 1]
    assert blank.source == "interpolated" and blank.reason is not None
    assert blank.reason.code in (FrameReason.TOO_FEW_TRACKS, FrameReason.TOO_FEW_INLIERS)
    assert np.trace(blank.covariance) > np.trace(before.covariance)


def test_every_third_frame_and_keyframes_are_localized(video: Path, tmp_path: Path) -> None:
    frames = localize(video, tmp_path, every=3)
    tracked = {frame.number for frame in frames if frame.source == "tracked"}
    assert tracked and all(number % 3 == 0 for number in tracked)


def test_no_pose_is_interpolated_across_a_cut(video: Path, tmp_path: Path) -> None:
    numbers = (0, 4, BLANK + 1, 10)
    one_shot = localize(video, tmp_path, numbers=numbers)
    assert one_shot[BLANK].source == "interpolated"
    two_shots = localize(video, tmp_path, numbers=numbers, cut=BLANK + 1)
    assert two_shots[BLANK].source == "none" and two_shots[BLANK].pose is None
    others = [frame for frame in two_shots if frame.number != BLANK]
    assert all(frame.source in ("keyframe", "tracked") for frame in others)


PANORAMA_SIZE = 640, 320


def panorama_pose(number: int) -> Float64:
    """Return ``panorama_from_world`` of a frame; the panorama moves and turns."""
    cos, sin = np.cos(0.05 * number), np.sin(0.05 * number)
    turn = np.array([[cos, sin, 0], [0, 0, -1], [-sin, cos, 0]])
    return np.column_stack([turn, -turn @ [0.1 * number, 0.05 * number - 0.2, 1.4]])


PANORAMA_POSES = [panorama_pose(number) for number in range(6)]


def render_panorama(pose: Float64) -> UInt8:
    """Render an equirectangular panorama of the room."""
    xy = np.stack(np.meshgrid(*map(np.arange, PANORAMA_SIZE)), axis=-1) + 0.5
    directions = make_panorama_camera(*PANORAMA_SIZE).cam_ray_from_img(xy.reshape(-1, 2))
    scene, rotation = room_scene(), pose[:, :3]
    eye = camera_center(rotation, pose[:, 3])
    distance, _, surface = scene.first_hit(eye, directions @ rotation)
    points = eye + distance[:, None] * (directions @ rotation)
    rgb = scene.texture.colors(points, surface, distance * np.pi / PANORAMA_SIZE[1])
    return rgb.reshape(PANORAMA_SIZE[1], PANORAMA_SIZE[0], 3)


def test_frames_of_a_panorama_video_get_the_pose_of_the_panorama(tmp_path: Path) -> None:
    path, size = tmp_path / "v.avi", PANORAMA_SIZE
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 15, size)
    for pose in PANORAMA_POSES:
        writer.write(cv2.cvtColor(render_panorama(pose), cv2.COLOR_RGB2BGR))
    writer.release()
    reason = KeyframeReason.FIRST.because()
    keyframes = tuple(SelectedFrame(n, n / 15, 0, reason, 1.0, 1.0) for n in (0, 5))
    names = {frame.number: frame.name for frame in keyframes}
    (tmp_path / "frames").mkdir()
    for frame in read_frames(path, frozenset(names)):
        (tmp_path / "frames" / names[frame.number]).write_bytes(encode_jpeg(frame.image))
    cut = cut_images(
        *(tmp_path / "frames", list(names.values()), tmp_path / "views", tmp_path / "masks"),
        InputOptions(),
    )
    cutter = ViewCutter(make_panorama_camera(*size))
    poses = {
        view: rotation @ PANORAMA_POSES[number]
        for number, name in names.items()
        for view, rotation in zip(cut.view_names[name], cutter.rotations, strict=True)
    }
    part, originals = build_part(cut.folder, cutter.camera, poses)
    selection = VideoSelection(keyframes, len(PANORAMA_POSES), 1.0)
    frames = localize_frames(path, selection, [part], originals, cut=cut)
    assert [frame.source for frame in frames] == ["keyframe", *["tracked"] * 4, "keyframe"]
    for frame, true in zip(frames, PANORAMA_POSES, strict=True):
        assert frame.pose is not None
        center = camera_center(true[:, :3], true[:, 3])
        assert np.linalg.norm(camera_center(*frame.pose) - center) < 0.02, frame.number
        assert rotation_angle_deg(frame.pose[0] @ true[:, :3].T) < 0.2, frame.number
