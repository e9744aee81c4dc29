"""Tests of the calibration of FastDepth in a real room with and without sensor depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core.calibration.calibrate import (
    CalibrationImages,
    CalibrationResult,
    calibrate,
    compare_prior,
)
from mpsfm_core.calibration.model_selection import std_of
from mpsfm_core.config import Config, load_config
from mpsfm_core.evaluation.peers import PEERS, write_database
from mpsfm_core.extraction.runner import extract
from mpsfm_core.inputs.images import load_images
from mpsfm_core.pipeline.provider_resolution import resolve_providers
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration
from mpsfm_core.support.threads import limit_threads

pytest.importorskip("mpsfm_onnx")
pytest.importorskip("mpsfm_kornia")
pytestmark = pytest.mark.slow

FRAMES = 30
"""Number of frames to reconstruct; successive frames of the room reconstruct in minutes."""


@dataclass(frozen=True)
class Room:
    """All images, successive frames, the configuration, and the options of the sensor depth."""

    photos: CalibrationImages
    frames: CalibrationImages
    config: Config
    truth: dict[str, Any]


@pytest.fixture(scope="module")
def room(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Room:
    folder = shared_data / "data" / "hololens_room"
    model = shared_data / "models" / "fastdepth_224.onnx"
    if not (folder.is_dir() and model.is_file()):
        pytest.skip("no HoloLens room or no FastDepth among the shared data")
    work = tmp_path_factory.mktemp("room")
    settings = [f"depth.options.model={model}", f"runtime.cache_dir={work / 'cache'}"]
    settings += ["pairs.mode=sequential", "pairs.overlap=4", "runtime.workers=2"]
    names = sorted(path.name for path in (folder / "images").iterdir())
    (work / "frames.txt").write_text("\n".join(names[:FRAMES]))
    photos = CalibrationImages(folder / "images", folder / "intrinsics.yaml")
    return Room(
        photos,
        replace(photos, image_list=work / "frames.txt"),
        load_config("fast-cpu", settings),
        {"directory": folder / "gt_depth", "scale": 0.001},
    )


@pytest.fixture(scope="module")
def by_sensor(room: Room) -> CalibrationResult:
    return calibrate(room.photos, room.config, ground_truth=room.truth)


def assert_near(
    found: CalibrationResult, by_sensor: CalibrationResult, room: Room, values: float
) -> None:
    """Check that the median std differs by at most 25 %, and factors by a ratio of `values`."""
    own, true = found.file.calibration, by_sensor.file.calibration
    assert isinstance(own, DepthCalibration) and isinstance(true, DepthCalibration)
    assert not (own.use_network_variance or true.use_network_variance)
    assert own.relative_std == pytest.approx(true.relative_std, rel=values)
    assert own.std_floor == pytest.approx(true.std_floor, rel=values)
    data = compare_prior(room.photos, room.config, room.truth)
    stds = [std_of(calibration, data.residuals(calibration)) for calibration in (own, true)]
    assert 0.75 < np.median(stds[0] / stds[1]) < 1.25
    # The default calibration, which is for another network, has a clearly different std.
    other = DepthCalibration()
    assert np.median(std_of(other, data.residuals(other)) / stds[1]) < 0.3


def test_std_covers_test_images(by_sensor: CalibrationResult) -> None:
    before, after = (by_sensor.report["metrics"][when] for when in ("before", "after"))
    assert len(by_sensor.report["images"]) == 123
    assert 0.60 < after["coverage"][0] < 0.76
    assert after["ause"] < before["ause"]
    assert after["nll_heavy"] < before["nll_heavy"]


def test_self_calibration_is_close_to_sensor_calibration(
    room: Room, by_sensor: CalibrationResult
) -> None:
    own = calibrate(room.frames, room.config)
    assert len(own.report["rounds"]) > 1
    assert_near(own, by_sensor, room, 0.25)


def test_colmap_points_are_close_to_sensor_calibration(
    room: Room, by_sensor: CalibrationResult, tmp_path: Path
) -> None:
    photos, registry = room.frames, Registry.discover()
    config = resolve_providers(room.config, registry).config
    images = load_images(photos.folder, photos.intrinsics, photos.image_list, config.inputs)
    problem = extract(images, config, registry, Stages(registry)).problem
    write_database(problem, tmp_path / "database.db")
    with limit_threads(1):  # COLMAP is deterministic with one thread.
        models = PEERS["colmap"](tmp_path / "database.db", tmp_path)
    largest = max(models, key=lambda number: models[number].num_reg_images())
    found = calibrate(photos, room.config, model=tmp_path / str(largest))
    assert_near(found, by_sensor, room, 0.35)
