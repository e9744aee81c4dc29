"""Runs configurations and peers on the sets of scene folders, on the same verified matches.

For each scene and configuration, priors, features and matches are computed once for all images of
the sets, matches only for pairs inside a set; the cache keeps them. Each finished run is a file
(:mod:`mpsfm_core.evaluation.records`), and a run that has its file already is not repeated.
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
"""Is told of each record, and whether it was there already."""


@dataclass(frozen=True)
class BenchmarkPlan:
    """What to run.

    ``configs``: names or files. ``buckets``: None for all. ``priors``: of
    :data:`~mpsfm_core.evaluation.prior_quality.QUALITIES` or ``degraded-N``, our mapper runs with
    each. ``peers``: of :data:`~mpsfm_core.evaluation.methods.PEER_METHODS`. ``overrides``: settings
    ``KEY=VALUE`` of all configurations. ``workers``: sets that are mapped at the same time.
    ``results``: label -> folder of models that another program made
    (:mod:`~mpsfm_core.evaluation.external_results`). ``distances``: metres, at which clouds are
    judged where a configuration has the dense stage and a scene true depth.
    """

    scenes: tuple[Path, ...]
    configs: tuple[str, ...] = ("benchmark",)
    buckets: tuple[str, ...] | None = None
    priors: tuple[str, ...] = ("config",)
    peers: tuple[str, ...] = PEER_METHODS
    overrides: tuple[str, ...] = ()
    workers: int = 1
    results: Mapping[str, Path] = field(default_factory=dict)
    distances: tuple[float, ...] = TOLERANCES


def run_benchmark(
    plan: BenchmarkPlan,
    output: Path,
    registry: Registry | None = None,
    done: RecordCallback | None = None,
) -> list[BenchmarkRecord]:
    """Run a plan and return the records of all its runs, old and new.

    What a method raises is in its record. Raises :class:`InputError` (or another
    :class:`~mpsfm_core.data.errors.MpsfmError` of the extraction) for what no run could do without.
    """
    registry = registry or Registry.discover()
    _check_names("prior", [p for p in plan.priors if parse_error_seed(p) is None], QUALITIES)
    _check_names("peer", plan.peers, PEER_METHODS)
    scenes = [read_scene(path) for path in plan.scenes]
    if len({scene.name for scene in scenes}) < len(scenes):
        raise InputError("two scene folders have the same name, as their results would")
    only = SetPairFilter()
    registry.register(only, name="pairs of sets")
    records = []
    for scene in scenes:
        sets = scene.chosen(plan.buckets)
        only.allow(sets)
        for config in plan.configs:
            runs = _SceneRuns(scene, sets, config, plan, output, registry)
            own = []
            for record, known in runs():
                own.append(record)
                if done is not None:
                    done(record, known)
            records += sorted(own, key=_order(sets, plan))
            for label, folder in plan.results.items():
                for record in read_external_records(label, folder, scene, sets, Path(config).stem):
                    write_record(output, record)
                    records.append(record)
                    if done is not None:
                        done(record, True)
    return records


class SetPairFilter:
    """Plugin that lets only pairs be matched whose images are in one set together."""

    def __init__(self) -> None:
        self._allowed: set[tuple[str, str]] = set()

    def allow(self, sets: Sequence[EvaluationSet]) -> None:
        """Allow the pairs of these sets from now on."""
        self._allowed = {pair for item in sets for pair in combinations(sorted(item.images), 2)}

    @hookimpl
    def mpsfm_filter_pairs(self, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
        """Those inside a set."""
        return [(a, b) for a, b in pairs if (min(a, b), max(a, b)) in self._allowed]


class PreparedSets(NamedTuple):
    """``problem``: verified matches, on keypoints as they were found, and priors of all ``images``
    of some sets. ``config``: as it was resolved for them."""

    problem: MappingProblem
    images: ImageSet
    config: Config
    registry: Registry

    def of(self, item: EvaluationSet) -> MappingProblem:
        """The problem of one set; its keypoints are adjusted by its own pairs alone."""
        names, images = set(item.images), self.problem.images
        inside = [
            pair
            for pair in self.problem.pairs
            if {images[pair.image_a].name, images[pair.image_b].name} <= names
        ]
        alone = replace(self.problem, pairs=tuple(inside))
        return adjust_problem(self.images, self.config, self.registry, alone).subset(
            list(item.images)
        )


def prepare_sets(
    scene: SceneFolder,
    sets: Sequence[EvaluationSet],
    prior: str,
    config: str,
    overrides: Sequence[str],
    work: Path,
    registry: Registry,
) -> PreparedSets:
    """Photos of the sets, verified and with priors, and the configuration.

    ``prior``: a quality of :mod:`~mpsfm_core.evaluation.prior_quality`. ``work``: a folder for the
    depth of that quality.
    """
    names = sorted({name for item in sets for name in item.images})
    settings = prior_overrides(prior, scene, names, work / f"{prior}-depth")
    stages = Stages(registry)
    loaded = load_config(config, (*settings, *overrides), registry=registry)
    loaded = resolve_providers(loaded, registry, stages).config
    listed = work / "images.txt"
    write_file(listed, "\n".join(names) + "\n")
    inputs = loaded.inputs.model_copy(update={"strict": True})  # a set is compared as a whole
    images = load_images(scene.images, scene.intrinsics, listed, inputs)
    as_found = loaded.adjustment.model_copy(update={"enabled": False})
    alone = loaded.model_copy(update={"adjustment": as_found})
    extraction = extract(images, alone, registry, stages)
    return PreparedSets(extraction.problem, images, loaded, registry)


class _SceneRuns:
    """All runs of one scene with one configuration."""

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
        """Records and whether they were there already."""
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
            options, dense = prepared.config.mapper_options(), self._dense(prepared)
            places: dict[MethodRun, tuple[EvaluationSet, str]] = {}
            for item in self._sets:
                subset = prepared.of(item)
                for label, method in methods.items():
                    task = MethodRun(
                        label, method, subset, options, dense if method == OURS else None
                    )
                    key = _key(task)
                    known = self._known(item, label, key)
                    if known is not None:
                        yield known, True
                    else:
                        places[task] = item, key
            for task, outcome in run_methods(list(places), self._plan.workers):
                record = self._record(*places[task], task, outcome)
                write_record(self._output, record)
                yield record, False

    def _dense(self, prepared: PreparedSets) -> DenseEvaluation | None:
        config = prepared.config
        if not config.dense.enabled or self._scene.depth is None:
            return None
        settings = config.dense, config.results, self._scene, self._plan.distances
        return DenseEvaluation(prepared.images, *settings)

    def _known(self, item: EvaluationSet, label: str, key: str) -> BenchmarkRecord | None:
        path = self._output / record_file(self._scene.name, self._config_name, item.name, label)
        try:
            record = read_record(path) if path.is_file() else None
        except InputError:
            return None
        if record is None or record.key != key or record.error:
            return None  # what failed may have lacked memory, and is tried again
        return record

    def _record(
        self, item: EvaluationSet, key: str, task: MethodRun, outcome: MethodResult
    ) -> BenchmarkRecord:
        return BenchmarkRecord(
            self._scene.name,
            self._config_name,
            item.bucket,
            item.name,
            task.label,
            key,
            outcome.models[0] if outcome.models else {},
            {name: self._scene.truth[name] for name in item.images},
            len(task.problem.pairs),
            outcome.seconds,
            outcome.cpu_seconds,
            outcome.error,
            outcome.models[1:],
            outcome.dense,
        )


def _order(
    sets: Sequence[EvaluationSet], plan: BenchmarkPlan
) -> Callable[[BenchmarkRecord], tuple[int, int]]:
    """Sorts records by set, then ours before the peers: runs end in no particular order."""
    places = {item.name: number for number, item in enumerate(sets)}
    labels = [_label(m, prior) for m in (OURS, *plan.peers) for prior in plan.priors]
    return lambda record: (places[record.set_name], labels.index(record.label))


def _label(method: str, prior: str) -> str:
    return f"{method}-{prior}" if method in PRIOR_METHODS else method


def _key(task: MethodRun) -> str:
    """Names all that the outcome of a task depends on."""
    parts: list[object] = [task.method, core_version(), pycolmap.__version__]
    if task.method == OURS:
        parts.append(task.options.model_dump(mode="json"))
    if task.dense is not None:
        settings = (task.dense.dense, task.dense.results)
        parts += [[each.model_dump(mode="json") for each in settings], task.dense.distances]
    if task.method in PRIOR_METHODS:
        parts += [digest(image) for image in task.problem.images]
    else:
        parts += [
            [image.name, image.camera.params.tolist(), digest(image.keypoints)]
            for image in task.problem.images
        ]
    return content_key(parts, [digest(pair) for pair in task.problem.pairs])


def _check_names(what: str, names: Iterable[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"no {what} {name!r}{did_you_mean(name, known)}")
