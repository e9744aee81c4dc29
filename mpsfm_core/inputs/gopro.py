"""Read GPS positions from the telemetry track (GPMF) of GoPro's MP4 files.

The track ``gpmd`` of the MP4 file has about one telemetry sample a second. A telemetry sample is a
tree of entries with key, type, size, repeat count and big-endian values, padded to four bytes
[gopro/gpmf-parser, README].
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mpsfm_core.inputs.gps import GpsPosition

_MAX_BYTES = 256 << 20
"""Maximum number of bytes of the MP4 box ``moov`` and of a telemetry sample."""
_MAX_DOP = 10.0
"""Dilution of precision (DOP) above which GPS positions are ignored."""
_MIN_FIX = 2
"""Minimum GPS fix of positions that are used, 2 for a 2D fix and 3 for a 3D fix."""
_GPS5 = struct.Struct(">5i")
"""Layout of a GPS5 entry with latitude, longitude, altitude, 2D speed and 3D speed."""
_GPS9 = struct.Struct(">7i2H")
"""Layout of a GPS9 entry, which appends days, seconds, DOP and fix to the values of GPS5."""

_Point = tuple[float, GpsPosition]


def read_positions(video: Path) -> list[_Point]:
    """Read time in seconds and position of all GPS measurements of a GoPro video file.

    Returns:
        GPS measurements in the order of time, none if the video has no telemetry track.

    Raises:
        OSError: the video file cannot be read.
        ValueError: the telemetry track is damaged.
    """
    points: list[_Point] = []
    try:
        with video.open("rb") as file:
            for time_s, duration_s, sample in _telemetry_samples(file):
                positions = [p for stream in _streams(sample) for p in _stream_positions(stream)]
                for number, position in enumerate(positions):
                    points.append((time_s + duration_s * number / len(positions), position))
    except (struct.error, IndexError, KeyError, ZeroDivisionError, OverflowError) as error:
        raise ValueError(f"the telemetry is damaged: {error!r}") from error
    return points


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield type and content of each MP4 box in the bytes ``data``."""
    start = 0
    while start + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, start)
        header = 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", data, start + 8)
            header = 16
        size = size or len(data) - start
        if size < header:
            raise ValueError(f"MP4 box {kind!r} has an invalid size of {size} bytes")
        yield kind, data[start + header : start + size]
        start += size


def _find(data: bytes, *path: bytes) -> bytes:
    """Return the content of the first MP4 box at a path of box types, or raise KeyError."""
    for name in path:
        data = dict(reversed(list(_boxes(data))))[name]
    return data


def _read_moov(file: BinaryIO) -> bytes | None:
    """Read the content of the MP4 box ``moov``, which describes the tracks of the video."""
    file_size = file.seek(0, 2)
    start = 0
    while start + 16 <= file_size:
        file.seek(start)
        size, kind, large = struct.unpack(">I4sQ", file.read(16))
        header = 16 if size == 1 else 8
        size = large if size == 1 else size or file_size - start
        if size < header:
            return None
        if kind == b"moov":
            file.seek(start + header)
            return file.read(min(size - header, _MAX_BYTES))
        start += size
    return None


def _telemetry_samples(file: BinaryIO) -> Iterator[tuple[float, float, bytes]]:
    """Yield time in seconds, duration in seconds and content of each telemetry sample."""
    moov = _read_moov(file) or b""
    for kind, track in _boxes(moov):
        if kind != b"trak" or _find(track, b"mdia", b"hdlr")[8:12] != b"meta":
            continue
        table = _find(track, b"mdia", b"minf", b"stbl")
        if _find(table, b"stsd")[12:16] != b"gpmd":
            continue
        header = _find(track, b"mdia", b"mdhd")
        (timescale,) = struct.unpack_from(">I", header, 20 if header[0] == 1 else 12)
        ticks = 0
        samples = zip(_sample_places(dict(_boxes(table))), _durations(table), strict=False)
        for (offset, size), duration in samples:
            file.seek(offset)
            yield ticks / timescale, duration / timescale, file.read(min(size, _MAX_BYTES))
            ticks += duration


def _numbers(box: bytes, form: str, start: int, count: int) -> tuple[int, ...]:
    numbers: tuple[int, ...] = struct.unpack_from(f">{count}{form}", box, start)
    return numbers


def _durations(table: bytes) -> Iterator[int]:
    box = _find(table, b"stts")
    (entries,) = _numbers(box, "I", 4, 1)
    for entry in range(entries):
        count, duration = _numbers(box, "I", 8 + 8 * entry, 2)
        for _ in range(count):
            yield duration


def _sample_places(table: dict[bytes, bytes]) -> Iterator[tuple[int, int]]:
    """Yield file offset and size in bytes of each sample of an MP4 track."""
    wide = b"co64" in table
    box = table[b"co64" if wide else b"stco"]
    chunks = _numbers(box, "Q" if wide else "I", 8, _numbers(box, "I", 4, 1)[0])
    fixed, num_samples = _numbers(table[b"stsz"], "I", 4, 2)
    sizes = iter(
        (fixed,) * num_samples if fixed else _numbers(table[b"stsz"], "I", 12, num_samples)
    )
    groups = table[b"stsc"]
    starts = [_numbers(groups, "I", 8 + 12 * i, 2) for i in range(_numbers(groups, "I", 4, 1)[0])]
    for number, offset in enumerate(chunks, start=1):
        (per_chunk,) = [count for first, count in starts if first <= number][-1:]
        for _ in range(per_chunk):
            size = next(sizes, None)
            if size is None:
                return
            yield offset, size
            offset += size


def _entries(data: bytes) -> Iterator[tuple[bytes, int, int, int, bytes]]:
    """Yield key, type, size, repeat count and content of each GPMF entry in the bytes ``data``."""
    start = 0
    while start + 8 <= len(data):
        key, kind, size, repeat = struct.unpack_from(">4sBBH", data, start)
        length = size * repeat
        yield key, kind, size, repeat, data[start + 8 : start + 8 + length]
        start += 8 + (length + 3) // 4 * 4


def _streams(sample: bytes) -> Iterator[dict[bytes, tuple[int, int, bytes]]]:
    """Yield the GPMF entries of each stream by key, as (size, repeat count, content)."""
    for key, kind, *_, device in _entries(sample):
        if key != b"DEVC" or kind != 0:
            continue
        for name, _, *_, stream in _entries(device):
            if name == b"STRM":
                yield {k: (size, repeat, data) for k, _, size, repeat, data in _entries(stream)}


def _stream_positions(stream: dict[bytes, tuple[int, int, bytes]]) -> Iterator[GpsPosition]:
    """Yield the GPS positions in the GPS5 or GPS9 entry of a GPMF stream."""
    kind = next((key for key in (b"GPS9", b"GPS5") if key in stream), None)
    if kind is None:
        return
    layout = _GPS9 if kind == b"GPS9" else _GPS5
    size, repeat, data = stream[kind]
    _, num_scales, scales = stream[b"SCAL"]
    scale = struct.unpack(f">{num_scales}i", scales)
    fix = _entry_number(stream, b"GPSF", ">I", 3)
    dop = _entry_number(stream, b"GPSP", ">H", 100) / 100
    if size != layout.size:
        raise ValueError(f"a GPS measurement has {size} bytes instead of {layout.size}")
    for number in range(repeat):
        raw = layout.unpack_from(data, number * size)
        values = [value / divisor for value, divisor in zip(raw, scale, strict=True)]
        if kind == b"GPS9":
            dop, fix = values[7], int(values[8])
        latitude, longitude, altitude = values[:3]
        if fix >= _MIN_FIX and dop <= _MAX_DOP and abs(latitude) <= 90 and abs(longitude) <= 180:
            yield GpsPosition(latitude, longitude, altitude)


def _entry_number(
    stream: dict[bytes, tuple[int, int, bytes]], key: bytes, form: str, default: int
) -> int:
    return int(struct.unpack_from(form, stream[key][2])[0]) if key in stream else default
