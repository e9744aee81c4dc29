"""Discovery of installed plugins, with the reason for each plugin that fails to load.

Importing a plugin and calling its hooks runs foreign code, which therefore runs in a thread with a
time limit. A Python thread cannot be killed. The thread of a plugin that hangs remains as a daemon
thread, and the process continues without the plugin.
"""

from __future__ import annotations

import importlib.util
import inspect
import logging
import re
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import pluggy

from mpsfm_core.data.errors import did_you_mean
from mpsfm_core.data.options import Options
from mpsfm_core.providers import (
    API_VERSION,
    CAPABILITIES,
    ENTRY_POINT_GROUP,
    KINDS,
    Hooks,
    ProviderSpec,
)
from mpsfm_core.support.timed_thread import TimedThread, TimeLimitError

_log = logging.getLogger(__name__)
_NAME = re.compile(r"[a-z0-9]+([._-][a-z0-9]+)*")
_REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


@dataclass(frozen=True)
class LoadedPlugin:
    """Result of loading one plugin, with its providers and hooks or the reason of the failure."""

    name: str
    distribution: str
    version: str
    module: object = None
    """Imported plugin module, or None if loading the plugin failed."""
    specs: tuple[object, ...] = ()
    """Provider specifications that the plugin's hook ``mpsfm_providers`` returned."""
    hooks: tuple[str, ...] = ()
    """Names of the hooks that the plugin implements, without the prefix ``mpsfm_``."""
    fault: str = ""
    """Reason why the plugin cannot be used, or an empty string."""
    hint: str = ""
    """Advice for the user on how to make the plugin usable."""


def create_plugin_manager() -> pluggy.PluginManager:
    """Create a pluggy plugin manager that has the MP-SfM hooks and no plugins."""
    manager = pluggy.PluginManager("mpsfm")
    manager.add_hookspecs(Hooks)
    return manager


def installed_plugins(
    timeout_s: float,
    crashing: Collection[tuple[str, str]] = (),
    on_load: Callable[[str, str], None] | None = None,
) -> Iterator[LoadedPlugin]:
    """Load every entry point of the group ``mpsfm.plugins``, ordered by distribution and name.

    Args:
        timeout_s: Time limit for loading each plugin.
        crashing: Pairs (name, module) of entry points that are not loaded, because they crash the
            process.
        on_load: Function that is called with the name and module of each entry point before the
            entry point is loaded.

    Yields:
        One loaded plugin per entry point, with a ``fault`` if loading the plugin failed.
    """
    entries = [(*_distribution(e), e) for e in metadata.entry_points(group=ENTRY_POINT_GROUP)]
    for name, version, entry in sorted(entries, key=lambda e: (e[0], e[2].name)):
        if (entry.name, entry.value) in crashing:
            hint = f"reinstall or uninstall {name}"
            fault = "ends the whole process when it is loaded"
            yield LoadedPlugin(entry.name, name, version, fault=fault, hint=hint)
        else:
            if on_load is not None:
                on_load(entry.name, entry.value)
            yield _load(entry, name, version, timeout_s)


def inspect_plugin(module: object, name: str, distribution: str, version: str) -> LoadedPlugin:
    """Collect the providers and hooks of an imported plugin module.

    Args:
        module: Plugin module, or object with hook implementations.
        name: Name of the plugin's entry point.
        distribution: Name of the plugin's pip package.
        version: Version of the plugin's pip package.

    Returns:
        Providers and hooks of the plugin, with a ``fault`` if the plugin implements an unknown
        hook.

    Raises:
        TypeError: The plugin implements no hook, or its hook ``mpsfm_providers`` does not return a
            list.
        Exception: Any exception that the plugin's ``mpsfm_providers`` raises.
    """
    manager = create_plugin_manager()
    manager.register(module, name)
    callers = manager.get_hookcallers(module) or []
    if not callers:
        raise TypeError(f"plugin {name!r} is a {type(module).__name__} without any mpsfm hook")
    answers = manager.hook.mpsfm_providers()
    answer = answers[0] if answers else ()
    if not isinstance(answer, (list, tuple)):
        raise TypeError(f"the hook mpsfm_providers returned {type(answer).__name__}, not a list")
    known = [caller for caller in callers if caller.has_spec()]
    unknown = [caller.name for caller in callers if not caller.has_spec()]
    fault = ""
    if unknown:
        near = did_you_mean(unknown[0], (n for n in vars(Hooks) if n.startswith("mpsfm_")))
        fault = f"implements the unknown hook {unknown[0]!r}, which nobody calls{near}"
    hooks = tuple(caller.name.removeprefix("mpsfm_") for caller in known)
    return LoadedPlugin(name, distribution, version, module, tuple(answer), hooks, fault)


def find_spec_fault(spec: ProviderSpec) -> tuple[str, str]:
    """Return why a provider specification is unusable and advice for the user, or empty strings."""
    if not isinstance(spec.api_version, int) or spec.api_version > API_VERSION:
        return (
            f"is made for plugin API {spec.api_version}, this core has {API_VERSION}",
            "pip install --upgrade mpsfm-core",
        )
    try:
        fault = _malformed(spec)
    except Exception as error:  # Fields of the provider specification may have any type.
        fault = str(error)
    if fault:
        return f"has a wrong specification: {fault}", "tell the plugin's author"
    missing = [name for name in spec.requires if not _installed(name)]
    if missing:
        hint = spec.install_hint or f"pip install {' '.join(missing)}"
        return f"needs {', '.join(missing)}, not installed", hint
    return "", ""


def _distribution(entry: metadata.EntryPoint) -> tuple[str, str]:
    """Return the name and version of the pip package that contains a plugin's entry point.

    A plugin with damaged package metadata gets placeholders, so that the list of plugins contains
    it.
    """
    try:
        if entry.dist is not None:
            # Each access to ``entry.dist.metadata`` parses the metadata file again.
            fields = entry.dist.metadata
            return str(fields["Name"]), str(fields["Version"])
    except Exception as error:
        _log.info("the package metadata of plugin %s cannot be read: %s", entry.name, error)
    return "unknown distribution", "unknown"


def _load(
    entry: metadata.EntryPoint, distribution: str, version: str, timeout_s: float
) -> LoadedPlugin:
    """Import a plugin and collect its providers in a thread with a time limit."""

    def load() -> LoadedPlugin | BaseException:
        try:
            return inspect_plugin(entry.load(), entry.name, distribution, version)
        # A SystemExit that a plugin raises must not end the program.
        except BaseException as error:
            return error

    try:
        # Standard output is reserved for the output of mpsfm commands, which may be JSON.
        with redirect_stdout(sys.stderr):
            result = TimedThread(f"mpsfm plugin {entry.name}").run(load, timeout_s)
    except TimeLimitError:
        fault = f"did not load within {timeout_s:g} s"
        text = "plugin %r of package %s did not load within %g s"
        _log.warning(text, entry.name, distribution, timeout_s)
        hint = f"pip uninstall {distribution}, or raise MPSFM_PLUGIN_TIMEOUT_S"
        return LoadedPlugin(entry.name, distribution, version, fault=fault, hint=hint)
    if isinstance(result, LoadedPlugin):
        return result
    fault = f"fails to load: {type(result).__name__}: {result}"
    hint = _hint(result, distribution)
    return LoadedPlugin(entry.name, distribution, version, fault=fault, hint=hint)


def _hint(error: BaseException, distribution: str) -> str:
    """Return advice for the user about a plugin whose import raised an error."""
    absent = (error.name or "") if isinstance(error, ImportError) else ""
    if absent.partition(".")[0] == "mpsfm_core" or "ProviderSpec.__init__()" in str(error):
        # The import fails because the plugin requires a newer version of mpsfm-core.
        return f"pip install --upgrade mpsfm-core, or uninstall {distribution}"
    if absent and isinstance(error, ModuleNotFoundError):
        return f"pip install the package of module {absent!r}, or uninstall {distribution}"
    return f"reinstall or uninstall {distribution}"


def _malformed(spec: ProviderSpec) -> str:
    """Describe the first invalid field of a provider specification, or return an empty string."""
    if spec.kind not in KINDS:
        return f"unknown kind {spec.kind!r}{did_you_mean(str(spec.kind), KINDS)}"
    name = spec.name
    if isinstance(name, str) and callable(spec.factory):
        # The text after "@" in a provider name is the name of a Python environment.
        name = name.partition("@")[0]
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        return f"name {spec.name!r} may only have lower-case letters, digits and - . _"
    if not (callable(spec.factory) or _is_reference(spec.factory)):
        return f"factory {spec.factory!r} does not look like 'package.module:Class'"
    is_model = inspect.isclass(spec.options) and issubclass(spec.options, Options)
    if not (spec.options is None or is_model or _is_reference(spec.options)):
        return "options is neither a subclass of Options nor 'package.module:Class'"
    if not (spec.contract is None or callable(spec.contract) or _is_reference(spec.contract)):
        return f"contract {spec.contract!r} does not look like 'package.module:function'"
    for name in ("capabilities", "requires", "tags"):
        values = getattr(spec, name)
        if isinstance(values, str) or not all(isinstance(value, str) for value in values):
            return f"{name} must be a tuple or set of texts"
    weights: Any = spec.weights
    if not (callable(weights) or isinstance(weights, (tuple, list))):
        return "weights is neither a tuple of files nor a function of the options"
    unknown = sorted(set(spec.capabilities) - set(CAPABILITIES))
    if unknown:
        return f"unknown capability {unknown[0]!r}{did_you_mean(unknown[0], CAPABILITIES)}"
    return ""


def _is_reference(value: Any) -> bool:
    return isinstance(value, str) and _REFERENCE.fullmatch(value) is not None


def _installed(name: str) -> bool:
    """Return whether a Python module's top-level package is installed, without importing it."""
    try:
        return importlib.util.find_spec(name.partition(".")[0]) is not None
    except (ImportError, ValueError):
        return False
