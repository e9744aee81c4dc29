"""Read configuration files and ``--set`` overrides into one checked :class:`Config`.

A configuration file may extend a shipped configuration or another file with ``extends:``. YAML
mappings are merged key by key, and all other values replace those of the parent file. Merging a
file with its parent file has three exceptions:

* A provider block with another ``use:`` than the parent file drops all keys of the parent's block,
  because another provider has different options.

* A provider block with ``use:`` drops the ``fallback:`` providers of the parent file.

* Naming features, a matcher or a multi-view network drops the block ``fast_pass:`` of the parent
  file, because the inexpensive first pass would replace the named provider for most images.

The choice among the providers of ``use:`` and ``fallback:`` depends on the machine and is made at
the start of a run, in :mod:`mpsfm_core.pipeline.provider_resolution`.
"""

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

REPLACE_FAST_PASS = ("features", "matcher", "dense_matcher", "multiview")
"""Configuration blocks whose ``use:`` drops the block ``fast_pass`` of the parent file. The block
``multiview`` is included because the groups of images of a multi-view network are chosen from the
match graph."""


def shipped_configs() -> dict[str, Path]:
    """Return the files of the shipped configurations by name, sorted."""
    package = Path(__file__).parents[1]
    # A wheel has the folder ``configs`` in the package, a source tree next to the package.
    folder = next(f for f in (package / "configs", package.parent / "configs") if f.is_dir())
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def describe_shipped() -> dict[str, str]:
    """Return the descriptions of the shipped configurations by name."""
    data = {name: _read_chain(path)[-1].data for name, path in shipped_configs().items()}
    return {name: str(values.get("description", "")) for name, values in data.items()}


def load_config(
    name_or_path: str | Path,
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    *,
    complete: bool = True,
) -> Config:
    """Read, merge and check a configuration.

    Args:
        name_or_path: Name of a shipped configuration, or a YAML file (a slash, .yaml or .yml marks
            a file).
        overrides: Settings such as ``masks.0.use=sky``, which replace those of the configuration
            files.
        registry: Providers that the configuration may name, by default ``Registry.discover()``.
        complete: If false, required provider options may be missing (null in the result).

    Returns:
        The configuration with all defaults filled in.

    Raises:
        ConfigError: a setting is wrong. The error message has the file, line and YAML path of the
            wrong setting and, for an unknown key, the nearest valid key.
    """
    layers = _read_chain(_find_file(str(name_or_path), Path()))
    # An override of ``X.use`` drops the options of ``X``, so overrides of options come later.
    order = sorted(overrides, key=lambda text: (text.startswith("fast_pass"), ".use=" not in text))
    layers += [_Layer(f"--set {text}", parse_assignment(text)) for text in order]
    try:
        merged, warnings = _merge_all(layers)
        config = parse_settings(Config, merged)
        config = _check(config, registry or Registry.discover(), layers, complete)
        return config.with_warnings(tuple(warnings))
    except SettingsError as error:
        raise ConfigError("; ".join(_locate(layers, p) for p in error.problems)) from error


@dataclass(frozen=True)
class _Layer:
    """Settings of one configuration file or one ``--set`` override."""

    source: str
    """Path of the configuration file, or the override as the user wrote it."""
    data: Mapping[str, Any]
    text: str = ""
    """Text of the configuration file, to find line numbers."""
    folder: Path = Path()
    """Folder of the configuration file, to resolve relative paths."""
    shipped: bool = False
    """True if the settings are those of a shipped configuration."""

    def has(self, path: SettingPath) -> bool:
        """Check whether the file or override has a setting at a YAML path."""
        node: Any = self.data
        for part in path:
            if isinstance(node, list) and isinstance(part, int) and part < len(node):
                node = node[part]
            elif isinstance(node, Mapping) and str(part) in node:
                node = node[str(part)]
            else:
                return False
        return True

    def locate(self, path: SettingPath) -> str:
        """Return ``FILE:LINE`` of a setting, or the text of the override."""
        line = find_line(self.text, path) if self.text else None
        return f"{self.source}:{line}" if line else self.source


def _find_file(name: str, folder: Path) -> Path:
    """Return the file of a shipped configuration, or of a path relative to a folder."""
    if "/" in name or "\\" in name or name.endswith((".yaml", ".yml")):
        path = folder / Path(name).expanduser()
        if not path.is_file():
            raise ConfigError(f"{path}: no such configuration file")
        return path
    shipped = shipped_configs()
    if name not in shipped:
        raise ConfigError(
            f"no configuration {name!r}{did_you_mean(name, shipped)}; the path of a configuration "
            "file ends in .yaml"
        )
    return shipped[name]


def _read_chain(path: Path, children: tuple[Path, ...] = ()) -> list[_Layer]:
    """Read a configuration file and the files that it extends, the base file first."""
    path = path.resolve()
    chain = (*children, path)
    if path in children:
        raise ConfigError(
            "extends: the files extend each other in a circle: " + " -> ".join(map(str, chain))
        )
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: the configuration file cannot be read: {error}") from error
    data = parse_yaml(text, str(path)) or {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: the file must be a mapping, is a {type(data).__name__}")
    check_version(data, FORMAT, path, ConfigError)
    data.pop(VERSION, None)
    parent = data.pop("extends", None)
    if children:
        data.pop("description", None)
    layer = _Layer(str(path), data, text, path.parent, path in shipped_configs().values())
    if parent is None:
        return [layer]
    if not isinstance(parent, str):
        raise ConfigError(f"{path}: extends: must name a configuration or a file, is {parent!r}")
    try:
        parent_path = _find_file(parent, path.parent)
    except ConfigError as error:
        raise ConfigError(f"{layer.locate(('extends',))}: extends: {error}") from error
    return [*_read_chain(parent_path, chain), layer]


def _merge_all(layers: Sequence[_Layer]) -> tuple[dict[str, Any], list[str]]:
    """Merge the settings of all files and overrides; warn if a user's file drops the fast pass."""
    merged: dict[str, Any] = {}
    warnings = []
    for layer in layers:
        try:
            named = [block for block in REPLACE_FAST_PASS if layer.has((block, "use"))]
            has_fast_pass = merged.get("fast_pass") is not None
            if named:
                merged.pop("fast_pass", None)
            if named and has_fast_pass and not layer.shipped and "fast_pass" not in layer.data:
                place = layer.locate((named[0], "use"))
                warnings.append(
                    f"{place}: naming {' and '.join(named)} disables the fast pass, so the named "
                    "providers process all images and pairs; set fast_pass to use a fast pass"
                )
            merged = _merge(merged, layer.data)
        except IndexError as error:
            raise ConfigError(f"{layer.source}: {error}") from error
    return merged, [] if merged.get("fast_pass") else warnings


def _merge(base: Any, change: Any) -> Any:
    """Merge a setting of a child file into the setting of its parent file."""
    if not isinstance(change, Mapping):
        return change
    is_indexed = bool(change) and all(isinstance(k, str) and k.isdigit() for k in change)
    if is_indexed and (base is None or isinstance(base, list)):
        return _merge_items(base or [], change)
    if not isinstance(base, Mapping) or change.get("use", base.get("use")) != base.get("use"):
        base = {}
    elif "use" in change:
        base = {key: value for key, value in base.items() if key != "fallback"}
    return {**base, **{key: _merge(base.get(key), value) for key, value in change.items()}}


def _merge_items(base: list[Any], change: Mapping[str, Any]) -> list[Any]:
    """Replace or append list entries by index, as in ``--set masks.0.use=sky``."""
    items = list(base)
    for key, value in change.items():
        index = int(key)
        if index > len(items):
            raise IndexError(f"no list entry {index}, because the list has {len(items)} entries")
        items[index : index + 1] = [_merge(items[index] if index < len(items) else None, value)]
    return items


def _check(config: Config, registry: Registry, layers: Sequence[_Layer], complete: bool) -> Config:
    """Check the options of every provider block, and fill in default options.

    In a provider block with ``fallback:``, only one of the named providers needs valid options. The
    options of a provider block with ``fallback:`` get no defaults, because the provider is chosen
    later.
    """
    problems: list[SettingProblem] = []
    checked = config
    for path, kind, block in config.provider_configs():
        try:
            calibration = _read_calibration(path, kind, block, layers)
            block = block.model_copy(update={"calibration": calibration})
            if block.is_unresolved:
                _check_candidates(path, kind, block, registry, complete)
            else:
                block = check_provider_config(path, kind, block, registry, complete)
            checked = checked.replaced(path, block)
        except SettingsError as error:
            problems += error.problems
    if not problems:
        problems += _missing_blocks(config)
    if not problems:
        problems += combination_problems(config, registry)
    if problems:
        raise SettingsError(tuple(problems))
    return checked


def _check_candidates(
    path: SettingPath, kind: Kind, block: ProviderConfig, registry: Registry, complete: bool
) -> None:
    """Raise SettingsError if no provider named by a block can be used on any machine."""
    names = (block.use, *block.fallback)
    installed = [name for name in names if name in registry.names(kind)]
    valid_keys = {key for name in installed for key in registry.default_options(kind, name)}
    unknown_keys = [key for key in block.options if key not in valid_keys]
    if installed and unknown_keys and SAME_NETWORK not in names:
        paths = [(*path, "options", key) for key in unknown_keys]
        texts = [f"unknown key{did_you_mean(key, valid_keys)}" for key in unknown_keys]
        raise SettingsError(tuple(map(SettingProblem, paths, texts)))
    errors = []
    for name in installed or names:
        if name == SAME_NETWORK:
            return
        candidate = block.model_copy(update={"use": name, "fallback": ()})
        try:
            check_provider_config(path, kind, candidate, registry, complete)
            return
        except SettingsError as error:
            errors.append(error)
    if installed:
        raise errors[0]
    raise SettingsError(tuple(problem for error in errors for problem in error.problems))


def check_provider_config(
    path: SettingPath,
    kind: Kind,
    block: ProviderConfig,
    registry: Registry,
    complete: bool = True,
) -> ProviderConfig:
    """Check a provider block without fallbacks; fill in the options of provider and wrappers.

    Args:
        path: Path of the provider block in the configuration, for error messages.
        kind: Kind of the provider.
        block: Provider block without fallbacks.
        registry: Installed providers.
        complete: If false, required provider options may be missing.

    Returns:
        The provider block with all options of the provider and its wrappers filled in.

    Raises:
        SettingsError: a provider or wrapper is not installed, or an option is wrong.
    """
    try:
        options = registry.validate_options(kind, block.use, block.options, (*path, "options"))
        filled = options.model_dump(mode="json") if options else {}
    except ProviderError as error:
        raise SettingsError((SettingProblem((*path, "use"), str(error)),)) from error
    except SettingsError as error:
        if complete or not all(problem.missing for problem in error.problems):
            raise
        filled = registry.default_options(kind, block.use) | block.options
    wrap = tuple(
        check_provider_config((*path, "wrap", index), "wrapper", wrapper, registry, complete)
        for index, wrapper in enumerate(block.wrap)
    )
    for index, wrapper in enumerate(wrap):
        if f"wraps-{kind}" not in registry.spec("wrapper", wrapper.use).capabilities:
            text = f"{wrapper.use!r} does not wrap {kind} providers"
            raise SettingsError((SettingProblem((*path, "wrap", index, "use"), text),))
    return block.model_copy(update={"options": filled, "wrap": wrap})


def _read_calibration(
    path: SettingPath, kind: Kind, block: ProviderConfig, layers: Sequence[_Layer]
) -> dict[str, Any] | None:
    """Return the calibrated uncertainty of a provider block; read the calibration file if named."""
    values, path = block.calibration, (*path, "calibration")
    if values is None:
        return None
    quantity = "depth" if kind == "multiview" else kind
    if quantity not in CALIBRATIONS:
        raise SettingsError((SettingProblem(path, f"a {kind} provider has no uncertainty"),))
    if isinstance(values, str):
        folder = next(layer.folder for layer in reversed(layers) if layer.has(path))
        file = folder / Path(values).expanduser()
        try:
            values = dict(read_values(file, quantity))
        except ConfigError as error:
            raise SettingsError((SettingProblem(path, str(error)),)) from error
    return parse_settings(CALIBRATIONS[quantity], values, path).model_dump(mode="json")


def _missing_blocks(config: Config) -> list[SettingProblem]:
    """Find missing configuration blocks that other blocks require."""
    if config.matcher is None and config.dense_matcher is None:
        return [SettingProblem(("matcher",), "a matcher or a dense_matcher is needed")]
    problems = []
    if config.fast_pass is not None and config.depth.use == FROM_MATCHER:
        problems.append(
            SettingProblem(("fast_pass",), "predicts no depth, which depth.use: matcher requires")
        )
    if config.depth.use == FROM_MULTIVIEW and config.multiview is None:
        problems.append(SettingProblem(("multiview",), "is needed by depth.use: multiview"))
    if config.matcher is not None and config.features is None:
        text = f"is needed by the sparse matcher {config.matcher.use!r}"
        problems.append(SettingProblem(("features",), text))
    if config.pairs.mode == "retrieval" and config.retrieval is None:
        problems.append(SettingProblem(("retrieval",), "is needed by pairs.mode: retrieval"))
    return problems


def combination_problems(config: Config, registry: Registry) -> list[SettingProblem]:
    """Find provider blocks that are valid alone but incompatible with each other.

    Provider blocks with ``fallback:`` or ``same-network`` are ignored, because their provider is
    not chosen yet. The path of a returned problem starts with the configuration block that should
    change.
    """
    problems = []
    if (fast_pass := config.fast_pass_config()) is not None:
        for problem in combination_problems(fast_pass, registry):
            problems.append(SettingProblem(("fast_pass", *problem.path), problem.text))
    specs = {
        path[0]: registry.spec(kind, block.use)
        for path, kind, block in config.provider_configs()
        if not block.is_unresolved
    }
    for name, capability in (("matcher", "sparse"), ("dense_matcher", "dense")):
        if name in specs and capability not in specs[name].capabilities:
            text = f"{specs[name].name!r} is not a {capability} matcher"
            problems.append(SettingProblem((name, "use"), text))
    if not {"matcher", "features"} <= specs.keys():
        return problems
    accepted_tags = set(specs["matcher"].tags)
    if accepted_tags and not accepted_tags & set(specs["features"].tags):
        text = f"{specs['matcher'].name!r} matches {', '.join(sorted(accepted_tags))} features"
        text += f", not {specs['features'].name!r}"
        problems.append(SettingProblem(("matcher", "use"), text))
    return problems


def _locate(layers: Sequence[_Layer], problem: SettingProblem) -> str:
    """Format the problem of a setting with file and line; later files are searched first."""
    for length in range(len(problem.path), 0, -1):
        path = problem.path[:length]
        for layer in reversed(layers):
            if layer.has(path):
                return f"{layer.locate(path)}: {problem}"
    return f"{layers[-1].source}: {problem}"
