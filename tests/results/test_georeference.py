"""Tests of georeferencing with GPS positions of known noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import DepthPrior, PinholeCamera
from mpsfm_core.data.decisions import GpsReason, Reason
from mpsfm_core.geometry import angle_between_deg, camera_center
from mpsfm_core.inputs.gps import GpsPosition, convert_to_enu
from mpsfm_core.mapping.scene.reconstruction import (
    Reconstruction,
    RegisteredImage,
    transform_reconstruction,
)
from mpsfm_core.results.georeference import georeference

ORIGIN = GpsPosition(47.3764, 8.5476, 410.0)
CAMERA = PinholeCamera(40, 30, 40.0, 40.0, 20.0, 15.0)


def walk(centers: np.ndarray, pitch_deg: float = 0.0, turn: float = 0.3) -> Reconstruction:
    """Return a reconstruction of level or pitched cameras at ``centers`` (m east, north, up)."""
    images = []
    ones = np.ones((3, 4), np.float32)
    for index, center in enumerate(centers):
        heading, pitch = turn * index, np.radians(pitch_deg)
        level = np.array([np.cos(heading), np.sin(heading), 0])
        forward = np.cos(pitch) * level + np.array([0, 0, np.sin(pitch)])
        right = np.array([level[1], -level[0], 0])
        rotation = np.stack([right, np.cross(forward, right), forward])
        depth = DepthPrior(10 * ones, ones, ones > 0)
        ids = np.zeros(0, np.int64)
        images.append(
            RegisteredImage(
                index, f"{index}.jpg", CAMERA, rotation, -rotation @ center, ids, depth, 1.0
            )
        )
    return Reconstruction(tuple(images), centers.copy(), np.zeros(len(centers)))


def scrambled(truth: Reconstruction) -> Reconstruction:
    quaternion = np.array([0.5, -0.1, 0.3, 0.8])
    rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)).matrix()
    return transform_reconstruction(truth, 0.2, rotation, np.array([3.0, -1.0, 2.0]), None)


def positions(centers: np.ndarray, noise_m: float, altitudes: bool) -> dict[str, GpsPosition]:
    noise = np.random.default_rng(0).normal(0, noise_m, centers.shape) * [1, 1, 2]
    geographic = pycolmap.GPSTransform().enu_to_ellipsoid(
        centers + noise, ORIGIN.latitude, ORIGIN.longitude, ORIGIN.altitude
    )
    return {
        f"{row}.jpg": GpsPosition(lat, lon, alt if altitudes else None, max(noise_m, 0.5))
        for row, (lat, lon, alt) in enumerate(geographic.tolist())
    }


STREET = np.stack([np.linspace(0, 120, 25), 0.5 * np.sin(np.arange(25)), np.full(25, 1.6)], 1)
FLIGHT = np.stack([*np.meshgrid(np.linspace(0, 300, 5), np.linspace(0, 300, 5))], -1).reshape(-1, 2)
FLIGHT = np.column_stack([FLIGHT, 80 + np.arange(25) % 3])


def check(found, truth: np.ndarray, up_deg: float, scale: float, off_m: float) -> None:
    laid, described = found
    assert laid.metric.trusted
    assert described.metres_per_unit == pytest.approx(5.0, rel=scale)
    centers = np.stack([camera_center(i.rotation, i.translation) for i in laid.images])
    expected = truth - np.median(truth, axis=0)
    assert np.abs(centers - expected)[:, :2].max() < off_m
    depth = laid.images[0].depth
    assert depth.depth[0, 0] == pytest.approx(10, rel=scale)
    assert depth.variance[0, 0] == pytest.approx(1, rel=2.1 * scale)
    ups = -np.stack([image.rotation[1] for image in laid.images])
    tilts = angle_between_deg(ups, np.array([0, 0, 1.0]))
    assert np.abs(tilts - tilts.mean()).max() < 2 * up_deg
    np.testing.assert_allclose(laid.points, centers, atol=1e-6)


def test_street_positions_take_gravity_from_cameras() -> None:
    """Positions on a line do not determine the rotation about this line."""
    found = georeference(scrambled(walk(STREET)), positions(STREET, 2.0, altitudes=True))
    assert "cameras" in found[1].up
    assert found[1].inliers >= 23
    check(found, STREET, up_deg=0.1, scale=0.02, off_m=3.0)


def test_flight_takes_gravity_from_altitudes() -> None:
    model = scrambled(walk(FLIGHT, pitch_deg=-80))
    found = georeference(model, positions(FLIGHT, 1.0, altitudes=True))
    assert found[1].up == "GPS altitudes"
    check(found, FLIGHT, up_deg=1.0, scale=0.01, off_m=4.0)
    down = np.stack([image.rotation[2] for image in found[0].images])
    assert angle_between_deg(down, np.array([0, 0, -1.0])).max() < 12


def test_flight_looking_down_takes_gravity_from_noisy_altitudes() -> None:
    """Two strips with the noise of a GPS tag: camera orientations give a wrong gravity."""
    strips = FLIGHT[:10]
    model = scrambled(walk(strips, pitch_deg=-88, turn=0.0))
    given = positions(strips, 1.5, altitudes=True)
    given = {name: replace(position, std_m=5.0) for name, position in given.items()}
    laid, described = georeference(model, given)
    assert (described.up, described.inliers) == ("GPS altitudes", 10)
    down = np.stack([image.rotation[2] for image in laid.images])
    assert angle_between_deg(down, np.array([0, 0, -1.0])).max() < 10


def test_wrong_positions_are_ignored() -> None:
    given = positions(STREET, 1.0, altitudes=False)
    for name in ("3.jpg", "9.jpg", "17.jpg"):
        given[name] = replace(given[name], latitude=given[name].latitude + 0.01)
    found = georeference(scrambled(walk(STREET)), given)
    assert found[1].inliers == 22
    assert found[1].metres_per_unit == pytest.approx(5.0, rel=0.02)


@pytest.mark.parametrize(
    ("centers", "noise_m", "why"),
    [
        (STREET[:3], 1.0, GpsReason.TOO_FEW_POSITIONS),
        (STREET / 20, 3.0, GpsReason.TOO_LITTLE_SPREAD),
        (np.random.default_rng(1).uniform(0, 900, (25, 3)), None, GpsReason.FEW_INLIERS),
    ],
)
def test_insufficient_positions_change_nothing(centers, noise_m, why: GpsReason) -> None:
    given = positions(centers, noise_m or 1.0, altitudes=False)
    if noise_m is None:  # of other photos
        given = dict(
            zip(given, np.random.default_rng(2).permutation(list(given.values())), strict=True)
        )
    found = georeference(scrambled(walk(centers)), given)
    assert isinstance(found, Reason) and found.code is why


def test_enu_is_in_meters_and_keeps_unknown_altitudes() -> None:
    east = GpsPosition(ORIGIN.latitude, ORIGIN.longitude + 0.001, None)
    north = GpsPosition(ORIGIN.latitude + 0.001, ORIGIN.longitude, 420.0)
    enu = convert_to_enu([east, north], ORIGIN)
    assert enu[0, 0] == pytest.approx(111_320 * np.cos(np.radians(47.3764)) * 0.001, rel=0.01)
    assert np.isnan(enu[0, 2])
    assert enu[1, 1:] == pytest.approx([111.2, 10], rel=0.01)
