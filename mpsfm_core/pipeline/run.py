"""From a folder of photos to results: the only place that knows all rooms."""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mpsfm_core.config import Config, load_config
from mpsfm_core.data import DepthPrior, Float64, MappingProblem, Pose, View
from mpsfm_core.data.errors import ConfigError, InputError, ReconstructionError
from mpsfm_core.data.result_layout import DENSE, DEPTH, MESH, SPARSE, SUMMARY
from mpsfm_core.dense.densify import DenseReport, densify
from mpsfm_core.dense.depth_range import depth_prior_from_points
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.mesh import TriangleMesh, mesh_depth_maps
from mpsfm_core.dense.options import DenseOptions, MeshOptions
from mpsfm_core.extraction.cache import cache_folder
from mpsfm_core.extraction.priors.focal_length import estimate_focal_lengths
from mpsfm_core.extraction.runner import Extraction, extend_matches, extract
from mpsfm_core.geometry import transform
from mpsfm_core.inputs.images import ImageSet, check_output_folder, find_images, load_images
from mpsfm_core.inputs.matches import (
    ImportedMatches,
    matches_from_database,
    matches_from_hloc,
)
from mpsfm_core.inputs.models import match_names, read_model, read_poses, reconstruction_poses
from mpsfm_core.inputs.video import extract_frames, is_video
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.initialization.seed_poses import apply_seed_poses, select_seed_images
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import MappingResult, Reconstruction, RegisteredImage
from mpsfm_core.pipeline import precompile, resources
from mpsfm_core.pipeline.checkpoints import DenseCheckpoints, MappingCheckpoints
from mpsfm_core.pipeline.provider_resolution import ProviderResolution, resolve_providers
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.provider_config import FROM_MATCHER
from mpsfm_core.providers.registry import Registry, core_version
from mpsfm_core.providers.weights import WeightStore
from mpsfm_core.report.page import write_report
from mpsfm_core.results.colmap_model import write_model
from mpsfm_core.results.depth_maps import read_depth_map, write_depth_maps
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.georeference import georeference
from mpsfm_core.results.mesh import write_mesh
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.ply import write_cloud
from mpsfm_core.results.summary import FORMAT as SUMMARY_FORMAT
from mpsfm_core.results.summary import describe_images, describe_pairs, describe_reconstructions
from mpsfm_core.results.writer import ComponentResult, update_summary, write_failure, write_results
from mpsfm_core.support.disk_arrays import DiskArrays
from mpsfm_core.support.files import lock_output_folder, replace_entries
from mpsfm_core.support.format_versions import VERSION
from mpsfm_core.support.threads import limit_threads, thread_limit

PathLike = str | Path

_log = logging.getLogger(__name__)
_MENTIONED = 5


@dataclass(frozen=True, eq=False)
class ReconstructionResult:
    """What :func:`reconstruct` returns.

    ``model``: COLMAP model of the original photos. ``further_models``: of images that are not
    connected to those of ``model``, largest first. ``mapping``: poses, points and refined depth
    as arrays. ``summary``: what ``summary.json`` says. ``output``: the folder that was written.
    """

    model: pycolmap.Reconstruction
    further_models: tuple[pycolmap.Reconstruction, ...]
    mapping: MappingResult
    summary: dict[str, Any]
    output: Path | None


def reconstruct(
    images: PathLike,
    output: PathLike | None = None,
    config: PathLike | Config = "default",
    *,
    intrinsics: PathLike | None = None,
    image_list: PathLike | None = None,
    poses: PathLike | None = None,
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    fresh: bool = False,
    database: PathLike | None = None,
    hloc: tuple[PathLike, PathLike] | None = None,
) -> ReconstructionResult:
    """Reconstruct a folder of photos, or a video.

    Args:
        images: folder of photos, subfolders included; or a video, whose frames are chosen as
            ``config.inputs.video`` says and go into ``frames/`` of the output.
        output: folder to write (see :mod:`mpsfm_core.results.writer`), nothing is written if None.
            A run has it to itself.
        config: name of a shipped configuration, a YAML file, or a loaded one.
        intrinsics: ``intrinsics.yaml``, a COLMAP model or ``transforms.json``; else the cameras
            of ``poses``, else EXIF, else what the depth provider sees, else a default focal length.
        image_list: text file with one image name a line.
        poses: COLMAP model or ``transforms.json`` with known poses of some or all images;
            ``mapping.known_poses`` says whether they are a start or stay.
        overrides: settings such as ``"runtime.workers=2"``; not with a loaded configuration.
        registry: the providers to choose from, by default those of all installed plugins.
        database: COLMAP database whose keypoints and matches are taken instead of our own; they are
            verified again. Its cameras are not: give it as ``intrinsics`` too if they are good.
        hloc: features and matches file of hloc, instead of ``database``.
        fresh: do not go on from the checkpoint that a run left which was killed while mapping.

    Raises:
        InputError: images, intrinsics, poses, configuration, weights or output are wrong. What
            providers lack is found out before any photo is looked at.
        ReconstructionError: no reconstruction was possible; ``summary.json`` has the reasons.
        MpsfmError: a provider failed or broke its contract, or the disk is full.
    """
    registry = registry or Registry.discover()
    if not isinstance(config, Config):
        config = load_config(config, overrides, registry)
    elif overrides:
        raise TypeError("overrides go into load_config(), this configuration is loaded already")
    if database is not None and hloc is not None:
        raise TypeError("matches are of a database or of hloc, not of both")
    if database is not None or hloc is not None:
        config = _without_matching(config)
    folder, target = Path(images), _path(output)
    run = _Run(config, registry, target, fresh)
    with ExitStack() as stack:
        stack.enter_context(limit_threads(config.runtime.workers))
        if target is not None:
            check_output_folder(target, folder)
            stack.enter_context(lock_output_folder(target))
        elif is_video(folder):
            raise InputError(f"{folder}: a video needs an output folder, for its frames")
        stack.enter_context(run.watching_processes())
        matches = (database,) if database is not None else hloc or ()
        return run(
            folder,
            _path(intrinsics),
            _path(image_list),
            _path(poses),
            tuple(Path(file) for file in matches),
        )


class _Run:
    """One reconstruction: the rooms in their order."""

    def __init__(
        self, config: Config, registry: Registry, output: Path | None, fresh: bool
    ) -> None:
        self._config = config
        self._registry = registry
        self._output = output
        self._fresh = fresh
        self._stages = Stages(registry)
        self._provision = ProviderResolution(config, ())
        self._folder = Path()
        self._dense: list[dict[str, Any]] | None = None
        self._imported: ImportedMatches | None = None
        self._place: dict[str, object] | None = None
        self._needs = resources.ResourceEstimate(0, 0, 0)
        self._started = resources.ChildMemoryMonitor()
        self._checkpoints: list[MappingCheckpoints | DenseCheckpoints] = []

    def watching_processes(self) -> AbstractContextManager[None]:
        """Measure the memory of processes that this one starts."""
        return self._started.watching()

    def __call__(
        self,
        folder: Path,
        intrinsics: Path | None,
        image_list: Path | None,
        poses: Path | None,
        matches: tuple[Path, ...],
    ) -> ReconstructionResult:
        stage = self._stages.stage
        if not is_video(folder):
            find_images(folder)  # no folder, no downloads
        with stage("providers"):
            self._provision = resolve_providers(self._config, self._registry, self._stages)
        config = self._provision.config
        if is_video(folder):
            with stage("video"):
                folder = self._frames(folder)
        self._folder = folder
        compilation = precompile.start_compilation() if thread_limit() > 1 else None
        with stage("inputs"):
            images = load_images(
                folder,
                intrinsics,
                image_list,
                config.inputs,
                model=poses,
                without=self._output,
            )
            self._foresee(images)
            known = {} if poses is None else _known_poses(poses, images)
            self._imported = _import_matches(matches, images)
        with stage("extraction"):
            images = estimate_focal_lengths(images, config, self._registry, self._stages)
            first = config.fast_pass_config() or config
            extraction = extract(images, first, self._registry, self._stages, self._imported)
        if compilation is not None:
            with stage("compilation"):
                compilation.wait()
        problem = extraction.problem.with_poses(known)
        mapping = self._map(problem, config.mapper_options())
        if config.has_second_pass and (held := self._held(mapping, images)) is not None:
            with stage("extraction"):
                loose = frozenset(range(len(images))) - {image.index for image in held}
                extraction = extend_matches(
                    images, config, self._registry, extraction, loose, self._stages
                )
            mapping = self._map_again(extraction, known, held)
        photos = OriginalImages(images, extraction.problem)
        if not mapping.reconstructions:
            self._forget_checkpoints()
            self._give_up(images, extraction, mapping, photos)
        if config.results.georeference and not known:
            mapping = self._georeference(images, mapping)
        mapping, self._dense = self._densified(mapping, photos, known)
        summary: dict[str, Any] = {}
        with stage("results"):
            components = [ComponentResult.of(part, photos) for part in mapping.reconstructions]
            models = tuple(component.model for component in components)

            def summarize() -> dict[str, Any]:
                summary.update(self._summary("success", images, extraction, mapping, models))
                return summary

            if self._output is None:
                summarize()
            else:
                seed = config.runtime.seed
                write_results(self._output, components, photos, config.results, summarize, seed)
        self._forget_checkpoints()
        self._report()
        if self._output is not None:
            summary["resources"] = self._resources(self._output)
            with suppress(OSError):  # what was written before stands
                update_summary(self._output, summary)
        return ReconstructionResult(models[0], models[1:], mapping, summary, self._output)

    def _map(self, problem: MappingProblem, options: MapperOptions) -> MappingResult:
        with self._stages.stage("mapping"):
            checkpoints = self._mapper_checkpoints(problem, options)
            return mapper.reconstruct(problem, options, self._stages, checkpoints)

    def _map_again(
        self, extraction: Extraction, known: Mapping[str, Pose], held: list[RegisteredImage]
    ) -> MappingResult:
        """With more matches, from where the images stand that were held by fewer; poses that the
        user fixed stay alone. ``known``: the poses that the user brought."""
        problem = extraction.problem.with_poses(known)
        options = self._provision.config.mapper_options()
        if not known:
            options = options.model_copy(update={"known_poses": "guess"})
        if options.known_poses != "fixed":
            problem = apply_seed_poses(problem, held)
        return self._map(problem, options)

    def _held(self, mapping: MappingResult, images: ImageSet) -> list[RegisteredImage] | None:
        """The images that quick matching holds in place, None if that is all."""
        config = self._provision.config
        assert config.fast_pass is not None
        held = select_seed_images(mapping, config.fast_pass.min_points)
        if len(held) == len(images):
            return None
        matchers = (config.matcher, config.dense_matcher)
        names = " and ".join(backend.use for backend in matchers if backend is not None)
        count = f"{len(images) - len(held)} of {len(images)} images"
        self._stages.notice(f"quick matching does not hold {count}: {names} matches them")
        return held

    def _foresee(self, images: ImageSet) -> None:
        """Say what the run will take; raises :class:`InputError` where that cannot be had."""
        config, registry = self._provision.config, self._registry
        store = WeightStore(config.runtime.cache_dir, offline=True)
        networks = {  # one that gives two things at once is there once
            (backend.use, file.uri): resources.network_bytes(file, store)
            for _, kind, backend in config.provider_configs()
            for file in registry.weights(kind, backend.use, backend.options)
        }
        self._needs = resources.estimate_resources(
            [image.pinhole.size for image in images],
            config,
            [choice.provider for choice in self._provision.choices],
            list(networks.values()),
        )
        self._stages.notice(f"takes about {self._needs}")
        if config.runtime.check_resources:
            cache = cache_folder(config.runtime.cache_dir)
            for text in resources.shortages(self._needs, cache, self._output):
                self._stages.notice(f"warning: {text}")

    def _resources(self, output: Path | None = None) -> dict[str, Any]:
        """What was predicted and what it was: of memory the peak so far."""
        peaks = [record.peak_memory_mb or 0.0 for record in self._stages.report().values()]
        measured = {
            "memory_mb": round(max(peaks, default=0.0) + self._started.peak_mb),
            "output_mb": None if output is None else round(resources.folder_mb(output)),
        }
        return {"predicted": asdict(self._needs), "measured": measured}

    def _mapper_checkpoints(
        self, problem: MappingProblem, options: MapperOptions
    ) -> MappingCheckpoints | None:
        config = self._provision.config
        if config.runtime.checkpoint_s is None:
            return None
        checkpoints = MappingCheckpoints(
            config.runtime.cache_dir,
            problem,
            options,
            self._stages,
            config.runtime.checkpoint_s,
        )
        if self._fresh:
            checkpoints.forget()
        self._checkpoints.append(checkpoints)
        return checkpoints

    def _dense_checkpoints(
        self, part: Reconstruction, photos: OriginalImages
    ) -> DenseCheckpoints | None:
        config = self._provision.config
        if config.runtime.checkpoint_s is None:
            return None
        keys = [photos.key(image) for image in part.images]
        checkpoints = DenseCheckpoints(config.runtime.cache_dir, part, keys, config.dense)
        if self._fresh:
            checkpoints.forget()
        self._checkpoints.append(checkpoints)
        return checkpoints

    def _forget_checkpoints(self) -> None:
        """The run is finished."""
        for checkpoints in self._checkpoints:
            checkpoints.forget()

    def _densified(
        self, mapping: MappingResult, photos: OriginalImages, known: Mapping[str, Pose]
    ) -> tuple[MappingResult, list[dict[str, Any]] | None]:
        """The groups with depth measured in the photos, and what to say of each.

        ``known``: the poses that the user brought.
        """
        config = self._provision.config
        if not config.dense.enabled:
            return mapping, None
        parts, reports = [], []
        disk = DiskArrays(cache_folder(config.runtime.cache_dir))
        with self._stages.stage("dense"):
            for part in mapping.reconstructions:
                dense, report = densify(
                    part,
                    photos.view,
                    config.dense,
                    None,
                    partial(self._stages.stage_progress, "dense"),
                    self._dense_checkpoints(part, photos),
                    disk.store,
                    poses_use_depth=not _poses_are(part, known),
                )
                parts.append(dense)
                reports.append(report.describe())
        return replace(mapping, reconstructions=tuple(parts)), reports

    def _georeference(self, images: ImageSet, mapping: MappingResult) -> MappingResult:
        """Lay reconstructions over the GPS positions of their photos, where these suffice."""
        positions = {image.name: image.gps for image in images if image.gps is not None}
        if not positions:
            return mapping
        laid = []
        for number, reconstruction in enumerate(mapping.reconstructions):
            found = georeference(reconstruction, positions)
            if isinstance(found, str):
                laid.append(reconstruction)
                described: dict[str, object] = {"why_not": found}
            else:
                laid.append(found[0])
                described = found[1].describe()
            if number == 0:
                self._place = described
        return replace(mapping, reconstructions=tuple(laid))

    def _frames(self, video: Path) -> Path:
        """The folder of the frames that are taken from a video."""
        assert self._output is not None

        def progress(done: int, total: int) -> None:
            self._stages.stage_progress("video", done, total)

        return extract_frames(video, self._output, self._provision.config.inputs.video, progress)

    def _give_up(
        self,
        images: ImageSet,
        extraction: Extraction,
        mapping: MappingResult,
        photos: OriginalImages,
    ) -> None:
        """Leave the reasons in the summary and raise."""
        summary = self._summary("failed", images, extraction, mapping, ())
        where = ""
        if self._output is not None:
            write_failure(self._output, photos, self._provision.config.results, summary)
            where = f"; the reasons per image and pair are in {self._output / SUMMARY}"
            self._report()
        pairs = summary["pairs"]
        raise ReconstructionError(
            f"no reconstruction was possible from {len(images)} images: {pairs['verified']} of "
            f"{pairs['matched']} matched pairs could be verified{where}",
            summary,
        )

    def _report(self) -> None:
        """Write the page; whatever goes wrong there, the results are safe."""
        if self._output is None or not self._provision.config.results.report:
            return
        with self._stages.stage("report"):
            try:
                write_report(self._output)
            except Exception as error:
                _log.warning("no report was written, all results were: %s", error)
                _log.debug("the report", exc_info=True)

    def _summary(
        self,
        status: str,
        images: ImageSet,
        extraction: Extraction,
        mapping: MappingResult,
        models: Sequence[pycolmap.Reconstruction],
    ) -> dict[str, Any]:
        return {
            VERSION: SUMMARY_FORMAT,
            "status": status,
            "photos": str(self._folder.resolve()),
            "matches_from": None if self._imported is None else self._imported.source,
            "images": describe_images(images, extraction.report, mapping),
            "pairs": describe_pairs(extraction.report, mapping),
            "reconstructions": describe_reconstructions(mapping, models),
            "georeference": self._place,
            "resources": self._resources(),
            "stages": {name: asdict(record) for name, record in self._stages.report().items()},
            "dense": self._dense,
            "mapping_runs": mapping.report.runs,
            "mapping_steps": {
                name: {"seconds": seconds, "calls": mapping.report.counts.get(name)}
                for name, seconds in mapping.report.seconds.items()
            },
            "providers": self._providers(extraction.report["providers"]),
            "config": self._provision.config.model_dump(mode="json"),
            "versions": {
                "mpsfm-core": core_version(),
                "pycolmap": pycolmap.__version__,
                "python": platform.python_version(),
            },
        }

    def _providers(self, usage: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """What predicted what, why it was chosen, under which licences, how often, how long."""
        used = {(line["kind"], line["name"]): line for line in usage}
        described = []
        unused = {"computed": 0, "from_cache": 0, "seconds": 0.0}
        blocks = zip(
            self._provision.choices, self._provision.config.provider_configs(), strict=True
        )
        for choice, (_, kind, backend) in blocks:
            spec = choice.provider
            described.append(
                {
                    "block": choice.block,
                    **used.get((kind, spec.name), {"kind": kind, "name": spec.name, **unused}),
                    "from": choice.origin,
                    "chosen": choice.reason.value,
                    "passed_over": {
                        name: why.to_json() for name, why in choice.passed_over.items()
                    },
                    "code_license": spec.code_license,
                    "weights_license": spec.weights_license,
                    "accuracy": spec.accuracy,
                    "wrappers": [wrapper.use for wrapper in backend.wrap],
                }
            )
        return described


def _without_matching(config: Config) -> Config:
    """No providers for what is brought."""
    if config.depth.use == FROM_MATCHER:
        raise ConfigError("depth: the matcher gives it, which does not run for matches of others")
    nothing = dict.fromkeys(("fast_pass", "features", "matcher", "dense_matcher", "retrieval"))
    return config.model_copy(update=nothing)


def _import_matches(files: tuple[Path, ...], images: ImageSet) -> ImportedMatches | None:
    """From a COLMAP database, or from the two files of hloc."""
    if not files:
        return None
    if len(files) == 1:
        return matches_from_database(files[0], images)
    return matches_from_hloc(files[0], files[1], images)


def _known_poses(model: Path, images: ImageSet) -> dict[str, Pose]:
    poses = read_poses(model)
    matched = match_names(images.names, poses)
    if not matched:
        raise InputError(f"{model}: has a pose of none of the images, names differ")
    if len(matched) < 2:
        raise InputError(f"{model}: has a pose of {next(iter(matched))} only, two are needed")
    others = sorted(poses.keys() - set(matched.values()))
    if others:
        text = "%s: %d of its %d images are not among the photos: %s"
        _log.warning(text, model, len(others), len(poses), ", ".join(others[:_MENTIONED]))
    return {name: poses[found] for name, found in matched.items()}


def _poses_are(part: Reconstruction, known: Mapping[str, Pose]) -> bool:
    """Whether all images of a group stand where the user's poses have them."""
    return all(
        name in known and all(map(np.array_equal, pose, known[name]))
        for name, pose in part.poses.items()
    )


def _path(value: PathLike | None) -> Path | None:
    return None if value is None else Path(value)


def densify_model(
    model: PathLike,
    images: PathLike,
    output: PathLike,
    options: DenseOptions | None = None,
    workers: int | None = None,
) -> DenseReport:
    """Measure depth in the photos of a model; write it, ``dense.ply`` and the model.

    The search starts from the maps in ``model/depth`` if the model is an output folder of ours,
    else from the range of the points that an image sees; images without either are left out.

    Raises:
        InputError: model or photos cannot be read, names do not match, the model has no points, or
            ``output`` cannot be written.
    """
    with lock_output_folder(Path(output)), limit_threads(workers):
        return _densify_model(Path(model), Path(images), Path(output), options)


def _densify_model(
    model: Path, images: Path, output: Path, options: DenseOptions | None
) -> DenseReport:
    colmap, poses = read_model(model), read_poses(model)
    matched = match_names(find_images(images), poses)
    if len(matched) < 2:
        raise InputError(f"{images}: has {len(matched)} of the photos of {model}, two are needed")
    photos = load_images(images, model=model, names=list(matched))
    points = {str(image.name): _depths_of_points(colmap, image) for image in colmap.images.values()}
    depths, poses_use_depth = [], True
    for photo in photos:
        found = matched[photo.name]
        file = model / DEPTH / f"{found}.npz"
        poses_use_depth &= file.is_file()
        depths.append(
            read_depth_map(file)[1] if file.is_file() else depth_prior_from_points(points[found])
        )
    known = _maps_alone(photos, [poses[matched[photo.name]] for photo in photos], depths)
    if not known.images:
        raise InputError(f"{model}: has no points, so nothing says how far the surfaces are")
    view_of = _view_of(photos)
    disk = DiskArrays(cache_folder())
    dense, report = densify(
        known,
        view_of,
        options or DenseOptions(),
        store_array=disk.store,
        poses_use_depth=poses_use_depth,
    )
    with replace_entries(output, (SPARSE, DENSE, DEPTH)) as folder:
        write_model(folder / SPARSE, colmap)
        write_depth_maps(folder / DEPTH, dense)
        write_cloud(folder / DENSE, fuse_depth_maps(dense, view_of, ResultOptions()))
    return report


def _maps_alone(
    photos: ImageSet, poses: Sequence[Pose], depths: Sequence[DepthPrior | None]
) -> Reconstruction:
    """The photos whose depth is known, without points."""
    none = np.zeros(0, np.int64)
    found = enumerate(zip(photos, poses, depths, strict=True))
    images = tuple(
        RegisteredImage(index, photo.name, photo.pinhole, *pose, none, depth, 1.0)
        for index, (photo, pose, depth) in found
        if depth is not None
    )
    return Reconstruction(images, np.zeros((0, 3)), np.zeros(0))


def _view_of(photos: ImageSet) -> Callable[[str], View]:
    rows = {name: row for row, name in enumerate(photos.names)}
    return lambda name: photos.view(rows[name])


def _depths_of_points(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Float64:
    seen = [point.point3D_id for point in image.points2D if point.has_point3D()]
    seen = [number for number in seen if model.exists_point3D(number)]
    if not seen or not image.has_pose:
        return np.zeros(0)
    xyz = np.array([model.points3D[number].xyz for number in seen])
    matrix = np.asarray(image.cam_from_world().matrix())
    return transform(matrix[:, :3], matrix[:, 3], xyz)[:, 2]


def mesh_model(
    folder: PathLike,
    photos: PathLike | None = None,
    options: MeshOptions | None = None,
) -> TriangleMesh:
    """Write ``mesh.ply`` and ``mesh.glb`` into a result folder that has depth maps.

    ``photos``: the folder of the photos, if they are not where the run found them. The PLY file has
    the axes of the model; the GLB has gravity down.

    Raises:
        InputError: folder or photos cannot be read, there are no depth maps, they show no surface,
            or the libraries for meshes are not installed.
    """
    with lock_output_folder(Path(folder)):
        source = ExportSource.read(Path(folder), _path(photos))
        poses = reconstruction_poses(source.model)
        files = [source.folder / DEPTH / f"{name}.npz" for name in source.names]
        depths = [read_depth_map(file)[1] if file.is_file() else None for file in files]
        known = _maps_alone(source.images, [poses[name] for name in source.names], depths)
        if not known.images:
            raise InputError(f"{folder}: has no depth maps; mpsfm dense makes them")
        mesh = mesh_depth_maps(known, _view_of(source.images), options or MeshOptions())
        with replace_entries(source.folder, MESH) as written:
            write_mesh(written, mesh, source)
    return mesh
