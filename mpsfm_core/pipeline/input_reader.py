"""Read the inputs of a run: videos, photos, cameras, known poses, rigs and matches."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import pycolmap

from mpsfm_core.data import Pose, Rig
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import CUT_VIEWS, IMAGES, MASKS_OF_VIEWS
from mpsfm_core.inputs.image_search import (
    MAX_LISTED,
    check_images_folder,
    check_output_folder,
    find_images,
    find_videos,
    select_listed_images,
)
from mpsfm_core.inputs.images import ImageSet, load_images
from mpsfm_core.inputs.intrinsics import Cameras
from mpsfm_core.inputs.matches import (
    ImportedMatches,
    matches_from_database,
    matches_from_hloc,
)
from mpsfm_core.inputs.models import Poses, describe_name_difference, match_names, read_poses
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.inputs.rigs import find_turned, read_rigs, require_upright
from mpsfm_core.inputs.video import (
    VideoSelection,
    extract_frames,
    read_selection,
    require_output_folder,
)
from mpsfm_core.inputs.view_cutting import (
    MAX_FIELD_OF_VIEW_DEG,
    CutImages,
    are_panoramas,
    cut_images,
    find_wide_cameras,
)
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.support.threads import opencv_threads, thread_limit

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Source:
    """Input files and objects of a run."""

    images: Path | ImageSet
    """Folder of photos or videos, path of a video, or loaded images."""
    cameras: Path | Cameras | None
    image_list: Path | None
    poses: Path | Poses | None = None
    matches: tuple[Path, ...] = ()
    """COLMAP database, or features and matches files of hloc; empty to run the matchers."""
    rigs: Path | Sequence[Rig] | None = None

    @property
    def camera_model(self) -> Path | pycolmap.Reconstruction | None:
        """Model of the known poses, whose cameras are used if no cameras are given."""
        return None if isinstance(self.poses, Mapping) else self.poses

    @property
    def folder(self) -> Path | None:
        """Folder of the photos, or None for images in memory."""
        return self.images.folder if isinstance(self.images, ImageSet) else self.images


class InputReader:
    """Reader of the inputs of a run; its methods are called in their order in the class."""

    def __init__(
        self, source: Source, output: Path | None, options: InputOptions, stages: Stages
    ) -> None:
        self._source = source
        self._output = output
        self._options = options
        self._stages = stages
        self.image_folder = source.folder
        """Folder of the photos, video frames or cut views, or None for images in memory."""
        self.videos: dict[str, Path] = {}
        """Paths of the videos, as :func:`~mpsfm_core.inputs.image_search.find_videos` returns."""
        self.selections: dict[str, VideoSelection] = {}
        """Keyframes of each video."""
        self.cut: CutImages | None = None
        """Views of panoramas or wide fisheye images, if the images were cut."""
        self.known_poses: dict[str, Pose] = {}
        """Poses that the user gave, by image name."""
        self.rigs: tuple[Rig, ...] = ()
        self.matches: ImportedMatches | None = None

    def check_output_folder(self) -> None:
        """Raise :class:`InputError` if results would be mixed with photos."""
        if self._output is not None and isinstance(self._source.images, Path):
            check_output_folder(self._output, self._source.images)

    def find_videos(self) -> None:
        """Search for videos, and check that there are videos or photos.

        Raises:
            InputError: there is no input, or the frames of a video have no output folder.
        """
        path = self._source.images
        if isinstance(path, ImageSet):
            return
        self.videos = find_videos(path, self._output)
        if not self.videos:
            check_images_folder(path, self._output)
        else:
            require_output_folder(path, self._output)

    def extract_video_frames(self) -> None:
        """Write keyframes of videos to the output folder, and use the keyframes as images."""
        if not self.videos:
            return
        assert self._output is not None
        with self._stages.stage("video"), opencv_threads(thread_limit()):
            progress = partial(self._stages.stage_progress, "video")
            self.image_folder = extract_frames(
                self.videos, self._output, self._options.video, progress
            )
            self.selections = {
                name: read_selection(self.image_folder / name) for name in self.videos
            }

    @property
    def shots(self) -> list[dict[str, float]]:
        """Time stamps of the keyframes of each shot by image name, empty for cut views."""
        shots: dict[tuple[str, int], dict[str, float]] = {}
        for name, selection in self.selections.items() if self.cut is None else ():
            for frame in selection.keyframes:
                image = (PurePosixPath(name) / frame.name).as_posix()
                shots.setdefault((name, frame.shot), {})[image] = frame.time_s
        return list(shots.values())

    def cut_wide_images(self) -> None:
        """Cut panoramas and wide fisheye images into views, and use the views as images."""
        options, source = self._options, self._source
        others = {"cameras": source.cameras, "poses": source.poses, "rigs": source.rigs}
        given = [name for name, value in others.items() if value is not None]
        given += ["database or hloc"] if source.matches else []
        if options.projection == "equirectangular" and (
            given or self.image_folder is None or self._output is None
        ):
            what = given[0] if given else "an image set in memory, or no output folder,"
            raise InputError(
                f"projection equirectangular: {what} cannot be used, because panoramas are files "
                "that are cut into views with known cameras and rigs in the output folder"
            )
        if self.image_folder is None or self._output is None:
            return
        folder = self.image_folder
        names = find_images(folder, self._output)
        if source.image_list is not None:
            names = select_listed_images(source.image_list, names, folder)
        cameras: dict[str, pycolmap.Camera] | None = None
        rigs: tuple[Rig, ...] = ()
        if options.projection == "equirectangular":
            notice = ""
        elif options.projection == "auto" and not given and are_panoramas(folder, names):
            notice = (
                f"the {len(names)} images are panoramas of 360 x 180 degrees, which are cut into "
                "views; --projection perspective takes them for ordinary photos"
            )
        elif source.cameras is not None and not source.poses and not source.matches:
            cameras = find_wide_cameras(folder, names, source.cameras, options)
            if not cameras:
                return
            notice = (
                f"images with a field of view above {MAX_FIELD_OF_VIEW_DEG:g} degrees are cut into "
                "views"
            )
            names = [name for name in names if name in cameras]
            rigs = self._read_given_rigs(names)
        else:
            return
        if notice:
            self._stages.notice(notice)
        with self._stages.stage("views"):
            self.cut = cut_images(
                folder,
                names,
                self._output / CUT_VIEWS,
                self._output / MASKS_OF_VIEWS,
                options,
                cameras=cameras,
                rigs=rigs,
                progress=partial(self._stages.stage_progress, "views"),
            )
            self.image_folder = self.cut.folder

    def load(self) -> ImageSet:
        """Read image headers, cameras, known poses, rigs and imported matches."""
        source = self._source
        images = self.load_images()
        if source.poses is not None:
            self.known_poses = _read_known_poses(source.poses, images, self.image_folder)
        self.rigs = self._read_rigs(images)
        self.matches = _read_matches(source.matches, images)
        return images

    def load_images(self) -> ImageSet:
        """Read image headers and cameras."""
        source, cut, options = self._source, self.cut, self._options
        if isinstance(source.images, ImageSet):
            if self.image_folder is not None or self._output is None:
                return source.images
            self.image_folder = self._output / IMAGES
            return source.images.written_to(self.image_folder)
        assert self.image_folder is not None
        if cut is not None:
            options = options.model_copy(update={"masks": cut.masks})
        return load_images(
            self.image_folder,
            source.cameras if cut is None else cut.cameras,
            source.image_list if cut is None else None,
            options,
            model=source.camera_model,
            without=self._output,
        )

    def _read_rigs(self, images: ImageSet) -> tuple[Rig, ...]:
        """Return the rigs of the images, by default those of other COLMAP input files."""
        source = self._source
        if self.cut is not None:
            return self.cut.rigs
        rigs = self._read_given_rigs(images.names)
        if source.rigs is None:
            rigs = self._find_rigs(images)
        else:
            require_upright(rigs, images)
        return () if find_turned(rigs, images) else tuple(rigs)

    def _read_given_rigs(self, names: Sequence[str]) -> tuple[Rig, ...]:
        """Return the rigs that the user gave as such."""
        rigs = self._source.rigs
        if isinstance(rigs, Path):
            return read_rigs(rigs, names, self.image_folder)
        return tuple(rigs or ())

    def _find_rigs(self, images: ImageSet) -> tuple[Rig, ...]:
        """Return the rigs of the COLMAP database or models that the user gave for other inputs."""
        source = self._source
        databases = [file for file in source.matches if file.suffix == ".db"]
        for path in [*databases, source.cameras, source.poses]:
            if not isinstance(path, Path) or not (path.is_dir() or path.suffix == ".db"):
                continue
            try:
                if rigs := read_rigs(path, images.names, self.image_folder, required=False):
                    return rigs
            except InputError as error:
                self._stages.warn(f"{error}. The images are mapped without rigs")
        return ()


def _read_matches(files: tuple[Path, ...], images: ImageSet) -> ImportedMatches | None:
    """Read matches from a COLMAP database, or from hloc's features and matches files."""
    if not files:
        return None
    if len(files) == 1:
        return matches_from_database(files[0], images)
    return matches_from_hloc(files[0], files[1], images)


def _read_known_poses(
    given: Path | Poses, images: ImageSet, images_folder: Path | None
) -> dict[str, Pose]:
    """Read the poses of a model, keyed by the matching image names of the run."""
    poses = read_poses(given, images_folder)
    model = given if isinstance(given, Path) else "poses"
    matched = match_names(images.names, poses)
    if not matched:
        difference = describe_name_difference(images.names, poses)
        raise InputError(f"{model}: the model has a pose of none of the images; {difference}")
    if len(matched) < 2:
        raise InputError(
            f"{model}: the model has a pose of {next(iter(matched))} only; a run needs the poses "
            f"of two images"
        )
    unmatched = sorted(poses.keys() - set(matched.values()))
    if unmatched:
        text = "%s: %d of its %d images are not among the photos: %s"
        listed = ", ".join(unmatched[:MAX_LISTED])
        _log.warning(text, model, len(unmatched), len(poses), listed)
    return {name: poses[model_name] for name, model_name in matched.items()}
