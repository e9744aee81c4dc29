"""Tests that files of earlier versions are read, and files of later versions refused or replaced.

``tests/golden/VERSION`` has a file of each format as that version wrote it
(``python -m tests.golden.make``).
"""

from __future__ import annotations

import ast
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml

from mpsfm_core.cli.remaining_time import RemainingTimeEstimator
from mpsfm_core.config import load_config
from mpsfm_core.data import DepthPrior, Features, NormalPrior, PairMatches
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.records import read_records
from mpsfm_core.evaluation.scene_folder import _read_sets
from mpsfm_core.extraction.cache import Cache, digest
from mpsfm_core.extraction.empty_results import JointPrior
from mpsfm_core.extraction.matching.verification import TwoViewGeometry
from mpsfm_core.inputs import video
from mpsfm_core.mapping.state import unflatten_state
from mpsfm_core.pipeline.checkpoints import read_checkpoint
from mpsfm_core.providers.environments.environment import Environment
from mpsfm_core.providers.registry import core_version
from mpsfm_core.providers.uncertainty.calibration_file import load_calibration
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.report.page import render
from mpsfm_core.report.result_folder import ResultFolder
from mpsfm_core.results.depth_maps import read_depth_map
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.support.files import lock_output_folder
from mpsfm_core.support.format_versions import VERSION, check_version

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = ROOT / "tests" / "golden"
VERSIONS = sorted(path.name for path in GOLDEN.iterdir() if (path / "digests.json").is_file())
KEY = "0" * 64


def results(folder: Path) -> Any:
    """Return all data that MP-SfM reads from a result folder."""
    found = ResultFolder.open(folder / "out")
    assert found.names == ["0.png", "1.png", "2.png"] == ExportSource.read(folder / "out").names
    assert found.model.num_reg_images() == 3 and len(found.dense_cloud()[0]) > 100
    maps = [(found.refined(n), found.prior(n), found.picture(n)) for n in found.names]
    assert all(part is not None for parts in maps for part in parts)
    assert "dense: {enabled" not in render(found)
    lines = [(line.image_a, line.image_b, len(line.points_a)) for line in found.matches()]
    return found.summary["reconstructions"], lines


def depth(folder: Path) -> Any:
    grid, prior = read_depth_map(folder / "out" / "depth" / "0.png.npz")
    return grid, digest(prior)


def configuration(folder: Path) -> Any:
    """Return the settings that the configuration file contains; later versions may have more
    settings."""
    (folder / "set.yaml").write_text("extends: config.yaml\n")
    config = load_config(folder / "set.yaml").model_dump(mode="json")
    said = yaml.safe_load((folder / "config.yaml").read_text())
    said.pop(VERSION, None)
    said.pop("description")
    return contained(said, config)


def contained(said: Any, found: Any) -> Any:
    if not isinstance(said, dict):
        return found
    return {key: contained(value, found[key]) for key, value in said.items()}


def calibrated(path: Path) -> Any:
    """Return the calibration values that ``tests.golden.make`` sets."""
    values = load_calibration(path).model_dump()
    return {name: values[name] for name in ("std_scale", "relative_std")}


def speeds(folder: Path) -> Any:
    left = RemainingTimeEstimator(folder / "cache")
    left.start_stage("features", 100)
    return left._expected["features"]


def frames(folder: Path) -> Any:
    """Return the folder of the reused frames, or "looked into" if the video would be decoded
    again."""
    options = video.VideoOptions.model_validate(
        json.loads((folder / "frames" / "frames.json").read_text())["options"]
    )
    try:
        return video.extract_frames({"": folder / "clip.avi"}, folder, options).name
    except InputError:
        return "looked into"


def exchange(folder: Path) -> Any:
    exchange_in(folder / "exchange")
    return {path.name: path.read_text() for path in (folder / "exchange").iterdir()}


class File(NamedTuple):
    """File of a format, with its path in the golden folder and the function that reads its content.

    A file of a later version is either refused (``rewritten`` is None), or replaced by a new file
    with the content ``rewritten``.
    """

    path: str
    read: Callable[[Path], Any]
    rewritten: Any = None


FILES: dict[str, File] = {
    "summary": File("out/summary.json", results),
    "depth": File("out/depth/0.png.npz", depth),
    "calibration.yaml": File(
        "calibration.yaml", lambda folder: calibrated(folder / "calibration.yaml")
    ),
    "calibration.json": File(
        "calibration.json", lambda folder: calibrated(folder / "calibration.json")
    ),
    "config": File("config.yaml", configuration),
    "testsets": File("testsets.yaml", lambda folder: list(_read_sets(folder / "testsets.yaml"))),
    "record": File(
        "runs/room/benchmark/minimal-00/ours-config.json",
        lambda folder: [(r.name, len(r.estimated), len(r.others)) for r in read_records(folder)],
    ),
    "hashes": File(
        "cache/weights/hashes.json",
        lambda folder: WeightStore(folder / "cache")._recorded("https://example.org/v1/model.onnx"),
    ),
    "timings": File("cache/timings.json", speeds, rewritten=0.3),
    "environment": File(
        "environment/providers.json",
        lambda folder: {p["kind"] for p in Environment(folder / "environment").describe()},
        rewritten=set(),
    ),
    "frames": File("frames/frames.json", frames, rewritten="looked into"),
    "exchange": File("exchange/.mpsfm-killed/ready.json", exchange),
}
EXPECTED = {
    "calibration.yaml": {"std_scale": 1.5, "relative_std": 0.03},
    "calibration.json": {"std_scale": 1.5, "relative_std": 0.03},
    "testsets": [("minimal", 0, ["0.png", "1.png"]), ("triplets/0-5", 0, ["0", "1", "2"])],
    "record": [(("room", "benchmark", "minimal-00", "ours-config"), 3, 1)],
    "hashes": "9a129038d9a00aed0cf6a7ea059ca50a813449061ab87848cf1a13eafdf33b2c",
    "timings": 0.25,
    "frames": "frames",
    "exchange": {"new.txt": "new"},
}


@pytest.fixture(params=VERSIONS)
def golden(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return a copy of the golden files of one version."""
    return Path(shutil.copytree(GOLDEN / request.param, tmp_path / "golden"))


def change_version(path: Path, version: int | None) -> None:
    """Change the format version in a file, or remove the version."""
    if path.suffix == ".npz":
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in archive.files if name != VERSION}
        arrays |= {} if version is None else {VERSION: np.array(version)}
        np.savez(path, **arrays)
        return
    is_json = path.suffix == ".json"
    load, dump = (json.loads, json.dumps) if is_json else (yaml.safe_load, yaml.safe_dump)
    content = load(path.read_text())
    assert content.pop(VERSION) >= 1
    path.write_text(dump({**content, **({} if version is None else {VERSION: version})}))


@pytest.mark.parametrize("name", FILES)
def test_file_of_earlier_version_is_read(name: str, golden: Path) -> None:
    found = FILES[name].read(golden)
    assert found == EXPECTED.get(name, found)


@pytest.mark.parametrize("name", FILES)
def test_file_without_version_is_read_as_version_one(
    name: str, golden: Path, tmp_path: Path
) -> None:
    older = Path(shutil.copytree(golden, tmp_path / "older"))
    path = older / FILES[name].path
    change_version(path, None)
    if name == "environment":
        path.write_text(json.dumps(json.loads(path.read_text())["providers"]))
    assert FILES[name].read(older) == FILES[name].read(golden)


@pytest.mark.parametrize("name", FILES)
def test_file_of_later_version_is_refused_or_replaced(name: str, golden: Path) -> None:
    change_version(golden / FILES[name].path, 999)
    if FILES[name].rewritten is not None:
        assert FILES[name].read(golden) == FILES[name].rewritten
        return
    newer = r"is of format 999, written by a newer mpsfm-core"
    with pytest.raises(InputError, match=newer) as caught:
        FILES[name].read(golden)
    assert Path(FILES[name].path).name in str(caught.value)


def test_configuration_of_golden_file_is_unchanged(golden: Path) -> None:
    said = yaml.safe_load((golden / "config.yaml").read_text())
    assert said.pop(VERSION) == 1
    said.pop("description")
    assert configuration(golden) == said


CLASSES = {
    **{"features": Features, "matcher": PairMatches, "depth": DepthPrior, "normals": NormalPrior},
    **{"joint": JointPrior, "two-view": TwoViewGeometry, "mask": np.ndarray},
}


def test_cache_entries_of_golden_files_are_unchanged(golden: Path) -> None:
    """If this test fails, increase :data:`mpsfm_core.extraction.cache.FORMAT`."""
    written = json.loads((golden / "digests.json").read_text())
    cache = Cache(golden / "cache")
    assert {kind: digest(cache.load(kind, KEY, cls)) for kind, cls in CLASSES.items()} == written


def test_checkpoint_of_golden_file_is_unchanged(golden: Path) -> None:
    header, frozen = read_checkpoint(golden / "cache" / "mapping" / "checkpoint.npz")
    assert header["version"] in VERSIONS and header["registered"] == 2
    state = unflatten_state(frozen)
    assert np.array_equal(state["poses"][0]["rotation"], np.eye(3))
    assert state["poses"][0]["support"] == 0.5 and state["seen"] == {"a": [1, 2], "b": None}


def test_golden_files_of_current_version_exist() -> None:
    assert core_version() in VERSIONS, "python -m tests.golden.make writes them"


def declared() -> dict[str, int]:
    """Return the format version that each module declares, by module path."""
    found = {}
    for path in sorted((ROOT / "mpsfm_core").rglob("*.py")):
        if "templates" in path.parts:
            continue
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                name = node.targets[0].id
                if re.fullmatch(r"(DESCRIPTION_)?FORMAT|PROTOCOL|API_VERSION", name):
                    assert isinstance(node.value, ast.Constant)
                    found[path.relative_to(ROOT / "mpsfm_core").as_posix()] = node.value.value
    return found


def test_documentation_lists_every_format() -> None:
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\|[^|]*\| (\d+) \| `([\w/.]+)` \|", text, re.MULTILINE)
    assert {module: int(number) for number, module in rows} == declared()


@pytest.mark.parametrize("version", [0, -3, "two", None, [1], float("nan"), float("inf")])
def test_check_version_of_invalid_version_raises(version: object) -> None:
    with pytest.raises(InputError, match=r"x\.json: the key .* is .*, not a positive"):
        check_version({VERSION: version}, 1, Path("x.json"))


@pytest.mark.parametrize("name", ["../old.txt", "/etc/passwd", "..", "", "a/b", 1])
@pytest.mark.parametrize("key", ["entries", "new"])
def test_exchange_with_paths_outside_the_folder_raises(
    key: str, name: object, tmp_path: Path
) -> None:
    """Test a manipulated result folder that refers to files outside the folder."""
    output = tmp_path / "out"
    scratch = output / ".mpsfm-x"
    (scratch / "new").mkdir(parents=True)
    (scratch / "old").mkdir()
    (tmp_path / "old.txt").write_text("the user's own")
    plan = {"entries": [], "new": [], key: [name]}
    (scratch / "ready.json").write_text(json.dumps(plan))
    with pytest.raises(InputError, match=r"not written by mpsfm .*; remove .*mpsfm-x"):
        exchange_in(output)
    assert (tmp_path / "old.txt").is_file()


def test_exchange_of_linked_folder_raises(tmp_path: Path) -> None:
    output, photos = tmp_path / "out", tmp_path / "photos"
    (output / ".mpsfm-x").mkdir(parents=True)
    photos.mkdir()
    (photos / "a.png").touch()
    (output / ".mpsfm-x" / "new").symlink_to(photos)
    (output / ".mpsfm-x" / "ready.json").write_text('{"entries": [], "new": ["a.png"]}')
    with pytest.raises(InputError, match="symbolic link"):
        exchange_in(output)
    (output / ".mpsfm-x" / "ready.json").unlink()
    (output / ".mpsfm-y").symlink_to(photos)
    exchange_in(output)
    assert (photos / "a.png").is_file()


def exchange_in(output: Path) -> None:
    with lock_output_folder(output):
        pass
