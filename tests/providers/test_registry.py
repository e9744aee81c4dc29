"""Tests of the registry: isolated discovery, unique names, and error messages with the next
step."""

from __future__ import annotations

import dataclasses
import json
import logging
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core import (
    DepthPrior,
    Options,
    PinholeCamera,
    ProviderContext,
    ProviderSpec,
    View,
    hookimpl,
)
from mpsfm_core.data.errors import InputError, ProviderError, WeightsError
from mpsfm_core.data.options import SettingsError
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import CORE, ProviderStatus, Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

InstallPlugin = Callable[..., str]

HEALTHY = """
    from mpsfm_core import ProviderSpec, hookimpl

    class Flat:
        def __init__(self, options, context):
            self.options = options
        def predict(self, view):
            raise NotImplementedError

    @hookimpl
    def mpsfm_providers():
        return [ProviderSpec("depth", "{name}", __name__ + ":Flat")]
"""


def rows(registry: Registry, distribution: str) -> list[ProviderStatus]:
    return [line for line in registry.status() if line.distribution == distribution]


def only(registry: Registry, distribution: str) -> ProviderStatus:
    (line,) = rows(registry, distribution)
    return line


@pytest.fixture
def context() -> ProviderContext:
    def no_weights(uri: str, sha256: str | None) -> Path:
        raise WeightsError(f"no {uri}")

    return ProviderContext(no_weights)


@pytest.fixture
def view() -> View:
    image = np.zeros((4, 6, 3), np.uint8)
    return View("a.jpg", image, PinholeCamera(6, 4, 5.0, 5.0, 3.0, 2.0))


class FlatOptions(Options):
    depth: float = 1.0
    weights: str = ""


class Flat:
    def __init__(self, options: FlatOptions, context: ProviderContext) -> None:
        self.value = options.depth
        if options.weights:
            context.resolve_weights(options.weights, None)

    def predict(self, view: View) -> DepthPrior:
        return DepthPrior.from_arrays(np.full((2, 2), self.value))


class Doubling:
    def __init__(self, inner: Any, options: None, context: ProviderContext) -> None:
        self.inner = inner

    def predict(self, view: View) -> DepthPrior:
        return DepthPrior.from_arrays(2 * self.inner.predict(view).depth)


class Adding(Doubling):
    def predict(self, view: View) -> DepthPrior:
        return DepthPrior.from_arrays(1 + self.inner.predict(view).depth)


FLAT = ProviderSpec("depth", "flat", Flat, FlatOptions)
DOUBLING = ProviderSpec("wrapper", "doubling", Doubling, capabilities=frozenset({"wraps-depth"}))


class TestDiscovery:
    def test_finds_an_installed_plugin(
        self, install_plugin: InstallPlugin, context: ProviderContext
    ) -> None:
        install_plugin("mpsfm-tiny", HEALTHY.format(name="tiny"), version="2.5")
        registry = Registry.discover()
        line = only(registry, "mpsfm-tiny")
        assert (line.kind, line.name, line.version) == ("depth", "tiny", "2.5")
        assert line.available
        assert registry.create("depth", "tiny", None, context).predict
        assert registry.version("depth", "tiny") == "mpsfm-tiny 2.5"

    @pytest.mark.parametrize(
        ("source", "reason"),
        [
            ("import module_that_nobody_has", "No module named 'module_that_nobody_has'"),
            ("raise RuntimeError('no licence server')", "RuntimeError: no licence server"),
            ("import sys; sys.exit('bye')", "SystemExit: bye"),
            ("x = 1", "without any mpsfm hook"),
            ("def broken(:", "SyntaxError"),
            (
                "from mpsfm_core import hookimpl\n"
                "@hookimpl\n"
                "def mpsfm_providers():\n    raise ValueError('half written')",
                "ValueError: half written",
            ),
            (
                "from mpsfm_core import hookimpl\n@hookimpl\ndef mpsfm_providers():\n    return 42",
                "returned int, not a list",
            ),
            (
                "from mpsfm_core import hookimpl\n"
                "@hookimpl\ndef mpsfm_providers():\n    return ['depth']",
                "lists a str among its providers",
            ),
            (
                "from mpsfm_core import hookimpl\n"
                "@hookimpl\ndef mpsfm_stage_started(stage, nonsense): ...",
                "nonsense",
            ),
        ],
    )
    def test_broken_plugin_is_listed_and_others_work(
        self, install_plugin: InstallPlugin, source: str, reason: str
    ) -> None:
        install_plugin("mpsfm-broken", source)
        install_plugin("mpsfm-tiny", HEALTHY.format(name="tiny"))
        registry = Registry.discover()
        line = only(registry, "mpsfm-broken")
        assert not line.available
        assert reason in line.reason
        assert line.kind == "plugin"
        assert only(registry, "mpsfm-tiny").available
        with pytest.raises(ProviderError, match="did not load: mpsfm-broken"):
            registry.spec("depth", "something-of-broken")

    def test_missing_module_shows_install_hint(self, install_plugin: InstallPlugin) -> None:
        install_plugin("mpsfm-broken", "import module_that_nobody_has")
        hint = only(Registry.discover(), "mpsfm-broken").install_hint
        assert "module_that_nobody_has" in hint

    def test_hanging_plugin_is_skipped(
        self, install_plugin: InstallPlugin, caplog: pytest.LogCaptureFixture
    ) -> None:
        install_plugin("mpsfm-hanging", "import threading\nthreading.Event().wait(6)")
        install_plugin("mpsfm-tiny", HEALTHY.format(name="tiny"))
        started = time.monotonic()
        registry = Registry.discover(timeout_s=1.5)
        assert time.monotonic() - started < 5
        line = only(registry, "mpsfm-hanging")
        assert line.reason == "did not load within 1.5 s"
        assert "mpsfm-hanging" in caplog.text
        assert only(registry, "mpsfm-tiny").available

    def test_time_limit_of_discovery_is_an_option(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("MPSFM_PLUGIN_TIMEOUT_S", "soon")
        with pytest.raises(InputError, match="MPSFM_PLUGIN_TIMEOUT_S='soon'"):
            Registry.discover()

    def test_invalid_entry_point_is_listed_with_reason(self, install_plugin: InstallPlugin) -> None:
        install_plugin("mpsfm-odd", "", entry_points="[mpsfm.plugins]\nodd = not a module!\n")
        assert not only(Registry.discover(), "mpsfm-odd").available

    def test_one_module_under_two_entry_points(self, install_plugin: InstallPlugin) -> None:
        module = "mpsfm_twice_plugin"
        install_plugin(
            "mpsfm-twice",
            HEALTHY.format(name="tiny"),
            entry_points=f"[mpsfm.plugins]\na = {module}\nb = {module}\n",
        )
        first, second = rows(Registry.discover(), "mpsfm-twice")
        assert first.available and first.name == "tiny"
        assert "second entry point" in second.reason and second.name == "b"

    def test_repeated_name_of_one_plugin_keeps_the_first(
        self, install_plugin: InstallPlugin
    ) -> None:
        source = """
            from mpsfm_core import ProviderSpec, hookimpl
            @hookimpl
            def mpsfm_providers():
                return [ProviderSpec("depth", "tiny", "a:A"), ProviderSpec("depth", "tiny", "a:B")]
        """
        install_plugin("mpsfm-twice", source)
        registry = Registry.discover()
        assert [line.available for line in rows(registry, "mpsfm-twice")] == [True, False]
        assert registry.spec("depth", "tiny").factory == "a:A"

    def test_one_name_from_two_distributions(self, install_plugin: InstallPlugin) -> None:
        install_plugin("mpsfm-one", HEALTHY.format(name="tiny"))
        install_plugin("mpsfm-two", HEALTHY.format(name="tiny"))
        registry = Registry.discover()
        assert not only(registry, "mpsfm-one").available
        assert not only(registry, "mpsfm-two").available
        with pytest.raises(ProviderError, match="mpsfm-one and mpsfm-two"):
            registry.spec("depth", "tiny")

    def test_hooks_without_providers_are_listed(self, install_plugin: InstallPlugin) -> None:
        source = """
            from mpsfm_core import hookimpl
            @hookimpl
            def mpsfm_filter_pairs(pairs):
                return [p for p in pairs if "bad" not in p]
        """
        install_plugin("mpsfm-filter", source)
        registry = Registry.discover()
        line = only(registry, "mpsfm-filter")
        assert line.available and line.capabilities == ("filter_pairs",)
        assert [("a", "b")] in registry.call_hook(
            "mpsfm_filter_pairs", pairs=[("a", "b"), ("a", "bad")]
        )

    @pytest.mark.parametrize(
        ("answer", "message"),
        [
            ("[0, 2]", "must return pairs of image names, got 0"),
            ("[(0, 1)]", "must return pairs of image names, got (0, 1)"),
            ("[('a', 'b')]", "returns no candidate pair, for example ('a', 'b')"),
            ("7", "must return pairs of image names, got int"),
        ],
    )
    def test_pair_filter_with_invalid_answer_is_skipped_and_named(
        self,
        answer: str,
        message: str,
        install_plugin: InstallPlugin,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        source = f"""
            from mpsfm_core import hookimpl
            @hookimpl
            def mpsfm_filter_pairs(pairs):
                return {answer}
        """
        install_plugin("mpsfm-filter", source)
        registry = Registry.discover()
        assert registry.call_hook("mpsfm_filter_pairs", pairs=[("a.jpg", "b.jpg")]) == []
        assert "mpsfm-filter" in caplog.text and message in caplog.text

    def test_pair_filter_may_return_no_pairs_or_a_generator(
        self, install_plugin: InstallPlugin
    ) -> None:
        source = """
            from mpsfm_core import hookimpl
            @hookimpl
            def mpsfm_filter_pairs(pairs):
                return ((b, a) for a, b in pairs if "bad" not in b)
        """
        install_plugin("mpsfm-filter", source)
        registry = Registry.discover()
        assert registry.call_hook("mpsfm_filter_pairs", pairs=[("a", "b")]) == [[("b", "a")]]
        assert registry.call_hook("mpsfm_filter_pairs", pairs=[("a", "bad")]) == [[]]

    def test_unknown_hook_is_reported_and_providers_stay(
        self, install_plugin: InstallPlugin
    ) -> None:
        extra = "    @hookimpl\n    def mpsfm_stage_startd(stage): ...\n"
        install_plugin("mpsfm-typo", HEALTHY.format(name="tiny") + extra)
        provider, plugin = rows(Registry.discover(), "mpsfm-typo")
        assert provider.available
        assert "did you mean 'mpsfm_stage_started'" in plugin.reason

    def test_status_is_plain_data(self, install_plugin: InstallPlugin) -> None:
        install_plugin("mpsfm-tiny", HEALTHY.format(name="tiny"))
        install_plugin("mpsfm-broken", "x = 1")
        assert json.loads(json.dumps([dataclasses.asdict(s) for s in Registry.discover().status()]))


class TestSpecifications:
    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            ({"api_version": 99}, "plugin API 99"),
            ({"requires": ("json", "no_such_module.part")}, "needs no_such_module.part"),
            ({"kind": "dept"}, "did you mean 'depth'"),
            ({"name": "Flat Depth"}, "lower-case"),
            ({"name": None}, "lower-case"),
            ({"factory": "no colon"}, "package.module:Class"),
            ({"factory": None}, "package.module:Class"),
            ({"options": dict}, "subclass of Options"),
            ({"contract": "no colon"}, "package.module:function"),
            ({"capabilities": frozenset({"metrics"})}, "did you mean 'metric'"),
            ({"capabilities": "metric"}, "capabilities must be"),
            ({"requires": 3}, "not iterable"),
        ],
    )
    def test_faulty_provider_is_listed_and_raises_on_selection(
        self, change: dict[str, Any], reason: str
    ) -> None:
        spec = dataclasses.replace(FLAT, **change)
        registry = Registry()
        registry.add(spec, DOUBLING, distribution="mpsfm-faulty", version="3")
        faulty = next(line for line in registry.status() if not line.available)
        assert reason in faulty.reason
        assert registry.spec("wrapper", "doubling") is DOUBLING
        with pytest.raises(ProviderError, match="mpsfm-faulty 3") as caught:
            registry.spec(spec.kind, spec.name)
        assert reason in str(caught.value)

    def test_missing_requirement_shows_the_plugin_hint(self) -> None:
        registry = Registry()
        hint = "pip install 'mpsfm-x[gpu]'"
        registry.add(dataclasses.replace(FLAT, requires=("no_such_module",), install_hint=hint))
        with pytest.raises(ProviderError, match=r"mpsfm-x\[gpu\]"):
            registry.spec("depth", "flat")
        assert registry.names("depth") == []

    def test_faulty_provider_does_not_take_a_used_name(self) -> None:
        registry = Registry()
        registry.add(FLAT, distribution="mpsfm-good")
        registry.add(dataclasses.replace(FLAT, api_version=99), distribution="mpsfm-newer")
        assert registry.version("depth", "flat").startswith("mpsfm-good")

    def test_nobody_takes_a_name_from_the_core(self) -> None:
        registry = Registry()
        registry.add(FLAT, distribution=CORE)
        registry.add(FLAT, distribution="mpsfm-greedy")
        assert registry.version("depth", "flat").startswith(CORE)
        assert "belongs to mpsfm-core" in only(registry, "mpsfm-greedy").reason

    def test_distribution_prefix_resolves_equal_names(self) -> None:
        registry = Registry()
        for name in ("mpsfm-a", "mpsfm-b"):
            registry.add(FLAT, distribution=name)
        with pytest.raises(ProviderError, match="choose 'mpsfm-a:flat' or 'mpsfm-b:flat'"):
            registry.spec("depth", "flat")
        assert registry.version("depth", "mpsfm-b:flat").startswith("mpsfm-b")
        config = ProviderConfig(use="mpsfm-b:flat")
        assert registry.calibration("depth", config) == DepthCalibration()
        with pytest.raises(ProviderError, match=r"did you mean 'mpsfm-.:flat'"):
            registry.spec("depth", "mpsfm-c:flat")

    def test_unknown_names_are_answered_with_the_nearest(self) -> None:
        registry = Registry()
        registry.add(FLAT, DOUBLING)
        with pytest.raises(ProviderError, match="did you mean 'flat'"):
            registry.spec("depth", "flatt")
        with pytest.raises(ProviderError, match="'doubling' is of kind wrapper"):
            registry.spec("depth", "doubling")
        with pytest.raises(ProviderError, match="pip install 'mpsfm-kornia"):
            registry.spec("features", "xfeat")

    def test_registering_a_broken_plugin_of_this_process_raises(self) -> None:
        with pytest.raises(ProviderError, match="without any mpsfm hook"):
            Registry().register(object())

    def test_a_plugin_of_this_process_registers_once(self) -> None:
        class Listener:
            @hookimpl
            def mpsfm_stage_started(self, stage: str) -> None: ...

        registry = Registry()
        registry.register(Listener(), name="viewer")
        with pytest.raises(ProviderError, match="'viewer' is registered already"):
            registry.register(Listener(), name="viewer")


class TestOptions:
    def test_defaults_are_filled_in(self) -> None:
        registry = Registry()
        registry.add(FLAT, DOUBLING)
        assert registry.validate_options("depth", "flat") == FlatOptions(depth=1.0)
        assert registry.validate_options("wrapper", "doubling") is None

    def test_errors_give_path_and_nearest_key(self) -> None:
        registry = Registry()
        registry.add(FLAT, DOUBLING)
        with pytest.raises(SettingsError, match=r"depth\.options\.dept: unknown key; did you mean"):
            registry.validate_options("depth", "flat", {"dept": 2}, ("depth", "options"))
        with pytest.raises(SettingsError, match=r"options.depth: .*number.* \(got 'far'\)"):
            registry.validate_options("depth", "flat", {"depth": "far"})
        with pytest.raises(SettingsError, match=r"options\.x: unknown key"):
            registry.validate_options("wrapper", "doubling", {"x": 1})

    def test_an_options_class_by_name(self, install_plugin: InstallPlugin) -> None:
        install_plugin(
            "mpsfm-lazy", "from mpsfm_core import Options\nclass Lazy(Options):\n    a: int = 3"
        )
        registry = Registry()
        registry.add(ProviderSpec("depth", "lazy", Flat, "mpsfm_lazy_plugin:Lazy"))
        options = registry.validate_options("depth", "lazy")
        assert options is not None and options.model_dump() == {"a": 3}


class TestCreate:
    def test_wrappers_apply_from_the_inside(self, context: ProviderContext, view: View) -> None:
        registry = Registry()
        adding = dataclasses.replace(DOUBLING, name="adding", factory=Adding)
        registry.add(FLAT, DOUBLING, adding)
        wrap = [ProviderConfig(use="doubling"), ProviderConfig(use="adding")]
        provider = registry.create("depth", "flat", {"depth": 5}, context, wrap)
        assert provider.predict(view).depth[0, 0] == 11

    def test_options_may_be_ready_made(self, context: ProviderContext, view: View) -> None:
        registry = Registry()
        registry.add(FLAT)
        provider = registry.create("depth", "flat", FlatOptions(depth=4), context)
        assert provider.predict(view).depth[0, 0] == 4

    @pytest.mark.parametrize(
        ("factory", "message"),
        [
            ("no_such_package.model:Depth", "cannot be imported from .*No module named"),
            ("json:Depth", "cannot be imported .*Depth"),
            ("sys:exit", "could not be constructed: TypeError"),
            (lambda options, context: 1 / 0, "could not be constructed: ZeroDivisionError"),
            (lambda options, context: exit(), "could not be constructed: SystemExit"),
            (lambda options, context: object(), r"without the method predict\(\)"),
        ],
    )
    def test_failures_name_the_provider(
        self, factory: Any, message: str, context: ProviderContext
    ) -> None:
        registry = Registry()
        spec = ProviderSpec("depth", "bad", factory, install_hint="pip install bad")
        registry.add(spec, distribution="mpsfm-bad", version="7")
        with pytest.raises(ProviderError, match=message) as caught:
            registry.create("depth", "bad", None, context)
        assert "depth provider 'bad' (mpsfm-bad 7)" in str(caught.value)

    def test_our_errors_pass_unchanged(self, context: ProviderContext) -> None:
        registry = Registry()
        registry.add(FLAT)
        with pytest.raises(WeightsError, match=r"no model\.onnx"):
            registry.create("depth", "flat", {"weights": "model.onnx"}, context)

    def test_capabilities_ask_for_their_method(self, context: ProviderContext) -> None:
        registry = Registry()
        registry.add(dataclasses.replace(FLAT, capabilities=frozenset({"joint-normals"})))
        with pytest.raises(ProviderError, match="predict_joint"):
            registry.create("depth", "flat", None, context)

    def test_a_wrapper_of_another_kind(self, context: ProviderContext) -> None:
        registry = Registry()
        wraps_normals = frozenset({"wraps-normals"})
        registry.add(FLAT, dataclasses.replace(DOUBLING, capabilities=wraps_normals))
        with pytest.raises(ProviderError, match="does not wrap depth"):
            registry.create("depth", "flat", None, context, [ProviderConfig(use="doubling")])


class TestHooks:
    def test_failing_event_listener_is_removed(self, caplog: pytest.LogCaptureFixture) -> None:
        heard: list[str] = []

        class Broken:
            calls = 0

            @hookimpl
            def mpsfm_stage_started(self, stage: str) -> None:
                Broken.calls += 1
                raise RuntimeError("window closed")

        class Listener:
            @hookimpl
            def mpsfm_stage_started(self, stage: str, total: int | None) -> None:
                heard.append(f"{stage} {total}")

        registry = Registry()
        registry.register(Broken(), name="viewer")
        registry.register(Listener(), name="log")
        with caplog.at_level(logging.WARNING):
            for total in (1, 2):
                registry.call_hook("mpsfm_stage_started", stage="mapping", total=total)
        assert heard == ["mapping 1", "mapping 2"]
        assert Broken.calls == 1
        assert caplog.text.count("window closed") == 1
        assert "viewer" in caplog.text

    @pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs SIGALRM")
    def test_blocking_event_listener_is_removed_and_named(
        self, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        class Blocking:
            @hookimpl
            def mpsfm_scene_changed(self) -> None:
                threading.Event().wait()

        monkeypatch.setattr("mpsfm_core.providers.registry.HOOK_TIMEOUT_S", 0.05)
        registry = Registry()
        registry.register(Blocking(), name="viewer")
        for _ in range(2):
            registry.call_hook("mpsfm_scene_changed", scene=None)
        assert "viewer" in caplog.text
        assert caplog.text.count("mpsfm_scene_changed does not return within 0.05 s") == 1

    def test_calibration_prefers_config_then_wrapper_then_hook_then_spec(self) -> None:
        declared = DepthCalibration(relative_std=0.1)

        class Knows:
            @hookimpl
            def mpsfm_calibration(self, kind: str, options: Any) -> DepthCalibration | None:
                known = kind == "depth" and options.depth == 2
                return DepthCalibration(relative_std=0.2) if known else None

        registry = Registry()
        registry.add(dataclasses.replace(FLAT, calibration=declared))
        outer = DepthCalibration(relative_std=0.3)
        registry.add(dataclasses.replace(DOUBLING, calibration=outer))
        registry.register(Knows(), name="knows")

        def relative_std(**settings: Any) -> float:
            calibration = registry.calibration("depth", ProviderConfig(use="flat", **settings))
            assert isinstance(calibration, DepthCalibration)
            return calibration.relative_std

        assert relative_std() == 0.1
        assert relative_std(wrap=(ProviderConfig(use="doubling"),)) == 0.3
        assert relative_std(options={"depth": 2}) == 0.2
        assert relative_std(options={"depth": 2}, wrap=(ProviderConfig(use="doubling"),)) == 0.3
        assert relative_std(options={"depth": 2}, calibration={"relative_std": 0.5}) == 0.5

    def test_calibration_of_normals_has_a_default(self) -> None:
        registry = Registry()
        registry.add(ProviderSpec("normals", "plain", Flat))
        assert registry.calibration("normals", ProviderConfig(use="plain")) == NormalCalibration()
