"""Run all stages of a reconstruction, from a folder of photos to a result folder."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.config import Config
from mpsfm_core.config.provider_arguments import Provider, configure
from mpsfm_core.data import Pose, Rig
from mpsfm_core.data.decisions import DoubtReason, Reason
from mpsfm_core.data.errors import ConfigError, ReconstructionError
from mpsfm_core.data.events import EventCallback
from mpsfm_core.data.result_layout import SUMMARY
from mpsfm_core.dense.densify import densify
from mpsfm_core.extraction.active_provider import thread_count, worker_count
from mpsfm_core.extraction.cache import cache_folder
from mpsfm_core.extraction.executors import THREADS, open_executor
from mpsfm_core.extraction.priors.focal_length import estimate_focal_lengths
from mpsfm_core.extraction.runner import Extraction, extract
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.inputs.intrinsics import Cameras, choose_cameras
from mpsfm_core.inputs.models import Poses
from mpsfm_core.mapping.scene.reconstruction import (
    MappingResult,
    Reconstruction,
    compute_depth_maps,
    hold_out,
)
from mpsfm_core.pipeline import precompile, resources
from mpsfm_core.pipeline.checkpoints import DenseCheckpoints, RunCheckpoints
from mpsfm_core.pipeline.input_reader import InputReader, Source
from mpsfm_core.pipeline.mapping_passes import MappingPasses
from mpsfm_core.pipeline.parts import PartRecord
from mpsfm_core.pipeline.provider_resolution import ProviderResolution, resolve_providers
from mpsfm_core.pipeline.remote_stereo import MatchStereo, RemoteStereo
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.pipeline.trajectory import localize_frames
from mpsfm_core.providers.provider_config import FROM_MATCHER
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.report.page import write_report
from mpsfm_core.report.reasons import explain
from mpsfm_core.results.georeference import georeference
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.summary import FORMAT as SUMMARY_FORMAT
from mpsfm_core.results.summary import (
    RunSummary,
    describe_images,
    describe_mapping_steps,
    describe_pairs,
    describe_reconstructions,
    describe_versions,
)
from mpsfm_core.results.trajectory import TrajectoryFrame, describe_trajectory
from mpsfm_core.results.writer import ComponentResult, update_summary, write_failure, write_results
from mpsfm_core.support.disk_arrays import store_on_disk
from mpsfm_core.support.files import lock_output_folder
from mpsfm_core.support.memory import ChildMemoryMonitor, measure_memory
from mpsfm_core.support.threads import limit_threads, opencv_threads, thread_limit

PathLike = str | Path

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ReconstructionResult:
    """Result of :func:`reconstruct`."""

    model: pycolmap.Reconstruction
    """COLMAP model of the largest component, with the cameras of the original photos."""
    further_models: tuple[pycolmap.Reconstruction, ...]
    """COLMAP models of all components except the largest, sorted by size."""
    mapping: MappingResult
    """Poses, points and refined depth maps as arrays."""
    summary: RunSummary
    """Content of ``summary.json``."""
    output: Path | None
    """Result folder, or None for a run without output folder."""


def reconstruct(
    images: PathLike | ImageSet,
    output: PathLike | None = None,
    config: PathLike | Config = "default",
    *,
    cameras: Cameras | None = None,
    intrinsics: PathLike | None = None,
    image_list: PathLike | None = None,
    poses: PathLike | Poses | None = None,
    rigs: PathLike | Sequence[Rig] | None = None,
    features: Provider | None = None,
    matcher: Provider | None = None,
    retrieval: Provider | None = None,
    camera: Provider | None = None,
    multiview: Provider | None = None,
    depth: Provider | None = None,
    normals: Provider | None = None,
    masks: Sequence[Provider] | None = None,
    database: PathLike | None = None,
    hloc: tuple[PathLike, PathLike] | None = None,
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    fresh: bool = False,
    on_event: EventCallback | None = None,
) -> ReconstructionResult:
    """Reconstruct photos or a video.

    The stages of a reconstruction are also separate functions, such as
    :func:`mpsfm_core.extract_features` and :func:`mpsfm_core.run_mapper`.

    Args:
        images: Folder of photos or of videos with its subfolders, a video, or the result of
            :func:`mpsfm_core.load_images`. Keyframes of videos are selected by ``inputs.video``
            and written into ``frames/`` of the output.
        output: Result folder, used by one run at a time, or None to write nothing.
        config: Name of a shipped configuration, a YAML file, or a loaded configuration.
        cameras: Camera of all images, camera of each image by name, or ``pycolmap.Reconstruction``.
            A camera is a :class:`~mpsfm_core.PinholeCamera` or a ``pycolmap.Camera`` of any
            perspective model, for the image after EXIF rotation.
        intrinsics: File with the cameras, instead of ``cameras``: ``intrinsics.yaml``, a COLMAP
            model or ``transforms.json``. Without cameras, focal lengths are taken from ``poses``,
            else from EXIF, else estimated by the camera or depth provider, else set to a default.
        image_list: Text file with one image name per line, by default all images of the folder.
        poses: Poses of some or all images as path of a COLMAP model or ``transforms.json``,
            ``pycolmap.Reconstruction``, or poses ``cam_from_world`` by image name in the forms that
            :func:`build_problem` accepts. The option ``mapping.known_poses`` chooses whether known
            poses are fixed or refined.
        rigs: Cameras that move as one, as path of COLMAP's ``rig_config.json``, of a COLMAP model
            or of a COLMAP database, as ``"folders"`` for one folder of images per camera, or as
            :class:`~mpsfm_core.Rig` objects. All images of a frame get one pose. Unknown relative
            poses are estimated. Without ``rigs``, the rigs of ``database``, ``intrinsics`` or
            ``poses`` are used.
        features: Provider of features that replaces the configured provider. Each provider argument
            is a name, a configuration block, or an object with the method that its provider kind
            requires. Results of a provider object are not cached for later runs.
        matcher: Sparse or dense matcher, which replaces all configured matchers. The default
            matcher for a feature provider of the caller is ``mutual-nearest``.
        retrieval: Provider of global image descriptors, which select image pairs.
        camera: Provider of focal lengths, which are combined with those of EXIF.
        multiview: Multi-view network, used by ``depth="multiview"``.
        depth: Provider of depth priors.
        normals: Provider of normal priors.
        masks: Mask providers, which replace the configured mask providers.
        database: COLMAP database whose keypoints and matches replace features and matchers. The
            matches of the database are verified again. The cameras of the database are ignored
            unless ``intrinsics`` names the database too.
        hloc: Features file and matches file of hloc, as an alternative to ``database``.
        overrides: Settings such as ``"runtime.workers=2"``; not allowed with a loaded
            configuration.
        registry: Providers that the configuration may name, by default all installed providers.
        fresh: If true, ignore the checkpoint of an interrupted run and start mapping again.
        on_event: Function that receives progress events, see :mod:`mpsfm_core.data.events`. To
            cancel the run, the function raises :class:`~mpsfm_core.Cancelled`.

    Returns:
        COLMAP models of the original photos, arrays of the mapper, and the summary.

    Raises:
        InputError: images, intrinsics, poses, configuration, weights or output are wrong. Missing
            providers are found before any image is decoded.
        ReconstructionError: no reconstruction was possible; the reasons are in ``summary.json``.
        MpsfmError: a provider failed or violated the provider contract, or the disk is full.

    Examples:
        >>> import mpsfm_core as mpsfm
        >>> result = mpsfm.reconstruct("photos/", "out/", depth="compact")
        >>> result.model.num_reg_images()
        8
    """
    config, registry = configure(
        config,
        registry,
        overrides,
        masks=masks,
        features=features,
        matcher=matcher,
        retrieval=retrieval,
        camera=camera,
        multiview=multiview,
        depth=depth,
        normals=normals,
    )
    if database is not None and hloc is not None:
        raise TypeError("give either database or hloc, not both")
    matches = (database,) if database is not None else hloc or ()
    if matches:
        config = _without_matching(config)
    given_cameras = choose_cameras(cameras, intrinsics)
    if isinstance(images, ImageSet) and (given_cameras is not None or image_list is not None):
        raise TypeError("cameras and image_list belong to load_images, which made the images")
    source = Source(
        images if isinstance(images, ImageSet) else Path(images),
        given_cameras,
        _path(image_list),
        Path(poses) if isinstance(poses, str) else poses,
        tuple(Path(file) for file in matches),
        Path(rigs) if isinstance(rigs, str) else rigs,
    )
    run = _Run(source, config, registry, _path(output), fresh, on_event)
    with run.environment():
        return run.execute()


class _Run:
    """One reconstruction run; the method ``execute`` runs all stages in order."""

    def __init__(
        self,
        source: Source,
        config: Config,
        registry: Registry,
        output: Path | None,
        fresh: bool,
        on_event: EventCallback | None = None,
    ) -> None:
        self._registry = registry
        self._output = output
        self._stages = Stages(registry, on_event)
        self._resolution = ProviderResolution(config, ())
        self._inputs = InputReader(source, output, config.inputs, self._stages)
        self._georeference_report: dict[str, object] | None = None
        self._dense_reports: list[dict[str, Any]] | None = None
        self._doubts: tuple[Reason, ...] = ()
        self._trajectories: dict[str, list[TrajectoryFrame]] = {}
        self._estimate = resources.ResourceEstimate(0, 0, 0)
        self._children = ChildMemoryMonitor()
        self._checkpoints = RunCheckpoints(fresh=fresh)
        self._part_records: list[PartRecord] = []
        self._compilation: precompile.Compilation | None = None

    @property
    def _config(self) -> Config:
        return self._resolution.config

    @contextmanager
    def environment(self) -> Iterator[None]:
        """Limit threads, lock the output folder, choose the folder of maps, and record warnings."""
        runtime = self._config.runtime
        with ExitStack() as stack:
            stack.enter_context(self._stages.recording_logged_warnings())
            stack.enter_context(limit_threads(runtime.workers))
            stack.enter_context(store_on_disk(cache_folder(runtime.cache_dir)))
            if self._output is not None:
                self._inputs.check_output_folder()
                stack.enter_context(lock_output_folder(self._output))
            stack.enter_context(self._children.watching())
            stack.callback(self._stop_compilation)
            yield

    def execute(self) -> ReconstructionResult:
        """Run all stages of the reconstruction and return the result."""
        self._resolve_providers()
        self._inputs.extract_video_frames()
        self._inputs.cut_wide_images()
        self._start_compilation()
        with self._stages.stage("inputs"):
            images = self._inputs.load()
            self._check_resources(images)
        images, extraction = self._extract(images)
        self._finish_compilation()
        passes = MappingPasses(
            self._config, self._registry, self._stages, self._inputs, self._checkpoints
        )
        num_doubts = len(extraction.doubts)
        extraction, mapping, originals = passes.run(images, extraction)
        self._add_doubts(extraction.doubts[num_doubts:])
        self._part_records = passes.part_records
        self._add_doubts(
            DoubtReason.CAMERA_JUMP.because(image_a=jump.before, image_b=jump.after)
            for jump in passes.jumps
        )
        if not mapping.reconstructions:
            self._fail(images, extraction, mapping, originals)
        self._warn_of_uncalibrated_rigs(mapping.reconstructions[0])
        with self._stages.stage("mapping"):
            computed = compute_depth_maps(mapping.reconstructions)
            mapping = replace(mapping, reconstructions=computed)
        mapping = self._georeference(images, mapping)
        mapping = self._densify(hold_out(mapping, self._config.dense.hold_out_every), originals)
        self._localize_frames(mapping, originals)
        result = self._write_results(images, extraction, mapping, originals)
        self._checkpoints.delete()
        self._write_report()
        self._complete_summary(result.summary)
        return result

    def _resolve_providers(self) -> None:
        """Choose providers and download their weights before any image is decoded."""
        self._inputs.find_videos()
        with self._stages.stage("providers"):
            for text in self._config.warnings:
                self._stages.warn(text)
            self._resolution = resolve_providers(self._config, self._registry, self._stages)
            self._warn_of_unused_matcher()

    def _warn_of_unused_matcher(self) -> None:
        """Warn if the fast first pass matches all images, so that the chosen matcher never runs."""
        fast_pass, matcher = self._config.fast_pass, self._config.matcher
        if fast_pass is None or matcher is None or self._config.has_second_pass:
            return
        if matcher.use != fast_pass.matcher.use:
            self._stages.warn(
                f"matcher {matcher.use!r} is not used: the fast pass has the same features "
                f"({fast_pass.features.use}) and matches all images; set fast_pass=null to use "
                f"the matcher"
            )

    def _extract(self, images: ImageSet) -> tuple[ImageSet, Extraction]:
        """Run the providers, with features and matcher of a fast first pass if configured."""
        with self._stages.stage("extraction"):
            images = estimate_focal_lengths(images, self._config, self._registry, self._stages)
            config = self._config.fast_pass_config() or self._config
            extraction = extract(images, config, self._registry, self._stages, self._inputs.matches)
            problem = replace(extraction.problem, rigs=self._inputs.rigs)
            extraction = replace(extraction, problem=problem)
            self._add_doubts(extraction.doubts)
        return images, extraction

    def _start_compilation(self) -> None:
        """Compile the numba kernels in parallel to extraction, if a core is free."""
        if thread_limit() > 1:
            self._compilation = precompile.start_compilation()
        if self._compilation is not None:
            self._stages.notice(
                "first run: numerical kernels are compiled during extraction; later runs load them"
            )

    def _finish_compilation(self) -> None:
        if self._compilation is not None:
            with self._stages.stage("compilation"):
                self._compilation.wait()

    def _stop_compilation(self) -> None:
        """End the kernel compilation of a run that failed before mapping."""
        if self._compilation is not None:
            self._compilation.stop()

    def _add_doubts(self, doubts: Iterable[Reason]) -> None:
        """Warn of reasons to doubt the result, and store them for the summary."""
        for doubt in doubts:
            self._doubts += (doubt,)
            explanation = explain(doubt)
            self._stages.warn(f"{explanation.text} {explanation.remedy}")

    def _warn_of_uncalibrated_rigs(self, largest: Reconstruction) -> None:
        """Warn of rigs whose relative poses could not be estimated from the largest component."""
        used = {name for rig in largest.rigs for name in rig.image_names}
        for rig in self._inputs.rigs:
            if not rig.is_calibrated and not used & set(rig.image_names):
                names = [name for frame in rig.frames for name in frame[:1] if name is not None]
                self._stages.warn(
                    f"the rig of {names[0] if names else rig.image_names[0]} has unknown relative "
                    "poses that could not be estimated, so its photos have independent poses; take "
                    "photos whose cameras see the same place, also at different moments, or check "
                    "that the photos of a frame were taken at the same moment"
                )

    def _georeference(self, images: ImageSet, mapping: MappingResult) -> MappingResult:
        """Align reconstructions with GPS positions, if enough images have a position."""
        positions = {image.name: image.gps for image in images if image.gps is not None}
        if self._inputs.known_poses or not self._config.results.georeference or not positions:
            return mapping
        aligned = []
        for number, reconstruction in enumerate(mapping.reconstructions):
            result = georeference(reconstruction, positions)
            if isinstance(result, Reason):
                aligned.append(reconstruction)
                report: dict[str, object] = {"why_not": result.to_json()}
            else:
                aligned.append(result[0])
                report = result[1].describe()
            if number == 0:
                self._georeference_report = report
        return replace(mapping, reconstructions=tuple(aligned))

    def _densify(self, mapping: MappingResult, originals: OriginalImages) -> MappingResult:
        """Refine the depth maps of all components by multi-view stereo."""
        config = self._config
        if not config.dense.enabled:
            return mapping
        dense_parts, self._dense_reports = [], []
        progress = partial(self._stages.stage_progress, "dense")
        with (
            self._stages.stage("dense"),
            open_executor(config.runtime, self._registry) as executor,
        ):
            for part in mapping.reconstructions:
                checkpoints, remote = self._dense_checkpoints(part, originals), None
                if executor is not None and checkpoints is not None:
                    threads = thread_count(config.runtime)
                    step = MatchStereo(originals.images, config.dense, checkpoints, threads)
                    remote = RemoteStereo(executor, part, step, progress)
                dense, report = densify(
                    part,
                    originals.view,
                    config.dense,
                    config.runtime.workers,
                    progress,
                    checkpoints,
                    remote,
                    poses_use_depth=not _has_poses(part, self._inputs.known_poses),
                )
                dense_parts.append(dense)
                self._dense_reports.append(report.describe())
        return replace(mapping, reconstructions=tuple(dense_parts))

    def _localize_frames(self, mapping: MappingResult, originals: OriginalImages) -> None:
        """Estimate the poses of the frames of each video between its keyframes."""
        every = self._config.inputs.video.trajectory_every
        if not self._inputs.videos or not every:
            return
        with self._stages.stage("trajectory"), opencv_threads(thread_limit()):
            progress = partial(self._stages.stage_progress, "trajectory")
            for name, video in self._inputs.videos.items():
                self._trajectories[name] = localize_frames(
                    video,
                    self._inputs.selections[name],
                    mapping.reconstructions,
                    originals,
                    every,
                    progress,
                    subfolder=name,
                    cut=self._inputs.cut,
                )

    def _describe_videos(self) -> list[dict[str, Any]]:
        """Describe the keyframes and the trajectory of each video."""
        return [
            {
                "file": str(self._inputs.videos[name]),
                **selection.describe(),
                "trajectory": describe_trajectory(self._trajectories[name], name)
                if name in self._trajectories
                else None,
            }
            for name, selection in self._inputs.selections.items()
        ]

    def _write_results(
        self,
        images: ImageSet,
        extraction: Extraction,
        mapping: MappingResult,
        originals: OriginalImages,
    ) -> ReconstructionResult:
        """Convert reconstructions to COLMAP models, and write result folder and summary."""
        config = self._config
        with self._stages.stage("results"):
            components = [ComponentResult.of(part, originals) for part in mapping.reconstructions]
            models = tuple(component.model for component in components)

            summarize = partial(
                self._summarize, "success", images, extraction, mapping, models, originals
            )
            if self._output is None:
                summary = summarize()
            else:
                seed, options = config.runtime.seed, config.results
                summary = write_results(
                    self._output,
                    components,
                    originals,
                    options,
                    summarize,
                    seed,
                    self._trajectories,
                )
            originals.release_views()
        return ReconstructionResult(models[0], models[1:], mapping, summary, self._output)

    def _fail(
        self,
        images: ImageSet,
        extraction: Extraction,
        mapping: MappingResult,
        originals: OriginalImages,
    ) -> None:
        """Write a summary with the reasons of the failure, and raise ReconstructionError."""
        self._checkpoints.delete()
        summary = self._summarize("failed", images, extraction, mapping, (), originals)
        hint = ""
        if self._output is not None:
            write_failure(self._output, originals, self._config.results, summary)
            hint = f"; the reasons per image and pair are in {self._output / SUMMARY}"
            self._write_report()
        pairs = summary["pairs"]
        raise ReconstructionError(
            f"no reconstruction was possible from {len(images)} images: {pairs['verified']} of "
            f"{pairs['matched']} matched pairs could be verified{hint}",
            summary,
        )

    def _write_report(self) -> None:
        """Write the report page; log errors, because the results are complete already."""
        if self._output is None or not self._config.results.report:
            return
        with self._stages.stage("report"):
            try:
                write_report(self._output)
            except Exception as error:
                _log.warning("only report.html cannot be written, of all results: %s", error)
                _log.debug("the report", exc_info=True)

    def _complete_summary(self, summary: RunSummary) -> None:
        """Add measured memory and disk space of the whole run to ``summary.json``."""
        if self._output is None:
            return
        summary["resources"] = self._describe_resources(self._output)
        # The disk may be full; the summary.json of the results stage remains valid.
        with suppress(OSError):
            update_summary(self._output, summary)

    def _summarize(
        self,
        status: str,
        images: ImageSet,
        extraction: Extraction,
        mapping: MappingResult,
        models: Sequence[pycolmap.Reconstruction],
        originals: OriginalImages,
    ) -> RunSummary:
        """Collect the results of all stages for ``summary.json``."""
        config, stages, inputs = self._config, self._stages, self._inputs
        photos = inputs.image_folder
        return {
            "format_version": SUMMARY_FORMAT,
            "status": status,
            "warnings": list(stages.warnings),
            "doubts": [doubt.to_json() for doubt in self._doubts],
            "hooks": [reason.to_json() for reason in self._registry.hook_reasons],
            "stages": {
                name: {"seconds": record.seconds, "peak_memory_mb": record.peak_memory_mb}
                for name, record in stages.report().items()
            },
            "providers": self._resolution.describe(extraction.report["providers"]),
            "config": config.model_dump(mode="json"),
            "versions": describe_versions(),
            "photos": None if photos is None else str(photos.resolve()),
            "videos": self._describe_videos(),
            "matches_from": None if inputs.matches is None else inputs.matches.source,
            "images": describe_images(images, extraction.report, mapping, originals),
            "pairs": describe_pairs(extraction.report, mapping, extraction.problem),
            "reconstructions": describe_reconstructions(mapping, models, extraction.problem),
            "mapping_runs": mapping.report.runs,
            "mapping_steps": describe_mapping_steps(mapping),
            "mapping_parts": [asdict(record) for record in self._part_records],
            "georeference": self._georeference_report,
            "dense": self._dense_reports,
            "resources": self._describe_resources(),
        }

    def _describe_resources(self, output: Path | None = None) -> dict[str, Any]:
        """Describe estimated and measured disk space and peak memory of the run."""
        peaks = [record.peak_memory_mb or 0.0 for record in self._stages.report().values()]
        measured = {
            "memory_mb": round(max(peaks, default=0.0) + self._children.peak_mb),
            "output_mb": None if output is None else round(resources.measure_folder_mb(output)),
        }
        return {"predicted": asdict(self._estimate), "measured": measured}

    def _check_resources(self, images: ImageSet) -> None:
        """Report estimated memory and disk space; use fewer workers if memory is short.

        Raises:
            InputError: the estimated memory or disk space is too large even with one worker.
        """
        config = self._config
        store = WeightStore(config.runtime.cache_dir, offline=True)
        networks = {  # A network that predicts both depth and normals is loaded only once.
            (provider.use, file.uri): resources.measure_weights(file, store)
            for _, kind, provider in config.provider_configs()
            for file in self._registry.weights(kind, provider.use, provider.options)
        }
        estimate = partial(
            resources.estimate_resources,
            [image.pinhole.size for image in images],
            config,
            list(networks.values()),
        )
        self._estimate = estimate()
        if config.runtime.check_resources:
            free_mb = measure_memory()[1]
            if self._estimate.memory_mb > free_mb:
                workers = resources.reduce_workers(estimate, thread_limit(), free_mb)
                self._limit_workers(workers)
                self._estimate = estimate(workers)
        self._stages.notice(f"the run takes about {self._estimate}")
        if config.runtime.check_resources:
            cache = cache_folder(config.runtime.cache_dir)
            for text in resources.find_shortages(self._estimate, cache, self._output):
                self._stages.warn(text)

    def _limit_workers(self, workers: int) -> None:
        """Reduce the number of workers of extraction and of the dense stage."""
        runtime = self._config.runtime
        configured = worker_count(runtime)
        workers = min(workers, configured)
        threads = max(runtime.threads, thread_count(runtime))
        runtime = runtime.model_copy(update={"workers": workers, "threads": threads})
        config = self._config.model_copy(update={"runtime": runtime})
        self._resolution = replace(self._resolution, config=config)
        if workers < configured:
            self._stages.notice(f"uses {workers} of {configured} workers, because memory is short")

    def _dense_checkpoints(
        self, part: Reconstruction, originals: OriginalImages
    ) -> DenseCheckpoints | None:
        config = self._config
        if config.runtime.checkpoint_s is None and config.runtime.executor == THREADS:
            return None
        keys = [originals.key(image) for image in part.images]
        checkpoints = DenseCheckpoints(config.runtime.cache_dir, part, keys, config.dense)
        return self._checkpoints.add(checkpoints)


def _without_matching(config: Config) -> Config:
    """Remove features and matchers from a configuration, because matches are imported."""
    if config.depth.use == FROM_MATCHER:
        raise ConfigError(
            "depth.use: 'matcher' needs a matcher, and imported matches replace it: "
            "choose another depth provider"
        )
    removed = dict.fromkeys(("fast_pass", "features", "matcher", "dense_matcher", "retrieval"))
    return config.model_copy(update=removed)


def _has_poses(part: Reconstruction, known: Mapping[str, Pose]) -> bool:
    """Check whether all poses of a component are exactly the poses given by the user."""
    return all(
        name in known and all(map(np.array_equal, pose, known[name]))
        for name, pose in part.poses.items()
    )


def _path(value: PathLike | None) -> Path | None:
    return None if value is None else Path(value)
