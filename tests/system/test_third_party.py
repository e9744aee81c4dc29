"""Tests of the plugin tutorial and of its example package."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from mpsfm_core.testing.contract import check_id, list_checks
from mpsfm_core.testing.hook_checks import HOOK_CHECKS

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "third-party-depth"
SCENE = ROOT / "examples" / "sample_scene"
TUTORIAL = ROOT / "docs" / "tutorial-plugin.md"


def test_tutorial_contains_files_of_example() -> None:
    pattern = r"`([\w./]+\.(?:py|yaml))`:\n\n```\w+\n(.*?)```"
    shown = dict(re.findall(pattern, TUTORIAL.read_text(encoding="utf-8"), re.DOTALL))
    assert len(shown) == 5
    for name, text in shown.items():
        assert text == (EXAMPLE / name).read_text(encoding="utf-8"), name
    changes = re.findall(r"```toml\n(.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL)
    project = (EXAMPLE / "pyproject.toml").read_text(encoding="utf-8")
    assert len(changes) == 2 and all(change in project for change in changes)


def test_every_contract_check_is_documented() -> None:
    document = (ROOT / "docs" / "contract.md").read_text(encoding="utf-8")
    shown = dict(re.findall(r"^\| `([a-z-]+)` \| (.*) \|$", document, re.MULTILINE))
    checks = [*list_checks(), *HOOK_CHECKS]
    for check in checks:
        text = " ".join((inspect.getdoc(check) or "").replace("``", "`").split())
        assert shown[check_id(check)] == text, f"docs/contract.md: | `{check_id(check)}` | {text} |"
    assert f"by {len(checks)} small functions" in document


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """Install the example plugin; return the environment variables that make it importable."""
    site = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source")
    for path in (p for p in EXAMPLE.rglob("*") if p.is_file() and "__pycache__" not in p.parts):
        copy = source / path.relative_to(EXAMPLE)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())  # building creates folders in the source tree
    options = ("--no-deps", "--no-index", "--no-build-isolation", "--quiet")
    run([sys.executable, "-m", "pip", "install", *options, "--target", site, source], os.environ)
    path = os.pathsep.join(map(str, (site, ROOT, *sys.path)))
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@pytest.mark.slow
def test_example_plugin_passes_contract(installed: Mapping[str, str], tmp_path: Path) -> None:
    tests = EXAMPLE / "tests"
    printed = run([sys.executable, "-m", "pytest", "-q", "--rootdir", tests, tests], installed)
    assert " passed" in printed and "failed" not in printed


@pytest.mark.slow
def test_example_plugin_is_trained_as_documented(
    installed: Mapping[str, str], tmp_path: Path
) -> None:
    weights = tmp_path / "room.npz"
    printed = run([sys.executable, EXAMPLE / "train.py", SCENE, weights], installed)
    errors = [float(line.rsplit(":", 1)[1]) for line in printed.splitlines()]
    assert errors == pytest.approx([0.111, 0.068], abs=0.003)
    assert weights.stat().st_size < 30_000


@pytest.mark.slow
def test_example_plugin_reconstructs(installed: Mapping[str, str], tmp_path: Path) -> None:
    """The last step of the tutorial reaches the stated pose AUC of 67, 93 and 98 %, and 0.5 cm."""
    mpsfm = [sys.executable, "-m", "mpsfm_core"]
    cameras = ("--intrinsics", SCENE / "intrinsics.yaml", "--config", EXAMPLE / "config.yaml")
    cache = ("--set", f"runtime.cache_dir={tmp_path / 'cache'}", "--set", "runtime.workers=1")
    output = tmp_path / "out"
    reconstruct = ("reconstruct", SCENE / "images", *cameras, *cache, "--output", output, "-q")
    run([*mpsfm, *reconstruct], installed)
    report = json.loads(run([*mpsfm, "evaluate", output, SCENE / "gt"], installed))
    assert report["registered"] == 8
    assert report["auc"]["1"] > 50 and report["auc"]["5"] > 88
    assert report["trajectory"]["ate_median"] < 0.01
    assert abs(report["trajectory"]["scale"] - 1) < 0.02
    summary = json.loads((output / "summary.json").read_text())
    (depth,) = [p for p in summary["providers"] if p["kind"] == "depth"]
    assert (depth["name"], depth["from"]) == ("ridge-depth", "ridge-depth 0.1.0")


def run(command: list[object], environment: Mapping[str, str]) -> str:
    ended = subprocess.run(
        list(map(str, command)), env=dict(environment), capture_output=True, text=True, timeout=300
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout
