"""Tests that exported functions pass valid arguments on, and are documented with an example."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer.main

import mpsfm_core
from mpsfm_core.cli import build_app
from mpsfm_core.cli import demo as demo_module
from mpsfm_core.cli import reconstruct as reconstruct_module
from mpsfm_core.cli import work_folder as work_folder_module

ROOT = Path(__file__).parents[2]
EXPORTED = {name: getattr(mpsfm_core, name) for name in mpsfm_core.__all__}
FUNCTIONS = {name: value for name, value in EXPORTED.items() if inspect.isfunction(value)}
PROGRESS = "on_event"
MODULES_WITH_DOCTESTS = (
    "mpsfm_core.data.features",
    "mpsfm_core.data.mapping_problem",
    "mpsfm_core.data.priors",
    "mpsfm_core.data.rigs",
    "mpsfm_core.providers.provider_config",
    "mpsfm_core.providers.protocols",
)


def calls(function: Any, names: dict[str, Any]) -> Iterator[tuple[ast.Call, Any]]:
    """Yield the calls in a function whose target is a name or dotted name of the module."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            target: Any = names.get(ast.unparse(node.func).split(".")[0])
            for attribute in ast.unparse(node.func).split(".")[1:]:
                target = getattr(target, attribute, None)
            if inspect.isfunction(target) or inspect.isclass(target):
                yield node, target


def misfit(node: ast.Call, target: Any) -> str:
    """Return the arguments of a call that its target does not accept, or an empty string."""
    try:
        parameters = inspect.signature(target).parameters.values()
    except (TypeError, ValueError):  # a class of a C extension
        return ""
    named = {p.name for p in parameters if p.kind is not p.VAR_KEYWORD}
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return ""
    return ", ".join(k.arg for k in node.keywords if k.arg is not None and k.arg not in named)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_exported_function_passes_only_known_arguments(name: str) -> None:
    function = FUNCTIONS[name]
    checked = 0
    for node, target in calls(function, vars(inspect.getmodule(function))):
        assert not misfit(node, target), f"{name}: {ast.unparse(node)}"
        checked += 1
    assert checked or name in ("hookimpl", "calibrate")


@pytest.mark.parametrize("module", [reconstruct_module, work_folder_module, demo_module])
def test_commands_pass_arguments_of_reconstruct(module: ModuleType) -> None:
    """Command functions pass ``**arguments`` to other functions, which mypy cannot check."""
    known = {*inspect.signature(mpsfm_core.reconstruct).parameters, "viewer", "quiet"}
    tree = ast.parse(inspect.getsource(module))
    passed = [
        keyword.arg
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "run"
        for keyword in node.keywords
    ]
    assert passed and {name for name in passed if name is not None} <= known


def test_command_reconstruct_offers_the_files_of_the_function() -> None:
    command = typer.main.get_command(build_app()).commands["reconstruct"]  # type: ignore[attr-defined]
    options = {parameter.name for parameter in command.params}
    files = {"images", "output", "config", "intrinsics", "image_list", "poses", "database", "hloc"}
    assert files | {"fresh", "overrides"} <= options


@pytest.mark.parametrize("name", FUNCTIONS)
def test_arguments_are_documented(name: str) -> None:
    documentation = inspect.getdoc(FUNCTIONS[name]) or ""
    for parameter in inspect.signature(FUNCTIONS[name]).parameters:
        assert re.search(rf"^ {{4}}{parameter}: ", documentation, re.MULTILINE), parameter


def test_stages_report_progress() -> None:
    stages = ("load_images", "extract_features", "match_images", "predict_priors", "run_mapper")
    for name in (*stages, "densify", "reconstruct"):
        assert PROGRESS in inspect.signature(FUNCTIONS[name]).parameters, name


@pytest.mark.parametrize("module", MODULES_WITH_DOCTESTS)
def test_examples_of_classes_run(module: str) -> None:
    tested = doctest.testmod(importlib.import_module(module))
    assert tested.attempted and not tested.failed


def code_run_by_tests() -> str:
    """Return the code of notebooks and of the pages whose snippets are run as tests."""
    pages = ("docs/library.md", "docs/coming-from.md", "docs/tutorial-plugin.md", "CONTRIBUTING.md")
    texts = [(ROOT / page).read_text(encoding="utf-8") for page in pages]
    parts = re.findall(r"^```python\n(.*?)^```", "\n".join(texts), re.MULTILINE | re.DOTALL)
    for notebook in (ROOT / "examples").glob("*.ipynb"):
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        parts += ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    return "\n".join(parts)


@pytest.mark.parametrize("name", sorted(EXPORTED.keys() - {"__version__"}))
def test_exported_name_has_an_example_that_tests_run(name: str) -> None:
    documentation = inspect.getdoc(EXPORTED[name]) or ""
    assert documentation
    has_doctest = getattr(EXPORTED[name], "__module__", "") in MODULES_WITH_DOCTESTS
    is_run = has_doctest and ">>>" in documentation
    assert is_run or re.search(rf"\b{name}\b", code_run_by_tests()), name


@pytest.mark.parametrize("name", FUNCTIONS)
def test_examples_of_functions_pass_known_arguments(name: str) -> None:
    documentation = inspect.getdoc(FUNCTIONS[name]) or ""
    for example in doctest.DocTestParser().get_examples(documentation):
        for node in ast.walk(ast.parse(example.source)):
            if isinstance(node, ast.Call):
                target = EXPORTED.get(ast.unparse(node.func).removeprefix("mpsfm."))
                assert target is None or not misfit(node, target), example.source
