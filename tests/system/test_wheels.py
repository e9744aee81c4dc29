"""Test of the wheels of all packages in an environment without the source tree."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

from mpsfm_core.providers.registry import Registry

ROOT = Path(__file__).resolve().parents[2]
PLUGINS = sorted(path.parent for path in (ROOT / "plugins").glob("*/pyproject.toml"))
NOT_PACKED = shutil.ignore_patterns("__pycache__", "build", "*.egg-info", "tests", "training")
CORE = ("mpsfm_core", "configs", "examples/sample_scene", "setup.py", "pyproject.toml")
CORE += ("README.md", "LICENSE", "mpsfm_pytest.py")
PIP = (sys.executable, "-m", "pip", "--quiet")


def run(*command: object, folder: Path) -> str:
    ended = subprocess.run([str(c) for c in command], cwd=folder, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout[-2000:] + ended.stderr[-2000:]
    return ended.stdout


def build(folder: Path) -> dict[str, Path]:
    """Build the wheel of each package from a copy of its source; return wheels by name."""
    sources = {path.name: folder / path.name for path in (*PLUGINS, ROOT / "meta")}
    for path in (*PLUGINS, ROOT / "meta"):
        shutil.copytree(path, sources[path.name], ignore=NOT_PACKED)
    core = folder / "core"
    for name in CORE:
        (core / name).parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, core / name)
    wheel = (*PIP, "wheel", "--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir")
    run(*wheel, folder / "wheels", core, *sources.values(), folder=folder)
    for source in (core, *sources.values()):
        shutil.rmtree(source)
    wheels = (folder / "wheels").glob("*.whl")
    return {path.name.split("-")[0].replace("_", "-"): path for path in wheels}


def install(wheels: dict[str, Path], folder: Path) -> Path:
    """Create an environment with the wheels and the installed dependencies; return its scripts."""
    venv.create(folder)
    names = {"base": str(folder), "platbase": str(folder)}
    scripts = Path(sysconfig.get_path("scripts", vars=names))
    into = (*PIP, "--python", scripts / "python", "install", "--no-deps", "--no-index")
    run(*into, *wheels.values(), folder=folder)
    others = folder / "others"
    others.mkdir()
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if not re.match(r"mpsfm|__editable__|__pycache__|.*\.pth$", entry.name):
            (others / entry.name).symlink_to(entry)
    Path(sysconfig.get_path("purelib", vars=names), "others.pth").write_text(f"{others}\n")
    return scripts


def check_metadata(wheels: dict[str, Path], folder: Path) -> None:
    """Check the wheels with twine and check-wheel-contents, if they are installed."""
    if importlib.util.find_spec("twine") is not None:
        run(sys.executable, "-m", "twine", "check", "--strict", *wheels.values(), folder=folder)
    if importlib.util.find_spec("check_wheel_contents") is not None:
        for name, wheel in wheels.items():
            source = ROOT if name == "mpsfm-core" else ROOT / "plugins" / name
            config = (ROOT / "meta" if name == "mpsfm" else source) / "pyproject.toml"
            run(
                sys.executable,
                "-m",
                "check_wheel_contents",
                "--config",
                config,
                wheel,
                folder=folder,
            )


@pytest.mark.slow
def test_wheels_of_all_packages_run_the_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPSFM_CACHE", str(tmp_path / "cache"))
    wheels = build(tmp_path)
    assert set(wheels) == {"mpsfm", "mpsfm-core", *(path.name for path in PLUGINS)}
    for folder in PLUGINS:
        package = folder / folder.name.replace("-", "_")
        packed = set(zipfile.ZipFile(wheels[folder.name]).namelist())
        files = [path for path in package.rglob("*") if path.is_file()]
        names = {path.relative_to(folder).as_posix() for path in files}
        assert {name for name in names if "__pycache__" not in name} <= packed, folder.name
        assert f"{package.name}/py.typed" in packed, folder.name
    for name, wheel in wheels.items():
        archive = zipfile.ZipFile(wheel)
        packed = set(archive.namelist())
        assert any(entry.endswith(".dist-info/licenses/LICENSE") for entry in packed), name
        metadata = next(entry for entry in packed if entry.endswith(".dist-info/METADATA"))
        # A package index cannot show files of the repository.
        links = re.findall(r"\]\((?!https?:)[^)]*\)", archive.read(metadata).decode())
        assert links == [], name
    core = zipfile.ZipFile(wheels["mpsfm-core"]).namelist()
    assert "mpsfm_core/py.typed" in core
    check_metadata(wheels, tmp_path)
    assert [name for name in core if "make_scene" in name] == []

    scripts = install(wheels, tmp_path / "environment")
    code = "import mpsfm_core; print(mpsfm_core.__file__)"
    resolve = (*PIP, "--python", scripts / "python", "install", "--no-index", "--find-links")
    run(*resolve, wheels["mpsfm"].parent, "mpsfm[torch]", folder=tmp_path)
    file = run(scripts / "python", "-c", code, folder=tmp_path).strip()
    assert file.startswith(str(tmp_path / "environment"))
    listed = json.loads(run(scripts / "mpsfm", "plugins", "list", "--json", folder=tmp_path))
    assert {line["distribution"] for line in listed} == set(wheels) - {"mpsfm"}
    usable = {(line["kind"], line["name"]): line["available"] for line in listed}
    here = Registry.discover().status()
    assert usable == {(line.kind, line.name): line.available for line in here}
    said = run(scripts / "mpsfm", "demo", "--offline", "--output", "out", folder=tmp_path)
    assert "8 of 8 images" in said and "pose AUC" in said
