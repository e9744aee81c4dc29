"""What a run needs, found or fetched before it looks at the first photo.

Providers, the packages below them, their weights, and the files and folders that their options
name. Where a block of the configuration leaves a choice (``fallback``, ``same-network``), the first
provider is taken that can be had here and now; weights that can be fetched count, until fetching
them fails.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from mpsfm_core.config import BLOCKS, Config, check_provider_config, combination_problems
from mpsfm_core.data.decisions import ChoiceReason, ProviderReason, Reason
from mpsfm_core.data.errors import ConfigError, InputError, WeightsError
from mpsfm_core.data.options import Options, SettingPath, SettingsError, dotted
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers import Kind, ProviderSpec, WeightsFile
from mpsfm_core.providers.provider_config import SAME_NETWORK, ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore, is_remote
from mpsfm_core.report.reasons import explain

_MEGABYTE = 1_000_000


@dataclass(frozen=True)
class ProviderChoice:
    """Which provider a block of the configuration has got, and why.

    ``block``: as ``depth`` or ``masks.0``. ``provider``: its specification; ``origin``: its
    distribution and version. ``passed_over``: what would have been preferred -> why it cannot be
    had. ``to_fetch``: weights that are not on this machine yet (of a preview only).
    """

    block: str
    provider: ProviderSpec
    origin: str
    reason: ChoiceReason
    passed_over: Mapping[str, Reason] = field(default_factory=dict)
    to_fetch: tuple[WeightsFile, ...] = ()

    def __str__(self) -> str:
        """In one line, for people."""
        spec = self.provider
        licenses = [spec.code_license]
        if spec.weights_license != "none":
            licenses.append(f"weights {spec.weights_license}")
        text = f"{self.block}: {spec.name} ({self.origin}; {', '.join(licenses)}), "
        text += explain(self.reason.because()).text
        if self.to_fetch:
            text += f"; to be fetched: {', '.join(map(describe_file, self.to_fetch))}"
        if spec.accuracy:
            text += f"; to expect: {spec.accuracy}"
        for name, why in self.passed_over.items():
            text += f"; not {name}: {explain(why).text}"
        return text


@dataclass(frozen=True)
class ProviderResolution:
    """A configuration that leaves no choice open, and how each of its providers was chosen."""

    config: Config
    choices: tuple[ProviderChoice, ...]


def resolve_providers(
    config: Config,
    registry: Registry,
    stages: Stages | None = None,
    blocks: Collection[str] = BLOCKS,
) -> ProviderResolution:
    """Find or fetch everything that a run with this configuration needs.

    ``stages`` is told of every choice and of downloads. ``blocks``: those that are wanted; others
    stay as they are. What is missing without a remedy is found out before anything is downloaded.

    Raises:
        ConfigError: a provider, or a file or folder that its options name, is missing; or the
            providers do not fit together.
        WeightsError: weights are missing, and no other provider may be taken instead.
    """
    stages = stages or Stages(registry)
    preview_providers(config, registry, blocks)
    downloads = _Downloads(stages)
    runtime = config.runtime
    store = WeightStore(runtime.cache_dir, True if runtime.offline else None, downloads.progress)

    def fetch(file: WeightsFile) -> None:
        with downloads.announced(file, store):
            store.resolve(file.uri, file.sha256)

    provision = _ProviderSearch(registry, fetch)(config, blocks)
    for choice in provision.choices:
        stages.notice(str(choice))
    return provision


def preview_providers(
    config: Config, registry: Registry, blocks: Collection[str] = BLOCKS
) -> ProviderResolution:
    """What :func:`resolve_providers` would give if every download succeeded; downloads nothing.

    Raises as :func:`resolve_providers`.
    """
    runtime = config.runtime
    store = WeightStore(runtime.cache_dir, True if runtime.offline else None)
    absent: list[WeightsFile] = []

    def look(file: WeightsFile) -> None:
        if store.locate(file.uri) is None:
            if store.offline or not is_remote(file.uri):
                store.resolve(file.uri, file.sha256)  # says what is missing, and what to do
            absent.append(file)

    return _ProviderSearch(registry, look, absent)(config, blocks)


def describe_file(file: WeightsFile) -> str:
    """URI and size of a weights file."""
    return file.uri if file.size is None else f"{file.uri} ({_megabytes(file.size)} MB)"


class _ProviderSearch:
    """Goes through the blocks of a configuration, and through the candidates of each.

    ``have``: sees to a weights file, raises where it cannot be had, and may note in ``absent`` that
    it is not here yet.
    """

    def __init__(
        self,
        registry: Registry,
        have: Callable[[WeightsFile], None],
        absent: list[WeightsFile] | None = None,
    ) -> None:
        self._registry = registry
        self._have = have
        self._absent = [] if absent is None else absent

    def __call__(self, config: Config, blocks: Collection[str]) -> ProviderResolution:
        choices = []
        for path, kind, backend in list(config.provider_configs()):
            if path[0] not in blocks:
                continue
            found, choice = self._choose(config, path, kind, backend)
            config = config.replaced(path, found)
            choices.append(choice)
        return ProviderResolution(config, tuple(choices))

    def _choose(
        self, config: Config, path: SettingPath, kind: Kind, backend: ProviderConfig
    ) -> tuple[ProviderConfig, ProviderChoice]:
        names = (backend.use, *backend.fallback)
        passed_over: dict[str, Reason] = {}
        for name in names:
            self._absent.clear()
            try:
                found = self._candidate(config, path, kind, backend, name)
            except InputError as error:
                if len(names) == 1:
                    raise
                passed_over[name] = _reason_of(error)
                continue
            reason = ChoiceReason.FIRST_CHOICE if backend.is_unresolved else ChoiceReason.CONFIGURED
            if passed_over:
                reason = ChoiceReason.FALLBACK
            spec = self._registry.spec(kind, found.use)
            origin = self._registry.version(kind, found.use)
            absent = tuple(self._absent)
            return found, ProviderChoice(dotted(path), spec, origin, reason, passed_over, absent)
        reasons = "; ".join(f"{name}: {explain(why).text}" for name, why in passed_over.items())
        raise ConfigError(f"{dotted(path)}: no provider can be had: {reasons}")

    def _candidate(
        self, config: Config, path: SettingPath, kind: Kind, backend: ProviderConfig, name: str
    ) -> ProviderConfig:
        """The block with this provider alone, once all that it needs is here."""
        candidate = backend.model_copy(update={"use": name, "fallback": ()})
        if name == SAME_NETWORK:
            candidate = self._same_network(config.depth, candidate)
        candidate = check_provider_config(path, kind, candidate, self._registry)
        if path[-1] in ("matcher", "dense_matcher"):
            self._check_fit(config.replaced(path, candidate), path)
        self._equip(path, kind, candidate)
        for index, wrapper in enumerate(candidate.wrap):
            self._equip((*path, "wrap", index), "wrapper", wrapper)
        return candidate

    def _same_network(self, depth: ProviderConfig, backend: ProviderConfig) -> ProviderConfig:
        if "joint-normals" not in self._registry.spec("depth", depth.use).capabilities:
            raise ConfigError(f"the depth provider {depth.use!r} gives no normals")
        return backend.model_copy(update={"use": depth.use, "options": depth.options})

    def _check_fit(self, config: Config, path: SettingPath) -> None:
        """Whether a matcher fits the features, which were chosen before."""
        problems = [p for p in combination_problems(config, self._registry) if p.path[0] == path[0]]
        if problems:
            raise SettingsError(tuple(problems))

    def _equip(self, path: SettingPath, kind: Kind, backend: ProviderConfig) -> None:
        """See to the files that a provider reads and to its weights."""
        options = self._registry.validate_options(kind, backend.use, backend.options)
        for key, file in _paths(options):
            if not file.exists():
                raise ConfigError(f"{dotted((*path, 'options', *key))}: {file} does not exist")
        for weights in self._registry.weights(kind, backend.use, backend.options):
            self._have(weights)


def _reason_of(error: InputError) -> Reason:
    """Return the typed reason why a provider cannot be used."""
    code = ProviderReason.UNAVAILABLE
    if isinstance(error, WeightsError):
        code = ProviderReason.NO_WEIGHTS
    elif isinstance(error, SettingsError):
        code = ProviderReason.INCOMPATIBLE
    return code.because(detail=str(error))


class _Downloads:
    """Tells of downloads: one line with the size before each, and a stage with its megabytes."""

    def __init__(self, stages: Stages) -> None:
        self._stages = stages
        self._stage = ""

    @contextmanager
    def announced(self, file: WeightsFile, store: WeightStore) -> Iterator[None]:
        """Around what may download a file."""
        if store.offline or not is_remote(file.uri) or store.locate(file.uri) is not None:
            yield
            return
        self._stage = f"fetch {file.uri.rpartition('/')[2]}"
        self._stages.notice(f"fetching {describe_file(file)}, licence {file.license}")
        with self._stages.step(self._stage, None if file.size is None else _megabytes(file.size)):
            yield

    def progress(self, name: str, done: int, total: int | None) -> None:
        """As :data:`mpsfm_core.providers.weights.Progress`."""
        self._stages.stage_progress(self._stage, _megabytes(done), _megabytes(total or done))


def _megabytes(size: int) -> int:
    return round(size / _MEGABYTE)


def _paths(options: Options | None, key: SettingPath = ()) -> Iterator[tuple[SettingPath, Path]]:
    """The files and folders that options name, with their places."""
    for name, value in options or ():
        if isinstance(value, Path):
            yield (*key, name), value
        elif isinstance(value, Options):
            yield from _paths(value, (*key, name))
