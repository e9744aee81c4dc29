"""Tests of videos in which drones and action cameras recorded GPS positions."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.inputs.gps import GpsPosition, insert_exif, read_gps
from mpsfm_core.inputs.image_header import read_header
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.options import VideoOptions
from mpsfm_core.inputs.telemetry import read_telemetry
from mpsfm_core.inputs.video import extract_frames
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

SIZE = (160, 120)
CAMERA = PinholeCamera(*SIZE, 130.0, 130.0, 80.0, 60.0)
FPS = 10
NUM_FRAMES = 24
START, STEP = (47.3, 8.5, 410.0), (1e-5, -2e-5, 0.5)
"""Latitude, longitude and altitude at the start, and the change of each in 0.1 s."""


def position(time_s: float) -> np.ndarray:
    return np.array(START) + np.array(STEP) * time_s * 10


@pytest.fixture(scope="module")
def pixels() -> list[np.ndarray]:
    """Return frames of a camera that turns around the center of a room."""
    scene = room_scene()
    poses = arc_poses(NUM_FRAMES, 2.0)
    return [cv2.cvtColor(scene.render(CAMERA, pose).rgb, cv2.COLOR_RGB2BGR) for pose in poses]


@pytest.fixture
def video(tmp_path: Path, pixels: list[np.ndarray]) -> Path:
    path = tmp_path / "DJI_0001.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), FPS, SIZE)
    for frame in pixels:
        writer.write(frame)
    writer.release()
    return path


MODELS = {
    "mini 3": "[iso: 100] [shutter: 1/640.0] [fnum: 1.7] [focal_len: 24.00] "
    "[latitude: {0:.6f}] [longitude: {1:.6f}] [rel_alt: 9.100 abs_alt: {2:.3f}] [ct: 5500]",
    "mavic 2": "[iso : 100] [fnum : 280] [focal_len : 240] [latitude : {0:.6f}] "
    "[longtitude : {1:.6f}] [altitude: {2:.6f}]",
    "air 2": "[iso : 100] [fnum : 280] [focal_len : 240] [latitude: {0:.6f}] "
    "[longitude: {1:.6f}] [altitude: {2:.6f}]",
    "mavic pro": "HOME(8.5001,47.3001) 2017.06.01 10:00:00\nGPS({1:.6f},{0:.6f},19) BAROMETER:9.1",
}


def write_subtitles(path: Path, model: str) -> None:
    blocks = []
    for number in range(NUM_FRAMES):
        start = f"00:00:{number // FPS:02d},{number % FPS * 100:03d}"
        fields = MODELS[model].format(*position(number / FPS))
        blocks.append(
            f"{number + 1}\n{start} --> 00:00:59,000\n"
            f'<font size="28">FrameCnt: {number + 1}, DiffTime: 100ms\n'
            f"2024-05-01 10:00:00.000\n{fields} </font>\n"
        )
    path.write_text("\n".join(blocks), encoding="utf-8-sig")


def klv(key: bytes, kind: bytes, size: int, values: bytes) -> bytes:
    content = values.ljust((len(values) + 3) // 4 * 4, b"\x00")
    return key + kind + struct.pack(">BH", size, len(values) // size) + content


def gpmf_sample(kind: str, positions: list[np.ndarray], fix: int = 3) -> bytes:
    """Return a telemetry sample with an accelerometer stream and a GPS stream."""
    scales = [10**7, 10**7, 1000, 1000, 100]
    if kind == "GPS9":
        scales += [1, 1000, 100, 1]
    data = b""
    for latitude, longitude, altitude in positions:
        fields = [round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3), 0, 0]
        data += struct.pack(">5i", *fields)
        if kind == "GPS9":
            data += struct.pack(">2i2H", 8000, 1000, 150, fix)
    stream = klv(b"STNM", b"c", 1, b"GPS (Lat., Long., Alt., 2D, 3D)")
    if kind == "GPS9":
        stream += klv(b"TYPE", b"c", 1, b"lllllllSS")
    else:
        stream += klv(b"GPSF", b"L", 4, struct.pack(">I", fix))
        stream += klv(b"GPSP", b"S", 2, struct.pack(">H", 150))
    stream += klv(b"SCAL", b"l", 4, struct.pack(f">{len(scales)}i", *scales))
    stream += klv(
        kind.encode(), b"?" if kind == "GPS9" else b"l", len(data) // len(positions), data
    )
    accelerometer = klv(b"SCAL", b"s", 2, struct.pack(">h", 418))
    accelerometer += klv(b"ACCL", b"s", 6, struct.pack(">6h", *range(6)))
    streams = klv(b"STRM", b"\x00", 1, accelerometer) + klv(b"STRM", b"\x00", 1, stream)
    return klv(b"DEVC", b"\x00", 1, klv(b"DVNM", b"c", 1, b"HERO9 Black") + streams)


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", len(content) + 8, kind) + content


def add_gopro_track(video: Path, samples: list[bytes], wide: bool = False) -> None:
    """Add a track ``gpmd`` with one sample per second to an MP4 file with the box moov at the
    end."""
    data = video.read_bytes()
    moov = data.rindex(b"moov") - 4
    assert moov + struct.unpack_from(">I", data, moov)[0] == len(data)

    def track(offset: int) -> bytes:
        chunks = box(b"co64", struct.pack(">IIQ", 0, 1, offset))
        if not wide:
            chunks = box(b"stco", struct.pack(">III", 0, 1, offset))
        sizes = struct.pack(f">III{len(samples)}I", 0, 0, len(samples), *map(len, samples))
        table = box(b"stsd", struct.pack(">III4s6xH", 0, 1, 16, b"gpmd", 1))
        table += box(b"stts", struct.pack(">IIII", 0, 1, len(samples), 1000))
        table += box(b"stsc", struct.pack(">IIIII", 0, 1, 1, len(samples), 1))
        table += box(b"stsz", sizes) + chunks
        media = box(b"mdhd", struct.pack(">IIIIIHH", 0, 0, 0, 1000, 1000 * len(samples), 0, 0))
        media += box(b"hdlr", struct.pack(">II4s12x", 0, 0, b"meta") + b"GoPro MET\x00")
        return box(b"trak", box(b"mdia", media + box(b"minf", box(b"stbl", table))))

    size = len(data) + len(track(0))
    content = data[moov + 8 :] + track(size + 8)
    video.write_bytes(data[:moov] + box(b"moov", content) + box(b"mdat", b"".join(samples)))


def check_frames(video: Path, output: Path, tolerance: float = 1e-6) -> None:
    """Check the EXIF positions of the extracted frames of a video."""
    images = load_images(extract_frames({"": video}, output, VideoOptions()))
    assert len(images) >= 3
    for image in images:
        number = int(image.name[len("frame_") : -len(".jpg")])
        assert image.gps is not None and image.gps.altitude is not None
        latitude, longitude, altitude = position(number / FPS)
        assert image.gps.latitude == pytest.approx(latitude, abs=tolerance)
        assert image.gps.longitude == pytest.approx(longitude, abs=tolerance)
        assert image.gps.altitude == pytest.approx(altitude, abs=0.01)


@pytest.mark.parametrize("model", ["mini 3", "mavic 2", "air 2"])
@pytest.mark.parametrize("suffix", [".srt", ".SRT"])
def test_subtitles_of_dji_give_positions_and_focal_length(
    tmp_path: Path, video: Path, model: str, suffix: str
) -> None:
    write_subtitles(video.with_suffix(suffix), model)
    check_frames(video, tmp_path / "out")
    images = load_images(tmp_path / "out" / "frames")
    assert {image.focal_source for image in images} == {"exif"}
    diagonal = np.hypot(*SIZE) / np.hypot(36, 24)
    assert images[0].pinhole.fx == pytest.approx(24 * diagonal, rel=1e-3)


def test_old_subtitles_of_dji_have_the_longitude_first_and_no_altitude(video: Path) -> None:
    write_subtitles(video.with_suffix(".SRT"), "mavic pro")
    telemetry = read_telemetry(video)
    middle = telemetry.position(1.25)
    assert middle is not None and middle.altitude is None
    assert middle.latitude == pytest.approx(position(1.25)[0], abs=1e-6)
    assert middle.longitude == pytest.approx(position(1.25)[1], abs=1e-6)


def test_subtitles_without_positions_change_nothing(tmp_path: Path, video: Path) -> None:
    video.with_suffix(".srt").write_text("1\n00:00:00,000 --> 00:00:01,000\nHello: world\n")
    images = load_images(extract_frames({"": video}, tmp_path / "out", VideoOptions()))
    assert all(image.gps is None and image.focal_source == "default" for image in images)


def test_zoomed_videos_have_no_common_focal_length(video: Path) -> None:
    write_subtitles(video.with_suffix(".srt"), "mini 3")
    text = video.with_suffix(".srt").read_text(encoding="utf-8-sig")
    video.with_suffix(".srt").write_text(text.replace("24.00", "48.00", 3))
    telemetry = read_telemetry(video)
    assert telemetry.points and telemetry.focal_35mm_mm is None


@pytest.mark.parametrize("kind", ["GPS5", "GPS9"])
@pytest.mark.parametrize("wide", [False, True])
def test_telemetry_track_of_gopro_gives_positions(
    tmp_path: Path, video: Path, kind: str, wide: bool
) -> None:
    samples = [
        gpmf_sample(kind, [position(second + part / 5) for part in range(5)]) for second in range(3)
    ]
    add_gopro_track(video, samples, wide)
    check_frames(video, tmp_path / "out")


@pytest.mark.parametrize("kind", ["GPS5", "GPS9"])
def test_gopro_without_gps_fix_gives_no_positions(video: Path, kind: str) -> None:
    add_gopro_track(video, [gpmf_sample(kind, [position(0)], fix=0)])
    assert read_telemetry(video).points == ()


def test_damaged_gopro_track_is_one_warning(video: Path, caplog) -> None:
    sample = gpmf_sample("GPS5", [position(0)])
    add_gopro_track(video, [sample.replace(b"SCAL" + b"l\x04", b"SCAX" + b"l\x04")])
    assert read_telemetry(video).points == ()
    (record,) = caplog.records
    assert "positions of video" in record.message and "are not used" in record.message


def test_frames_are_extracted_again_if_subtitles_arrive(tmp_path: Path, video: Path) -> None:
    folder = extract_frames({"": video}, tmp_path / "out", VideoOptions())
    assert load_images(folder)[0].gps is None
    write_subtitles(video.with_suffix(".srt"), "mini 3")
    check_frames(video, tmp_path / "out")


@pytest.mark.parametrize("altitude", [None, -12.5, 4000.25])
@pytest.mark.parametrize("sign", [1, -1])
def test_inserted_exif_is_read_back(altitude: float | None, sign: int) -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    stored = GpsPosition(sign * 33.1234567, -sign * 151.7654321, altitude)
    found = read_gps(insert_exif(jpeg, stored, 24.0))
    assert found is not None
    assert found.latitude == pytest.approx(stored.latitude, abs=1e-7)
    assert found.longitude == pytest.approx(stored.longitude, abs=1e-7)
    assert found.altitude == altitude
    assert read_header(insert_exif(jpeg, None, 24.0)).tags[0xA405] == 24
    assert insert_exif(jpeg, None) == jpeg
