"""Write one file of each format of this version by ``python -m tests.golden.make``.

The files are written to a folder named after the version of MP-SfM. The tests check that later
versions read these files, or refuse them with a clear message. Existing folders are not changed;
create a new folder if a format has changed or a version is released.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mpsfm_core import reconstruct
from mpsfm_core.cli.remaining_time import RemainingTimeEstimator
from mpsfm_core.config import load_config
from mpsfm_core.data import (
    DenseMatches,
    DepthPrior,
    Features,
    NormalPrior,
    PairDepth,
    PairMatches,
    PinholeCamera,
    SparseMatches,
)
from mpsfm_core.evaluation.records import BenchmarkRecord, write_record
from mpsfm_core.evaluation.scene_folder import write_sets
from mpsfm_core.extraction.cache import Cache, digest
from mpsfm_core.extraction.empty_results import JointPrior
from mpsfm_core.extraction.matching.verification import TwoViewGeometry
from mpsfm_core.inputs import video
from mpsfm_core.inputs.options import VideoOptions
from mpsfm_core.mapping.state import flatten_state
from mpsfm_core.pipeline import checkpoints
from mpsfm_core.providers.environments.environment import Environment
from mpsfm_core.providers.environments.worker import _description
from mpsfm_core.providers.registry import Registry, core_version
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration
from mpsfm_core.providers.uncertainty.calibration_file import CalibrationFile, Provenance
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.support.files import replace_entries
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from tests.support.file_server import serving

HERE = Path(__file__).parent
CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)
CONFIG = """
description: a run of priors in files
features: {{use: sift, options: {{max_keypoints: 300}}}}
matcher: {{use: mutual-nearest}}
depth:
  use: files
  options: {{directory: {folder}/depth, relative_std: 0.02}}
  calibration: {{std_scale: 1.5, relative_std: 0.03}}
normals: {{use: from-depth}}
extraction: {{integration_size: 32}}
dense: {{enabled: false}}
results: {{nerfstudio: true}}
runtime: {{workers: 1, cache_dir: {folder}/cache}}
"""
KEY = "0" * 64
STATE = {
    "poses": [{"rotation": np.eye(3), "support": 0.5}],
    "seen": {"a": [1, 2], "b": None},
}
"""State with the data types of a mapper's state, whose own fields change with every version."""


def entries() -> dict[str, Any]:
    """Return one object of each class that the cache stores, by kind."""
    rng = np.random.default_rng(0)
    maps = rng.uniform(1, 2, (3, 4)).astype(np.float32)
    depth = DepthPrior(maps, maps**2, maps > 1.2, metric=False)
    normals = np.zeros((3, 4, 3), np.float32)
    normals[..., 2] = -1
    faces = NormalPrior(normals, maps, maps > 1.2)
    xy, scores = rng.uniform(0, 9, (5, 2)), rng.uniform(0, 1, 5).astype(np.float32)
    rows = np.stack([np.arange(5), np.arange(5)[::-1]], axis=1)
    matches = SparseMatches(rows, scores)
    return {
        "features": Features(xy, maps[[0, 1, 2, 0, 1]], scores, scores + 1, 0.7),
        "matcher": PairMatches(matches, DenseMatches(xy, xy + 1, scores), PairDepth(depth, depth)),
        "depth": depth,
        "normals": faces,
        "joint": JointPrior(depth, faces),
        "two-view": TwoViewGeometry(
            "", "calibrated", 4, np.arange(4), np.eye(3), np.array([0.6, 0, 0.8])
        ),
        "mask": np.array([[0, 255]], np.uint8),
    }


def write_run(folder: Path, output: Path) -> None:
    """Write a result folder, and the configuration of its run."""
    for name in ("photos", "depth"):
        (folder / name).mkdir()
    for number, pose in enumerate(arc_poses(3, 12.0)):
        rendering = room_scene().render(CAMERA, pose)
        cv2.imwrite(str(folder / "photos" / f"{number}.png"), rendering.rgb[..., ::-1])
        np.savez(folder / "depth" / f"{number}.npz", depth=rendering.depth)
    (folder / "intrinsics.yaml").write_text("1: {params: [140, 140, 80, 60], images: all}\n")
    (folder / "run.yaml").write_text(CONFIG.format(folder=folder))
    intrinsics = folder / "intrinsics.yaml"
    reconstruct(folder / "photos", output / "out", folder / "run.yaml", intrinsics=intrinsics)
    config = load_config(folder / "run.yaml")
    (output / "config.yaml").write_text(config.to_yaml())
    (output / "out" / "report.html").unlink()  # written again from the other files


def write_cache(output: Path) -> None:
    """Write cache entries of each kind, a checkpoint, hashes of weights, and stage speeds."""
    cache, found = Cache(output / "cache"), {}
    for kind, value in entries().items():
        cache.store(kind, KEY, value)
        found[kind] = digest(value)
    (output / "digests.json").write_text(json.dumps(found, indent=1) + "\n")
    header = {"code": checkpoints.code_key(), "version": core_version(), "registered": 2}
    text = json.dumps({**header, "time": "2026-01-01 00:00:00"}).encode()
    (output / "cache" / "mapping").mkdir()
    with (output / "cache" / "mapping" / "checkpoint.npz").open("wb") as file:
        state: Any = flatten_state(STATE)
        np.savez(file, header=np.frombuffer(text, np.uint8), **state)
    with serving() as server:
        server.files["/v1/model.onnx"] = b"weights"
        uri = f"{server.url}/v1/model.onnx"
        WeightStore(output / "cache").resolve(uri)
    record = output / "cache" / "weights" / "hashes.json"
    record.write_text(record.read_text().replace(server.url, "https://example.org"))
    clock = iter(range(9))
    speeds = RemainingTimeEstimator(output / "cache", lambda: float(next(clock)))
    speeds.start_stage("features", 4)
    speeds.finish_stage("features")
    speeds.save()
    for path in (*output.rglob("*.lock"), *(output / "cache" / "weights").rglob("*.onnx")):
        path.unlink()


def write_calibrations(output: Path) -> None:
    """Write a calibration file as YAML and as JSON."""
    provenance = Provenance(
        provider="a", distribution="mpsfm-a 1.0", truth="maps", data="b", date="2026-01-01",
        core=core_version(), images=3, pixels=1000, weights={"a.onnx": "00"},
        intervals_95={"std_scale": (1.1, 1.9)}, metrics={"before": {"nll": 1.5}},
    )  # fmt: skip
    values = DepthCalibration(std_scale=1.5, relative_std=0.03)
    made = CalibrationFile(kind="depth", calibration=values, provenance=provenance)
    for name in ("calibration.yaml", "calibration.json"):
        made.write(output / name)


def write_evaluation(output: Path) -> None:
    """Write test sets and a benchmark record."""
    sets = {"minimal": [{"images": ["0.png", "1.png"]}], "triplets": {"0-5": [["0", "1", "2"]]}}
    write_sets(output, sets, "overlap from depth")  # type: ignore[arg-type]
    poses = {f"{k}.png": (np.eye(3), np.array([k, 0.0, 0.5])) for k in range(3)}
    record = BenchmarkRecord(
        "room", "benchmark", "minimal", "minimal-00", "ours-config", KEY, poses, poses, 3, 1.0, 1.5,
        others=(poses,),
    )  # fmt: skip
    write_record(output, record)


def write_others(output: Path) -> None:
    """Write video frames, an environment, and the unfinished replacement of a killed run."""
    clip = output / "clip.avi"
    clip.write_bytes(b"not looked into")
    options = VideoOptions()
    folder = output / video.FRAMES
    folder.mkdir()
    selected = options.model_dump(mode="json", exclude={"trajectory_every"})
    origin = dict(zip(video._ORIGIN, (video._digest(clip), selected, None), strict=True))
    selection = {"num_frames": 9, "duration_s": 0.3, "num_over_budget": 0, "keyframes": []}
    (folder / video._LIST).write_text(
        json.dumps({video.VERSION: video.FORMAT, **origin, **selection})
    )
    environment = Environment(output / "environment")
    environment.ask = lambda **_: _description(Registry.discover(environments=False))  # type: ignore[method-assign,assignment]
    environment.refresh()
    exchange = output / "exchange"
    child = os.fork()
    if child == 0:
        Path.rename = lambda *_: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[method-assign]
        with replace_entries(exchange, ("old.txt",)) as fresh:
            (exchange / "old.txt").write_text("old")
            (fresh / "new.txt").write_text("new")
    os.waitpid(child, 0)
    (scratch,) = exchange.glob(".mpsfm-*")
    (scratch / "old" / "nothing").touch()  # git does not store empty folders
    scratch.rename(exchange / ".mpsfm-killed")


def main() -> None:
    """Write all files, without paths of this machine."""
    output = HERE / core_version()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        made = folder / "made"
        made.mkdir()
        write_run(folder, made)
        write_cache(made)
        write_calibrations(made)
        write_evaluation(made)
        write_others(made)
        for path in made.rglob("*"):
            if path.suffix in (".json", ".yaml"):
                path.write_text(path.read_text().replace(temporary, "/home/user"))
        shutil.copytree(made, output)


if __name__ == "__main__":
    main()
