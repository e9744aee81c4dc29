"""Fixtures: a small scene, and a process that reconstructs the scene under injected faults."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from tests.support.result_files import content

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CAMERA = PinholeCamera(240, 180, 210.0, 210.0, 120.0, 90.0)
CONFIG = """
features: {{use: sift}}
matcher: {{use: mutual-nearest}}
depth: {{use: files, options: {{directory: {depth}, relative_std: 0.02}}}}
normals: {{use: from-depth}}
extraction: {{integration_size: 64}}
runtime: {{workers: 1, checkpoint_s: 0, cache_dir: {cache}}}
"""


@dataclass
class Scene:
    """Scene of three photos whose output folder contains earlier results."""

    folder: Path
    process: Any
    earlier: dict[str, str] = field(default_factory=dict)
    whole: dict[str, str] = field(default_factory=dict)
    calls: int = 0

    @property
    def work(self) -> Path:
        """Folder of the cache and the output, in which system calls are counted."""
        return self.folder / "work"

    @property
    def output(self) -> Path:
        return self.work / "out"

    def reset(self) -> None:
        """Restore the earlier results and an empty cache."""
        shutil.rmtree(self.work, ignore_errors=True)
        (self.output / "sparse").mkdir(parents=True)
        (self.output / "sparse" / "images.bin").write_text("an earlier model")
        (self.output / "dense.ply").write_text("an earlier cloud")
        (self.output / "summary.json").write_text("an earlier summary")
        (self.output / "notes.txt").write_text("the user's own")
        self.earlier = content(self.output)

    def request(self, **further: Any) -> dict[str, Any]:
        paths = {"images": "images", "intrinsics": "intrinsics.yaml", "config": "config.yaml"}
        return {
            **{name: str(self.folder / path) for name, path in paths.items()},
            "output": str(self.output),
            "folder": str(self.work),
            "report": str(self.folder / "report.json"),
            **further,
        }

    def run(self, **further: Any) -> dict[str, Any]:
        """Run once with a fault ``errno`` (0 for SIGKILL) at the system call ``number``."""
        self.process.stdin.write(json.dumps(self.request(**further)) + "\n")
        self.process.stdin.flush()
        return dict(json.loads(self.process.stdout.readline()))

    def leftovers(self) -> list[str]:
        """Return the temporary folders, unfinished files and checkpoints of earlier runs."""
        paths = [p for p in self.work.rglob("*") if p.name.startswith(".")]
        paths += [p for p in (self.work / "cache" / "mapping").rglob("*") if p.is_file()]
        return [str(path.relative_to(self.work)) for path in paths]

    def age(self) -> None:
        """Set the time of unfinished files so far back that no running process can own them."""
        for path in self.work.rglob("*.tmp"):
            os.utime(path, (0, 0))


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("failing calls need a C compiler and Linux")
    folder = tmp_path_factory.mktemp("faults")
    shim = folder / "failing_calls.so"
    source = str(HERE / "failing_calls.c")
    built = subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", str(shim), source, "-ldl"], capture_output=True
    )
    assert built.returncode == 0, built.stderr
    (folder / "images").mkdir()
    (folder / "depth").mkdir()
    room = room_scene()
    for number, pose in enumerate(arc_poses(3, 12.0)):
        rendering = room.render(CAMERA, pose)
        bgr = cv2.cvtColor(rendering.rgb, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / "images" / f"{number}.png"), bgr)
        np.savez(folder / "depth" / f"{number}.npz", depth=rendering.depth)
    (folder / "intrinsics.yaml").write_text("1: {params: [210, 210, 120, 90], images: all}\n")
    text = CONFIG.format(depth=folder / "depth", cache=folder / "work" / "cache")
    (folder / "config.yaml").write_text(text)
    threads = ("OMP", "OPENBLAS", "MKL", "NUMBA")
    environment = {
        **os.environ,
        **{f"{name}_NUM_THREADS": "1" for name in threads},
        "OPENCV_FOR_THREADS_NUM": "1",
        "LD_PRELOAD": str(shim),
        "PYTHONPATH": str(ROOT),
    }
    with (folder / "stderr.txt").open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, str(HERE / "reconstructions.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environment,
        )
        assert process.stdin is not None and process.stdout is not None
        made = Scene(folder, process)
        made.reset()
        process.stdin.write(json.dumps(made.request()) + "\n")
        process.stdin.flush()
        assert process.stdout.readline() == "ready\n", (folder / "stderr.txt").read_text()
        made.reset()
        ended = made.run()
        assert ended["error"] is None, ended
        made.whole, made.calls = content(made.output), ended["calls"]
        assert not made.leftovers()
        yield made
        process.stdin.close()
        process.wait(timeout=60)
        process.stdout.close()
