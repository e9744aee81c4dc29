"""Tests that the contract checks of hooks pass correct hooks and name each fault."""

from __future__ import annotations

import importlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mpsfm_core import Options
from mpsfm_core.data.errors import InputError
from mpsfm_core.providers import ExportFormat, ProviderSpec, hookimpl
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import CheckResult, ContractSetup, hook_checks
from mpsfm_core.testing.hook_checks import run_hook_checks
from mpsfm_core.testing.scaffold import write_plugin
from tests.support.reference_providers import PaintedDepth


def check(**hooks: Any) -> list[CheckResult]:
    """Run the contract checks of a plugin with the given hook functions."""
    plugin = type("Hooks", (), {name: staticmethod(hookimpl(f)) for name, f in hooks.items()})
    registry = Registry()
    registry.register(plugin, name="wrong", distribution="mpsfm-wrong")
    return run_hook_checks(registry, "wrong")


@pytest.fixture
def template(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    write_plugin("brand-new-hook", "hook", tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path / "brand-new-hook"))
    registry = Registry()
    module = importlib.import_module("brand_new_hook.plugin")
    registry.register(module, name="brand-new-hook", distribution="brand-new-hook")
    yield registry
    for name in [name for name in sys.modules if name.startswith("brand_new_hook")]:
        sys.modules.pop(name)


@pytest.mark.usefixtures("no_mapper")
def test_hooks_of_template_pass(template: Registry) -> None:
    results = run_hook_checks(template, "brand-new-hook")
    assert [(r.id, r.status) for r in results] == [
        ("hook-filter-pairs", "pass"),
        ("hook-events", "pass"),
    ]
    assert results[0].message.startswith("keeps 1 of 4 pairs")


def names(pair: Any) -> Any:
    """Return the file names of a pair without their folders, and the pair if they are equal."""
    files = frozenset(Path(name).name for name in pair)
    return files if len(files) == 2 else frozenset(pair)


@pytest.mark.parametrize(
    ("filter_pairs", "message"),
    [
        (lambda pairs: list(range(len(pairs))), "must return pairs of image names, got 0"),
        (lambda pairs: [(0, 1)], "must return pairs of image names, got (0, 1)"),
        (
            lambda pairs: [(Path(a).stem, Path(b).stem) for a, b in pairs],
            "returns no candidate pair, for example ('a', 'b')",
        ),
        (
            lambda pairs: [(a, Path(b).name) for a, b in pairs],
            "which is no candidate",
        ),
        (lambda pairs: [(a, b) for a, b in pairs if a < b], "depends on the order"),
        (lambda pairs: list(pairs) if pairs[0] else [], "raises IndexError"),
        (
            lambda pairs: [p for i, p in enumerate(pairs) if names(p) not in map(names, pairs[:i])],
            "in two folders with equal file names",
        ),
        (lambda pairs: [*pairs, *pairs], "returns a pair twice"),
        (lambda pairs: pairs.sort(reverse=True), "modifies its argument"),
        (lambda pairs: sys.stdout.write("filtered") and pairs, "prints 'filtered"),
        (lambda pairs: [], "selects none of 5 000 pairs"),
        (lambda pairs: dict(pairs), "must return pairs of image names, got 'left/a.jpg'"),
    ],
)
def test_check_names_fault_of_pair_filter(filter_pairs: Any, message: str) -> None:
    def mpsfm_filter_pairs(pairs: Any) -> Any:
        return filter_pairs(pairs)

    (result,) = check(mpsfm_filter_pairs=mpsfm_filter_pairs)
    assert (result.id, result.status) == ("hook-filter-pairs", "fail")
    assert message in result.message


def started(stage: str, total: int | None) -> None:
    float(total)  # type: ignore[arg-type]


def rejected(name: str, reason: Any, text: str) -> None:
    text.encode("ascii")
    name.encode("ascii")


def changed(scene: Any) -> None:
    scene().images[0]


@pytest.fixture
def no_mapper(monkeypatch: pytest.MonkeyPatch) -> None:
    """Report the events of a run without mapping, which takes seconds."""
    monkeypatch.setattr("mpsfm_core.mapping.mapper.reconstruct", lambda *arguments: None)


@pytest.mark.usefixtures("no_mapper")
@pytest.mark.parametrize(
    ("hooks", "message"),
    [
        ({"mpsfm_stage_started": started}, "mpsfm_stage_started raises TypeError"),
        ({"mpsfm_image_rejected": rejected}, "mpsfm_image_rejected raises UnicodeEncodeError"),
        ({"mpsfm_scene_changed": changed}, "mpsfm_scene_changed raises IndexError"),
        (
            {"mpsfm_notice": lambda text: sys.stdout.write(text)},
            "mpsfm_notice prints 'reconstruction of a small synthetic scene",
        ),
    ],
)
def test_check_names_fault_of_event_hook(hooks: dict[str, Any], message: str) -> None:
    (result,) = check(**hooks)
    assert (result.id, result.status) == ("hook-events", "fail")
    assert message in result.message


@pytest.mark.usefixtures("no_mapper")
def test_slow_event_hook_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hook_checks, "MAX_EVENT_S", -1.0)
    (result,) = check(mpsfm_notice=lambda text: None)
    assert result.status == "fail" and "mpsfm_notice takes" in result.message


@pytest.mark.usefixtures("no_mapper")
def test_blocking_event_hook_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hook_checks, "HOOK_TIMEOUT_S", 0.05)
    (result,) = check(mpsfm_notice=lambda text: threading.Event().wait())
    assert result.status == "fail" and "mpsfm_notice does not return" in result.message


class FileOptions(Options):
    weights: str


class GoodViewer:
    def __init__(self, output: Path, pictures: Any) -> None:
        assert pictures("no such image") is None

    def show(self, scene: Any, cloud: Any = None) -> None: ...

    def finish(self) -> str:
        return "finished"


class ViewerWithoutText(GoodViewer):
    def finish(self) -> str:
        return None  # type: ignore[return-value]


class ViewerThatWaits(GoodViewer):
    def finish(self) -> str:
        threading.Event().wait()
        return "closed"


class ViewerOfFirstImage(GoodViewer):
    def show(self, scene: Any, cloud: Any = None) -> None:
        scene.images[0]


@pytest.mark.usefixtures("no_mapper")
@pytest.mark.parametrize(
    ("name", "status", "message"),
    [
        ("GoodViewer", "pass", "good shows 1 scenes"),
        ("ViewerWithoutText", "fail", "returns no text, but None"),
        ("ViewerOfFirstImage", "fail", "raises IndexError"),
        ("ViewerThatWaits", "fail", "finish() does not return within 0.2 s"),
        ("NoViewer", "fail", "raises AttributeError"),
    ],
)
def test_viewers(name: str, status: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hook_checks, "HOOK_TIMEOUT_S", 0.2)
    (result,) = check(mpsfm_viewers=lambda: {"good": f"{__name__}:{name}"})
    assert (result.id, result.status) == ("hook-viewers", status)
    assert message in result.message


def test_executor_for_every_name_fails() -> None:
    (result,) = check(mpsfm_executor=lambda name, options: object())
    assert "for the name 'another-executor'" in result.message
    (result,) = check(mpsfm_executor=lambda name, options: None)
    assert "cannot tell: mpsfm_executor returns None for the name 'wrong'" in result.message


def test_calibration_of_foreign_provider_fails() -> None:
    from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

    def providers() -> list[ProviderSpec]:
        return [ProviderSpec("depth", "mine", PaintedDepth, FileOptions, contract=setup)]

    def setup(folder: Path) -> ContractSetup:
        return ContractSetup(options={"weights": str(folder / "tiny.npz")})

    (result,) = check(mpsfm_calibration=lambda kind, provider, options: DepthCalibration())
    assert "returns a model for a foreign depth provider" in result.message
    (result,) = check(
        mpsfm_providers=providers,
        mpsfm_calibration=lambda provider: NormalCalibration() if provider == "mine" else None,
    )
    assert "returns a NormalCalibration for the depth provider 'mine'" in result.message


def test_exports_name_existing_modules() -> None:
    (result,) = check(mpsfm_exports=lambda: {"net": "no_such_module"})
    assert "'net' is a str" in result.message


def test_export_of_undeclared_files_fails() -> None:
    def write(source: Any, folder: Path) -> None:
        (folder / source.model.cameras[1].model.name).touch()

    formats = [ExportFormat("mine", "Text for tests.", ("cameras.txt",), write)]
    (result,) = check(mpsfm_export_formats=lambda: formats)
    assert result.status == "fail" and "and declares ['cameras.txt']" in result.message


def test_plugin_without_hooks_is_an_error() -> None:
    with pytest.raises(InputError, match="no plugin with hooks 'wrong'"):
        run_hook_checks(Registry(), "wrong")


@pytest.mark.slow
def test_small_reconstruction_reports_all_events() -> None:
    seen: dict[str, Any] = {}
    (result,) = check(
        mpsfm_image_registered=lambda name, registered, total: seen.update(total=total),
        mpsfm_scene_changed=lambda scene: seen.update(points=len(scene().points)),
    )
    assert result.status == "pass", result.message
    assert seen["total"] == 3 and seen["points"] > 50
