"""Fixtures of system tests: a small scene of photos and the command line in a subprocess."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

ROOT = Path(__file__).resolve().parents[2]
CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
COMMAND = [sys.executable, "-m", "mpsfm_core"]
POSES_ONLY = ("--set", "dense.enabled=false", "--set", "results.report=false")
"""Settings that skip multi-view stereo and the report, two thirds of the time of a small run."""

CONFIG = """
features:
  use: sift
matcher:
  use: mutual-nearest
depth:
  use: files
  options: {{directory: {depth}, relative_std: 0.02}}
normals:
  use: from-depth
runtime:
  workers: 1
"""


@dataclass(frozen=True)
class PhotoScene:
    """``images``, ``intrinsics`` and ``config`` are arguments of the command line."""

    folder: Path

    @property
    def images(self) -> Path:
        return self.folder / "images"

    @property
    def intrinsics(self) -> Path:
        return self.folder / "intrinsics.yaml"

    @property
    def config(self) -> Path:
        return self.folder / "config.yaml"

    @property
    def truth(self) -> Path:
        return self.folder / "gt"

    @property
    def without_intrinsics(self) -> list[str]:
        return ["reconstruct", str(self.images), "--config", str(self.config)]

    @property
    def arguments(self) -> list[str]:
        return [*self.without_intrinsics, "--intrinsics", str(self.intrinsics)]


@pytest.fixture(scope="session")
def photo_scene(tmp_path_factory: pytest.TempPathFactory) -> PhotoScene:
    """Five photos of a synthetic room, 15 degrees apart, with exact depth as float files."""
    scene = PhotoScene(tmp_path_factory.mktemp("scene"))
    for path in (scene.images, scene.truth, scene.folder / "depth"):
        path.mkdir()
    room, poses = room_scene(), arc_poses(5, 15.0)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=320, height=240, params=CAMERA.params, camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for number, pose in enumerate(poses):
        rendering = room.render(CAMERA, pose)
        name = f"{number}.png"
        bgr = cv2.cvtColor(rendering.rgb, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(scene.images / name), bgr)
        np.savez(scene.folder / "depth" / f"{number}.npz", depth=rendering.depth)
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=1, image_id=number + 1), pycolmap.Rigid3d(pose)
        )
    model.write_text(str(scene.truth))
    scene.intrinsics.write_text("1: {params: [280, 280, 160, 120], images: all}\n")
    scene.config.write_text(CONFIG.format(depth=scene.folder / "depth"))
    return scene


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cache folder of all commands of the test session, so that repeated runs are fast."""
    return tmp_path_factory.mktemp("cache")


@dataclass(frozen=True)
class Ended:
    """Exit code and output of a finished command."""

    code: int
    out: str
    err: str


Mpsfm = Callable[..., Ended]


@pytest.fixture(scope="session")
def environment(cache: Path) -> Mapping[str, str]:
    """Environment of the commands: this source tree, the test cache, single-threaded libraries."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(paths),
        "MPSFM_CACHE": str(cache),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }


@pytest.fixture(scope="session")
def mpsfm(environment: Mapping[str, str]) -> Mpsfm:
    """Function that runs ``mpsfm ARGUMENTS`` in a subprocess."""

    def run(
        *arguments: object, extra: Mapping[str, str] | None = None, timeout: float = 300, **options
    ) -> Ended:
        ended = subprocess.run(
            [*COMMAND, *map(str, arguments)],
            env={**environment, **(extra or {})},
            capture_output=True,
            text=True,
            timeout=timeout,
            **options,
        )
        return Ended(ended.returncode, ended.stdout, ended.stderr)

    return run


@pytest.fixture(scope="session")
def interrupted(environment: Mapping[str, str]) -> Mpsfm:
    """Runs ``mpsfm ARGUMENTS`` and presses Ctrl-C when a line on stderr starts with ``after``;
    ``by``: another signal."""

    def heed_interrupts() -> None:
        # A shell makes background processes ignore Ctrl-C, which the subprocess would inherit.
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    def run(*arguments: object, after: str, by: int = signal.SIGINT) -> Ended:
        process = subprocess.Popen(
            [*COMMAND, *map(str, arguments)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=heed_interrupts,
        )
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if line.startswith(after):
                # Ctrl-C goes to the whole process group, including workers.
                os.killpg(process.pid, by)
                break
        out, rest = process.communicate(timeout=120)
        return Ended(process.returncode, out, "".join(lines) + rest)

    return run
