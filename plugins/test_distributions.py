"""Tests of the packaging of all plugins in this repository."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

PLUGINS = sorted(path.parent for path in Path(__file__).parent.glob("*/pyproject.toml"))
DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "rerun": "rerun-sdk"}
"""Name of a distribution by its import name, where both names differ."""
WITH_THE_CORE = {"mpsfm_core", "pydantic"}
"""Packages that plugins may import without declaring them, because the core requires them."""
WITHOUT_THEIR_DEPENDENCIES = {"depth_anything_3", "vismatch"}
"""Packages with conflicting dependencies, which plugins do not declare.
The ``install_hint`` of a provider specification has the command that installs these packages.
"""
FOR_TESTS_ONLY = ("contract.py", "stand_in.py")
BESIDE_THE_AUTHORS_CODE = ("export.py", "export_moge.py", "export_unidepth.py")
"""Model export scripts, which import the authors' code and its packages."""
HEAVY = {"viser", "rerun", "torch", "transformers", "onnxruntime", "kornia", "cv2", "scipy", "onnx"}

each_plugin = pytest.mark.parametrize("folder", PLUGINS, ids=lambda folder: folder.name)


def project_of(folder: Path) -> dict[str, Any]:
    with (folder / "pyproject.toml").open("rb") as file:
        project: dict[str, Any] = tomllib.load(file)["project"]
    return project


def package_of(folder: Path) -> Path:
    return folder / folder.name.replace("-", "_")


def imports_of(module: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.split(".")[0]


@each_plugin
def test_project_metadata_is_complete(folder: Path) -> None:
    project = project_of(folder)
    assert project["name"] == folder.name
    assert project["license"] == "Apache-2.0"
    assert project["entry-points"]["mpsfm.plugins"]
    for dependency in project["dependencies"]:
        assert re.fullmatch(r"[a-z0-9-]+>=[0-9.]+", dependency), "a lower bound and no other"
    assert any(dependency.startswith("mpsfm-core>=") for dependency in project["dependencies"])


@each_plugin
def test_imports_are_declared(folder: Path) -> None:
    project, package = project_of(folder), package_of(folder)
    tests = project.get("optional-dependencies", {}).get("test", [])
    for module in package.rglob("*.py"):
        if module.name in BESIDE_THE_AUTHORS_CODE:
            continue
        known = [*project["dependencies"], *(tests if module.name in FOR_TESTS_ONLY else [])]
        declared = {re.split(r"[<>=]", dependency)[0] for dependency in known}
        known_names = WITH_THE_CORE | WITHOUT_THEIR_DEPENDENCIES | {package.name}
        for name in set(imports_of(module)) - known_names:
            wanted = DISTRIBUTIONS.get(name, name.replace("_", "-"))
            assert name in sys.stdlib_module_names or wanted in declared, f"{module.name}: {name}"


@each_plugin
def test_registration_imports_nothing_heavy(folder: Path) -> None:
    modules = list(project_of(folder)["entry-points"]["mpsfm.plugins"].values())
    code = (
        f"import importlib, sys; [importlib.import_module(name) for name in {modules!r}]; "
        f"sys.exit(', '.join({HEAVY!r} & set(sys.modules)) or None)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@each_plugin
def test_readme_has_the_required_sections(folder: Path) -> None:
    text = (folder / "README.md").read_text(encoding="utf-8")
    assert text.startswith(f"# {folder.name}\n")
    assert f"pip install {folder.name}" in text or f"pip install '{folder.name}" in text
    sections = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert sections[:3] == ["Provides", "Install", "Use"]
    assert sections[-1] == "License"
    assert "```yaml" in text or "export " in text
    overview = folder.parents[1] / "README.md"
    assert f"[{folder.name}](plugins/{folder.name})" in overview.read_text(encoding="utf-8")


def test_meta_distribution_names_every_plugin() -> None:
    meta = project_of(PLUGINS[0].parents[1] / "meta")
    extras = meta["optional-dependencies"]
    names = {re.split(r"[<>=]", requirement)[0] for requirement in extras["all"]}
    assert names == {folder.name for folder in PLUGINS}
    for requirement in (*meta["dependencies"], *extras["torch"], *extras["viewers"]):
        assert re.split(r"[<>=]", requirement)[0] in names | {"mpsfm-core"}
    versions = {project_of(folder)["version"] for folder in PLUGINS}
    core = project_of(PLUGINS[0].parents[1])["version"]
    assert versions | {meta["version"]} == {core}, "one version"
