"""Tests that broken plugins are listed with reason and repair, and healthy plugins work."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mpsfm_core.data.errors import ProviderError
from mpsfm_core.providers import API_VERSION, ProviderContext
from mpsfm_core.providers.registry import Registry

ROOT = Path(__file__).resolve().parents[2]
InstallPlugin = Callable[..., str]

HEALTHY = """
    from mpsfm_core import ProviderSpec, hookimpl
    from tests.support.reference_providers import PaintedDepth

    @hookimpl
    def mpsfm_providers():
        return [ProviderSpec("depth", "healthy", PaintedDepth)]
"""

SPEC = """
    from mpsfm_core import ProviderSpec, hookimpl

    @hookimpl
    def mpsfm_providers():
        return [{}]
"""

BROKEN = {
    "mpsfm-raises": "raise OSError('libnetwork.so.12: cannot open shared object file')",
    "mpsfm-exits": "import os, sys\nsys.exit('no licence')",
    "mpsfm-interrupts": "raise KeyboardInterrupt",
    "mpsfm-talks": "print('Welcome to mpsfm-talks!')"
    + SPEC.format("'depth'").replace("\n    ", "\n"),
    "mpsfm-rubbish": SPEC.format("{'kind': 'depth'}, None, 7"),
    "mpsfm-missing": SPEC.format(
        "ProviderSpec('depth', 'missing', 'a:A', requires=('no_such_library',),"
        " install_hint='pip install no-such-library')"
    ),
    "mpsfm-newer": SPEC.format(
        f"ProviderSpec('depth', 'newer', 'a:A', api_version={API_VERSION + 1})"
    ),
    "mpsfm-newer-name": "from mpsfm_core import WhatComesNextYear",
    "mpsfm-newer-room": "import mpsfm_core.next_year",
    "mpsfm-newer-field": SPEC.format("ProviderSpec('depth', 'field', 'a:A', next_year=1)"),
    "mpsfm-twin-a": SPEC.format("ProviderSpec('depth', 'twin', 'a:A')"),
    "mpsfm-twin-b": SPEC.format("ProviderSpec('depth', 'twin', 'b:B')"),
    "mpsfm-imports": "import a_library_that_nobody_has",
}

EXPECTED = {
    "mpsfm-raises": ("OSError: libnetwork.so.12", "reinstall or uninstall mpsfm-raises"),
    "mpsfm-exits": ("SystemExit: no licence", "reinstall or uninstall mpsfm-exits"),
    "mpsfm-interrupts": ("KeyboardInterrupt", "reinstall or uninstall mpsfm-interrupts"),
    "mpsfm-talks": ("lists a str among its providers", "tell the author of mpsfm-talks"),
    "mpsfm-rubbish": ("among its providers", "tell the author of mpsfm-rubbish"),
    "mpsfm-missing": ("needs no_such_library, not installed", "pip install no-such-library"),
    "mpsfm-newer": ("is made for plugin API", "pip install --upgrade mpsfm-core"),
    "mpsfm-newer-name": ("cannot import name 'WhatComes", "pip install --upgrade mpsfm-core, or"),
    "mpsfm-newer-room": ("'mpsfm_core.next_year'", "pip install --upgrade mpsfm-core, or"),
    "mpsfm-newer-field": ("argument 'next_year'", "pip install --upgrade mpsfm-core, or uninstall"),
    "mpsfm-twice": ("is a second entry point", "tell the author of mpsfm-twice"),
    "mpsfm-twin-a": (
        "is brought by mpsfm-twin-a and mpsfm-twin-b",
        "choose 'mpsfm-twin-a:twin' or",
    ),
    "mpsfm-twin-b": (
        "is brought by mpsfm-twin-a and mpsfm-twin-b",
        "choose 'mpsfm-twin-a:twin' or",
    ),
    "mpsfm-imports": ("No module named 'a_library_that_nobody_has'", "pip install the package of"),
}


@pytest.fixture
def silent_server() -> Iterator[tuple[str, int]]:
    """Return the address of a server that accepts connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()


@pytest.fixture
def environment(install_plugin: InstallPlugin, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Install all broken plugins and set a time limit that healthy plugins always meet."""
    for name, source in BROKEN.items():
        install_plugin(name, source)
    install_plugin("mpsfm-healthy", HEALTHY)
    again = "[mpsfm.plugins]\nagain = mpsfm_healthy_plugin\n"
    install_plugin("mpsfm-twice", "", entry_points=again)
    monkeypatch.setenv("MPSFM_PLUGIN_TIMEOUT_S", "120")
    path = os.pathsep.join([sys.path[0], str(ROOT), *sys.path])
    return {**os.environ, "PYTHONPATH": path}


def mpsfm(environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mpsfm_core", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)


def test_plugin_list_states_faults_and_remedies(environment: dict[str, str]) -> None:
    ended = mpsfm(environment, "plugins", "list", "--json")
    assert ended.returncode == 0
    lines: dict[str, dict[str, Any]] = {p["distribution"]: p for p in json.loads(ended.stdout)}
    for name, (reason, hint) in EXPECTED.items():
        assert not lines[name]["available"], name
        assert reason in lines[name]["reason"], name
        assert hint in lines[name]["install_hint"], name
    assert lines["mpsfm-healthy"]["available"]
    # The warnings must not appear inside the JSON output.
    assert "Welcome to mpsfm-talks!" in ended.stderr

    table = mpsfm(environment, "plugins", "list").stdout.splitlines()
    for name, (reason, hint) in EXPECTED.items():
        (row,) = [" ".join(row.split()) for row in table if f" {name} 1.0 " in row]
        assert "unavailable: " in row and reason in row and hint in row, name


def test_plugin_that_waits_for_the_network_is_skipped(
    install_plugin: InstallPlugin, silent_server: tuple[str, int]
) -> None:
    """Check that the command ends although the server never answers, because of the time limit."""
    waiting = "import socket\nwith socket.create_connection({!r}) as server: server.recv(1)"
    install_plugin("mpsfm-waits", waiting.format(silent_server))
    path = os.pathsep.join([sys.path[0], str(ROOT), *sys.path])
    limited = {**os.environ, "PYTHONPATH": path, "MPSFM_PLUGIN_TIMEOUT_S": "1"}
    ended = mpsfm(limited, "plugins", "list", "--json")
    assert ended.returncode == 0
    lines = {p["distribution"]: p for p in json.loads(ended.stdout)}
    assert "did not load within 1 s" in lines["mpsfm-waits"]["reason"]
    assert "pip uninstall mpsfm-waits" in lines["mpsfm-waits"]["install_hint"]
    assert lines["mpsfm-core"]["available"]


def test_broken_plugins_raise_only_when_selected(
    environment: dict[str, str], tmp_path: Path
) -> None:
    ended = mpsfm(environment, "plugins", "check", "healthy", "--only", "deterministic")
    assert (ended.returncode, ended.stdout.splitlines()[-1]) == (0, "1 pass")

    registry = Registry.discover()
    context = ProviderContext(resolve_weights=lambda uri, sha256: Path(uri))
    assert registry.create("depth", "healthy", None, context)
    assert registry.create("features", "sift", None, context)
    for name, message in (
        ("missing", "pip install no-such-library"),
        ("newer", "pip install --upgrade mpsfm-core"),
        ("twin", "choose 'mpsfm-twin-a:twin' or 'mpsfm-twin-b:twin'"),
    ):
        with pytest.raises(ProviderError, match=message):
            registry.create("depth", name, None, context)
    with pytest.raises(ProviderError, match=r"did not load: .*mpsfm-imports \(fails to load"):
        registry.create("depth", "of-a-broken-one", None, context)


def test_check_of_broken_plugin_states_the_reason(environment: dict[str, str]) -> None:
    ended = mpsfm(environment, "plugins", "check", "mpsfm-imports")
    assert ended.returncode == 2
    assert "mpsfm-imports fails to load: ModuleNotFoundError" in ended.stderr
    ended = mpsfm(environment, "plugins", "check", "missing")
    assert ended.returncode == 2
    assert "pip install no-such-library" in ended.stderr


CRASH = "import ctypes; ctypes.string_at(0)"


def test_a_plugin_that_crashes_the_process(install_plugin: InstallPlugin) -> None:
    install_plugin("mpsfm-crashes", CRASH)
    install_plugin(
        "mpsfm-late",
        f"""
        from mpsfm_core import ProviderSpec, hookimpl

        class Late:
            def __init__(self, options, context):
                pass

            def predict(self, view):
                {CRASH}

        @hookimpl
        def mpsfm_providers():
            return [ProviderSpec("depth", "late", Late)]
        """,
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    ended = mpsfm(environment, "plugins", "list", "--json")
    assert ended.returncode == 0, ended.stderr
    lines = {line["distribution"]: line for line in json.loads(ended.stdout)}
    assert "ends the whole process" in lines["mpsfm-crashes"]["reason"]
    assert lines["mpsfm-late"]["available"] and lines["mpsfm-core"]["available"]
    ended = mpsfm(environment, "plugins", "check", "late")
    assert ended.returncode == 1
    assert "output-rules, " in ended.stdout and "ends the process (SIGSEGV)" in ended.stdout


def test_metadata_without_a_name(install_plugin: InstallPlugin) -> None:
    module = install_plugin("mpsfm-nameless", HEALTHY)
    (info,) = Path(sys.path[0]).glob("mpsfm_nameless-*.dist-info")
    (info / "METADATA").write_text("Metadata-Version: 2.1\n")
    (line,) = [p for p in Registry.discover().status() if p.name == "healthy"]
    assert line.available
    assert module in sys.modules
