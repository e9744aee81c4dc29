"""Tests that ``mpsfm plugins new`` writes packages that pass the contract."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.config import load_config
from mpsfm_core.providers import KINDS, Kind
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import run_checks
from mpsfm_core.testing.scaffold import write_plugin

ROOT = Path(__file__).resolve().parents[2]


def mpsfm(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(build_app(), [str(a) for a in arguments])
    return result.exit_code, result.output


@pytest.fixture
def written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[Kind], tuple[Registry, Path]]]:
    """Write a plugin ``brand-new-KIND`` and register it together with all installed plugins."""

    def write(kind: Kind) -> tuple[Registry, Path]:
        name = f"brand-new-{kind}"
        files = write_plugin(name, kind, tmp_path)
        assert all(path.exists() for path in files)
        monkeypatch.syspath_prepend(str(tmp_path / name))
        registry = Registry.discover()
        registry.register(importlib.import_module(f"{name.replace('-', '_')}.plugin"))
        return registry, tmp_path / name

    yield write
    for module in [name for name in sys.modules if name.startswith("brand_new_")]:
        sys.modules.pop(module)


@pytest.mark.parametrize("kind", KINDS)
def test_new_plugin_passes_its_contract(
    kind: Kind, written: Callable[[Kind], tuple[Registry, Path]]
) -> None:
    registry, folder = written(kind)
    results = run_checks(registry, kind, f"brand-new-{kind}")
    assert {r.id: r.message for r in results if r.status not in ("pass", "skip")} == {}
    assert "ground truth is unknown" not in "".join(r.message for r in results)
    assert f"mpsfm plugins check brand-new-{kind}" in (folder / "README.md").read_text()


@pytest.mark.parametrize("kind", KINDS)
def test_its_readme_shows_a_configuration_that_loads(
    kind: Kind, written: Callable[[Kind], tuple[Registry, Path]]
) -> None:
    registry, folder = written(kind)
    block = (folder / "README.md").read_text().split("```yaml\n")[1].split("```")[0]
    assert f"brand-new-{kind}" in block
    shown = yaml.safe_load(block)
    assert shown.pop("extends") == "fast-cpu"
    registered = {(s.kind, s.name) for s in registry.status() if s.available}
    if not {("features", "xfeat"), ("depth", "onnx")} <= registered:
        pytest.skip("the first-party plugins that it extends are not installed")
    path = folder / "config.yaml"
    path.write_text(block)
    load_config(path, registry=registry, complete=False)


def test_depth_plugin_has_less_than_50_lines(tmp_path: Path) -> None:
    files = [path for path in write_plugin("brand-new", "depth", tmp_path) if path.suffix == ".py"]
    lines = [line for path in files for line in path.read_text().splitlines() if line.strip()]
    assert 20 < len(lines) < 50


def test_the_command(tmp_path: Path) -> None:
    code, output = mpsfm("plugins", "new", "brand-new", "--kind", "mask", "--output", tmp_path)
    assert code == 0
    assert str(tmp_path / "brand-new" / "brand_new" / "model.py") in output
    assert "mpsfm plugins check brand-new" in output.splitlines()[-1]
    code, output = mpsfm("plugins", "new", "brand-new", "--kind", "mask", "--output", tmp_path)
    assert (code, "exists already" in output) == (2, True)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("My_Depth", "lower-case letters"),
        ("class", "lower-case letters"),
        ("numpy", "a module 'numpy' exists"),
    ],
)
def test_names_that_are_no_good(name: str, message: str, tmp_path: Path) -> None:
    code, output = mpsfm("plugins", "new", name, "--kind", "depth", "--output", tmp_path)
    assert code == 2
    assert message in " ".join(output.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_installed_it_is_checked_by_name_and_by_its_own_tests(tmp_path: Path) -> None:
    """Check the path from the command to the tests of the installed package, without network."""
    write_plugin("brand-new-depth", "depth", tmp_path)
    site = tmp_path / "site"
    install = ("install", "--no-deps", "--no-index", "--no-build-isolation", "--quiet")
    folder = tmp_path / "brand-new-depth"
    run([sys.executable, "-m", "pip", *install, "--target", site, folder], tmp_path)
    path = os.pathsep.join(map(str, (site, ROOT, *sys.path)))
    mpsfm_command = [sys.executable, "-m", "mpsfm_core"]
    checked = run([*mpsfm_command, "plugins", "check", "brand-new-depth"], tmp_path, path)
    assert "pass  depth/brand-new-depth: light-import" in checked
    assert "fail" not in checked
    tested = run([sys.executable, "-m", "pytest", "-q", folder / "tests"], folder, path)
    assert "passed" in tested.splitlines()[-1]


def run(command: list[object], folder: Path, path: str = "") -> str:
    environment = {**os.environ, "PYTHONPATH": path} if path else dict(os.environ)
    ended = subprocess.run(
        list(map(str, command)), cwd=folder, env=environment, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout
