"""Which providers there are, and how one is made from its name and options.

A :class:`Registry` is an ordinary object: the pipeline makes one with :meth:`Registry.discover`
and hands it on. Finding and listing providers imports no plugin's heavy modules; those come with
:meth:`Registry.create`.
"""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any, Literal

import pluggy

from mpsfm_core.data.errors import InputError, MpsfmError, ProviderError, did_you_mean
from mpsfm_core.data.options import Options, SettingPath, parse_settings
from mpsfm_core.providers import (
    CAPABILITY_METHODS,
    KINDS,
    PROTOCOLS,
    Kind,
    ProviderContext,
    ProviderSpec,
    WeightsFile,
)
from mpsfm_core.providers.builtin import plugin as builtin
from mpsfm_core.providers.discovery import (
    LoadedPlugin,
    crashing_plugins,
    create_plugin_manager,
    find_spec_fault,
    inspect_plugin,
    installed_plugins,
)
from mpsfm_core.providers.environments.environment import all_environments
from mpsfm_core.providers.environments.remote_provider import EnvironmentHooks, remote_providers
from mpsfm_core.providers.first_party import requirement_for
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration

_log = logging.getLogger(__name__)

CORE = "mpsfm-core"
"""Distribution of the built-in providers; no other can take a name away from it."""

TIMEOUT_VARIABLE = "MPSFM_PLUGIN_TIMEOUT_S"
"""Environment variable: how long one plugin may take to load, in seconds."""

DEFAULT_TIMEOUT_S = 10.0
"""A light plugin module loads in milliseconds; a cold network disk may take seconds."""

Calibration = DepthCalibration | NormalCalibration


@dataclass(frozen=True)
class ProviderStatus:
    """One line of ``mpsfm plugins list``.

    ``kind`` is ``"plugin"`` for a plugin that could not be loaded (``name`` is then its entry
    point) and for one that brings hooks but no providers (``capabilities`` are then its hooks).
    ``reason`` says why it is not ``available``, ``install_hint`` what to do about it.
    """

    kind: Kind | Literal["plugin"]
    name: str
    distribution: str
    version: str
    code_license: str = ""
    weights_license: str = ""
    capabilities: tuple[str, ...] = ()
    summary: str = ""
    available: bool = True
    reason: str = ""
    install_hint: str = ""


@dataclass(frozen=True)
class _Entry:
    spec: ProviderSpec
    distribution: str
    version: str
    fault: str = ""
    hint: str = ""

    @property
    def label(self) -> str:
        """How messages name the provider."""
        return f"{self.spec.kind} provider {self.spec.name!r} ({self.distribution} {self.version})"


class Registry:
    """Providers by kind and name, and the hooks of all plugins.

    A new registry is empty; :meth:`discover` returns one with the built-in providers and all
    installed plugins.
    """

    def __init__(self) -> None:
        self._entries: list[_Entry] = []
        self._plugins: list[ProviderStatus] = []
        self._manager = create_plugin_manager()
        self._muted: set[tuple[str, str]] = set()

    @classmethod
    def discover(
        cls, timeout_s: float | None = None, environments: bool = True, *, probe: bool = False
    ) -> Registry:
        """Load the built-in providers and every installed plugin, and look up what
        ``environments`` bring (:mod:`mpsfm_core.providers.environments`), as ``NAME@ENVIRONMENT``.

        A plugin that fails is listed with the reason and hurts nobody else. ``timeout_s``: time
        limit for each plugin, by default ``$MPSFM_PLUGIN_TIMEOUT_S`` or 10 s. ``probe``: load
        them in another process first, so that one which crashes is listed as well.
        """
        registry = cls()
        registry.register(builtin, name="builtin", distribution=CORE, version=core_version())
        limit = _default_timeout() if timeout_s is None else timeout_s
        for plugin in installed_plugins(limit, crashing_plugins(limit) if probe else ()):
            registry._add(plugin)
        if environments:
            registry._add_environments()
        return registry

    def register(
        self,
        plugin: object,
        *,
        name: str | None = None,
        distribution: str = "this process",
        version: str = "0",
    ) -> None:
        """Add a plugin (a module or object with ``@hookimpl`` functions) of this process.

        Raises :class:`~mpsfm_core.data.errors.ProviderError` where discovery would list it as
        broken."""
        name = name or str(getattr(plugin, "__name__", type(plugin).__name__))
        try:
            loaded = inspect_plugin(plugin, name, distribution, version)
        except Exception as error:
            raise ProviderError(f"plugin {name!r}: {type(error).__name__}: {error}") from error
        if self._manager.is_registered(plugin) or self._manager.has_plugin(_label(loaded)):
            raise ProviderError(f"plugin {name!r} is registered already")
        self._add(loaded)

    def add(
        self, *specs: ProviderSpec, distribution: str = "this process", version: str = "0"
    ) -> None:
        """Add single providers of this process; their factory may be a callable."""
        for spec in specs:
            self._entries.append(_Entry(spec, distribution, version, *find_spec_fault(spec)))

    def status(self) -> tuple[ProviderStatus, ...]:
        """All providers by kind and name, then plugins that are broken or have hooks only."""
        providers = [_status(entry, *self._fault(entry)) for entry in self._entries]
        order = (*KINDS, "plugin")
        return tuple(
            sorted(
                (*providers, *self._plugins),
                key=lambda s: (
                    order.index(s.kind) if s.kind in order else len(order),
                    s.name,
                    s.distribution,
                ),
            )
        )

    def names(self, kind: Kind) -> list[str]:
        """Names of the available providers of a kind, sorted."""
        entries = [e for e in self._entries if e.spec.kind == kind]
        return sorted(e.spec.name for e in entries if not self._fault(e)[0])

    def spec(self, kind: Kind, name: str) -> ProviderSpec:
        """The specification of an available provider.

        Raises :class:`~mpsfm_core.data.errors.ProviderError` with the nearest name and what to
        install when there is none, or with the reason when it is there and unavailable."""
        return self._entry(kind, name).spec

    def version(self, kind: Kind, name: str) -> str:
        """Distribution and version that a provider comes from, e.g. ``mpsfm-onnx 0.1.0``."""
        entry = self._entry(kind, name)
        return f"{entry.distribution} {entry.version}"

    def validate_options(
        self,
        kind: Kind,
        name: str,
        values: Mapping[str, Any] | None = None,
        path: SettingPath = ("options",),
    ) -> Options | None:
        """The provider's options with defaults filled in, None when it has none.

        Raises :class:`~mpsfm_core.data.options.SettingsError` with the path (below ``path``) and
        the nearest key for each wrong setting."""
        model = self._options_model(kind, name)
        return parse_settings(model or _NoOptions, values or {}, path) if model or values else None

    def default_options(self, kind: Kind, name: str) -> dict[str, Any]:
        """The provider's options as plain values, None for those that the user has to give."""
        model = self._options_model(kind, name) or _NoOptions
        return dict.fromkeys(model.model_fields) | model.model_construct().model_dump(mode="json")

    def weights(
        self, kind: Kind, name: str, values: Mapping[str, Any] | None = None
    ) -> tuple[WeightsFile, ...]:
        """The weights files that a provider loads with these options.

        Raises :class:`~mpsfm_core.data.options.SettingsError` when the options are wrong or lack
        one that the user has to give."""
        entry = self._entry(kind, name)
        files = entry.spec.weights
        if not callable(files):
            return tuple(files)
        options = self.validate_options(kind, name, values)
        try:
            return tuple(files(options))
        except MpsfmError:
            raise
        except Exception as error:
            what = f"cannot say which weights it loads: {type(error).__name__}: {error}"
            raise ProviderError(_sentence(entry.label, what, "tell its author")) from error

    def calibration(self, kind: Kind, backend: ProviderConfig) -> Calibration:
        """The uncertainty model of a depth, multi-view or normals backend.

        What the configuration says (``backend.calibration``, values only: a file was read when the
        configuration was loaded) goes first. Else the outermost wrapper and then the provider are
        asked: its plugin's ``mpsfm_calibration`` hook, then its specification. Else the class's
        defaults.
        """
        model: type[Calibration] = NormalCalibration if kind == "normals" else DepthCalibration
        if isinstance(backend.calibration, Mapping):
            return parse_settings(model, backend.calibration, ("calibration",))
        wrappers: list[tuple[Kind, ProviderConfig]] = [
            ("wrapper", w) for w in reversed(backend.wrap)
        ]
        for chosen, block in (*wrappers, (kind, backend)):
            options = self.validate_options(chosen, block.use, block.options)
            answers = self.call_hook(
                "mpsfm_calibration", kind=chosen, provider=block.use, options=options
            )
            for answer in (*answers, self.spec(chosen, block.use).calibration):
                if isinstance(answer, model):
                    return answer
        return model()

    def create(
        self,
        kind: Kind,
        name: str,
        options: Options | Mapping[str, Any] | None,
        context: ProviderContext,
        wrap: Sequence[ProviderConfig] = (),
    ) -> Any:
        """Import and construct a provider, inside of its wrappers (the innermost first).

        The result has the method of ``PROTOCOLS[kind]``. Raises
        :class:`~mpsfm_core.data.errors.ProviderError` naming provider, plugin and what to do when
        it cannot be imported or constructed; errors that are already ours pass unchanged."""
        entry = self._entry(kind, name)
        provider = self._construct(entry, (), options, context)
        extra = [m for c, m in CAPABILITY_METHODS.items() if c in entry.spec.capabilities]
        _require_methods(entry, provider, [*_methods(kind), *extra])
        for wrapper in wrap:
            outer = self._entry("wrapper", wrapper.use)
            if f"wraps-{kind}" not in outer.spec.capabilities:
                raise ProviderError(f"{outer.label} does not wrap {kind} providers")
            provider = self._construct(outer, (provider,), wrapper.options, context)
            _require_methods(outer, provider, _methods(kind))
        return provider

    @property
    def hook(self) -> pluggy.HookRelay:
        """The hooks of all plugins, unguarded; :meth:`call_hook` is the guarded call."""
        return self._manager.hook

    def call_hook(self, name: str, /, **arguments: Any) -> list[Any]:
        """Call a hook of every plugin and return what they answer, None left out.

        A plugin that raises is skipped with a logged warning and not called for this hook again:
        an installed viewer, logger or filter that is broken must not end somebody's run.
        """
        answers = []
        for implementation in reversed(getattr(self.hook, name).get_hookimpls()):
            if (implementation.plugin_name, name) in self._muted:
                continue
            given = {key: arguments[key] for key in implementation.argnames}
            try:
                answer = implementation.function(**given)
            except Exception as error:
                self._muted.add((implementation.plugin_name, name))
                text = f"plugin {implementation.plugin_name!r} failed in {name} and is left out"
                _log.warning("%s: %s: %s", text, type(error).__name__, error)
                _log.debug("%s", text, exc_info=True)
                continue
            if answer is not None:
                answers.append(answer)
        return answers

    def _add_environments(self) -> None:
        remotes = [r for environment in all_environments() for r in remote_providers(environment)]
        for r in remotes:
            self._entries.append(_Entry(r.spec, r.distribution, r.version, r.fault, r.hint))
        if remotes:
            self._manager.register(EnvironmentHooks(remotes), "environments")

    def _add(self, plugin: LoadedPlugin) -> None:
        origin = (plugin.distribution, plugin.version)
        status = ProviderStatus("plugin", plugin.name, *origin, capabilities=plugin.hooks)
        fault = plugin.fault
        if plugin.module is not None and self._manager.is_registered(plugin.module):
            fault = "is a second entry point of a plugin that is already loaded"
        elif plugin.module is not None:
            self._manager.register(plugin.module, _label(plugin))
            for spec in plugin.specs:
                if isinstance(spec, ProviderSpec):
                    self._entries.append(_Entry(spec, *origin, *find_spec_fault(spec)))
                else:
                    fault = f"lists a {type(spec).__name__} among its providers"
        if fault:
            hint = plugin.hint or f"tell the author of {plugin.distribution}"
            self._plugins.append(replace(status, available=False, reason=fault, install_hint=hint))
        elif not plugin.specs:
            self._plugins.append(replace(status, summary="hooks only"))

    def _entry(self, kind: Kind, name: str) -> _Entry:
        found = [e for e in self._entries if (e.spec.kind, e.spec.name) == (kind, name)]
        for entry in found:
            if not self._fault(entry)[0]:
                return entry
        if found:
            raise ProviderError(_sentence(found[0].label, *self._fault(found[0])))
        raise ProviderError(self._unknown(kind, name))

    def _fault(self, entry: _Entry) -> tuple[str, str]:
        """Why a provider cannot be used (its own fault or a shared name), and what to do."""
        if entry.fault:
            return entry.fault, entry.hint
        same = [e for e in self._entries if _key(e) == _key(entry) and not e.fault]
        homes = list(dict.fromkeys(e.distribution for e in same))
        if len(homes) > 1 and CORE not in homes:
            return f"is brought by {' and '.join(homes)}", "uninstall all but one of them"
        if entry is not same[0]:
            owner = f"{same[0].distribution} {same[0].version}"
            return f"has a name that belongs to {owner}", f"tell the author of {entry.distribution}"
        return "", ""

    def _unknown(self, kind: Kind, name: str) -> str:
        if home := requirement_for(kind, name):
            return f"{kind} provider {name!r} comes with a plugin: pip install '{home}'"
        known = self.names(kind)
        base, _, environment = name.partition("@")
        if environment and not any(other.endswith(f"@{environment}") for other in known):
            return (
                f"no {kind} provider {base!r} in an environment {environment!r}: "
                f"'mpsfm env list' shows what there is, 'mpsfm env create' makes one"
            )
        text = f"no {kind} provider {name!r}{did_you_mean(name, known)}"
        others = [e.spec.kind for e in self._entries if e.spec.name == name]
        if others:
            text += f" ({name!r} is of kind {others[0]})"
        broken = [p for p in self._plugins if not p.available]
        if broken:
            text += "; plugins that did not load: "
            text += ", ".join(f"{p.distribution} ({p.reason})" for p in broken)
        return f"{text}; 'mpsfm plugins list' shows all"

    def _options_model(self, kind: Kind, name: str) -> type[Options] | None:
        entry = self._entry(kind, name)
        model: type[Options] | str | None = entry.spec.options
        return _load_reference(entry, model) if isinstance(model, str) else model

    def _construct(
        self,
        entry: _Entry,
        inner: tuple[Any, ...],
        options: Options | Mapping[str, Any] | None,
        context: ProviderContext,
    ) -> Any:
        if not isinstance(options, Options):
            options = self.validate_options(entry.spec.kind, entry.spec.name, options)
        factory = entry.spec.factory
        if isinstance(factory, str):
            factory = _load_reference(entry, factory)
        try:
            return factory(*inner, options, context)
        except MpsfmError:
            raise
        except (Exception, SystemExit) as error:
            what = f"could not be constructed: {type(error).__name__}: {error}"
            raise ProviderError(_sentence(entry.label, what, entry.spec.install_hint)) from error


class _NoOptions(Options):
    """For a provider that has no options: refuses every key."""


def _label(plugin: LoadedPlugin) -> str:
    return f"{plugin.distribution}: {plugin.name}"


def _key(entry: _Entry) -> tuple[str, str]:
    return entry.spec.kind, entry.spec.name


def _status(entry: _Entry, fault: str, hint: str) -> ProviderStatus:
    spec = entry.spec
    return ProviderStatus(
        spec.kind,
        str(spec.name),
        entry.distribution,
        entry.version,
        spec.code_license,
        spec.weights_license,
        tuple(sorted(map(str, spec.capabilities))),
        spec.summary,
        not fault,
        fault,
        hint,
    )


def _sentence(subject: str, what: str, hint: str) -> str:
    return f"{subject} {what}; {hint}" if hint else f"{subject} {what}"


def _load_reference(entry: _Entry, reference: str) -> Any:
    """The object that ``"package.module:Name"`` names."""
    module, _, path = reference.partition(":")
    try:
        target: Any = importlib.import_module(module)
        for attribute in path.split("."):
            target = getattr(target, attribute)
    except MpsfmError:
        raise
    except (Exception, SystemExit) as error:
        what = f"cannot be imported from {reference!r}: {type(error).__name__}: {error}"
        raise ProviderError(_sentence(entry.label, what, entry.spec.install_hint)) from error
    return target


def _methods(kind: Kind) -> list[str]:
    return [name for name in vars(PROTOCOLS[kind]) if not name.startswith("_")]


def _require_methods(entry: _Entry, provider: object, names: Sequence[str]) -> None:
    for name in names:
        if not callable(getattr(provider, name, None)):
            kind = type(provider).__name__
            raise ProviderError(f"{entry.label} gives a {kind} without the method {name}()")


def _default_timeout() -> float:
    value = os.environ.get(TIMEOUT_VARIABLE, "")
    try:
        return float(value) if value else DEFAULT_TIMEOUT_S
    except ValueError as error:
        raise InputError(f"{TIMEOUT_VARIABLE}={value!r} is not a number of seconds") from error


def core_version() -> str:
    """Version of the installed core, ``"source"`` in a tree that was never installed."""
    try:
        return metadata.version(CORE)
    except metadata.PackageNotFoundError:
        return "source"
