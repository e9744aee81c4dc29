"""Tests of the selection of frames from rendered videos by their content."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.decisions import KeyframeReason
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_search import find_images
from mpsfm_core.inputs.options import VideoOptions
from mpsfm_core.inputs.video import (
    SelectedFrame,
    choose_frames,
    extract_frames,
    is_video,
    read_frames,
    read_selection,
    thin_keyframes,
)
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

SIZE = (160, 120)
CAMERA = PinholeCamera(*SIZE, 130.0, 130.0, 80.0, 60.0)


@pytest.fixture(scope="module")
def turn() -> list[np.ndarray]:
    """Return frames of a camera that turns around the center of a room by 2 degrees per frame."""
    scene = room_scene()
    return [
        cv2.cvtColor(scene.render(CAMERA, pose).rgb, cv2.COLOR_RGB2BGR)
        for pose in arc_poses(40, 2.0)
    ]


def write(path: Path, frames: list[np.ndarray]) -> Path:
    size = frames[0].shape[1::-1]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30, size)
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def test_frames_are_chosen_by_motion_and_not_by_time(turn, tmp_path: Path) -> None:
    slow = [frame for frame in turn[:20] for _ in range(3)] + turn[20:]
    steady = choose_frames(write(tmp_path / "a.avi", turn), VideoOptions()).numbers
    waiting = choose_frames(write(tmp_path / "b.avi", slow), VideoOptions()).numbers
    assert 5 <= len(steady) <= 15
    assert abs(len(waiting) - len(steady)) <= 1
    gaps = np.diff([number // 3 if number < 60 else number - 40 for number in waiting])
    assert gaps.max() <= 2.5 * np.median(gaps)


def test_waiting_camera_gives_no_frames(turn, tmp_path: Path) -> None:
    frames = [*turn[:20], *[turn[20]] * 40, *turn[20:]]
    chosen = choose_frames(write(tmp_path / "v.avi", frames), VideoOptions()).numbers
    assert sum(20 < number < 60 for number in chosen) <= 1


def test_blurred_frames_are_not_selected(turn, tmp_path: Path) -> None:
    blurred = {n for n in range(len(turn)) if n % 3}
    frames = [cv2.blur(f, (13, 1)) if n in blurred else f for n, f in enumerate(turn)]
    chosen = choose_frames(write(tmp_path / "v.avi", frames), VideoOptions()).numbers
    assert len(chosen) >= 5
    assert len(blurred & set(chosen)) <= 1  # two thirds of all frames


def test_keyframes_over_budget_with_least_motion_are_dropped(turn, tmp_path: Path, caplog) -> None:
    options = VideoOptions(motion=0.02, max_frames=6)
    selection = choose_frames(write(tmp_path / "v.avi", turn), options)
    chosen = selection.numbers
    assert len(chosen) == 6 and selection.num_over_budget > 0
    assert max(np.diff(chosen)) <= 2.5 * min(np.diff(chosen))
    assert not caplog.text


def test_too_few_keyframes_for_overlap_cause_a_warning(turn, tmp_path: Path, caplog) -> None:
    video = write(tmp_path / "v.avi", turn)
    every = choose_frames(video, VideoOptions(motion=0.01)).keyframes
    needed = thin_keyframes(every, 2, 32.0)
    assert 2 < len(needed) < len(every) // 2
    number = np.searchsorted([frame.number for frame in needed], [frame.number for frame in every])
    gaps = np.bincount(number, [frame.motion for frame in every])
    assert gaps.max() <= 32.0 and (gaps[1:-1] + gaps[2:]).min() > 32.0
    assert not caplog.text
    choose_frames(video, VideoOptions(motion=0.01, max_frames=len(needed) - 1))
    assert f"max_frames to {len(needed)}" in caplog.text


def test_thinning_keeps_quick_turns_and_ends_of_shots() -> None:
    def frame(number: int, motion: float, shot: int = 0) -> SelectedFrame:
        return SelectedFrame(number, number / 30, shot, KeyframeReason.FIRST.because(), 1.0, motion)

    slow = [frame(number, 1.0) for number in range(10)]
    quick = [frame(number, 3.0) for number in range(10, 14)]
    second = [frame(number, 0.0, shot=1) for number in (14, 15)]
    kept = [f.number for f in thin_keyframes([*slow, *quick, *second], 10)]
    assert {0, 13, 14, 15} <= set(kept) and {10, 11, 12} <= set(kept)
    assert len(kept) == 10
    many = [frame(number, 1.0) for number in range(1300)]
    assert len(thin_keyframes(many, 400, 4.0)) == 400
    kept = [f.number for f in thin_keyframes(many, 300, 4.0)]
    assert len(kept) > 300 and np.diff(kept).max() == 4


def test_cut_starts_a_shot(turn, tmp_path: Path) -> None:
    scene = room_scene(seed=7)
    other = [
        cv2.cvtColor(scene.render(CAMERA, pose).rgb, cv2.COLOR_RGB2BGR)[::-1]
        for pose in arc_poses(10, 2.0)
    ]
    video = write(tmp_path / "v.avi", [*turn[:20], *other])
    selection = read_selection(extract_frames({"": video}, tmp_path / "out", VideoOptions()))
    shots = {frame.shot: frame for frame in reversed(selection.keyframes)}
    assert sorted(shots) == [0, 1] and shots[1].number in range(20, 24)
    assert shots[1].reason.code is KeyframeReason.CUT
    assert selection.describe()["cuts_s"] == [pytest.approx(shots[1].number / 30)]


def test_fast_turn_is_no_cut(tmp_path: Path) -> None:
    """After a turn of 25 degrees between two frames, tracking fails, but keypoints match."""
    scene, camera = room_scene(), PinholeCamera(480, 360, 390.0, 390.0, 240.0, 180.0)
    poses = arc_poses(20, 2.5)
    frames = [
        cv2.cvtColor(scene.render(camera, pose).rgb, cv2.COLOR_RGB2BGR)
        for pose in [*poses[:5], *poses[14:]]
    ]
    selection = choose_frames(write(tmp_path / "v.avi", frames), VideoOptions())
    assert selection.describe()["cuts_s"] == []
    assert 5 in selection.numbers


def test_time_stamps_of_variable_frame_rate_are_those_of_the_container(turn, tmp_path) -> None:
    """The last 10 of 40 frames of the MP4 file have twice the duration of the others."""
    video = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), 30, SIZE)
    for frame in turn:
        writer.write(frame)
    writer.release()
    data = bytearray(video.read_bytes())
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):
        start = data.index(name) - 4
        data[start : start + 4] = struct.pack(">I", struct.unpack_from(">I", data, start)[0] + 8)
    entry = data.index(b"stts") + 12  # ISO 14496-12: name, version and flags, number of entries
    count, duration = struct.unpack_from(">II", data, entry)
    assert count == 40
    data[entry - 4 : entry + 8] = struct.pack(">IIIII", 2, 30, duration // 2, 10, duration)
    video.write_bytes(data)
    times = [frame.time_s for frame in read_frames(video)]
    expected = np.concatenate([np.arange(31), 30 + 2 * np.arange(1, 10)]) / 60
    assert times == pytest.approx(expected.tolist(), abs=2e-3)


def test_extracted_frames_are_reused(turn, tmp_path: Path) -> None:
    video = write(tmp_path / "v.avi", turn)
    assert is_video(video)
    folder = extract_frames({"": video}, tmp_path / "out", VideoOptions())
    names = find_images(folder)
    assert names == [f"frame_{n:06d}.jpg" for n in choose_frames(video, VideoOptions()).numbers]
    picture = cv2.imread(str(folder / names[2])).astype(float)
    difference = [np.abs(picture - frame).mean() for frame in turn]
    assert np.argmin(difference) == int(names[2][6:12])
    written = (folder / names[0]).stat().st_mtime_ns
    assert extract_frames({"": video}, tmp_path / "out", VideoOptions()) == folder
    assert (folder / names[0]).stat().st_mtime_ns == written
    extract_frames({"": video}, tmp_path / "out", VideoOptions(motion=0.3))
    assert len(find_images(folder)) < len(names)


def test_frames_of_several_videos_are_in_subfolders(turn, tmp_path: Path) -> None:
    videos = {
        "a": write(tmp_path / "a.avi", turn),
        "day/b": write(tmp_path / "b.avi", turn[::-1]),
    }
    folder = extract_frames(videos, tmp_path / "out", VideoOptions())
    parts = {name: read_selection(folder / name) for name in videos}
    expected = [f"{name}/{frame.name}" for name, part in parts.items() for frame in part.keyframes]
    assert find_images(folder) == expected
    first = folder / "a" / parts["a"].keyframes[0].name
    content = first.read_bytes()
    # Only the second video has changed, and a removed video leaves no frames.
    write(tmp_path / "b.avi", turn[10:])
    extract_frames(videos, tmp_path / "out", VideoOptions())
    assert first.read_bytes() == content
    assert read_selection(folder / "day/b").num_frames == len(turn) - 10
    extract_frames({"day/b": videos["day/b"]}, tmp_path / "out", VideoOptions())
    assert not (folder / "a").exists() and len(find_images(folder)) >= 2


def test_video_of_static_camera_raises(turn, tmp_path: Path) -> None:
    video = write(tmp_path / "v.avi", [turn[0]] * 30)
    with pytest.raises(InputError, match="camera hardly moves"):
        extract_frames({"": video}, tmp_path / "out", VideoOptions())
    assert not (tmp_path / "out").exists()


def test_truncated_video_is_used_until_its_end(turn, tmp_path: Path) -> None:
    video = write(tmp_path / "v.avi", turn)
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    chosen = choose_frames(video, VideoOptions()).numbers
    assert 3 <= len(chosen) <= 8


def test_portrait_video_gives_upright_frames(turn, tmp_path: Path) -> None:
    """Phones store frames in sensor orientation, with their rotation in the header of the track."""
    video = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), 30, SIZE)
    for frame in turn:
        writer.write(frame)
    writer.release()
    data = bytearray(video.read_bytes())
    header = data.index(b"tkhd") + 4
    matrix = (
        header + (4 + 32 if data[header] else 4 + 20) + 16
    )  # ISO 14496-12: version, times, others
    one, least = 1 << 16, 1 << 30
    clockwise = (0, one, 0, -one, 0, 0, SIZE[1] * one, 0, least)
    data[matrix : matrix + 36] = struct.pack(">9i", *clockwise)
    video.write_bytes(data)
    frames = sorted(extract_frames({"": video}, tmp_path, VideoOptions()).glob("*.jpg"))
    assert len(frames) >= 5
    for path in frames:
        seen, stored = cv2.imread(str(path)), turn[int(path.stem[6:])]
        expected = cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE)
        assert seen.shape == expected.shape
        assert np.corrcoef(seen.ravel(), expected.ravel())[0, 1] > 0.8
