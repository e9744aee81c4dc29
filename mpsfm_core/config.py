"""The configuration of a run: YAML files and ``--set`` into one checked :class:`Config`.

A file may say ``extends:`` with the name of a shipped configuration or a path relative to itself.
Mappings are merged key by key, everything else is replaced; a block whose ``use:`` changes loses
the rest that its parent said of it, as another provider has other options, and a block that says
``use:`` loses its parent's ``otherwise:``. Where features, a
matcher or a multi-view network are named, the parent's quick matching is lost.

A block may name providers to take ``otherwise``. Which of them it will be is not the
configuration's to say: it depends on the machine, and :mod:`mpsfm_core.provision` finds it out
when a run starts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.errors import ConfigError, ProviderError, did_you_mean
from mpsfm_core.extraction.options import (
    AdjustmentOptions,
    ExtractionOptions,
    PairOptions,
    VerificationOptions,
)
from mpsfm_core.formats import VERSION, check_version
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.mapping.options import MapperOptions, MappingOptions
from mpsfm_core.options import (
    AS_DEPTH,
    FROM_MATCHER,
    FROM_MULTIVIEW,
    Backend,
    Options,
    SettingPath,
    SettingProblem,
    SettingsError,
    parse_settings,
)
from mpsfm_core.providers import Kind
from mpsfm_core.registry import Registry
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.uncertainty.file import CALIBRATIONS, read_values
from mpsfm_core.yaml_text import line_of, parse_assignment, parse_yaml, write_yaml

FORMAT = 1
"""Of configuration files."""


class RuntimeOptions(Options):
    """Where and how a run computes; nothing here changes what it computes but the seed.

    That is up to rounding: networks may add in another order on other devices and thread counts.
    What is cached stands, whatever made it.
    """

    workers: int | None = Field(None, ge=1)
    """Images or pairs that the extraction works on at once, null for one a core."""
    threads: int = Field(1, ge=1)
    """Threads that a provider may use for each of them."""
    seed: int = Field(0, ge=0)
    """Seed of everything random: providers, verification, mapper, pixels of ``dense.ply``."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where providers compute; ``auto`` takes a GPU when there is one."""
    cache_dir: Path | None = None
    """Folder of weights and extraction results, null for the platform's cache folder."""
    executor: str = "threads"
    """Where features, matches and priors are computed: ``threads`` of this process, or workers that
    a plugin reaches (``dask``, ``ray``) and that share ``cache_dir`` and the photos."""
    executor_options: dict[str, Any] = Field(default_factory=dict)
    """Of the executor, as ``address``."""
    on_error: Literal["fail", "skip"] = "fail"
    """A provider that fails on a photo (raises, breaks its contract, does not answer) ends the run,
    or the run goes on without that photo, or without that pair, and says so. More than half of the
    photos end it in any case."""
    timeout_s: float | None = Field(1800.0, gt=0)
    """Seconds that a provider may take for one photo or pair, null for any time."""
    checkpoint_s: float | None = Field(10.0, ge=0)
    """Seconds between checkpoints of the mapping, more where writing one takes long; a run that
    was killed goes on from the last. Null writes none, and none of the dense stage either."""
    check_resources: bool = True
    """A run that cannot fit into memory or onto the disk ends before a photo is decoded, and one
    that may not fit says so; off: what it takes is told and no more."""
    offline: bool = False
    """Never download; a missing weights file is an error."""


class QuickMatching(Options):
    """Features and a sparse matcher that cost little."""

    features: Backend
    matcher: Backend
    min_points: int = Field(100, ge=1)
    """An image is held in place by so many points that three images see. (COLMAP's
    init_min_num_inliers, what it takes to begin a model. Ours: images of fountain and
    rendered_kitchen see 321 and more; two triplets of hololens_room with 35 and 72 were wrong by 45
    and 5 degrees where the networks are right to 2.)"""
    partners: int = Field(15, ge=1)
    """``pairs.partners`` of images that are matched again, where not all pairs are. (Ours, of 26 of
    the 123 images of hololens_room: with 30, 15 and 10 partners networks match 641, 313 and 216
    pairs, pose AUC@1/5/20 is 6.4 / 51.2 / 85.2, 7.3 / 49.6 / 85.2 and 5.1 / 54.1 / 87.5.)"""


class Config(Options):
    """Everything a run needs to know besides its images and output folder."""

    description: str = ""
    """One line for ``mpsfm config list``; not inherited."""
    inputs: InputOptions = Field(default_factory=InputOptions)
    pairs: PairOptions = Field(default_factory=PairOptions)
    quick: QuickMatching | None = None
    """Matching that is tried first: photos that it holds in place are not given to ``features`` and
    ``matcher`` again, pairs with others are (:mod:`mpsfm_core.pipeline`)."""
    features: Backend | None = None
    matcher: Backend | None = None
    """Sparse matcher, needs ``features``."""
    dense_matcher: Backend | None = None
    """Detector-free matcher, instead of the sparse one or beside it."""
    retrieval: Backend | None = None
    multiview: Backend | None = None
    """Network that sees several photos at once, needed by ``depth: {use: multiview}``."""
    depth: Backend
    normals: Backend
    """Of the depth network's own pass with ``use: as-depth``, if that gives normals."""
    masks: tuple[Backend, ...] = ()
    """A pixel is used when all masks allow it."""
    verification: VerificationOptions = Field(default_factory=VerificationOptions)
    adjustment: AdjustmentOptions = Field(default_factory=AdjustmentOptions)
    extraction: ExtractionOptions = Field(default_factory=ExtractionOptions)
    mapping: MappingOptions = Field(default_factory=MappingOptions)
    dense: DenseOptions = Field(default_factory=DenseOptions)
    results: ResultOptions = Field(default_factory=ResultOptions)
    runtime: RuntimeOptions = Field(default_factory=RuntimeOptions)

    def backends(self) -> Iterator[tuple[SettingPath, Kind, Backend]]:
        """Every chosen provider: its path in the configuration, kind and block."""
        if self.quick is not None:
            yield ("quick", "features"), "features", self.quick.features
            yield ("quick", "matcher"), "matcher", self.quick.matcher
        for name, kind in _BLOCKS.items():
            backend = getattr(self, name)
            if backend is not None:
                yield (name,), kind, backend
        for index, backend in enumerate(self.masks):
            yield ("masks", index), "mask", backend

    def replaced(self, path: SettingPath, backend: Backend) -> Config:
        """The configuration with another backend at a path of :meth:`backends`."""
        block, *index = path
        value: Any = backend
        if block == "quick" and self.quick is not None:
            value = self.quick.model_copy(update={str(index[0]): backend})
        elif index:
            value = tuple(backend if i == index[0] else b for i, b in enumerate(self.masks))
        return self.model_copy(update={str(block): value})

    def quick_pass(self) -> Config | None:
        """The configuration with its quick matching alone, None where it has none."""
        if self.quick is None:
            return None
        alone = {"quick": None, "dense_matcher": None, **dict(self.quick)}
        return self.model_copy(update=alone)

    @property
    def tries_again(self) -> bool:
        """Whether quick matching is followed by another one where it does not suffice; not where
        the other's first choice cannot be had and the same features would be found again."""
        if self.quick is None:
            return False
        again = self.features is not None and self.features.use == self.quick.features.use
        return self.dense_matcher is not None or not again

    def mapper_options(self) -> MapperOptions:
        """The settings of the mapper, with the seed of the run."""
        return MapperOptions(**dict(self.mapping), seed=self.runtime.seed)

    def to_yaml(self) -> str:
        """The configuration with all defaults; loading it gives the same configuration."""
        return write_yaml({VERSION: FORMAT, **self.model_dump(mode="json")})


_BLOCKS: dict[str, Kind] = {
    "features": "features",
    "matcher": "matcher",
    "dense_matcher": "matcher",
    "retrieval": "retrieval",
    "multiview": "multiview",
    "depth": "depth",
    "normals": "normals",
}


_CAREFUL = ("features", "matcher", "dense_matcher", "multiview")
"""Blocks that quick matching does not go with unasked: who names a matcher wants that one, and what
a multi-view network is shown together is chosen by matches."""

BLOCKS = ("quick", *_BLOCKS, "masks")
"""The blocks that name providers, each after those that its choice depends on."""


def shipped_configs() -> dict[str, Path]:
    """The configurations that come with the package: name -> file, sorted by name."""
    package = Path(__file__).parent
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

    Raises :class:`~mpsfm_core.errors.ConfigError` with file, line, YAML path and, for unknown
    keys and names, the nearest valid one.
    """
    layers = _read_chain(_find(str(name_or_path), Path()))
    # A change of provider drops the options of its block, one of the matcher quick matching: it
    # goes before the overrides that set them.
    last = sorted(overrides, key=lambda text: (text.startswith("quick"), ".use=" not in text))
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
        line = line_of(self.text, path) if self.text else None
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
                merged.pop("quick", None)
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
        base = {key: value for key, value in base.items() if key != "otherwise"}
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
    for path, kind, backend in config.backends():
        try:
            known = backend.model_copy(
                update={"calibration": _calibration(path, kind, backend, layers)}
            )
            if known.is_open:
                _check_open(path, kind, known, registry, complete)
            else:
                known = check_backend(path, kind, known, registry, complete)
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
    path: SettingPath, kind: Kind, backend: Backend, registry: Registry, complete: bool
) -> None:
    """Raise if none of the candidates could be taken, whatever is on this machine later."""
    names = (backend.use, *backend.otherwise)
    here = [name for name in names if name in registry.names(kind)]
    known = {key for name in here for key in registry.default_options(kind, name)}
    unknown = [key for key in backend.options if key not in known]
    if here and unknown and AS_DEPTH not in names:
        places = [(*path, "options", key) for key in unknown]
        texts = [f"unknown key{did_you_mean(key, known)}" for key in unknown]
        raise SettingsError(tuple(map(SettingProblem, places, texts)))
    errors = []
    for name in here or names:
        if name == AS_DEPTH:
            return
        candidate = backend.model_copy(update={"use": name, "otherwise": ()})
        try:
            check_backend(path, kind, candidate, registry, complete)
            return
        except SettingsError as error:
            errors.append(error)
    if here:
        raise errors[0]
    raise SettingsError(tuple(problem for error in errors for problem in error.problems))


def check_backend(
    path: SettingPath, kind: Kind, backend: Backend, registry: Registry, complete: bool = True
) -> Backend:
    """A backend that names one provider, with its options and its wrappers' filled in.

    ``path``: of the block, for messages. ``complete=False`` lets required options be absent.

    Raises :class:`~mpsfm_core.options.SettingsError` when there is no such provider or wrapper,
    or an option is wrong.
    """
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
        check_backend((*path, "wrap", index), "wrapper", wrapper, registry, complete)
        for index, wrapper in enumerate(backend.wrap)
    )
    for index, wrapper in enumerate(wrap):
        if f"wraps-{kind}" not in registry.spec("wrapper", wrapper.use).capabilities:
            text = f"{wrapper.use!r} does not wrap {kind} providers"
            raise SettingsError((SettingProblem((*path, "wrap", index, "use"), text),))
    return backend.model_copy(update={"options": filled, "wrap": wrap})


def _calibration(
    path: SettingPath, kind: Kind, backend: Backend, layers: Sequence[_Layer]
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
    if config.quick is not None and config.depth.use == FROM_MATCHER:
        problems.append(SettingProblem(("quick",), "gives no depth, as depth.use: matcher needs"))
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
    if (alone := config.quick_pass()) is not None:
        for problem in combination_problems(alone, registry):
            problems.append(SettingProblem(("quick", *problem.path), problem.text))
    settled = {
        path[0]: registry.spec(kind, backend.use)
        for path, kind, backend in config.backends()
        if not backend.is_open
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
