"""A scene to evaluate on: photos, intrinsics, true poses and depth, and sets of images.

The layout::

    images/           photos
    intrinsics.yaml   optional: see mpsfm_core.inputs.intrinsics; else the cameras of gt/
    gt/               COLMAP model with true poses
    gt_depth/         optional: 16-bit PNG, millimetres along z, 0 where unknown
    testsets.yaml     optional: bucket -> sets of images; else one set of all images; beside the
                      buckets maybe ``format_version``

A bucket is a list of sets, or a mapping of names to lists of sets (then its buckets are called
``triplets/0-5`` and so on). A set is a list of image names, extensions optional, or a mapping with
the list under ``images``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from mpsfm_core.data import Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.image_search import find_images
from mpsfm_core.inputs.models import match_names, read_poses
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version
from mpsfm_core.support.yaml_text import write_yaml

TESTSETS = "testsets.yaml"
FORMAT = 1
"""Of ``testsets.yaml``."""


@dataclass(frozen=True)
class EvaluationSet:
    """Images that are reconstructed together; ``index`` counts the sets of a bucket."""

    bucket: str
    index: int
    images: tuple[str, ...]

    @property
    def name(self) -> str:
        """Unique in its scene and fit for a folder's name."""
        return f"{self.bucket.replace('/', '_')}-{self.index:02d}"


@dataclass(frozen=True, eq=False)
class SceneFolder:
    """A scene of the layout above; ``truth``: ``cam_from_world`` by image name."""

    path: Path
    truth: Mapping[str, Pose]
    sets: tuple[EvaluationSet, ...]

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.resolve().name

    @property
    def images(self) -> Path:
        """Folder of the photos."""
        return self.path / "images"

    @property
    def intrinsics(self) -> Path:
        """File or model with the cameras."""
        file = self.path / "intrinsics.yaml"
        return file if file.is_file() else self.path / "gt"

    @property
    def depth(self) -> Path | None:
        """Folder of the true depth maps, if there is one."""
        folder = self.path / "gt_depth"
        return folder if folder.is_dir() else None

    def chosen(self, buckets: Sequence[str] | None) -> list[EvaluationSet]:
        """The sets of some buckets, all by default; ``triplets`` means all ``triplets/...``.

        Raises :class:`InputError` when a bucket does not exist.
        """
        known = dict.fromkeys(item.bucket for item in self.sets)
        wanted = list(known) if buckets is None else list(buckets)
        for bucket in wanted:
            if not any(_answers(name, bucket) for name in known):
                raise InputError(f"{self.path}: no bucket {bucket!r}; it has {', '.join(known)}")
        return [item for item in self.sets if any(_answers(item.bucket, b) for b in wanted)]


def read_scene(path: Path, *, with_sets: bool = True) -> SceneFolder:
    """Read a scene folder; without its sets, there is one set of all images.

    Raises :class:`InputError` when images or true poses are missing, or a set names an image
    that is not there or has no true pose.
    """
    if not (path / "images").is_dir():
        raise InputError(f"{path}: a scene folder has its photos in images/")
    names = find_images(path / "images")
    poses = read_poses(path / "gt")
    truth = {name: poses[found] for name, found in match_names(names, poses).items()}
    file = path / TESTSETS
    if not (with_sets and file.is_file()):
        return SceneFolder(path, truth, (EvaluationSet("all", 0, tuple(truth)),))
    sets = []
    for bucket, number, listed in _read_sets(file):
        found = match_names(listed, truth)
        missing = [name for name in listed if name not in found]
        if missing:
            raise InputError(
                f"{file}: {bucket}: no photo with a true pose is called {', '.join(missing)}"
            )
        sets.append(EvaluationSet(bucket, number, tuple(sorted(found.values()))))
    return SceneFolder(path, truth, tuple(sets))


def write_sets(path: Path, buckets: Mapping[str, Sequence[Mapping[str, Any]]], note: str) -> None:
    """Write ``testsets.yaml`` of a scene folder; ``note`` becomes its first line, a comment."""
    write_file(path / TESTSETS, f"# {note}\n{write_yaml({VERSION: FORMAT, **buckets})}")


def _answers(bucket: str, wanted: str) -> bool:
    return bucket == wanted or bucket.startswith(wanted + "/")


def _read_sets(file: Path) -> Iterator[tuple[str, int, list[str]]]:
    """Bucket, number of the set in it, and its image names."""
    try:
        # The base loader leaves all scalars texts: a stem such as 0008 is no number.
        content = yaml.load(file.read_text(encoding="utf-8"), Loader=yaml.BaseLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise InputError(f"{file} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"{file}: must map buckets to sets of images")
    check_version(content, FORMAT, file)
    content.pop(VERSION, None)
    for bucket, entries in content.items():
        groups = entries if isinstance(entries, dict) else {"": entries}
        for group, sets in groups.items():
            name = f"{bucket}/{group}" if group != "" else str(bucket)
            if not isinstance(sets, list):
                raise InputError(f"{file}: {name}: must be a list of sets")
            for number, entry in enumerate(sets):
                images = entry.get("images") if isinstance(entry, dict) else entry
                if not isinstance(images, list) or len(images) < 2:
                    raise InputError(f"{file}: {name}: set {number} needs two or more images")
                yield name, number, images
