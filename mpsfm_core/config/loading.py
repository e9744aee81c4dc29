"""The configuration of a run: YAML files and ``--set`` into one checked :class:`Config`.

A file may say ``extends:`` with the name of a shipped configuration or a path relative to itself.
Mappings are merged key by key, everything else is replaced; a block whose ``use:`` changes loses
the rest that its parent said of it, as another provider has other options, and a block that says
``use:`` loses its parent's ``fallback:``. Where features, a
matcher or a multi-view network are named, the parent's quick matching is lost.

A block may name providers to take ``fallback``. Which of them it will be is not the
configuration's to say: it depends on the machine, and
:mod:`mpsfm_core.pipeline.provider_resolution` finds it out when a run starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpsfm_core.config.model import FORMAT, Config
from mpsfm_core.data.errors import ConfigError, ProviderError, did_you_mean
from mpsfm_core.data.options import SettingPath, SettingProblem, SettingsError, parse_settings
from mpsfm_core.providers import Kind
from mpsfm_core.providers.provider_config import (
    FROM_MATCHER,
    FROM_MULTIVIEW,
    SAME_NETWORK,
    ProviderConfig,
)
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration_file import CALIBRATIONS, read_values
from mpsfm_core.support.format_versions import VERSION, check_version
from mpsfm_core.support.yaml_text import find_line, parse_assignment, parse_yaml

_CAREFUL = ("features", "matcher", "dense_matcher", "multiview")
"""Blocks that quick matching does not go with unasked: who names a matcher wants that one, and what
a multi-view network is shown together is chosen by matches."""


def shipped_configs() -> dict[str, Path]:
    """The configurations that come with the package: name -> file, sorted by name."""
    package = Path(__file__).parents[1]
    # Installed from a wheel they lie in the package, in a source tree beside it.
    folder = next(f for f in (package / "configs", package.parent / "configs") if f.is_dir())
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def describe_shipped() -> dict[str, str]:
    """The shipped configurations with their descriptions."""
    read = {name: _read_chain(path)[-1].data for name, path in shipped_configs().items()}
    return {name: str(data.get("description", "")) for name, data in read.items()}


def load_config(
    name_or_path: str | Path,
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    *,
    complete: bool = True,
) -> Config:
    """Read, merge and check a configuration.

    ``name_or_path``: a shipped name, or a YAML file (anything with a slash or ending in .yaml or
    .yml). ``overrides``: texts ``a.b=value`` with a YAML value, applied last; list entries by
    index. ``registry``: default ``Registry.discover()``; every backend's name and options are
    checked against it, and the returned options have all defaults filled in. ``complete=False``
    lets required options of backends be absent (they are null), to look at a configuration.

    Raises :class:`~mpsfm_core.data.errors.ConfigError` with file, line, YAML path and, for unknown
    keys and names, the nearest valid one.
    """
    layers = _read_chain(_find(str(name_or_path), Path()))
    # A change of provider drops the options of its block, one of the matcher quick matching: it
    # goes before the overrides that set them.
    last = sorted(overrides, key=lambda text: (text.startswith("fast_pass"), ".use=" not in text))
    layers += [_Layer(f"--set {text}", parse_assignment(text)) for text in last]
    try:
        config = parse_settings(Config, _merge_all(layers))
        return _check(config, registry or Registry.discover(), layers, complete)
    except SettingsError as error:
        raise ConfigError("; ".join(_located(layers, p) for p in error.problems)) from error


@dataclass(frozen=True)
class _Layer:
    """What one file or one ``--set`` says; ``text`` is the file's, ``folder`` where it lies."""

    source: str
    data: Mapping[str, Any]
    text: str = ""
    folder: Path = Path()

    def says(self, path: SettingPath) -> bool:
        """Whether there is an entry at ``path``."""
        node: Any = self.data
        for part in path:
            if isinstance(node, list) and isinstance(part, int) and part < len(node):
                node = node[part]
            elif isinstance(node, Mapping) and str(part) in node:
                node = node[str(part)]
            else:
                return False
        return True

    def place(self, path: SettingPath) -> str:
        """``FILE:LINE`` of an entry, or the override's text."""
        line = find_line(self.text, path) if self.text else None
        return f"{self.source}:{line}" if line else self.source


def _find(name: str, folder: Path) -> Path:
    if "/" in name or "\\" in name or name.endswith((".yaml", ".yml")):
        path = folder / Path(name).expanduser()
        if not path.is_file():
            raise ConfigError(f"{path}: no such configuration file")
        return path
    shipped = shipped_configs()
    if name not in shipped:
        raise ConfigError(
            f"no configuration {name!r}{did_you_mean(name, shipped)} (a file ends in .yaml)"
        )
    return shipped[name]


def _read_chain(path: Path, children: tuple[Path, ...] = ()) -> list[_Layer]:
    """The file's layers, the one that extends nothing first."""
    path = path.resolve()
    chain = (*children, path)
    if path in children:
        raise ConfigError("extends goes in a circle: " + " -> ".join(map(str, chain)))
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    data = parse_yaml(text, str(path)) or {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: must be a mapping, is a {type(data).__name__}")
    check_version(data, FORMAT, path, ConfigError)
    data.pop(VERSION, None)
    parent = data.pop("extends", None)
    if children:
        data.pop("description", None)
    layer = _Layer(str(path), data, text, path.parent)
    if parent is None:
        return [layer]
    if not isinstance(parent, str):
        raise ConfigError(f"{path}: extends: must be a name or a path, is {parent!r}")
    try:
        found = _find(parent, path.parent)
    except ConfigError as error:
        raise ConfigError(f"{layer.place(('extends',))}: extends: {error}") from error
    return [*_read_chain(found, chain), layer]


def _merge_all(layers: Sequence[_Layer]) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for layer in layers:
        try:
            if any(layer.says((block, "use")) for block in _CAREFUL):
                merged.pop("fast_pass", None)
            merged = _merge(merged, layer.data)
        except IndexError as error:
            raise ConfigError(f"{layer.source}: {error}") from error
    return merged


def _merge(base: Any, change: Any) -> Any:
    if not isinstance(change, Mapping):
        return change
    indices = bool(change) and all(isinstance(k, str) and k.isdigit() for k in change)
    if indices and (base is None or isinstance(base, list)):
        return _merge_items(base or [], change)
    if not isinstance(base, Mapping) or change.get("use", base.get("use")) != base.get("use"):
        base = {}
    elif "use" in change:  # who names a provider wants this one
        base = {key: value for key, value in base.items() if key != "fallback"}
    return {**base, **{key: _merge(base.get(key), value) for key, value in change.items()}}


def _merge_items(base: list[Any], change: Mapping[str, Any]) -> list[Any]:
    """``--set masks.0.use=...``: replace an entry of a list, or append the next one."""
    items = list(base)
    for key, value in change.items():
        index = int(key)
        if index > len(items):
            raise IndexError(f"entry {index} of a list that has {len(items)}")
        items[index : index + 1] = [_merge(items[index] if index < len(items) else None, value)]
    return items


def _check(config: Config, registry: Registry, layers: Sequence[_Layer], complete: bool) -> Config:
    """The configuration with the options of every backend checked and filled in.

    Of a backend that is open one candidate must be possible; its options stay as they are given.
    """
    problems: list[SettingProblem] = []
    checked = config
    for path, kind, backend in config.provider_configs():
        try:
            known = backend.model_copy(
                update={"calibration": _calibration(path, kind, backend, layers)}
            )
            if known.is_unresolved:
                _check_open(path, kind, known, registry, complete)
            else:
                known = check_provider_config(path, kind, known, registry, complete)
            checked = checked.replaced(path, known)
        except SettingsError as error:
            problems += error.problems
    if not problems:
        problems += _missing_blocks(config)
    if not problems:
        problems += combination_problems(config, registry)
    if problems:
        raise SettingsError(tuple(problems))
    return checked


def _check_open(
    path: SettingPath, kind: Kind, backend: ProviderConfig, registry: Registry, complete: bool
) -> None:
    """Raise if none of the candidates could be taken, whatever is on this machine later."""
    names = (backend.use, *backend.fallback)
    here = [name for name in names if name in registry.names(kind)]
    known = {key for name in here for key in registry.default_options(kind, name)}
    unknown = [key for key in backend.options if key not in known]
    if here and unknown and SAME_NETWORK not in names:
        places = [(*path, "options", key) for key in unknown]
        texts = [f"unknown key{did_you_mean(key, known)}" for key in unknown]
        raise SettingsError(tuple(map(SettingProblem, places, texts)))
    errors = []
    for name in here or names:
        if name == SAME_NETWORK:
            return
        candidate = backend.model_copy(update={"use": name, "fallback": ()})
        try:
            check_provider_config(path, kind, candidate, registry, complete)
            return
        except SettingsError as error:
            errors.append(error)
    if here:
        raise errors[0]
    raise SettingsError(tuple(problem for error in errors for problem in error.problems))


def check_provider_config(
    path: SettingPath,
    kind: Kind,
    backend: ProviderConfig,
    registry: Registry,
    complete: bool = True,
) -> ProviderConfig:
    """A backend that names one provider, with its options and its wrappers' filled in.

    ``path``: of the block, for messages. ``complete=False`` lets required options be absent.

    Raises :class:`~mpsfm_core.data.options.SettingsError` when there is no such provider or
    wrapper, or an option is wrong."""
    try:
        options = registry.validate_options(kind, backend.use, backend.options, (*path, "options"))
        filled = options.model_dump(mode="json") if options else {}
    except ProviderError as error:
        raise SettingsError((SettingProblem((*path, "use"), str(error)),)) from error
    except SettingsError as error:
        if complete or not all(problem.missing for problem in error.problems):
            raise
        filled = registry.default_options(kind, backend.use) | backend.options
    wrap = tuple(
        check_provider_config((*path, "wrap", index), "wrapper", wrapper, registry, complete)
        for index, wrapper in enumerate(backend.wrap)
    )
    for index, wrapper in enumerate(wrap):
        if f"wraps-{kind}" not in registry.spec("wrapper", wrapper.use).capabilities:
            text = f"{wrapper.use!r} does not wrap {kind} providers"
            raise SettingsError((SettingProblem((*path, "wrap", index, "use"), text),))
    return backend.model_copy(update={"options": filled, "wrap": wrap})


def _calibration(
    path: SettingPath, kind: Kind, backend: ProviderConfig, layers: Sequence[_Layer]
) -> dict[str, Any] | None:
    """The calibration's values, read from its file if it names one."""
    values, path = backend.calibration, (*path, "calibration")
    if values is None:
        return None
    quantity = "depth" if kind == "multiview" else kind
    if quantity not in CALIBRATIONS:
        raise SettingsError((SettingProblem(path, f"a {kind} provider has no uncertainty"),))
    if isinstance(values, str):
        folder = next(layer.folder for layer in reversed(layers) if layer.says(path))
        file = folder / Path(values).expanduser()
        try:
            values = dict(read_values(file, quantity))
        except ConfigError as error:
            raise SettingsError((SettingProblem(path, str(error)),)) from error
    return parse_settings(CALIBRATIONS[quantity], values, path).model_dump(mode="json")


def _missing_blocks(config: Config) -> list[SettingProblem]:
    """Blocks that others need."""
    if config.matcher is None and config.dense_matcher is None:
        return [SettingProblem(("matcher",), "a matcher or a dense_matcher is needed")]
    problems = []
    if config.fast_pass is not None and config.depth.use == FROM_MATCHER:
        problems.append(SettingProblem(("fast_pass",), "gives no depth, as depth.use: matcher needs"))
    if config.depth.use == FROM_MULTIVIEW and config.multiview is None:
        problems.append(SettingProblem(("multiview",), "is needed by depth.use: multiview"))
    if config.matcher is not None and config.features is None:
        text = f"is needed by the sparse matcher {config.matcher.use!r}"
        problems.append(SettingProblem(("features",), text))
    if config.pairs.mode == "retrieval" and config.retrieval is None:
        problems.append(SettingProblem(("retrieval",), "is needed by pairs.mode: retrieval"))
    return problems


def combination_problems(config: Config, registry: Registry) -> list[SettingProblem]:
    """What does not fit together in a configuration although each block is right by itself.

    Open blocks fit for the present. The path of a problem begins with the block that should change.
    """
    problems = []
    if (alone := config.fast_pass_config()) is not None:
        for problem in combination_problems(alone, registry):
            problems.append(SettingProblem(("fast_pass", *problem.path), problem.text))
    settled = {
        path[0]: registry.spec(kind, backend.use)
        for path, kind, backend in config.provider_configs()
        if not backend.is_unresolved
    }
    for name, capability in (("matcher", "sparse"), ("dense_matcher", "dense")):
        if name in settled and capability not in settled[name].capabilities:
            text = f"{settled[name].name!r} is not a {capability} matcher"
            problems.append(SettingProblem((name, "use"), text))
    if not {"matcher", "features"} <= settled.keys():
        return problems
    accepted = set(settled["matcher"].tags)
    if accepted and not accepted & set(settled["features"].tags):
        text = f"{settled['matcher'].name!r} matches {', '.join(sorted(accepted))} features"
        text += f", not {settled['features'].name!r}"
        problems.append(SettingProblem(("matcher", "use"), text))
    return problems


def _located(layers: Sequence[_Layer], problem: SettingProblem) -> str:
    """The problem with the place that caused it: the last layer that says most of its path."""
    for length in range(len(problem.path), 0, -1):
        path = problem.path[:length]
        for layer in reversed(layers):
            if layer.says(path):
                return f"{layer.place(path)}: {problem}"
    return f"{layers[-1].source}: {problem}"
