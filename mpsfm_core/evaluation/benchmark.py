"""Benchmark of configurations and COLMAP mappers on the same verified matches.

Priors, features and matches are computed once per scene and configuration and cached. Only image
pairs within a test set are matched. Each finished run writes a record
(:mod:`mpsfm_core.evaluation.records`), and a run with a valid record is not repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import pycolmap

from mpsfm_core.config import Config, load_config
from mpsfm_core.data import MappingProblem
from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.evaluation.cloud_accuracy import TOLERANCES
from mpsfm_core.evaluation.dense_geometry import DenseEvaluation
from mpsfm_core.evaluation.external_results import read_external_records
from mpsfm_core.evaluation.methods import (
    OURS,
    PEER_METHODS,
    PRIOR_METHODS,
    MethodResult,
    MethodRun,
    run_methods,
)
from mpsfm_core.evaluation.prior_quality import QUALITIES, parse_error_seed, prior_overrides
from mpsfm_core.evaluation.records import BenchmarkRecord, read_record, record_file, write_record
from mpsfm_core.evaluation.scene_folder import EvaluationSet, SceneFolder, read_scene
from mpsfm_core.extraction.cache import content_key, digest
from mpsfm_core.extraction.runner import adjust_problem, extract
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.pipeline.provider_resolution import resolve_providers
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers import hookimpl
from mpsfm_core.providers.registry import Registry, core_version
from mpsfm_core.support.files import write_file

RecordCallback = Callable[[BenchmarkRecord, bool], None]
"""Callback that receives a benchmark record, and True if an earlier benchmark wrote the record."""


@dataclass(frozen=True)
class BenchmarkPlan:
    """Plan of a benchmark with its scenes, configurations, prior qualities and mappers."""

    scenes: tuple[Path, ...]
    """Scene folders."""
    configs: tuple[str, ...] = ("benchmark",)
    """Names or file paths of the compared configurations."""
    buckets: tuple[str, ...] | None = None
    """Names of the overlap buckets whose test sets are reconstructed, or None for all buckets."""
    priors: tuple[str, ...] = ("config",)
    """Qualities of the depth priors (:mod:`~mpsfm_core.evaluation.prior_quality`) with which mpsfm
    runs."""
    peers: tuple[str, ...] = PEER_METHODS
    """Names of :data:`~mpsfm_core.evaluation.methods.PEER_METHODS`."""
    overrides: tuple[str, ...] = ()
    """Settings ``KEY=VALUE`` that override the values of all configurations."""
    workers: int = 1
    """Number of test sets that are reconstructed in parallel."""
    results: Mapping[str, Path] = field(default_factory=dict)
    """Folder with the models of another program, by its label in the report
    (:mod:`~mpsfm_core.evaluation.external_results`)."""
    distances: tuple[float, ...] = TOLERANCES
    """Distance thresholds in meters for the accuracy of dense point clouds."""


def run_benchmark(
    plan: BenchmarkPlan,
    output: Path,
    registry: Registry | None = None,
    on_record: RecordCallback | None = None,
) -> list[BenchmarkRecord]:
    """Run a benchmark and return the records of all test sets and methods, cached or new.

    If a mapper fails, its record contains the error.

    Args:
        plan: What to run.
        output: Output folder of the benchmark records.
        registry: Registry of plugins.
        on_record: Callback for each benchmark record, cached or new.

    Raises:
        InputError: A name in the benchmark plan is unknown, or a scene folder is invalid.
        MpsfmError: The extraction of priors or matches fails.
    """
    registry = registry or Registry.discover()
    _check_names("prior", [p for p in plan.priors if parse_error_seed(p) is None], QUALITIES)
    _check_names("peer", plan.peers, PEER_METHODS)
    scenes = [read_scene(path) for path in plan.scenes]
    if len({scene.name for scene in scenes}) < len(scenes):
        raise InputError("two scene folders have the same name; rename one of them")
    pair_filter = SetPairFilter()
    registry.register(pair_filter, name="pairs of sets")
    records = []
    for scene in scenes:
        sets = scene.select_sets(plan.buckets)
        pair_filter.allow(sets)
        for config in plan.configs:
            runs = _SceneRuns(scene, sets, config, plan, output, registry)
            scene_records = []
            for record, cached in runs():
                scene_records.append(record)
                if on_record is not None:
                    on_record(record, cached)
            records += sorted(scene_records, key=_sort_key(sets, plan))
            for label, folder in plan.results.items():
                for record in read_external_records(label, folder, scene, sets, Path(config).stem):
                    write_record(output, record)
                    records.append(record)
                    if on_record is not None:
                        on_record(record, True)
    return records


class SetPairFilter:
    """Plugin that restricts matching to image pairs within a test set."""

    def __init__(self) -> None:
        self._allowed: set[tuple[str, str]] = set()

    def allow(self, sets: Sequence[EvaluationSet]) -> None:
        """Replace the allowed image pairs by the pairs within some test sets."""
        self._allowed = {pair for item in sets for pair in combinations(sorted(item.images), 2)}

    @hookimpl
    def mpsfm_filter_pairs(self, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
        """Return the image pairs that are within a test set."""
        return [(a, b) for a, b in pairs if (min(a, b), max(a, b)) in self._allowed]


class PreparedSets(NamedTuple):
    """Extraction results for all images of the benchmark's test sets."""

    problem: MappingProblem
    """Priors and verified matches of the images, before keypoint adjustment."""
    images: ImageSet
    """Images of all test sets."""
    config: Config
    """Configuration in which each block has one available provider."""
    registry: Registry
    """Registry of plugins."""

    def build_problem(self, image_set: EvaluationSet) -> MappingProblem:
        """Build the mapping problem of a test set, whose pairs determine keypoint adjustment."""
        names, images = set(image_set.images), self.problem.images
        inside = [
            pair
            for pair in self.problem.pairs
            if {images[pair.image_a].name, images[pair.image_b].name} <= names
        ]
        restricted = replace(self.problem, pairs=tuple(inside))
        adjusted = adjust_problem(self.images, self.config, self.registry, restricted)
        return adjusted.subset(list(image_set.images))


def prepare_sets(
    scene: SceneFolder,
    sets: Sequence[EvaluationSet],
    prior: str,
    config: str,
    overrides: Sequence[str],
    work: Path,
    registry: Registry,
) -> PreparedSets:
    """Extract priors and verified matches for all images of the given test sets.

    Args:
        scene: Scene folder.
        sets: Sets of images.
        prior: Quality of :mod:`~mpsfm_core.evaluation.prior_quality`.
        config: Name or file of the configuration.
        overrides: Settings ``KEY=VALUE``.
        work: Folder to which degraded depth maps are written.
        registry: Registry of plugins.
    """
    names = sorted({name for item in sets for name in item.images})
    settings = prior_overrides(prior, scene, names, work / f"{prior}-depth")
    stages = Stages(registry)
    loaded = load_config(config, (*settings, *overrides), registry=registry)
    loaded = resolve_providers(loaded, registry, stages).config
    image_list = work / "images.txt"
    write_file(image_list, "\n".join(names) + "\n")
    # The option ``inputs.strict`` makes an unreadable image an error, because no image may be
    # skipped.
    inputs = loaded.inputs.model_copy(update={"strict": True})
    images = load_images(scene.images, scene.intrinsics, image_list, inputs)
    no_adjustment = loaded.adjustment.model_copy(update={"enabled": False})
    unadjusted = loaded.model_copy(update={"adjustment": no_adjustment})
    extraction = extract(images, unadjusted, registry, stages)
    return PreparedSets(extraction.problem, images, loaded, registry)


class _SceneRuns:
    """All benchmark runs of one scene with one configuration."""

    def __init__(
        self,
        scene: SceneFolder,
        sets: Sequence[EvaluationSet],
        config: str,
        plan: BenchmarkPlan,
        output: Path,
        registry: Registry,
    ) -> None:
        self._scene = scene
        self._sets = sets
        self._config = config
        self._config_name = Path(config).stem
        self._plan = plan
        self._output = output
        self._registry = registry

    def __call__(self) -> Iterator[tuple[BenchmarkRecord, bool]]:
        """Yield each record, and True if the record is from an earlier benchmark."""
        for number, prior in enumerate(self._plan.priors):
            prepared = prepare_sets(
                self._scene,
                self._sets,
                prior,
                self._config,
                self._plan.overrides,
                self._output / "work" / self._scene.name,
                self._registry,
            )
            methods = {
                _label(method, prior): method
                for method in (OURS, *self._plan.peers)
                if method in PRIOR_METHODS or number == 0
            }
            options = prepared.config.mapper_options()
            dense = self._dense_evaluation(prepared)
            pending: dict[MethodRun, tuple[EvaluationSet, str]] = {}
            for image_set in self._sets:
                problem = prepared.build_problem(image_set)
                for label, method in methods.items():
                    run = MethodRun(
                        label, method, problem, options, dense if method == OURS else None
                    )
                    key = _content_key(run)
                    record = self._read_cached(image_set, label, key)
                    if record is not None:
                        yield record, True
                    else:
                        pending[run] = image_set, key
            for run, result in run_methods(list(pending), self._plan.workers):
                record = self._build_record(*pending[run], run, result)
                write_record(self._output, record)
                yield record, False

    def _dense_evaluation(self, prepared: PreparedSets) -> DenseEvaluation | None:
        """Return the dense evaluation, None without densification or anything to compare with."""
        config = prepared.config
        comparable = self._scene.depth is not None or config.dense.hold_out_every is not None
        if not config.dense.enabled or not comparable:
            return None
        max_points, distances = config.results.dense_max_points, self._plan.distances
        return DenseEvaluation(prepared.images, config.dense, max_points, self._scene, distances)

    def _read_cached(
        self, image_set: EvaluationSet, label: str, key: str
    ) -> BenchmarkRecord | None:
        """Read the record of an earlier successful run with the same key, or return None."""
        file = record_file(self._scene.name, self._config_name, image_set.name, label)
        path = self._output / file
        try:
            record = read_record(path) if path.is_file() else None
        except InputError:
            return None
        if record is None or record.key != key or record.error:
            return None  # A failed run is repeated, because memory may have been short.
        return record

    def _build_record(
        self, image_set: EvaluationSet, key: str, run: MethodRun, result: MethodResult
    ) -> BenchmarkRecord:
        return BenchmarkRecord(
            self._scene.name,
            self._config_name,
            image_set.bucket,
            image_set.name,
            run.label,
            key,
            result.models[0] if result.models else {},
            {name: self._scene.truth[name] for name in image_set.images},
            len(run.problem.pairs),
            result.seconds,
            result.cpu_seconds,
            result.error,
            result.models[1:],
            result.dense,
        )


def _sort_key(
    sets: Sequence[EvaluationSet], plan: BenchmarkPlan
) -> Callable[[BenchmarkRecord], tuple[int, int]]:
    """Return a key that sorts benchmark records by test set, then by method."""
    positions = {image_set.name: number for number, image_set in enumerate(sets)}
    labels = [_label(m, prior) for m in (OURS, *plan.peers) for prior in plan.priors]
    return lambda record: (positions[record.set_name], labels.index(record.label))


def _label(method: str, prior: str) -> str:
    return f"{method}-{prior}" if method in PRIOR_METHODS else method


def _content_key(run: MethodRun) -> str:
    """Compute a hash of all inputs that determine the result of a run."""
    parts: list[object] = [run.method, core_version(), pycolmap.__version__]
    if run.method == OURS:
        parts.append(run.options.model_dump(mode="json"))
    if run.dense is not None:
        options = run.dense.dense.model_dump(mode="json")
        parts += [options, run.dense.max_points, run.dense.distances]
    if run.method in PRIOR_METHODS:
        parts += [digest(image) for image in run.problem.images]
    else:
        parts += [
            [image.name, image.camera.params.tolist(), digest(image.keypoints)]
            for image in run.problem.images
        ]
    return content_key(parts, [digest(pair) for pair in run.problem.pairs])


def _check_names(kind: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raise :class:`InputError` if a scene, configuration or method name is unknown."""
    for name in names:
        if name not in known:
            raise InputError(f"no {kind} {name!r}{did_you_mean(name, known)}")
