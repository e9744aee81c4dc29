"""Tests of focal lengths from EXIF, and of damaged headers."""

from __future__ import annotations

import math

import pytest

from mpsfm_core.inputs.image_header import ImageHeader, read_header

FOCAL_35MM, FOCAL_MM = 0xA405, 0x920A
PIXELS_X, PIXELS_Y = 0xA002, 0xA003
PLANE_RESOLUTION, PLANE_UNIT = 0xA20E, 0xA210


def header(**tags: float) -> ImageHeader:
    numbers = {
        "f35": FOCAL_35MM,
        "mm": FOCAL_MM,
        "x": PIXELS_X,
        "y": PIXELS_Y,
        "resolution": PLANE_RESOLUTION,
        "unit": PLANE_UNIT,
    }
    return ImageHeader(None, 1, {numbers[name]: value for name, value in tags.items()})


def test_equivalent_of_full_frame_sensor() -> None:
    """On a 3:2 sensor, the image width corresponds to 36 mm of the 35 mm format."""
    assert header(f35=36).focal_px(6000, 4000) == pytest.approx(6000)


def test_equivalent_is_by_diagonal() -> None:
    expected = 26 / math.hypot(36, 24) * 5000
    assert header(f35=26).focal_px(4000, 3000) == pytest.approx(expected)
    assert header(f35=26).focal_px(3000, 4000) == pytest.approx(expected)


def test_focal_px_from_focal_plane_resolution() -> None:
    """The sensor of a Canon 5D has 35.8 mm for 4368 pixels, with the resolution per inch."""
    resolution = 4368 / 35.8 * 25.4
    found = header(mm=50, resolution=resolution, unit=2).focal_px(4368, 2912)
    assert found == pytest.approx(50 / 35.8 * 4368)
    metric = header(mm=50, resolution=resolution / 2.54, unit=3).focal_px(4368, 2912)
    assert metric == pytest.approx(found)


def test_focal_px_of_resized_photo_is_scaled() -> None:
    """The focal plane resolution is that of the sensor; the photo has a quarter of the pixels."""
    tags = {"mm": 50, "resolution": 4368 / 35.8, "unit": 4, "x": 4368, "y": 2912}
    assert header(**tags).focal_px(1092, 728) == pytest.approx(50 / 35.8 * 1092)


def test_cropped_photo_has_no_focal_length() -> None:
    assert header(f35=26, x=4000, y=3000).focal_px(4000, 2250) is None
    assert header(f35=26, x=4000, y=3000).focal_px(1000, 751) is not None


@pytest.mark.parametrize("value", [0, 1, 5, 900, 65535])
def test_focal_px_with_implausible_equivalent_is_none(value: float) -> None:
    assert header(f35=value).focal_px(4000, 3000) is None
    tags = {"mm": 50, "resolution": 4368 / 35.8, "unit": 4}
    assert header(f35=value, **tags).focal_px(4368, 2912) == pytest.approx(50 / 35.8 * 4368)


def test_focal_px_with_implausible_plane_resolution_is_none() -> None:
    assert header(mm=4.2, resolution=72, unit=2).focal_px(4000, 3000) is None


@pytest.mark.parametrize("tags", [{}, {"mm": 50}, {"f35": 0}, {"mm": 50, "resolution": 0}])
def test_focal_px_of_incomplete_tags_is_none(tags: dict[str, float]) -> None:
    assert header(**tags).focal_px(4000, 3000) is None


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_read_header_of_every_format_finds_focal_length(suffix, write_image) -> None:
    tags = {FOCAL_MM: 4.25, FOCAL_35MM: 26, PIXELS_X: 80, PIXELS_Y: 60}
    found = read_header(write_image(f"a{suffix}", tags=tags).read_bytes())
    assert {tag: found.tags[tag] for tag in tags} == pytest.approx(tags)
    assert found.focal_px(80, 60) == pytest.approx(26 / math.hypot(36, 24) * 100)


def test_read_header_of_truncated_file_does_not_raise(write_image) -> None:
    data = write_image("a.jpg", tags={FOCAL_MM: 4.25, FOCAL_35MM: 26}).read_bytes()
    for length in range(200):
        read_header(data[:length])
