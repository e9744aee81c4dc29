"""Providers that the caller passes as object, name or configuration block."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mpsfm_core.config.loading import (
    REPLACE_FAST_PASS,
    check_provider_config,
    combination_problems,
    load_config,
)
from mpsfm_core.config.model import PROVIDER_BLOCKS, Config
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.data.options import SettingPath, SettingsError, parse_settings
from mpsfm_core.providers import Kind
from mpsfm_core.providers.instances import spec_of_instance
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry

Provider = Any
"""Provider argument of a public function, which is the name of a provider, a configuration block
(mapping or :class:`~mpsfm_core.ProviderConfig`), or an object with the method that its provider
kind requires."""

_DEFAULT_MATCHER = "mutual-nearest"
"""Default matcher if the caller chooses only features; it accepts features of any kind."""


def configure(
    config: str | Path | Config,
    registry: Registry | None = None,
    overrides: Sequence[str] = (),
    *,
    masks: Sequence[Provider] | None = None,
    **providers: Provider,
) -> tuple[Config, Registry]:
    """Load a configuration and replace its providers by providers of the caller.

    Args:
        config: Name of a shipped configuration, a YAML file, or a loaded configuration.
        registry: Providers that the configuration may name, by default all installed providers.
        overrides: Settings such as ``"runtime.workers=2"``.
        masks: Mask providers of the caller, or None to keep the configured mask providers.
        providers: Provider of the caller by configuration block, such as ``depth``, where None
            keeps the configured provider. A dense matcher of the caller replaces a configured
            sparse matcher, and a sparse matcher replaces a dense matcher.

    Returns:
        The configuration, and the registry extended by the provider objects of the caller.

    Raises:
        ConfigError: a setting or provider is wrong.
        ProviderError: a provider object lacks a method.
    """
    registry = registry or Registry.discover()
    if not isinstance(config, Config):
        config = load_config(config, overrides, registry)
    elif overrides:
        raise TypeError(
            "overrides require the name or file of a configuration, not a loaded configuration"
        )
    given = {name: provider for name, provider in providers.items() if provider is not None}
    if "features" in given and not {"matcher", "dense_matcher"} & given.keys():
        given["matcher"] = _DEFAULT_MATCHER
    blocks: dict[str, Any] = {}
    for name, provider in given.items():
        kind = PROVIDER_BLOCKS[name]
        block, registry = _block(kind, (name,), provider, registry)
        if kind == "matcher":
            is_sparse = "sparse" in registry.spec(kind, block.use).capabilities
            blocks |= {"matcher": None, "dense_matcher": None}
            name = "matcher" if is_sparse else "dense_matcher"
        blocks[name] = block
    if masks is not None:
        checked = []
        for index, provider in enumerate(masks):
            block, registry = _block("mask", ("masks", index), provider, registry)
            checked.append(block)
        blocks["masks"] = tuple(checked)
    if blocks.keys() & set(REPLACE_FAST_PASS):
        blocks["fast_pass"] = None
    config = config.model_copy(update=blocks)
    if blocks and (problems := combination_problems(config, registry)):
        raise SettingsError(tuple(problems))
    return config, registry


def _block(
    kind: Kind, path: SettingPath, provider: Provider, registry: Registry
) -> tuple[ProviderConfig, Registry]:
    """Check a provider argument; return its configuration block and the extended registry."""
    if isinstance(provider, str):
        block = ProviderConfig(use=provider)
    elif isinstance(provider, Mapping):
        block = parse_settings(ProviderConfig, provider, path)
    elif isinstance(provider, ProviderConfig):
        block = provider
    else:
        spec = spec_of_instance(kind, provider)
        extended = registry.extended(spec)
        (name,) = set(extended.names(kind)) - set(registry.names(kind))
        block, registry = ProviderConfig(use=name), extended
    if block.is_unresolved:
        return block, registry
    try:
        return check_provider_config(path, kind, block, registry), registry
    except SettingsError as error:
        raise ConfigError("; ".join(map(str, error.problems))) from error
