"""Contract checks of plugin hooks, which run each hook of a plugin as a reconstruction does."""

from __future__ import annotations

import importlib.util
import io
import pickle
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing, redirect_stdout
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from mpsfm_core.data.decisions import ImageReason
from mpsfm_core.data.errors import InputError, MpsfmError, did_you_mean
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers import PROVIDER_KINDS, ExportFormat, ModelExport
from mpsfm_core.providers.registry import HOOK_TIMEOUT_S, Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_core.providers.validation import validate_filtered_pairs
from mpsfm_core.support.time_limit import time_limit
from mpsfm_core.testing.contract import CheckResult, Status, check_id
from mpsfm_core.testing.contract_case import load_setup
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

MAX_EVENT_S = 1.0
"""Time limit in seconds for a hook that receives an event. A reconstruction of 1 000 images reports
several thousand events, and waits for each hook."""
MAX_CHECK_S = 100.0
"""Time limit in seconds for one check of hooks, which interrupts viewers and executors that
block. The checks of the plugins in this repository take at most 10 s."""
MAX_FILTER_S = 10.0
"""Time limit in seconds to filter 5 000 image pairs."""
_PAIRS = [
    ("a.jpg", "b.jpg"),
    ("a.jpg", "left/a.jpg"),
    ("left/a.jpg", "right/a.jpg"),
    ("b.jpg", "right/München 1.JPG"),
]
"""Candidate pairs with equal file names in different folders, a space and an upper-case suffix."""
_RIGS = (("left", ""), ("right", ""), ("right", "b"))
"""Folders of images, and suffixes of their file names, which are equal for the first two."""
_KINDS_WITH_CALIBRATION = {
    "depth": DepthCalibration,
    "multiview": DepthCalibration,
    "normals": NormalCalibration,
}


@dataclass
class HookCase:
    """Hooks of the plugin under test, the argument of every contract check of hooks."""

    registry: Registry
    """Registry of all installed providers."""
    name: str
    """Name of the plugin's entry point."""
    hooks: Registry
    """Registry with the plugin under test only."""
    executor: str = ""
    """Value of ``runtime.executor`` that selects the executor of the plugin."""
    executor_options: Mapping[str, Any] = field(default_factory=dict)
    """Value of ``runtime.executor_options``."""

    def call(self, hook: str, **arguments: Any) -> Any:
        """Call a hook of the plugin, which has to print nothing on standard output.

        Raises:
            CheckSkipped: the plugin does not implement the hook.
            CheckFailed: the hook raises an exception, does not return, or prints on standard
                output.
        """
        caller = getattr(self.hooks.hook, hook)
        if not caller.get_hookimpls():
            raise CheckSkipped(f"the plugin does not implement {hook}")
        printed = io.StringIO()
        try:
            with redirect_stdout(printed), time_limit(HOOK_TIMEOUT_S, hook):
                answer = caller(**arguments)
        except TimeoutError as error:
            raise CheckFailed(str(error)) from error
        except ModuleNotFoundError as error:
            raise CheckFailed(f"{hook} needs {error.name!r}, which is not installed") from error
        except Exception as error:
            raise CheckFailed(f"{hook} raises {type(error).__name__}: {error}") from error
        if printed.getvalue():
            raise CheckFailed(f"{hook} prints {printed.getvalue()[:60]!r} on standard output")
        is_list = isinstance(answer, list) and not caller.spec.opts["firstresult"]
        return (answer[0] if answer else None) if is_list else answer


def check_hook_filter_pairs(case: HookCase) -> str:
    """Require that a pair filter returns a subset of its candidate pairs of image names.

    Images in different folders may have equal file names. The filter receives each pair once, in
    any order, and 5 000 pairs in the largest call.
    """
    before = pickle.dumps(_PAIRS)
    kept = _filter(case, _PAIRS)
    if pickle.dumps(_PAIRS) != before:
        raise CheckFailed("mpsfm_filter_pairs modifies its argument")
    if kept is None:
        _filter(case, [])
        return "the filter returns None, which keeps all pairs"
    if len({frozenset(pair) for pair in kept}) < len(kept):
        raise CheckFailed("mpsfm_filter_pairs returns a pair twice")
    turned = _filter(case, [(b, a) for a, b in reversed(_PAIRS)])
    if {frozenset(pair) for pair in turned or ()} != {frozenset(pair) for pair in kept}:
        raise CheckFailed("mpsfm_filter_pairs depends on the order of pairs or of their images")
    _require_equal_file_names(case)
    _filter(case, [])
    _filter(case, _PAIRS[:1])
    started = time.perf_counter()
    many = _filter(case, [(f"{number}.jpg", f"{number + 1}.jpg") for number in range(5000)])
    seconds = time.perf_counter() - started
    if not kept and not many and many is not None:
        raise CheckFailed(
            "cannot tell: mpsfm_filter_pairs selects none of 5 000 pairs; return None for all"
        )
    if seconds > MAX_FILTER_S:
        raise CheckFailed(f"mpsfm_filter_pairs takes {seconds:.0f} s for 5 000 pairs")
    return f"keeps {len(kept)} of {len(_PAIRS)} pairs; {seconds:.2f} s for 5 000 pairs"


def check_hook_events(case: HookCase) -> str:
    """Require that the event hooks accept all events of a small reconstruction.

    The reconstruction has four images, of which one is rejected. Each call of an event hook has to
    take less than 1 s, because the reconstruction waits for the hook.
    """
    hooks = _CountedHooks(case)
    if not hooks.event_hooks:
        raise CheckSkipped("the plugin implements no event hook")
    run_small_reconstruction(Stages(hooks))
    if hooks.slowest[1] > MAX_EVENT_S:
        raise CheckFailed(f"{hooks.slowest[0]} takes {hooks.slowest[1]:.1f} s for one event")
    return ", ".join(f"{count} {name}" for name, count in sorted(hooks.calls.items()))


def check_hook_viewers(case: HookCase) -> str:
    """Require that each viewer shows the scenes of a small reconstruction and an empty scene."""
    viewers = case.call("mpsfm_viewers")
    if not isinstance(viewers, Mapping) or not viewers:
        raise CheckFailed(f"mpsfm_viewers returns {viewers!r}, not viewer classes by name")
    texts = []
    for name, reference in viewers.items():
        with tempfile.TemporaryDirectory(prefix="mpsfm-viewer-") as folder:
            try:
                with time_limit(HOOK_TIMEOUT_S, "its constructor"):
                    viewer = resolve_name(reference)(Path(folder), lambda _: None)
                registry = Registry()
                if _has_hooks(viewer):
                    registry.register(viewer, name=name)
                viewed = HookCase(case.registry, name, registry)
                scenes = run_small_reconstruction(Stages(_CountedHooks(viewed)))
                for scene in scenes:
                    with time_limit(HOOK_TIMEOUT_S, "show()"):
                        viewer.show(scene)
                with time_limit(HOOK_TIMEOUT_S, "finish()"):
                    text = viewer.finish()
            except CheckFailed:
                raise
            except Exception as error:
                what = f"{type(error).__name__}: {error}"
                raise CheckFailed(f"viewer {name!r} ({reference}) raises {what}") from error
        if not isinstance(text, str):
            raise CheckFailed(f"finish() of viewer {name!r} returns no text, but {text!r}")
        texts.append(f"{name} shows {len(scenes)} scenes")
    return ", ".join(texts)


def check_hook_executor(case: HookCase) -> str:
    """Require that an executor runs each work item once in other processes and raises errors.

    The hook has to return None for the name of another executor. The name of the executor is the
    name of the plugin without ``mpsfm-``, or the argument ``executor`` of ``run_hook_checks``.
    """
    from mpsfm_core.testing import executor_contract

    if case.call("mpsfm_executor", name="another-executor", options={}) is not None:
        raise CheckFailed("mpsfm_executor returns an executor for the name 'another-executor'")
    name = case.executor or case.name.removeprefix("mpsfm-")
    executor = case.call("mpsfm_executor", name=name, options=dict(case.executor_options))
    if executor is None:
        raise CheckFailed(f"cannot tell: mpsfm_executor returns None for the name {name!r}")
    with closing(executor), tempfile.TemporaryDirectory(prefix="mpsfm-executor-") as folder:
        try:
            executor_contract.check_items(executor, Path(folder) / "items")
            executor_contract.check_errors(executor)
        except AssertionError as error:
            raise CheckFailed(f"executor {name!r}: {error}") from error
    return f"executor {name!r} runs 40 items in other processes"


def check_hook_calibration(case: HookCase) -> str:
    """Require None or an uncertainty model of the kind for each provider of the plugin.

    The hook has to return None for the providers of other plugins.
    """
    for kind in _KINDS_WITH_CALIBRATION:
        foreign = {"kind": kind, "provider": "provider-of-another-plugin", "options": None}
        if case.call("mpsfm_calibration", **foreign) is not None:
            raise CheckFailed(f"mpsfm_calibration returns a model for a foreign {kind} provider")
    models = 0
    for status in case.hooks.status():
        if status.kind not in PROVIDER_KINDS or not status.available:
            continue
        defaults = case.hooks.default_options(status.kind, status.name)
        values = {key: value for key, value in defaults.items() if value is not None}
        try:
            options = case.hooks.validate_options(status.kind, status.name, values)
        except MpsfmError:  # A required option has no default.
            with tempfile.TemporaryDirectory(prefix="mpsfm-calibration-") as folder:
                spec = case.hooks.spec(status.kind, status.name)
                values |= load_setup(spec, Path(folder)).options
                options = case.hooks.validate_options(status.kind, status.name, values)
        model = case.call(
            "mpsfm_calibration", kind=status.kind, provider=status.name, options=options
        )
        expected = _KINDS_WITH_CALIBRATION.get(status.kind, (DepthCalibration, NormalCalibration))
        if model is not None and not isinstance(model, expected):
            raise CheckFailed(
                f"mpsfm_calibration returns a {type(model).__name__} for the {status.kind} "
                f"provider {status.name!r}"
            )
        models += model is not None
    return f"{models} uncertainty models"


def check_hook_exports(case: HookCase) -> str:
    """Require that each recipe for an ONNX export names an existing module of the plugin."""
    exports = case.call("mpsfm_exports")
    if not isinstance(exports, Mapping):
        raise CheckFailed(f"mpsfm_exports returns {exports!r}, not recipes by name")
    for name, recipe in exports.items():
        if not isinstance(recipe, ModelExport):
            raise CheckFailed(f"mpsfm_exports: {name!r} is a {type(recipe).__name__}")
        if importlib.util.find_spec(recipe.script) is None:
            raise CheckFailed(f"mpsfm_exports: {name!r} names no module {recipe.script!r}")
    return f"{len(exports)} exports"


def check_hook_export_formats(case: HookCase) -> str:
    """Require that each export format names an existing function and the files that it writes.

    The function exports a small synthetic model. It may raise ``InputError`` for missing data.
    """
    formats = case.call("mpsfm_export_formats")
    if not isinstance(formats, Sequence) or isinstance(formats, str):
        raise CheckFailed(f"mpsfm_export_formats returns {formats!r}, not a list of formats")
    for entry in formats:
        if not isinstance(entry, ExportFormat):
            raise CheckFailed(f"mpsfm_export_formats lists a {type(entry).__name__}")
        try:
            write = resolve_name(entry.write) if isinstance(entry.write, str) else entry.write
        except (ImportError, AttributeError) as error:
            raise CheckFailed(f"export format {entry.name!r}: {error}") from error
        if not callable(write) or not entry.entries:
            raise CheckFailed(f"export format {entry.name!r} writes no file")
        _require_declared_entries(entry, write)
    return ", ".join(entry.name for entry in formats)


HOOK_CHECKS: tuple[Callable[[HookCase], str], ...] = (
    check_hook_filter_pairs,
    check_hook_events,
    check_hook_viewers,
    check_hook_executor,
    check_hook_calibration,
    check_hook_exports,
    check_hook_export_formats,
)
"""Contract checks of plugin hooks, in the order to run them."""

EVENT_HOOKS = (
    "mpsfm_notice",
    "mpsfm_stage_started",
    "mpsfm_stage_progress",
    "mpsfm_stage_finished",
    "mpsfm_image_registered",
    "mpsfm_image_rejected",
    "mpsfm_scene_changed",
)
"""Hooks that receive the events of a reconstruction."""


def run_hook_checks(
    registry: Registry,
    name: str,
    *,
    only: Collection[str] | None = None,
    executor: str = "",
    executor_options: Mapping[str, Any] | None = None,
    without: Collection[str] = (),
    on_start: Callable[[str, str, str], None] | None = None,
    on_result: Callable[[CheckResult], None] | None = None,
) -> list[CheckResult]:
    """Run the contract checks of the hooks that a plugin implements.

    Args:
        registry: Registry with the plugin.
        name: Name of the plugin's entry point or distribution.
        only: Ids of the contract checks to run, or None to run all.
        executor: Name of the plugin's executor, by default the name of the plugin.
        executor_options: Options of the executor.
        without: Plugins to leave out, as ``plugin/NAME``.
        on_start: Function that is called with the first three fields of the
            :class:`CheckResult` before each check.
        on_result: Function that is called with the result of each check.

    Returns:
        Results of the checks whose hooks the plugin implements.

    Raises:
        InputError: no plugin with hooks has the name.
    """
    results = []
    for plugin, module in find_hook_modules(registry, name).items():
        if f"plugin/{plugin}" in without:
            continue
        hooks = Registry()
        hooks.register(module, name=plugin)
        case = HookCase(registry, plugin, hooks, executor, executor_options or {})
        for check in HOOK_CHECKS:
            id = check_id(check)
            if only is not None and id not in only:
                continue
            if on_start:
                on_start(f"plugin/{plugin}", "", id)
            started = time.perf_counter()
            status: Status = "pass"
            try:
                with time_limit(MAX_CHECK_S, f"the plugin {plugin!r}"):
                    message = check(case)
            except CheckSkipped:
                continue
            except (CheckFailed, MpsfmError, TimeoutError) as error:
                status, message = "fail", str(error)
            seconds = time.perf_counter() - started
            results.append(CheckResult(f"plugin/{plugin}", "", id, status, message, seconds))
            if on_result:
                on_result(results[-1])
    return results


def find_hook_modules(registry: Registry, name: str) -> dict[str, object]:
    """Find the modules of the plugins that an entry point or distribution name denotes.

    Returns:
        Module of each plugin with hooks, apart from ``mpsfm_providers``, by entry-point name.

    Raises:
        InputError: no plugin with hooks has the name.
    """
    modules = registry.hook_modules()
    found = {
        plugin: module
        for (distribution, plugin), module in modules.items()
        if name in (distribution, plugin) and _has_hooks(module)
    }
    if not found:
        known = {part for key in modules for part in key}
        raise InputError(f"no plugin with hooks {name!r}{did_you_mean(name, known)}")
    return found


def has_hooks(registry: Registry, name: str) -> bool:
    """Return whether an entry point or distribution has a plugin with hooks."""
    modules = registry.hook_modules().items()
    return any(name in key and _has_hooks(module) for key, module in modules)


def run_small_reconstruction(stages: Stages) -> list[Any]:
    """Reconstruct four synthetic images, and report the events of a run.

    Args:
        stages: Receiver of the events.

    Returns:
        An empty scene, and the scene after each change.
    """
    from mpsfm_core.data import PinholeCamera, SceneState
    from mpsfm_core.mapping import mapper
    from mpsfm_core.mapping.options import MapperOptions
    from mpsfm_core.testing.synthetic.problems import make_mapping_problem
    from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

    camera = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)
    problem = make_mapping_problem(
        room_scene(), camera, arc_poses(3, 10.0), points_per_view=80, map_width=40
    )
    scenes = [SceneState((), problem.images[0].keypoints[:0, [0, 0, 0]])]
    changed = stages.scene_changed

    def record(scene: Callable[[], SceneState]) -> None:
        scenes.append(scene())
        changed(scene)

    stages.scene_changed = record  # type: ignore[method-assign]
    stages.notice("reconstruction of a small synthetic scene")
    changed(lambda: scenes[0])
    with stages.stage("mapping"), stages.step("mapping", None):
        mapper.reconstruct(problem, MapperOptions(), stages)
        stages.stage_progress("mapping", 3, 4)
        stages.image_rejected("right/München 1.JPG", ImageReason.NO_VERIFIED_MATCHES.because())
    return scenes


def _require_equal_file_names(case: HookCase) -> None:
    """Require that the filter does not take images in two folders for one image."""
    names = [[f"{folder}/{number}{suffix}.jpg" for number in (1, 2, 3)] for folder, suffix in _RIGS]
    counts = []
    for right in (names[1], names[2]):
        pairs = [pair for images in (names[0], right) for pair in combinations(images, 2)]
        pairs += list(zip(names[0], right, strict=True))
        counts.append(len(_filter(case, pairs) or pairs))
    if counts[0] < counts[1]:
        raise CheckFailed(
            f"mpsfm_filter_pairs keeps {counts[0]} pairs of images in two folders with equal file "
            f"names, and {counts[1]} with different file names"
        )


class _CountedHooks(Registry):
    """Registry of one plugin, which raises exceptions of hooks and measures their time."""

    def __init__(self, case: HookCase) -> None:
        super().__init__()
        self._case = case
        self.calls: Counter[str] = Counter()
        self.slowest = ("", 0.0)
        relay = case.hooks.hook
        self.event_hooks = {name for name in EVENT_HOOKS if getattr(relay, name).get_hookimpls()}

    def call_hook(self, name: str, /, **arguments: Any) -> list[Any]:
        """Call a hook of the plugin under test."""
        if name not in self.event_hooks:
            return []
        started = time.perf_counter()
        answer = self._case.call(name, **arguments)
        seconds = time.perf_counter() - started
        self.calls[name] += 1
        self.slowest = max(self.slowest, (name, seconds), key=lambda entry: entry[1])
        return [answer]


def _require_declared_entries(entry: ExportFormat, write: Callable[..., None]) -> None:
    """Require that an export of a small model writes the declared files and no others."""
    import pycolmap  # The import is local, because pytest loads this module when it collects tests.

    from mpsfm_core.results.exports.source import ExportSource

    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 50
    model = pycolmap.synthesize_dataset(options)
    with tempfile.TemporaryDirectory(prefix="mpsfm-export-") as folder:
        sparse, output = Path(folder, "sparse"), Path(folder, "export")
        sparse.mkdir()
        output.mkdir()
        model.write(str(sparse))
        try:
            write(ExportSource.read(sparse), output)
        except InputError:
            return
        except Exception as error:
            what = f"{type(error).__name__}: {error}"
            raise CheckFailed(f"export format {entry.name!r} raises {what}") from error
        written = {path.name for path in output.iterdir()}
    if not written or not written <= set(entry.entries):
        raise CheckFailed(
            f"export format {entry.name!r} writes {sorted(written)}, and declares "
            f"{sorted(entry.entries)}"
        )


def _filter(case: HookCase, pairs: list[tuple[str, str]]) -> list[tuple[str, str]] | None:
    answer = case.call("mpsfm_filter_pairs", pairs=pairs)
    try:
        kept = None if answer is None else validate_filtered_pairs(answer, pairs)[0]
    except (TypeError, ValueError) as error:
        raise CheckFailed(f"mpsfm_filter_pairs: {error}") from error
    candidates = {frozenset(pair) for pair in pairs}
    foreign = [pair for pair in kept or () if frozenset(pair) not in candidates]
    if foreign:
        raise CheckFailed(f"mpsfm_filter_pairs returns {foreign[0]!r}, which is no candidate")
    return kept


def _has_hooks(module: object) -> bool:
    """Return whether a plugin module or viewer implements a hook other than mpsfm_providers."""
    names = (name for name in dir(module) if name.startswith("mpsfm_"))
    return any(
        name != "mpsfm_providers" and hasattr(getattr(module, name), "mpsfm_impl") for name in names
    )
