"""Tests of the documentation: commands and links are valid, and pages load nothing external."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import pycolmap
import pytest
import typer.main

import mpsfm_core
from mpsfm_core import load_config
from mpsfm_core.cli import build_app
from mpsfm_core.providers.kinds import PROVIDER_KINDS
from mpsfm_core.providers.protocols import Hooks
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES_WITH_CODE = [*PAGES, ROOT / "CONTRIBUTING.md"]


def commands_of(page: Path) -> list[str]:
    """Return the mpsfm commands in the shell blocks of a page."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(?:sh|bash|console)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip().startswith("mpsfm ")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_valid(page: Path) -> None:
    for line in commands_of(page):
        if "..." in line:
            continue
        node, arguments = typer.main.get_command(build_app()), shlex.split(line, comments=True)[1:]
        while hasattr(node, "commands"):
            assert arguments[0] in node.commands, line
            node = node.commands[arguments.pop(0)]
        node.make_context("mpsfm", arguments)


def blocks_of(page: Path, language: str) -> list[str]:
    """Return the code blocks of a language in a page."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_configurations_are_valid(page: Path, tmp_path: Path) -> None:
    for number, block in enumerate(blocks_of(page, "yaml")):
        if block.startswith("extends:"):
            file = tmp_path / f"{number}.yaml"
            file.write_text(block)
            load_config(file)


@pytest.mark.parametrize("page", PAGES_WITH_CODE, ids=lambda page: page.name)
def test_python_blocks_use_existing_names(page: Path) -> None:
    for block in blocks_of(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mpsfm_core"):
                module = importlib.import_module(str(node.module))
                for alias in node.names:
                    assert hasattr(module, alias.name), f"{node.module}.{alias.name}"
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "mpsfm_core":
                assert hasattr(mpsfm_core, node.attr), node.attr


def test_every_picture_is_shown() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for picture in (ROOT / "docs" / "pictures").iterdir():
        assert f"pictures/{picture.name}" in pages, picture.name
        assert picture.stat().st_size < 200_000, picture.name


def test_the_first_pages_have_commands() -> None:
    assert len(commands_of(ROOT / "docs" / "first-run.md")) >= 3
    assert len(commands_of(ROOT / "README.md")) >= 3


@pytest.mark.slow
def test_first_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the commands of the first-run page and of two how-tos on three photos."""
    monkeypatch.setenv("MPSFM_OFFLINE", "1")
    monkeypatch.setenv("MPSFM_CACHE", str(tmp_path / "cache"))
    (tmp_path / "photos").mkdir()
    video = cv2.VideoWriter(
        str(tmp_path / "room.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10, (640, 480)
    )
    for number in range(3):
        photo = ROOT / "examples" / "sample_scene" / "images" / f"view_{number}.jpg"
        shutil.copy(photo, tmp_path / "photos")
        video.write(cv2.imread(str(photo)))
    video.release()
    further = re.compile(r"mpsfm (export|mesh) out/")
    commands = commands_of(ROOT / "docs" / "first-run.md")
    commands += filter(further.match, commands_of(ROOT / "docs" / "how-to.md"))
    run = [sys.executable, "-m", "mpsfm_core"]
    for line in commands:
        if not line.startswith("mpsfm demo"):
            arguments = shlex.split(line, comments=True)[1:]
            ended = subprocess.run([*run, *arguments], cwd=tmp_path, capture_output=True, text=True)
            assert ended.returncode == 0, f"{line}\n{ended.stderr[-2000:]}"
    assert {path.name for path in (tmp_path / "out" / "exports").iterdir()} >= {"gsplat", "rerun"}
    assert (tmp_path / "out" / "mesh.glb").is_file()


def test_site_builds_and_loads_nothing_external(tmp_path: Path) -> None:
    for module in ("mkdocs", "material", "mkdocstrings"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed: pip install 'mpsfm-core[docs]'")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    assert (tmp_path / "pictures" / "report.jpg").is_file()
    reference = (tmp_path / "reference.html").read_text(encoding="utf-8")
    assert 'id="mpsfm_core.data.DepthPrior"' in reference
    for picture in tmp_path.rglob("*.svg"):
        assert "url(http" not in picture.read_text().replace('"', ""), picture.name
    for page in tmp_path.glob("*.html"):
        fetched = re.findall(
            r"<(?:script|img|link)[^>]*(?:src|href)=\"(https?://[^\"]*)", page.read_text()
        )
        assert fetched == [], page.name


@pytest.mark.slow
@pytest.mark.parametrize("page", ["library.md", "coming-from.md"])
def test_python_snippets_run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the Python blocks of a page in order, with the arrays that the page assumes."""
    monkeypatch.setenv("MPSFM_OFFLINE", "1")
    monkeypatch.setenv("MPSFM_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for number in range(3):
        photo = ROOT / "examples" / "sample_scene" / "images" / f"view_{number}.jpg"
        shutil.copy(photo, tmp_path / "photos")
    pycolmap.set_random_seed(0)
    pycolmap.extract_features("database.db", "photos/", device=pycolmap.Device.cpu)
    pycolmap.match_exhaustive("database.db", device=pycolmap.Device.cpu)
    names = arrays_of_caller()
    for block in blocks_of(ROOT / "docs" / page, "python"):
        exec(compile(block, page, "exec"), names)
    assert names["result"].reconstructions if page == "library.md" else names["result"].model


def arrays_of_caller() -> dict[str, object]:
    """Return keypoints, matches, depth and poses of three views, under the names of library.md."""
    camera = mpsfm_core.PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
    poses = arc_poses(3, 10.0)
    problem = make_mapping_problem(room_scene(), camera, poses, points_per_view=200)
    pairs = {(pair.image_a, pair.image_b): pair.matches for pair in problem.pairs}
    names: dict[str, object] = {"camera": camera, "model": None}
    names |= {"matches_ab": pairs[0, 1], "matches_bc": pairs[1, 2]}
    for letter, image, pose in zip("abc", problem.images, poses, strict=True):
        names[f"xy_{letter}"], names[f"pose_{letter}"] = image.keypoints, pose
        names[f"depth_{letter}"], names[f"var_{letter}"] = image.depth.depth, image.depth.variance
    return names


def test_arrays_without_files_take_at_most_20_lines() -> None:
    block = blocks_of(ROOT / "docs" / "library.md", "python")[2]
    assert len(block.splitlines()) <= 20
    names = arrays_of_caller()
    exec(compile(block, "library.md", "exec"), names)
    assert names["model"].num_reg_images() == 3  # type: ignore[attr-defined]


def test_plugin_page_names_all_kinds_and_hooks() -> None:
    page = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    hooks = [name for name in vars(Hooks) if name.startswith("mpsfm_")]
    assert [name for name in [*PROVIDER_KINDS, *hooks] if f"`{name}" not in page] == []
