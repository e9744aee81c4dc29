"""FastDepth in a real room, compared with the depth of a sensor."""

from __future__ import annotations

from pathlib import Path

import pytest

from mpsfm_core.calibration.calibrate import Photos, calibrate
from mpsfm_core.config import load_config

pytest.importorskip("mpsfm_onnx")


@pytest.mark.slow
def test_one_std_covers_held_out_images(shared_data: Path, tmp_path: Path) -> None:
    room = shared_data / "data" / "hololens_room"
    model = shared_data / "models" / "fastdepth_224.onnx"
    if not (room.is_dir() and model.is_file()):
        pytest.skip("no HoloLens room or no FastDepth among the shared data")
    settings = ["depth.use=onnx", f"depth.options.model={model}", f"runtime.cache_dir={tmp_path}"]
    truth = {"directory": room / "gt_depth", "scale": 0.001}
    report = calibrate(
        Photos(room / "images", room / "intrinsics.yaml"),
        load_config("demo", settings, complete=False),
        ground_truth=truth,
    ).report
    before, after = (report["metrics"][when] for when in ("before", "after"))
    assert len(report["images"]) == 123
    assert 0.60 < after["coverage"][0] < 0.76
    assert after["ause"] < before["ause"]
    assert after["nll_heavy"] < before["nll_heavy"]
