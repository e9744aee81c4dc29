"""Tests of ``mpsfm plugins``, ``mpsfm config`` and exit codes of commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
import yaml
from typer.testing import CliRunner

import mpsfm_core
from mpsfm_core.cli import build_app
from mpsfm_core.data.errors import ConfigError, ReconstructionError

HEAVY = ("torch", "onnxruntime", "kornia", "cv2", "numba", "pycolmap", "scipy")


def mpsfm(*arguments: str) -> tuple[int, str, str]:
    """Run a command in this process; return exit code, stdout and stderr."""
    result = CliRunner().invoke(build_app(), arguments)
    return result.exit_code, result.stdout, result.stderr


def test_plugins_list_imports_nothing_heavy(install_plugin: Callable[..., str]) -> None:
    source = """
        from mpsfm_core import ProviderSpec, hookimpl
        @hookimpl
        def mpsfm_providers():
            return [ProviderSpec("depth", "needy", "torch:nn", requires=("torch", "no_such_pkg"))]
    """
    install_plugin("mpsfm-needy", source)
    script = (
        "import dataclasses, json, sys; from mpsfm_core import Registry\n"
        "print(json.dumps(list(map(dataclasses.asdict, Registry.discover().status()))))\n"
        f"print(*[name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    )
    paths = [str(Path(mpsfm_core.__file__).parents[1]), *sys.path]
    run = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stderr.strip() == ""
    (line,) = [p for p in json.loads(run.stdout) if p["distribution"] == "mpsfm-needy"]
    assert line["available"] is False
    assert "no_such_pkg" in line["reason"]


def test_plugins_list_json_equals_table(install_plugin: Callable[..., str]) -> None:
    source = """
        from mpsfm_core import ProviderSpec, hookimpl
        @hookimpl
        def mpsfm_providers():
            return [ProviderSpec("depth", "tiny", "a:A", capabilities=frozenset({"metric"}),
                                 summary="[bold] a tiny one", code_license="MIT",
                                 weights_license="CC-BY-4.0")]
    """
    install_plugin("mpsfm-tiny", source, version="4.2")
    install_plugin("mpsfm-broken", "import nothing_of_that_name")
    code, text, _ = mpsfm("plugins", "list", "--json")
    assert code == 0
    found = {line["distribution"]: line for line in json.loads(text)}
    assert found["mpsfm-tiny"] == {
        "kind": "depth",
        "name": "tiny",
        "distribution": "mpsfm-tiny",
        "version": "4.2",
        "code_license": "MIT",
        "weights_license": "CC-BY-4.0",
        "capabilities": ["metric"],
        "summary": "[bold] a tiny one",
        "available": True,
        "reason": "",
        "install_hint": "",
    }
    assert not found["mpsfm-broken"]["available"]

    code, table, _ = mpsfm("plugins", "list")
    assert code == 0
    (tiny,) = [row for row in table.splitlines() if "mpsfm-tiny" in row]
    assert " ".join(tiny.split()) == ("depth tiny mpsfm-tiny 4.2 MIT / CC-BY-4.0 metric available")
    (broken,) = [row for row in table.splitlines() if row.startswith("plugin") and "broken" in row]
    assert "unavailable: fails to load: ModuleNotFoundError" in broken


class TestConfig:
    def test_config_list_prints_shipped_configurations(self) -> None:
        code, text, _ = mpsfm("config", "list")
        assert code == 0
        assert {"default", "fast-cpu", "sensor-depth"} <= {
            row.split()[0] for row in text.split("\n") if row
        }

    @pytest.fixture
    def tiny_config(self, tmp_path: Path, install_plugin: Callable[..., str]) -> str:
        """Configuration whose providers come from one plugin of the test."""
        source = """
            from mpsfm_core import Options, ProviderSpec, hookimpl
            class TinyOptions(Options):
                far: float = 10.0
            @hookimpl
            def mpsfm_providers():
                return [ProviderSpec("depth", "tiny", "a:A", TinyOptions),
                        ProviderSpec("normals", "tiny", "a:A"),
                        ProviderSpec("matcher", "tiny", "a:A", capabilities=frozenset({"dense"}))]
        """
        install_plugin("mpsfm-tiny", source)
        path = tmp_path / "tiny.yaml"
        path.write_text("depth: {use: tiny}\nnormals: {use: tiny}\ndense_matcher: {use: tiny}\n")
        return str(path)

    def test_config_show_fills_in_defaults(self, tiny_config: str) -> None:
        code, text, _ = mpsfm("config", "show", tiny_config, "--set", "runtime.seed=5")
        assert code == 0
        shown = yaml.safe_load(text)
        assert shown["depth"]["options"] == {"far": 10.0}
        assert shown["runtime"]["seed"] == 5
        assert shown["runtime"]["device"] == "auto"

    def test_config_show_with_wrong_setting_exits_with_2(self, tiny_config: str) -> None:
        code, text, error = mpsfm("config", "show", tiny_config, "--set", "depth.options.fra=5")
        assert (code, text) == (2, "")
        assert error == (
            "mpsfm: --set depth.options.fra=5: depth.options.fra: "
            "unknown key; did you mean 'far'?\n"
        )


class TestEndings:
    @pytest.fixture
    def app(self) -> typer.Typer:
        """Command line whose command ``fail`` raises the exception in ``errors``."""
        app = build_app()

        @app.command()
        def fail(name: str) -> None:
            raise {
                "config": ConfigError("x.yaml:3: wrong\nindeed"),
                "nothing": ReconstructionError("no pair worked"),
                "disk": OSError(28, "No space left on device", "out/points.ply"),
                "bug": KeyError("surprise"),
                "interrupt": KeyboardInterrupt(),
                "exit": typer.Exit(7),
                "usage": typer.BadParameter("not like this"),
            }[name]

        return app

    @pytest.mark.parametrize(
        ("name", "code", "line"),
        [
            ("config", 2, "mpsfm: x.yaml:3: wrong indeed\n"),
            ("nothing", 3, "mpsfm: no pair worked\n"),
            ("disk", 1, "mpsfm: [Errno 28] No space left on device: 'out/points.ply'\n"),
            ("bug", 1, "mpsfm: internal error: KeyError: 'surprise' (run mpsfm --debug"),
            ("interrupt", 130, "mpsfm: interrupted\n"),
            ("exit", 7, ""),
            ("usage", 2, ""),
        ],
    )
    def test_errors_print_one_line_and_set_exit_code(
        self, app: typer.Typer, name: str, code: int, line: str
    ) -> None:
        result = CliRunner().invoke(app, ["fail", name])
        assert result.exit_code == code
        assert result.stderr.startswith(line)
        assert "Traceback" not in result.output

    @pytest.mark.parametrize("variable", [None, "1"])
    def test_debug_raises_the_error(self, app: typer.Typer, variable: str | None) -> None:
        arguments = ["fail", "bug"] if variable else ["--debug", "fail", "bug"]
        environment = {"MPSFM_DEBUG": variable} if variable else {}
        result = CliRunner().invoke(app, arguments, env=environment)
        assert isinstance(result.exception, KeyError)

    def test_usage_errors_exit_with_2(self) -> None:
        assert mpsfm("plugin")[0] == 2
        assert mpsfm("config", "show", "--sett", "a=1")[0] == 2

    def test_version_option_prints_version(self) -> None:
        code, text, _ = mpsfm("--version")
        assert code == 0 and text.strip()


def test_plugins_check_plugin_without_providers_checks_hooks(
    install_plugin: Callable[..., str],
) -> None:
    source = """
        from mpsfm_core import hookimpl
        @hookimpl
        def mpsfm_exports():
            return {}
    """
    module = install_plugin("mpsfm-hooks", source)
    entries = f"[mpsfm.plugins]\nlistener = {module}\n"
    install_plugin("mpsfm-hooks", source, version="2.0", entry_points=entries)
    code, out, _ = mpsfm("plugins", "check", "listener")
    assert code == 0
    assert "pass  plugin/listener: hook-exports" in out


CRASHING = """
    import os
    import numpy as np
    from mpsfm_core import ProviderSpec, hookimpl

    class Good:
        def __init__(self, options, context): ...

        def describe(self, view):
            return np.ones(4, np.float32) / 2

    class Abort(Good):
        def describe(self, view):
            os.abort()

    class Exit(Good):
        def describe(self, view):
            os._exit(0)

    @hookimpl
    def mpsfm_providers():
        classes = {"abort": Abort, "exit": Exit, "good": Good}
        return [ProviderSpec("retrieval", name, f"{__name__}:{value.__name__}")
                for name, value in classes.items()]
"""


def test_plugins_check_names_providers_that_end_the_process_and_leaves_no_files(
    install_plugin: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_plugin("mpsfm-crashing", CRASHING)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    code, out, _ = mpsfm("plugins", "check", "mpsfm-crashing", "--only", "output-rules")
    assert code == 1
    lines = [line.split(",")[0] + line.partition(" s")[2] for line in out.splitlines()]
    assert lines == [
        "fail  retrieval/abort: output-rules: the check ends the process (SIGABRT)",
        "fail  retrieval/exit: output-rules: the check ends the process (exit code 0)",
        "pass  retrieval/good: output-rules",
        "2 fail",
    ]
    assert out.endswith("2 fail, 1 pass\n")
    assert not list(temporary.iterdir())


@pytest.mark.parametrize(("option", "code"), [((), 0), (("--strict",), 1)])
def test_plugins_check_strict_fails_if_check_cannot_measure(
    option: tuple[str, ...], code: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "log").touch()
    monkeypatch.setenv("MPSFM_CHECKING", str(tmp_path / "log"))  # checks in this process
    found, text, _ = mpsfm("plugins", "check", "depth/flat", "--only", "depth-scale", *option)
    assert found == code, text
    assert "1 unmeasured: the ground truth is unknown" in text
