"""Tests of the detection of equirectangular panoramas."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.panorama import is_equirectangular
from mpsfm_core.inputs.view_cutting import are_panoramas
from mpsfm_core.testing.synthetic.scenes import room_scene


def panorama(eye: tuple[float, float, float], height: int = 128) -> np.ndarray:
    """Render an equirectangular gray panorama of the synthetic room, z is up."""
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi
    polar = (np.arange(height) + 0.5)[:, None] / height * np.pi
    directions = np.stack(
        np.broadcast_arrays(
            np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)
        ),
        axis=-1,
    ).reshape(-1, 3)
    scene = room_scene()
    distance, _, surface = scene.first_hit(np.array(eye), directions)
    points = np.array(eye) + distance[:, None] * directions
    rgb = scene.texture.colors(points, surface, distance * np.pi / height)
    return cv2.cvtColor(rgb.reshape(height, 2 * height, 3), cv2.COLOR_RGB2GRAY)


EYES = [(0.0, 0.0, 1.4), (1.5, -1.0, 1.2), (-2.0, 1.5, 1.7)]


@pytest.mark.parametrize("eye", EYES)
def test_rendered_panoramas_are_detected(eye: tuple[float, float, float]) -> None:
    assert is_equirectangular(panorama(eye))


@pytest.mark.parametrize("eye", EYES)
def test_crops_of_a_panorama_are_not_panoramas(eye: tuple[float, float, float]) -> None:
    whole = panorama(eye)
    for row, column in ((0, 0), (16, 32), (48, 80)):
        assert not is_equirectangular(whole[row : row + 80, column : column + 160])
    assert not is_equirectangular(whole[:, :200])
    assert not is_equirectangular(np.roll(whole, 40, axis=0))


def test_object_on_uniform_background_is_not_a_panorama() -> None:
    image = np.full((64, 128), 250, np.uint8)
    image[20:44, 40:80] = np.random.default_rng(0).integers(0, 255, (24, 40))
    assert not is_equirectangular(image)
    assert not is_equirectangular(np.full((64, 128), 90, np.uint8))


def test_panoramas_without_metadata_are_refused(tmp_path: Path) -> None:
    for number, eye in enumerate(EYES):
        large = cv2.resize(panorama(eye), (2048, 1024), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), large)
    with pytest.raises(InputError, match=r"0\.jpg is a panorama \(equirectangular, by its pixels"):
        load_images(tmp_path)


def test_folder_of_panoramas_is_recognized(tmp_path: Path) -> None:
    large = cv2.resize(panorama(EYES[0]), (2048, 1024), interpolation=cv2.INTER_CUBIC)
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), large)
    cv2.imwrite(str(tmp_path / "wide.png"), large[:, 200:-200])  # less than 360 degrees
    cv2.imwrite(str(tmp_path / "upside.png"), np.roll(large, 300, axis=0))  # poles in the middle
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    assert are_panoramas(tmp_path, ["a.png", "b.png", "upside.png"])
    assert not are_panoramas(tmp_path, ["a.png", "upside.png"])
    assert are_panoramas(tmp_path, ["a.png", "b.png"])
    assert not are_panoramas(tmp_path, ["a.png", "wide.png"])
    assert not are_panoramas(tmp_path, ["a.png", "broken.jpg"])
    assert not are_panoramas(tmp_path, [])
