"""Registry that lists, checks and constructs providers of all installed plugins.

The class :class:`Registry` is no singleton. The pipeline creates a registry with
:meth:`Registry.discover` and passes the registry to its stages.
"""

from __future__ import annotations

import importlib
import logging
import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from importlib import metadata
from itertools import count
from types import MappingProxyType
from typing import Any

import pluggy

from mpsfm_core.data.decisions import HookReason, Reason
from mpsfm_core.data.errors import InputError, MpsfmError, ProviderError, did_you_mean
from mpsfm_core.data.options import Options, SettingPath, parse_settings
from mpsfm_core.providers import KINDS, Kind, ProviderContext, ProviderSpec, WeightsFile
from mpsfm_core.providers.builtin import plugin as builtin
from mpsfm_core.providers.discovery import (
    LoadedPlugin,
    create_plugin_manager,
    find_spec_fault,
    inspect_plugin,
    installed_plugins,
)
from mpsfm_core.providers.environments.environment import all_environments
from mpsfm_core.providers.environments.remote_provider import EnvironmentHooks, remote_providers
from mpsfm_core.providers.first_party import requirement_for
from mpsfm_core.providers.kinds import required_methods
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.source_hash import hash_requirement, hash_source
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_core.providers.validation import validate_filtered_pairs
from mpsfm_core.support.time_limit import time_limit

_log = logging.getLogger(__name__)

CORE = "mpsfm-core"
"""Pip package that contains the built-in providers. Providers of other pip packages cannot have the
name of a built-in provider of the same kind."""

TIMEOUT_VARIABLE = "MPSFM_PLUGIN_TIMEOUT_S"
"""Environment variable with the time limit in seconds for loading one plugin."""

DEFAULT_TIMEOUT_S = 10.0
"""Time limit in seconds for loading one plugin; a slow network disk needs several seconds."""

HOOK_TIMEOUT_S = 20.0
"""Time limit in seconds for a hook that a run calls. The contract of plugins allows 1 s for an
event; the time limit allows for a busy machine."""

_HOOKS_WITHOUT_TIMEOUT = {"mpsfm_filter_pairs"}
"""Hooks whose time grows with the number of images."""

_HOOK_VALIDATORS: Mapping[str, Callable[..., Any]] = MappingProxyType(
    {"mpsfm_filter_pairs": validate_filtered_pairs}
)
"""Functions that validate the return value of a plugin hook, by the name of the hook. A validator
receives the return value and the arguments of the hook. The validator returns the validated value,
and a sentence for each :class:`HookReason` to distrust the value."""

Calibration = DepthCalibration | NormalCalibration


@dataclass(frozen=True)
class ProviderStatus:
    """Status of one provider or plugin, as in one line of ``mpsfm plugins list``."""

    kind: Kind
    """Kind of the provider, or ``"plugin"`` for a plugin without usable providers."""
    name: str
    """Name of the provider, or of the plugin's entry point."""
    distribution: str
    version: str
    code_license: str = ""
    weights_license: str = ""
    capabilities: tuple[str, ...] = ()
    """Capabilities of the provider, or hooks of the plugin."""
    summary: str = ""
    available: bool = True
    reason: str = ""
    """Reason why the provider or plugin is not available, or an empty string."""
    install_hint: str = ""
    """Advice for the user on how to install or repair an unavailable provider or plugin."""


@dataclass(frozen=True)
class _Entry:
    """Registered specification of a provider with the pip package that contains it."""

    spec: ProviderSpec
    distribution: str
    version: str
    fault: str = ""
    """Reason why the provider is unavailable, or an empty string."""
    hint: str = ""
    """Advice for the user on how to make the provider available."""
    is_versioned: bool = True
    """False if the provider is an object or function of this process without a version."""

    @property
    def label(self) -> str:
        """Kind, name, pip package and version of the provider, for messages to the user."""
        return f"{self.spec.kind} provider {self.spec.name!r} ({self.distribution} {self.version})"


class Registry:
    """Collection of all providers by kind and name, and of the hooks of all plugins.

    The constructor creates an empty registry. The method :meth:`discover` returns a registry with
    the built-in providers and all installed plugins. Listing providers does not import their code,
    which only :meth:`create` imports.
    """

    def __init__(self) -> None:
        self._entries: list[_Entry] = []
        self._plugins: list[ProviderStatus] = []
        self._manager = create_plugin_manager()
        self._hook_reasons: dict[tuple[str, str, HookReason], Reason] = {}

    @classmethod
    def discover(
        cls,
        timeout_s: float | None = None,
        environments: bool = True,
        *,
        without: Collection[tuple[str, str]] = (),
        on_load: Callable[[str, str], None] | None = None,
    ) -> Registry:
        """Create a registry of the built-in providers, all installed plugins and environments.

        The registry lists a plugin that fails to load with the reason, and loads all other plugins.

        Args:
            timeout_s: Time limit in seconds for loading one plugin, by default
                ``$MPSFM_PLUGIN_TIMEOUT_S`` or 10.
            environments: True also registers the providers of other Python environments as
                ``NAME@ENVIRONMENT``, see :mod:`mpsfm_core.providers.environments`.
            without: Pairs (name, module) of entry points that crash the process. Their plugins are
                listed as unavailable and not loaded.
            on_load: Function that is called with the name and module of each plugin before the
                plugin is loaded.

        Returns:
            Registry with the providers of all plugins.
        """
        registry = cls()
        registry.register(builtin, name="builtin", distribution=CORE, version=core_version())
        limit = _default_timeout() if timeout_s is None else timeout_s
        for plugin in installed_plugins(limit, without, on_load):
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
        version: str | None = None,
    ) -> None:
        """Register a plugin that is defined in this process, without an installed package.

        Args:
            plugin: Plugin module, or object with methods that are marked by ``@hookimpl``.
            name: Name of the plugin, by default the name of the module or class ``plugin``.
            distribution: Name of the pip package that ``mpsfm plugins list`` shows.
            version: Version of the plugin's code, as in :meth:`add`.

        Raises:
            ProviderError: The plugin fails to load or is already registered.
        """
        name = name or str(getattr(plugin, "__name__", type(plugin).__name__))
        try:
            loaded = inspect_plugin(plugin, name, distribution, version or "0")
        except Exception as error:
            raise ProviderError(
                f"plugin {name!r} fails to load: {type(error).__name__}: {error}"
            ) from error
        if self._manager.is_registered(plugin) or self._manager.has_plugin(_label(loaded)):
            raise ProviderError(f"plugin {name!r} is registered already")
        self._add(loaded, is_versioned=version is not None)

    def add(
        self, *specs: ProviderSpec, distribution: str = "this process", version: str | None = None
    ) -> None:
        """Register provider specifications without a plugin; their factory may be a callable.

        Args:
            specs: Specifications of the providers to register.
            distribution: Name of the pip package that ``mpsfm plugins list`` shows.
            version: Version of the providers' code, which the caller has to change whenever the
                code changes. Without a version, later runs do not reuse results of callable
                factories from the cache.
        """
        for spec in specs:
            fault = find_spec_fault(spec)
            is_versioned = version is not None
            self._entries.append(
                _Entry(spec, distribution, version or "0", *fault, is_versioned=is_versioned)
            )

    def extended(self, spec: ProviderSpec) -> Registry:
        """Return a copy of the registry, with an additional provider of the calling program.

        The name of the provider gets a number if another provider has the same name.

        Args:
            spec: Specification of the additional provider.
        """
        names = {entry.spec.name for entry in self._entries if entry.spec.kind == spec.kind}
        free = (f"{spec.name}-{number}" if number > 1 else spec.name for number in count(1))
        extended = copy(self)
        extended._entries = list(self._entries)
        extended.add(replace(spec, name=next(name for name in free if name not in names)))
        return extended

    def status(self) -> tuple[ProviderStatus, ...]:
        """List all providers by kind and name, then plugins without usable providers."""
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
        """Return the sorted names of the available providers of one kind, such as ``depth``."""
        entries = [e for e in self._entries if e.spec.kind == kind]
        return sorted(e.spec.name for e in entries if not self._fault(e)[0])

    def spec(self, kind: Kind, name: str) -> ProviderSpec:
        """Return the specification of an available provider.

        Args:
            kind: Kind of the provider, such as ``depth``.
            name: Name of the provider, or ``DISTRIBUTION:NAME`` if several pip packages contain
                providers of the same name.

        Raises:
            ProviderError: No provider has that kind and name, or the provider is unavailable. The
                error message has the reason, the most similar provider name, or the package to
                install.
        """
        return self._entry(kind, name).spec

    def version(self, kind: Kind, name: str) -> str:
        """Return the pip package and version of a provider, such as ``mpsfm-onnx 0.1.0``."""
        entry = self._entry(kind, name)
        return f"{entry.distribution} {entry.version}"

    def code_keys(self, kind: Kind, name: str) -> dict[str, str] | None:
        """Return hashes of a provider's code and versions of its required packages.

        Returns:
            Hash or version by module name, or None if the code of the provider cannot be
            identified. The code of a factory function in this process is only identified by a
            version with which the function is registered.
        """
        entry = self._entry(kind, name)
        factory = entry.spec.factory
        # The client of a provider in another environment requests the code hashes from that
        # environment.
        if hasattr(factory, "code_keys"):
            keys: dict[str, str] | None = factory.code_keys()
            return keys
        found: dict[str, str | None] = {}
        if isinstance(factory, str):
            module = factory.partition(":")[0]
            found[module] = hash_source(module)
        elif not entry.is_versioned:
            return None
        found |= {module: hash_requirement(module) for module in entry.spec.requires}
        known = {module: key for module, key in found.items() if key is not None}
        return known if len(known) == len(found) else None

    def validate_options(
        self,
        kind: Kind,
        name: str,
        values: Mapping[str, Any] | None = None,
        path: SettingPath = ("options",),
    ) -> Options | None:
        """Validate option values of a provider and add default values.

        Args:
            kind: Kind of the provider, such as ``depth``.
            name: Name of the provider.
            values: Option values from the configuration.
            path: Path of the options in the configuration, for error messages.

        Returns:
            Validated options of the provider, or None if the provider has no options.

        Raises:
            SettingsError: An option name or value is wrong. The error message has the path of the
                option and the most similar option name.
        """
        model = self._options_model(kind, name)
        return parse_settings(model or _NoOptions, values or {}, path) if model or values else None

    def default_options(self, kind: Kind, name: str) -> dict[str, Any]:
        """Return the default option values of a provider, with None for required options."""
        model = self._options_model(kind, name) or _NoOptions
        return dict.fromkeys(model.model_fields) | model.model_construct().model_dump(mode="json")

    def weights(
        self, kind: Kind, name: str, values: Mapping[str, Any] | None = None
    ) -> tuple[WeightsFile, ...]:
        """List the weights files that a provider loads with the given options.

        Args:
            kind: Kind of the provider, such as ``depth``.
            name: Name of the provider.
            values: Option values from the configuration.

        Returns:
            Weights files of the provider, with URI and expected hash.

        Raises:
            SettingsError: An option value of the provider is wrong or missing.
            ProviderError: The function with which the plugin declares the weights files raises an
                exception.
        """
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

    def calibration(self, kind: Kind, config: ProviderConfig) -> Calibration:
        """Return the uncertainty model of a depth, multi-view or normals provider.

        The uncertainty model is searched in the configuration, then in the wrapper providers from
        the outermost to the innermost, then in the provider. Without a declared uncertainty model,
        the default values of :class:`DepthCalibration` or :class:`NormalCalibration` are used. A
        wrapper or provider declares an uncertainty model by the plugin's ``mpsfm_calibration`` hook
        or in its specification.

        Args:
            kind: Kind of the provider, such as ``depth``.
            config: Configuration of the provider. The value of ``config.calibration`` is no file
                name, because calibration files are read when the configuration is loaded.

        Returns:
            Uncertainty model of the provider.
        """
        model: type[Calibration] = NormalCalibration if kind == "normals" else DepthCalibration
        if isinstance(config.calibration, Mapping):
            return parse_settings(model, config.calibration, ("calibration",))
        wrappers: list[tuple[Kind, ProviderConfig]] = [
            ("wrapper", w) for w in reversed(config.wrap)
        ]
        for chosen, block in (*wrappers, (kind, config)):
            options = self.validate_options(chosen, block.use, block.options)
            answers = self.call_hook(
                "mpsfm_calibration",
                kind=chosen,
                provider=self.spec(chosen, block.use).name,
                options=options,
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
        """Import and construct a provider and the wrapper providers around it.

        Args:
            kind: Kind of the provider, such as ``depth``.
            name: Name of the provider.
            options: Validated options of the provider, or option values from the configuration.
            context: Device, threads, seed and weights access for the factory of the provider.
            wrap: Configurations of the wrapper providers, innermost first.

        Returns:
            Provider object with the methods of the protocol of its kind.

        Raises:
            ProviderError: The provider cannot be imported or constructed, or the provider object
                lacks a method.
            MpsfmError: Any MP-SfM error that the provider's factory raises, unchanged.
        """
        entry = self._entry(kind, name)
        provider = self._construct(entry, (), options, context)
        _require_methods(entry, provider, required_methods(kind, entry.spec.capabilities))
        for wrapper in wrap:
            outer = self._entry("wrapper", wrapper.use)
            if f"wraps-{kind}" not in outer.spec.capabilities:
                raise ProviderError(f"{outer.label} does not wrap {kind} providers")
            provider = self._construct(outer, (provider,), wrapper.options, context)
            _require_methods(outer, provider, required_methods(kind))
        return provider

    def hook_modules(self) -> dict[tuple[str, str], object]:
        """Return the registered plugin modules by pip package and name of the entry point."""
        modules = {}
        for label, module in self._manager.list_name_plugin():
            distribution, separator, name = label.partition(": ")
            if separator and module is not None:
                modules[distribution, name] = module
        return modules

    @property
    def hook(self) -> pluggy.HookRelay:
        """Hooks of all plugins, which unlike :meth:`call_hook` let exceptions pass."""
        return self._manager.hook

    def call_hook(self, name: str, /, **arguments: Any) -> list[Any]:
        """Call a hook of every plugin and return the values that are not None.

        If a plugin's hook raises an exception, returns an invalid value or does not return within
        :data:`HOOK_TIMEOUT_S`, a warning is logged and this hook of the plugin is not called
        again. An error in a viewer or logger plugin must not end a run. :attr:`hook_reasons` lists
        the hooks that are left out.

        Args:
            name: Name of the plugin hook to call.
            arguments: Keyword arguments of the plugin hook.

        Returns:
            Return values of the hooks, in the order in which the plugins were registered.
        """
        answers = []
        for implementation in reversed(getattr(self.hook, name).get_hookimpls()):
            plugin = implementation.plugin_name
            if (plugin, name, HookReason.LEFT_OUT) in self._hook_reasons:
                continue
            given = {key: arguments[key] for key in implementation.argnames}
            doubts: dict[HookReason, str] = {}
            try:
                limit_s = math.inf if name in _HOOKS_WITHOUT_TIMEOUT else HOOK_TIMEOUT_S
                with time_limit(limit_s, name):
                    answer = implementation.function(**given)
                if answer is not None and name in _HOOK_VALIDATORS:
                    answer, doubts = _HOOK_VALIDATORS[name](answer, **arguments)
            except Exception as error:
                answer = None
                doubts = {HookReason.LEFT_OUT: f"{type(error).__name__}: {error}"}
                _log.debug("plugin %r failed in %s", plugin, name, exc_info=True)
            for code, detail in doubts.items():
                self._warn_of_hook(code, plugin, name, detail)
            if answer is not None:
                answers.append(answer)
        return answers

    @property
    def hook_reasons(self) -> list[Reason]:
        """Reasons why hooks of plugins were left out or distrusted, each reported once."""
        return list(self._hook_reasons.values())

    def _warn_of_hook(self, code: HookReason, plugin: str, hook: str, detail: str) -> None:
        """Log a warning about a plugin's hook and record its reason, unless it is recorded."""
        if (plugin, hook, code) not in self._hook_reasons:
            reason = code.because(plugin=plugin, hook=hook, detail=detail)
            self._hook_reasons[plugin, hook, code] = reason
            text = "failed in %s and is left out" if code is HookReason.LEFT_OUT else "%s"
            _log.warning(f"plugin %r {text}: %s", plugin, hook, detail)

    def _add_environments(self) -> None:
        remotes = [r for environment in all_environments() for r in remote_providers(environment)]
        for r in remotes:
            self._entries.append(_Entry(r.spec, r.distribution, r.version, r.fault, r.hint))
        if remotes:
            self._manager.register(EnvironmentHooks(remotes), "environments")

    def _add(self, plugin: LoadedPlugin, *, is_versioned: bool = True) -> None:
        origin = (plugin.distribution, plugin.version)
        status = ProviderStatus("plugin", plugin.name, *origin, capabilities=plugin.hooks)
        fault = plugin.fault
        if plugin.module is not None and self._manager.is_registered(plugin.module):
            fault = "is a second entry point of a plugin that is already loaded"
        elif plugin.module is not None:
            self._manager.register(plugin.module, _label(plugin))
            for spec in plugin.specs:
                if isinstance(spec, ProviderSpec):
                    fault_of_spec = find_spec_fault(spec)
                    self._entries.append(
                        _Entry(spec, *origin, *fault_of_spec, is_versioned=is_versioned)
                    )
                else:
                    fault = f"lists a {type(spec).__name__} among its providers"
        if fault:
            hint = plugin.hint or f"tell the author of {plugin.distribution}"
            self._plugins.append(replace(status, available=False, reason=fault, install_hint=hint))
        elif not plugin.specs:
            self._plugins.append(replace(status, summary="hooks only"))

    def _entry(self, kind: Kind, name: str) -> _Entry:
        distribution, _, plain = str(name).rpartition(":")
        matching = [
            e
            for e in self._entries
            if (e.spec.kind, str(e.spec.name)) == (kind, plain)
            and (not distribution or e.distribution == distribution)
        ]
        faults = [(e.fault, e.hint) if distribution else self._fault(e) for e in matching]
        for entry, (fault, _) in zip(matching, faults, strict=True):
            if not fault:
                return entry
        if matching:
            raise ProviderError(_sentence(matching[0].label, *faults[0]))
        raise ProviderError(self._unknown(kind, name))

    def _fault(self, entry: _Entry) -> tuple[str, str]:
        """Return why a provider is unavailable and advice for the user, or empty strings."""
        if entry.fault:
            return entry.fault, entry.hint
        same_name = [e for e in self._entries if _key(e) == _key(entry) and not e.fault]
        distributions = list(dict.fromkeys(e.distribution for e in same_name))
        if len(distributions) > 1 and CORE not in distributions:
            names = " or ".join(f"'{d}:{entry.spec.name}'" for d in distributions)
            return (
                f"is brought by {' and '.join(distributions)}",
                f"choose {names} in the 'use' key",
            )
        if entry is not same_name[0]:
            owner = f"{same_name[0].distribution} {same_name[0].version}"
            hint = f"choose '{entry.distribution}:{entry.spec.name}' in the 'use' key"
            return f"has a name that belongs to {owner}", hint
        return "", ""

    def _unknown(self, kind: Kind, name: str) -> str:
        if requirement := requirement_for(kind, name):
            return f"{kind} provider {name!r} comes with a plugin: pip install '{requirement}'"
        known = self.names(kind)
        if ":" in name:
            known = [
                f"{e.distribution}:{e.spec.name}" for e in self._entries if e.spec.kind == kind
            ]
        base, _, environment = name.partition("@")
        if environment and not any(n.endswith(f"@{environment}") for n in known):
            return (
                f"no {kind} provider {base!r} in an environment {environment!r}: "
                f"'mpsfm env list' shows what there is, 'mpsfm env create' makes one"
            )
        text = f"no {kind} provider {name!r}{did_you_mean(name, known)}"
        other_kinds = [e.spec.kind for e in self._entries if e.spec.name == name]
        if other_kinds:
            text += f" ({name!r} is of kind {other_kinds[0]})"
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
    """Options class of a provider without options, which rejects every option."""


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
    """Import the class or function that a text ``"package.module:Name"`` names."""
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


def _require_methods(entry: _Entry, provider: object, names: Sequence[str]) -> None:
    for name in names:
        if not callable(getattr(provider, name, None)):
            kind = type(provider).__name__
            raise ProviderError(f"{entry.label} is a {kind} without the method {name}()")


def _default_timeout() -> float:
    value = os.environ.get(TIMEOUT_VARIABLE, "")
    try:
        return float(value) if value else DEFAULT_TIMEOUT_S
    except ValueError as error:
        raise InputError(
            f"variable {TIMEOUT_VARIABLE}={value!r} is not a number of seconds"
        ) from error


def core_version() -> str:
    """Return the version of mpsfm-core, or ``"source"`` if the package is not installed."""
    try:
        return metadata.version(CORE)
    except metadata.PackageNotFoundError:
        return "source"
