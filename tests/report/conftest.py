"""Fixtures: result folders of real runs, and a real browser."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import mpsfm_core
from mpsfm_core.cli import build_app
from mpsfm_core.data import PinholeCamera
from mpsfm_core.data.errors import ReconstructionError
from mpsfm_core.report.page import write_report
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
HOSTILE = "a</script><b onload='x'>&amp; \"{{DATA}}\u2028.png"
"""File name that would inject code into the report if it were not escaped."""
CONFIG = """
features: {{use: sift}}
matcher: {{use: mutual-nearest}}
depth:
  use: files
  options: {{directory: {depth}, relative_std: 0.02}}
normals: {{use: from-depth}}
runtime: {{workers: 1}}
"""


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the result folder of a run with four photos of a room and a photo of noise."""
    folder = tmp_path_factory.mktemp("finished")
    photos, depth = folder / "photos", folder / "depth"
    room = room_scene()
    for name, pose in zip(
        (HOSTILE, "1.png", "2.png", "more/3.png"), arc_poses(4, 15.0), strict=True
    ):
        rendering = room.render(CAMERA, pose)
        _write(photos / name, rendering.rgb)
        _write_depth(depth / name, rendering.depth)
    _write_noise(photos / "noise.png", depth)
    return _run(folder)


@pytest.fixture
def walked(finished: Path, tmp_path: Path) -> Path:
    """Return a copy of the finished folder with the trajectory of a video of three frames."""
    folder = Path(shutil.copytree(finished, tmp_path / "walked"))
    half = np.sqrt(0.5)
    rows = ["# timestamp", "0 0 0 0 0 0 0 1", "0.5 0.2 0 0 0 0 0 1", f"1 0.4 0 0 0 0 {half} {half}"]
    (folder / "trajectory.txt").write_text("\n".join(rows) + "\n")
    write_report(folder)
    return folder


@pytest.fixture
def held_out(finished: Path, tmp_path: Path) -> Path:
    """Return a copy of the finished folder, as if the dense stage had ignored the photo 1.png."""
    folder = Path(shutil.copytree(finished, tmp_path / "held_out"))
    summary = json.loads((folder / "summary.json").read_text())
    summary["images"]["held_out"] = ["1.png"]
    (folder / "summary.json").write_text(json.dumps(summary))
    write_report(folder)
    return folder


@pytest.fixture
def meshed(finished: Path, tmp_path: Path) -> Path:
    """Return a copy of the finished folder after ``mpsfm mesh``."""
    folder = Path(shutil.copytree(finished, tmp_path / "meshed"))
    command = ["mesh", str(folder), "--set", "max_triangles=2000"]
    done = CliRunner().invoke(build_app(), command)
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture(scope="session")
def failed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the result folder of a failed run with three photos of noise."""
    folder = tmp_path_factory.mktemp("failed")
    (folder / "photos").mkdir()
    for number in range(3):
        _write_noise(folder / "photos" / f"{number}.png", folder / "depth", seed=number)
    with pytest.raises(ReconstructionError):
        _run(folder)
    return folder / "out"


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Start headless Chromium, with logs of console and network."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver (Debian: chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    arguments = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars")
    software_3d = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    for argument in (*arguments, *software_3d):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    opened = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    screen = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    yield opened
    opened.quit()


def _run(folder: Path) -> Path:
    config = folder / "config.yaml"
    config.write_text(CONFIG.format(depth=folder / "depth"))
    (folder / "intrinsics.yaml").write_text("1: {params: [280, 280, 160, 120], images: all}\n")
    settings = mpsfm_core.load_config(config, [f"runtime.cache_dir={folder / 'cache'}"])
    mpsfm_core.reconstruct(
        folder / "photos",
        folder / "out",
        settings,
        intrinsics=folder / "intrinsics.yaml",
    )
    return folder / "out"


def _write_noise(path: Path, depth: Path, seed: int = 9) -> None:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (24, 32, 3), np.uint8)
    _write(path, cv2.resize(coarse, CAMERA.size, interpolation=cv2.INTER_CUBIC))
    _write_depth(depth / path.name, np.full((CAMERA.height, CAMERA.width), 3, np.float32))


def _write(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes())


def _write_depth(photo: Path, depth: np.ndarray) -> None:
    photo.parent.mkdir(parents=True, exist_ok=True)
    np.savez(photo.with_suffix(".npz"), depth=depth)
