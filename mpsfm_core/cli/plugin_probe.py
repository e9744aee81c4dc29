"""Listing of all plugins in a child process, which a plugin may crash."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any, NamedTuple

from mpsfm_core.support.child_process import subprocess_environment

_SCRIPT = """
import dataclasses, json, os, sys
from mpsfm_core.providers.registry import Registry

def write(value):
    os.write(1, (json.dumps(value, default=str) + chr(10)).encode())

crashing = {tuple(pair) for pair in json.loads(sys.argv[1])}
status = Registry.discover(without=crashing, on_load=lambda *plugin: write(plugin)).status()
for line in status:
    write(dataclasses.asdict(line))
os._exit(0)
"""
"""Script that writes ``[name, module]`` before a plugin is loaded, then a line per provider."""


class PluginProbe(NamedTuple):
    """Result of loading all plugins in a child process."""

    crashing: set[tuple[str, str]]
    """Pairs (name, module) of the entry points of plugins that crash their process."""
    status: list[dict[str, Any]]
    """Fields of the :class:`~mpsfm_core.providers.registry.ProviderStatus` of all providers."""
    messages: str
    """Text that plugins printed, and warnings that the registry logged."""


def probe_plugins() -> PluginProbe:
    """Load all plugins in a child process, and list their providers.

    If the child process crashes, the plugin with the last written name is the cause. The child
    process then starts again without that plugin.
    """
    crashing: set[tuple[str, str]] = set()
    while True:
        process = subprocess.run(
            [sys.executable, "-c", _SCRIPT, json.dumps(sorted(crashing))],
            env=subprocess_environment(),
            capture_output=True,
            check=False,
        )
        texts = process.stdout.decode().splitlines()
        announced = [text for text in texts if text.startswith("[")]
        if process.returncode >= 0 or not announced:
            status = [json.loads(text) for text in texts if text.startswith("{")]
            return PluginProbe(crashing, status, process.stderr.decode(errors="replace"))
        name, module = json.loads(announced[-1])
        crashing.add((name, module))
