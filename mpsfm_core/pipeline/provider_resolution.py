"""Choice of providers, weights and files before the first image is decoded.

A configuration block with ``fallback`` or ``same-network`` gets the first provider that is
available on this machine. A provider is available if its plugin is installed and accepts the
options, and if its weights are present or can be downloaded. If a download fails, the next provider
is tried.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from mpsfm_core.config import BLOCKS, Config, check_provider_config, combination_problems
from mpsfm_core.data.decisions import ChoiceReason, ProviderReason, Reason
from mpsfm_core.data.errors import ConfigError, InputError, WeightsError
from mpsfm_core.data.options import Options, SettingPath, SettingsError, dotted
from mpsfm_core.extraction.report import ProviderReport
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers import Kind, ProviderSpec, WeightsFile
from mpsfm_core.providers.provider_config import SAME_NETWORK, ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore, is_remote
from mpsfm_core.report.reasons import explain
from mpsfm_core.results.summary import ProviderSummary

_MEGABYTE = 1_000_000


@dataclass(frozen=True)
class ProviderChoice:
    """Provider chosen for one configuration block, with the reason of the choice."""

    block: str
    """Name of the configuration block, such as ``depth`` or ``masks.0``."""
    provider: ProviderSpec
    origin: str
    """Name and version of the Python distribution that contains the provider."""
    reason: ChoiceReason
    passed_over: Mapping[str, Reason] = field(default_factory=dict)
    """Reasons why preferred providers are unavailable, by provider name."""
    to_fetch: tuple[WeightsFile, ...] = ()
    """Weights files to download; empty after :func:`resolve_providers`."""

    def __str__(self) -> str:
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
    """Configuration with one provider per block, and the reasons of the choices."""

    config: Config
    choices: tuple[ProviderChoice, ...]
    """Chosen provider of each configuration block, in the order of
    :meth:`Config.provider_configs`."""

    def describe(self, usage: Sequence[ProviderReport]) -> list[ProviderSummary]:
        """Describe choice, licenses and usage of the provider of each configuration block."""
        reports = {(report["kind"], report["name"]): report for report in usage}
        described: list[ProviderSummary] = []
        blocks = zip(self.choices, self.config.provider_configs(), strict=True)
        for choice, (_, kind, provider_config) in blocks:
            spec = choice.provider
            unused = ProviderReport(
                kind=kind, name=spec.name, computed=0, from_cache=0, seconds=0.0
            )
            described.append(
                {
                    "block": choice.block,
                    **reports.get((kind, spec.name), unused),
                    "from": choice.origin,
                    "chosen": choice.reason.value,
                    "passed_over": {
                        name: why.to_json() for name, why in choice.passed_over.items()
                    },
                    "code_license": spec.code_license,
                    "weights_license": spec.weights_license,
                    "accuracy": spec.accuracy,
                    "wrappers": [wrapper.use for wrapper in provider_config.wrap],
                }
            )
        return described


def resolve_providers(
    config: Config,
    registry: Registry,
    stages: Stages | None = None,
    blocks: Collection[str] = BLOCKS,
) -> ProviderResolution:
    """Choose the provider of every configuration block, and download weights.

    Blocks for which no provider can be available raise an error before the first download.

    Args:
        config: Configuration that may name several candidate providers per block.
        registry: Installed providers.
        stages: Receiver of messages about choices and downloads.
        blocks: Names of the configuration blocks that get a provider; other blocks stay unchanged.

    Returns:
        The configuration with one provider per block, and the reasons of the choices.

    Raises:
        ConfigError: a provider or a file named in its options is missing, or the providers are
            incompatible.
        WeightsError: weights are missing, and no fallback is available.
    """
    stages = stages or Stages(registry)
    preview_providers(config, registry, blocks)
    downloads = _Downloads(stages)
    runtime = config.runtime
    store = WeightStore(runtime.cache_dir, True if runtime.offline else None, downloads.progress)

    def fetch(file: WeightsFile) -> None:
        with downloads.announced(file, store):
            store.resolve(file.uri, file.sha256)

    resolution = _ProviderSearch(registry, fetch)(config, blocks)
    for choice in resolution.choices:
        stages.notice(str(choice))
    return resolution


def preview_providers(
    config: Config, registry: Registry, blocks: Collection[str] = BLOCKS
) -> ProviderResolution:
    """Choose the providers as if every download succeeded, without downloading anything.

    The function has the arguments and raises the errors of :func:`resolve_providers`.
    """
    runtime = config.runtime
    store = WeightStore(runtime.cache_dir, True if runtime.offline else None)
    absent: list[WeightsFile] = []

    def require(file: WeightsFile) -> None:
        if store.locate(file.uri) is None:
            if store.offline or not is_remote(file.uri):
                # The call raises a WeightsError, whose message tells how to get the weights.
                store.resolve(file.uri, file.sha256)
            absent.append(file)

    return _ProviderSearch(registry, require, absent)(config, blocks)


def describe_file(file: WeightsFile) -> str:
    """Return URI and size of a weights file as text."""
    return file.uri if file.size is None else f"{file.uri} ({_megabytes(file.size)} MB)"


class _ProviderSearch:
    """Search for the first available provider of each configuration block.

    Args:
        registry: Installed providers.
        require_weights: Function that makes a weights file available, or raises WeightsError.
            Instead of downloading a file, the function may append the file to the list ``absent``.
        absent: Weights of the current candidate provider that must be downloaded.
    """

    def __init__(
        self,
        registry: Registry,
        require_weights: Callable[[WeightsFile], None],
        absent: list[WeightsFile] | None = None,
    ) -> None:
        self._registry = registry
        self._require_weights = require_weights
        self._absent = [] if absent is None else absent

    def __call__(self, config: Config, blocks: Collection[str]) -> ProviderResolution:
        choices = []
        for path, kind, block in list(config.provider_configs()):
            if path[0] not in blocks:
                continue
            resolved, choice = self._choose(config, path, kind, block)
            config = config.replaced(path, resolved)
            choices.append(choice)
        return ProviderResolution(config, tuple(choices))

    def _choose(
        self, config: Config, path: SettingPath, kind: Kind, block: ProviderConfig
    ) -> tuple[ProviderConfig, ProviderChoice]:
        names = (block.use, *block.fallback)
        passed_over: dict[str, Reason] = {}
        for name in names:
            self._absent.clear()
            try:
                resolved = self._prepare(config, path, kind, block, name)
            except InputError as error:
                if len(names) == 1:
                    raise
                passed_over[name] = _reason_of(error)
                continue
            reason = ChoiceReason.FIRST_CHOICE if block.is_unresolved else ChoiceReason.CONFIGURED
            if passed_over:
                reason = ChoiceReason.FALLBACK
            spec = self._registry.spec(kind, resolved.use)
            origin = self._registry.version(kind, resolved.use)
            absent = tuple(self._absent)
            choice = ProviderChoice(dotted(path), spec, origin, reason, passed_over, absent)
            return resolved, choice
        reasons = "; ".join(f"{name}: {explain(why).text}" for name, why in passed_over.items())
        raise ConfigError(f"{dotted(path)}: no provider is available: {reasons}")

    def _prepare(
        self, config: Config, path: SettingPath, kind: Kind, block: ProviderConfig, name: str
    ) -> ProviderConfig:
        """Return a configuration block with one provider, after making its weights available."""
        candidate = block.model_copy(update={"use": name, "fallback": ()})
        if name == SAME_NETWORK:
            candidate = self._same_network(config.depth, candidate)
        candidate = check_provider_config(path, kind, candidate, self._registry)
        if path[-1] in ("matcher", "dense_matcher"):
            self._check_fit(config.replaced(path, candidate), path)
        self._require_files(path, kind, candidate)
        for index, wrapper in enumerate(candidate.wrap):
            self._require_files((*path, "wrap", index), "wrapper", wrapper)
        return candidate

    def _same_network(self, depth: ProviderConfig, block: ProviderConfig) -> ProviderConfig:
        """Return the normals configuration with provider and options of the depth provider."""
        if "joint-normals" not in self._registry.spec("depth", depth.use).capabilities:
            raise ConfigError(f"the depth provider {depth.use!r} gives no normals")
        return block.model_copy(update={"use": depth.use, "options": depth.options})

    def _check_fit(self, config: Config, path: SettingPath) -> None:
        """Raise SettingsError if a matcher is incompatible with the resolved features."""
        problems = [p for p in combination_problems(config, self._registry) if p.path[0] == path[0]]
        if problems:
            raise SettingsError(tuple(problems))

    def _require_files(self, path: SettingPath, kind: Kind, block: ProviderConfig) -> None:
        """Check that the files in provider options exist, and make the weights available."""
        options = self._registry.validate_options(kind, block.use, block.options)
        for key, file in _paths(options):
            if not file.exists():
                raise ConfigError(f"{dotted((*path, 'options', *key))}: {file} does not exist")
        for weights in self._registry.weights(kind, block.use, block.options):
            self._require_weights(weights)


def _reason_of(error: InputError) -> Reason:
    """Convert an error to the typed reason why a provider is unavailable."""
    code = ProviderReason.UNAVAILABLE
    if isinstance(error, WeightsError):
        code = ProviderReason.NO_WEIGHTS
    elif isinstance(error, SettingsError):
        code = ProviderReason.INCOMPATIBLE
    return code.because(detail=str(error))


class _Downloads:
    """Reports the start and the progress of weight downloads, in megabytes."""

    def __init__(self, stages: Stages) -> None:
        self._stages = stages
        self._stage = ""

    @contextmanager
    def announced(self, file: WeightsFile, store: WeightStore) -> Iterator[None]:
        """Report the download of a weights file in a ``with`` block, if a download is needed."""
        if store.offline or not is_remote(file.uri) or store.locate(file.uri) is not None:
            yield
            return
        self._stage = f"fetch {file.uri.rpartition('/')[2]}"
        self._stages.notice(f"fetching {describe_file(file)}, license {file.license}")
        with self._stages.step(self._stage, None if file.size is None else _megabytes(file.size)):
            yield

    def progress(self, name: str, done: int, total: int | None) -> None:
        """Report download progress; implements :data:`mpsfm_core.providers.weights.Progress`."""
        self._stages.stage_progress(self._stage, _megabytes(done), _megabytes(total or done))


def _megabytes(size: int) -> int:
    return round(size / _MEGABYTE)


def _paths(options: Options | None, key: SettingPath = ()) -> Iterator[tuple[SettingPath, Path]]:
    """Yield all files and folders in provider options, with their setting paths."""
    for name, value in options or ():
        if isinstance(value, Path):
            yield (*key, name), value
        elif isinstance(value, Options):
            yield from _paths(value, (*key, name))
