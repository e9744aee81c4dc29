"""Localize photos in an existing model, and write their poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpsfm_core.config import Config
from mpsfm_core.config.provider_arguments import Provider, configure
from mpsfm_core.data import MappingImage, MappingProblem, NormalPrior, Rig
from mpsfm_core.data.camera_models import NO_DISTORTION, CameraModel
from mpsfm_core.data.decisions import Reason
from mpsfm_core.data.errors import DataError, InputError
from mpsfm_core.data.events import EventCallback
from mpsfm_core.data.rigs import find_frames
from mpsfm_core.extraction.cache import content_key, digest, pack, unpack
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.matching.pair_matching import merge_matches
from mpsfm_core.extraction.pairs.pairing import numbered_neighbor_pairs
from mpsfm_core.extraction.priors.focal_length import estimate_focal_lengths
from mpsfm_core.extraction.runner import (
    extract,
    extraction_environment,
    match_queries,
    predict_priors,
)
from mpsfm_core.inputs.image_search import check_output_folder, find_images
from mpsfm_core.inputs.images import ImageSet, SourceImage, load_images
from mpsfm_core.inputs.intrinsics import Cameras, choose_cameras
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.inputs.rigs import read_rigs, require_upright
from mpsfm_core.inputs.video import (
    extract_frames,
    is_video,
    read_selection,
    require_output_folder,
)
from mpsfm_core.mapping.localization import (
    FixedModel,
    LocalizedImage,
    Localizer,
    snap_to_observations,
    triangulate_model,
)
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.state import flatten_state, unflatten_state
from mpsfm_core.pipeline.provider_resolution import resolve_providers
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.pipeline.trajectory import localize_frames
from mpsfm_core.providers.registry import Registry
from mpsfm_core.report.reasons import explain
from mpsfm_core.results.exports.source import ExportSource
from mpsfm_core.results.localization import (
    ENTRIES,
    LocalizedPhoto,
    extend_model,
    find_pose_doubts,
    write_localization,
)
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.trajectory import TrajectoryFrame
from mpsfm_core.support.files import lock_output_folder, replace_entries
from mpsfm_core.support.format_versions import VERSION
from mpsfm_core.support.npz import read_npz, write_npz
from mpsfm_core.support.threads import limit_threads

PathLike = str | Path

FORMAT = 1
"""Format version of the database of a model for localization."""
DATABASE = "localization.npz"
"""Name of the database in the folder of the model."""
BATCH_SIZE = 50
"""Number of photos that are localized together, which bounds the memory."""
QUERY_FOLDER = "query/"
"""Prefix of the name of a photo during localization if an image of the model has the same name."""
_UNUSED_BLOCKS = {"runtime", "results", "dense", "fast_pass", "description"}
"""Configuration blocks that do not change the database."""


@dataclass(frozen=True, eq=False)
class LocalizationResult:
    """Result of :func:`localize`."""

    photos: Mapping[str, LocalizedPhoto]
    """Localized photos by name."""
    reasons: Mapping[str, Reason]
    """Reason why a photo has no pose, by name of the photo."""
    extended: pycolmap.Reconstruction | None
    """Copy of the model with the localized photos, or None without the option ``extend``."""
    output: Path | None
    """Folder of the written files, or None if nothing was written."""
    frames: tuple[TrajectoryFrame, ...] = ()
    """Frames of the localized video with their poses, empty without a video."""


def localize(
    model: PathLike,
    photos: PathLike,
    output: PathLike | None = None,
    config: PathLike | Config = "default",
    *,
    images: PathLike | None = None,
    cameras: Cameras | None = None,
    intrinsics: PathLike | None = None,
    rigs: PathLike | Sequence[Rig] | None = None,
    features: Provider | None = None,
    matcher: Provider | None = None,
    retrieval: Provider | None = None,
    camera: Provider | None = None,
    depth: Provider | None = None,
    normals: Provider | None = None,
    masks: Sequence[Provider] | None = None,
    database: PathLike | None = None,
    sequence: bool = False,
    extend: bool = False,
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    on_event: EventCallback | None = None,
) -> LocalizationResult:
    """Estimate the poses of photos in an existing model, which stays unchanged.

    Each photo is matched with similar images of the model. Its pose results from points that are
    triangulated from the images of the model, or lifted from the depth of a single image. Photos of
    one camera with unknown focal length share the refined focal length, and photos that a rig took
    at one moment share one pose.

    Args:
        model: COLMAP model with at least two images, or result folder.
        photos: Folder of the photos to localize, one photo, or a video. The keyframes of a video
            are a sequence, and its other frames are localized between the keyframes.
        output: Folder for the poses, or None to write nothing. A video needs a folder.
        config: Name of a shipped configuration, a YAML file, or a loaded configuration. The block
            ``fast_pass`` is not used.
        images: Folder of the images of the model, by default the folder that the run of the result
            folder recorded, else ``images/`` next to the model.
        cameras: Camera of all photos, camera of each photo by name, or ``pycolmap.Reconstruction``.
            Without cameras, focal lengths are taken from EXIF, else estimated by the camera or
            depth provider, else set to a default, and then refined.
        intrinsics: File with the cameras, instead of ``cameras``: ``intrinsics.yaml``, a COLMAP
            model or ``transforms.json``.
        rigs: Cameras of the photos that move as one, as in :func:`reconstruct`, with known relative
            poses and translations in units of the model.
        features: Provider of features that replaces the configured provider, see
            :func:`reconstruct`.
        matcher: Sparse or dense matcher, which replaces all configured matchers.
        retrieval: Provider of global image descriptors, which select the images of the model to
            match. By default, images with similar features are selected.
        camera: Provider of focal lengths.
        depth: Provider of depth priors.
        normals: Provider of normal priors.
        masks: Mask providers, which replace the configured mask providers.
        database: File with the triangulated points and depth of the model, by default
            ``localization.npz`` in the folder of the model. A missing or outdated file is written.
        sequence: If true, photos with consecutive numbers in their names are matched, too, and
            registered together. By default, photos are not matched with each other.
        extend: If true, add the localized photos to a copy of the model.
        overrides: Settings such as ``"runtime.workers=2"``; not allowed with a loaded
            configuration.
        registry: Providers that the configuration may name, by default all installed providers.
        on_event: Function that receives progress events, see :mod:`mpsfm_core.data.events`.

    Returns:
        Poses with covariance, and the reason for each photo without pose.

    Raises:
        InputError: model, photos, cameras, configuration, weights or output are wrong.
        MpsfmError: a provider failed or violated the provider contract, or the disk is full.

    Examples:
        >>> located = mpsfm.localize("out/", "new_photos/", "located/")
        >>> located.photos["a.jpg"].pose, located.photos["a.jpg"].covariance.shape
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
        depth=depth,
        normals=normals,
    )
    given_cameras = choose_cameras(cameras, intrinsics)
    stages = Stages(registry, on_event)
    folder = None if output is None else Path(output)
    with ExitStack() as stack:
        stack.enter_context(limit_threads(config.runtime.workers))
        if folder is not None:
            if Path(photos).is_dir():
                check_output_folder(folder, Path(photos))
            stack.enter_context(lock_output_folder(folder))
        video = Path(photos) if is_video(Path(photos)) else None
        frames_folder = None if video is None else require_output_folder(video, folder)
        source = ExportSource.read(Path(model), None if images is None else Path(images))
        with stages.stage("providers"):
            config = config.model_copy(update={"fast_pass": None})
            config = resolve_providers(config, registry, stages).config
        run = _Localization(source, config, registry, stages)
        if video is not None and frames_folder is not None:
            photos, sequence = run.extract_keyframes(video, frames_folder), True
        queries = run.load_queries(Path(photos), given_cameras, rigs)
        if extend:
            _require_new_names(source, queries)
        fixed = run.load_model(Path(database) if database else source.folder / DATABASE)
        found: dict[str, LocalizedPhoto] = {}
        reasons: dict[str, Reason] = {}
        for batch in run.split(queries, sequence=sequence):
            for name, outcome in run.localize(fixed, batch, sequence=sequence):
                if isinstance(outcome, Reason):
                    reasons[name] = outcome
                else:
                    found[name] = outcome
        extended = extend_model(source.model, found) if extend else None
        frames = [] if video is None else run.localize_frames(video, Path(photos))
        if folder is not None:
            with replace_entries(folder, ENTRIES) as scratch:
                described = {
                    name: {**reason.to_json(), "text": explain(reason).text}
                    for name, reason in reasons.items()
                }
                write_localization(scratch, found, described, extended, frames)
    return LocalizationResult(found, reasons, extended, folder, tuple(frames))


class _Localization:
    """Localization of photos in one model."""

    def __init__(
        self, source: ExportSource, config: Config, registry: Registry, stages: Stages
    ) -> None:
        self._source, self._config = source, config
        self._registry, self._stages = registry, stages
        self._sequence: tuple[Reconstruction, OriginalImages] | None = None
        self._rigs: tuple[Rig, ...] = ()
        with stages.stage("inputs"):
            self._references = self._load_references()

    def _load_references(self) -> ImageSet:
        """Load the images of the model, with the cameras of the model."""
        source = self._source
        if len(source.names) < 2:
            raise InputError(f"{source.folder}: localization needs a model of two or more images")
        return source.load_images(self._config.inputs)

    def load_queries(
        self,
        photos: Path,
        cameras: Path | Cameras | None,
        rigs: PathLike | Sequence[Rig] | None = None,
    ) -> ImageSet:
        """Load the photos to localize and their rigs, and estimate unknown focal lengths."""
        folder, names = (photos.parent, [photos.name]) if photos.is_file() else (photos, [])
        names = names or find_images(photos)
        if not names:
            raise InputError(f"{photos}: the folder has no photos to localize")
        with self._stages.stage("inputs"):
            queries = load_images(folder, cameras, options=self._config.inputs, names=names)
            if rigs is not None:
                self._rigs = _read_calibrated_rigs(rigs, queries, folder)
        return estimate_focal_lengths(queries, self._config, self._registry, self._stages)

    def extract_keyframes(self, video: Path, output: Path) -> Path:
        """Write the keyframes of a video into the output folder, and return their folder."""
        with self._stages.stage("video"):
            progress = partial(self._stages.stage_progress, "video")
            return extract_frames({"": video}, output, self._config.inputs.video, progress)

    def localize_frames(self, video: Path, keyframes: Path) -> list[TrajectoryFrame]:
        """Localize the frames of a video between its keyframes, which are localized before."""
        every = self._config.inputs.video.trajectory_every
        if self._sequence is None or not every:
            return []
        part, originals = self._sequence
        with self._stages.stage("trajectory"):
            progress = partial(self._stages.stage_progress, "trajectory")
            selection = read_selection(keyframes)
            return localize_frames(video, selection, [part], originals, every, progress)

    def split(self, queries: ImageSet, *, sequence: bool) -> Iterator[ImageSet]:
        """Yield the photos in batches of whole frames, or all photos of a sequence."""
        frames = find_frames(queries.names, self._rigs)
        ordered = sorted(zip(frames, queries, strict=True), key=lambda item: item[0])
        batch: list[SourceImage] = []
        for _, members in groupby(ordered, key=lambda item: item[0]):
            images = [image for _, image in members]
            if batch and not sequence and len(batch) + len(images) > BATCH_SIZE:
                yield ImageSet(batch, self._config.inputs)
                batch = []
            batch += images
        yield ImageSet(batch, self._config.inputs)

    def load_model(self, path: Path) -> FixedModel:
        """Load triangulated points and depth of the model, or compute and store them."""
        poses = reconstruction_poses(self._source.model)
        model_names = self._source.names
        known = {
            image.name: poses[name]
            for image, name in zip(self._references, model_names, strict=True)
        }
        settings = self._config.model_dump(mode="json", exclude=_UNUSED_BLOCKS)
        key = content_key(
            FORMAT,
            settings,
            digest(tuple(known.values())),
            [self._references.pixel_key(index) for index in range(len(self._references))],
            [image.pinhole.params.tolist() for image in self._references],
        )
        stored = _read_database(path, key)
        if stored is not None:
            return replace(stored, problem=stored.problem.with_poses(known))
        with self._stages.stage("extraction"):
            extraction = extract(self._references, self._config, self._registry, self._stages)
        with self._stages.stage("mapping"):
            problem = extraction.problem.with_poses(known)
            fixed = triangulate_model(problem, self._config.mapper_options())
        _write_database(path, key, fixed)
        return fixed

    def localize(
        self, model: FixedModel, queries: ImageSet, *, sequence: bool
    ) -> Iterator[tuple[str, LocalizedPhoto | Reason]]:
        """Yield the name of each photo with its pose, or with the reason without a pose."""
        names = queries.names
        with self._stages.stage("extraction"):
            problem = self._extend_problem(model, queries, sequence=sequence)
        num_references = len(self._references)
        rows = [num_references + row for row in range(len(names))]
        with self._stages.stage("localization"):
            localizer = Localizer(problem, model, self._config.mapper_options())
            if sequence:
                outcomes, part = localizer.localize_sequence(rows)
                images = [
                    replace(image, name=names[image.index - num_references])
                    for image in part.images
                ]
                part = replace(part, images=tuple(images))
                self._sequence = part, OriginalImages(queries, problem)
            else:
                by_row: dict[int, LocalizedImage | Reason] = {}
                for group in _group_photos(queries, self._rigs):
                    together = [rows[row] for row in group]
                    by_row |= zip(group, localizer.localize_together(together), strict=True)
                    self._stages.stage_progress("localization", len(by_row), len(rows))
                outcomes = [by_row[row] for row in range(len(rows))]
        determined = {
            query.camera.camera_id
            for query, outcome in zip(queries, outcomes, strict=True)
            if isinstance(outcome, LocalizedImage)
            and len(outcome.matches.keys() & set(self._references.names)) > 1
        }
        for query, outcome in zip(queries, outcomes, strict=True):
            name = query.name
            if isinstance(outcome, Reason):
                self._stages.image_rejected(name, outcome)
                yield name, outcome
            else:
                self._stages.image_registered(name, num_references + 1, num_references + len(names))
                focal_known = query.focal_known or query.camera.camera_id in determined
                yield name, self._convert(query, outcome, focal_known=focal_known)

    def _extend_problem(
        self, model: FixedModel, queries: ImageSet, *, sequence: bool
    ) -> MappingProblem:
        """Add photos to the mapping problem of the model, with matches to images of the model."""
        num_references = len(self._references)
        taken = set(self._references.names)
        renamed = [
            replace(q, name=QUERY_FOLDER + q.name) if q.name in taken else q for q in queries
        ]
        joint = ImageSet([*self._references, *renamed], self._config.inputs)
        context = ExtractionContext(joint, self._config, self._registry, self._stages)
        between = []
        if sequence:
            neighbors = numbered_neighbor_pairs(queries.names, self._config.pairs)
            between = [(num_references + a, num_references + b) for a, b in neighbors]
        with extraction_environment(context):
            context.run_masks()
            matches = match_queries(context, num_references, between)
        context = ExtractionContext(queries, self._config, self._registry, self._stages)
        with extraction_environment(context):
            context.run_masks()
            priors = predict_priors(context, None)
        added = [
            _query_image(photo, priors.depth[query.name], priors.normals[query.name])
            for photo, query in zip(renamed, queries, strict=True)
        ]
        name_of = dict(zip(queries.names, (photo.name for photo in renamed), strict=True))
        rigs = tuple(rig.subset(name_of).renamed(name_of) for rig in self._rigs)
        images = (*model.problem.images, *added)
        problem = replace(model.problem, images=images, rigs=rigs)
        max_distance_px = self._config.extraction.dense_snap_px
        return snap_to_observations(merge_matches(problem, matches), model, max_distance_px)

    def _convert(
        self, source: SourceImage, image: LocalizedImage, *, focal_known: bool
    ) -> LocalizedPhoto:
        """Convert a localized image to camera, keypoints and names of the original images."""
        model_names = dict(zip(self._references.names, self._source.names, strict=True))
        references = {reference.name: reference for reference in self._references}
        matches = {
            model_names[other]: (
                source.original_pixels(xy),
                references[other].original_pixels(other_xy),
            )
            for other, (xy, other_xy) in image.matches.items()
            if other in references
        }
        contradiction = None
        if image.contradiction is not None:
            values = image.contradiction.values
            other = str(values["other_image"])
            contradiction = model_names.get(other, other), float(values["violation_ratio"])
        return LocalizedPhoto(
            source.name,
            (image.rotation, image.translation),
            image.covariance,
            source.refined_camera(image.camera),
            image.num_inliers,
            image.num_matches,
            matches,
            find_pose_doubts(matches, contradiction, focal_known=focal_known),
        )


def _group_photos(queries: ImageSet, rigs: Sequence[Rig]) -> list[list[int]]:
    """Group photos that share a camera of unknown focal length or a rig."""
    count, rig_of = len(queries), {n: k for k, rig in enumerate(rigs) for n in rig.image_names}
    shared: list[tuple[int, tuple[str, int]]] = []
    for row, query in enumerate(queries):
        if not query.focal_known:
            shared.append((row, ("camera", query.camera.camera_id)))
        if query.name in rig_of:
            shared.append((row, ("rig", rig_of[query.name])))
    nodes = {key: count + number for number, key in enumerate({key for _, key in shared})}
    rows, columns = [row for row, _ in shared], [nodes[key] for _, key in shared]
    size = count + len(nodes)
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(size, size))
    label_of = connected_components(links, directed=False)[1][:count]
    _, first = np.unique(label_of, return_index=True)
    return [np.flatnonzero(label_of == label_of[row]).tolist() for row in sorted(first)]


def _read_calibrated_rigs(
    rigs: PathLike | Sequence[Rig], queries: ImageSet, folder: Path
) -> tuple[Rig, ...]:
    """Return the rigs of the photos, whose relative poses must be known."""
    if isinstance(rigs, str | Path):
        rigs = read_rigs(Path(rigs), queries.names, folder)
    if not all(rig.is_calibrated for rig in rigs):
        raise InputError(
            "rigs: a relative pose is unknown; localization needs rigs with known sensor_from_rig, "
            "which `mpsfm reconstruct --rigs` can estimate"
        )
    require_upright(rigs, queries)
    return tuple(rigs)


def _query_image(image: SourceImage, depth: Any, normals: Any) -> MappingImage:
    """Build an image of the mapping problem without keypoints."""
    return MappingImage(
        image.name,
        image.pinhole,
        np.zeros((0, 2)),
        depth,
        normals,
        focal_known=image.focal_known,
        camera_id=image.camera.camera_id,
        focal_log_std=image.focal_log_std,
        camera_model=image.camera_model,
    )


def _require_new_names(source: ExportSource, queries: ImageSet) -> None:
    """Check that no photo has the name of an image of the model, which is to be extended."""
    taken = sorted(set(queries.names) & set(source.names))
    if taken:
        raise InputError(
            f"{source.folder}: the model already has an image {taken[0]!r}; rename this photo, or "
            f"move the photos to a subfolder, to extend the model"
        )


def _write_database(path: Path, key: str, model: FixedModel) -> None:
    """Write the triangulated model; its normals are not needed to localize images."""
    images = tuple(
        replace(image, normals=_flat_normals(image), known_pose=None)
        for image in model.problem.images
    )
    arrays = {
        VERSION: np.array(FORMAT),
        "key": np.array(key),
        "wrong_depth": np.array(model.wrong_depth, dtype=np.int64),
        **pack(replace(model.problem, images=images), "problem"),
        **{f"state/{name}": array for name, array in flatten_state(model.state).items()},
    }
    try:
        write_npz(path, **arrays)
    except OSError as error:
        raise InputError(
            f"{path}: the database of the model cannot be written ({error}); choose another file "
            f"with --database"
        ) from error


def _read_database(path: Path, key: str) -> FixedModel | None:
    """Read the triangulated model, or return None if the file is missing or outdated."""
    try:
        arrays = read_npz(path)
        if str(arrays["key"]) != key:
            return None
        problem = unpack(MappingProblem, arrays, "problem")
        images = (
            replace(image, camera_model=CameraModel.SIMPLE_RADIAL, distortion=NO_DISTORTION)
            for image in problem.images
        )
        prefix = "state/"
        state = {
            name.removeprefix(prefix): array
            for name, array in arrays.items()
            if name.startswith(prefix)
        }
        problem = replace(problem, images=tuple(images))
        wrong_depth = tuple(map(int, arrays["wrong_depth"]))
        return FixedModel(problem, unflatten_state(state), wrong_depth)
    except (OSError, ValueError, KeyError, DataError):
        return None


def _flat_normals(image: MappingImage) -> NormalPrior:
    """Return normals that face the camera, which compress to few bytes."""
    normals = np.zeros_like(image.normals.normals)
    normals[..., 2] = -1
    variance = np.ones(normals.shape[:2], np.float32)
    return NormalPrior(normals, variance, image.normals.valid)
