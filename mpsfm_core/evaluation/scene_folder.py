"""Scene folder of the benchmark: images, intrinsics, true poses and depth, and test sets.

The layout::

    images/           photos
    intrinsics.yaml   optional: see mpsfm_core.inputs.intrinsics; else the cameras of gt/
    gt/               COLMAP model with true poses
    gt_depth/         optional: 16-bit PNG, millimetres along z, 0 where unknown
    testsets.yaml     optional: bucket -> sets of images, and ``format_version``; else one set of
                      all images

In ``testsets.yaml``, a bucket is a list of test sets of similar overlap, or a mapping of group
names to lists of test sets (for example ``triplets/0-5``). A test set is a list of image names,
extensions optional, or a mapping with the list under ``images``.
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
"""Format version of ``testsets.yaml``."""


@dataclass(frozen=True)
class EvaluationSet:
    """Test set: images of a scene that are reconstructed together."""

    bucket: str
    """Overlap bucket of the test set, such as ``leq5``."""
    index: int
    """Index of the test set in its bucket."""
    images: tuple[str, ...]
    """Names of the images in the test set."""

    @property
    def name(self) -> str:
        """Name of the test set, unique in the scene and valid as a folder name."""
        return f"{self.bucket.replace('/', '_')}-{self.index:02d}"


@dataclass(frozen=True, eq=False)
class SceneFolder:
    """Scene folder with true poses and test sets."""

    path: Path
    """Path of the scene folder."""
    truth: Mapping[str, Pose]
    """True poses ``cam_from_world`` by image name."""
    sets: tuple[EvaluationSet, ...]
    """Test sets of all overlap buckets."""

    @property
    def name(self) -> str:
        """Name of the scene, which is the name of its folder."""
        return self.path.resolve().name

    @property
    def images(self) -> Path:
        """Folder of the scene's images."""
        return self.path / "images"

    @property
    def intrinsics(self) -> Path:
        """Intrinsics file or COLMAP model with the cameras of the images."""
        file = self.path / "intrinsics.yaml"
        return file if file.is_file() else self.path / "gt"

    @property
    def depth(self) -> Path | None:
        """Folder of the true depth maps, or None without true depth."""
        folder = self.path / "gt_depth"
        return folder if folder.is_dir() else None

    def select_sets(self, buckets: Sequence[str] | None) -> list[EvaluationSet]:
        """Return the test sets of the named overlap buckets, by default of all buckets.

        Args:
            buckets: Names of buckets; The bucket ``triplets`` selects all groups ``triplets/...``.

        Raises:
            InputError: A named bucket does not exist in ``testsets.yaml``.
        """
        known = dict.fromkeys(item.bucket for item in self.sets)
        selected = list(known) if buckets is None else list(buckets)
        for bucket in selected:
            if not any(_is_in_bucket(name, bucket) for name in known):
                raise InputError(
                    f"{self.path}: no bucket {bucket!r}; the scene has {', '.join(known)}"
                )
        return [item for item in self.sets if any(_is_in_bucket(item.bucket, b) for b in selected)]


def read_scene(path: Path, *, with_sets: bool = True) -> SceneFolder:
    """Read images, true poses and test sets of a scene folder.

    Args:
        path: Scene folder.
        with_sets: Read the test sets of ``testsets.yaml`` (if False, the scene has one test set
            with all images).

    Raises:
        InputError: Images or true poses are missing, or a test set has an image without true pose.
    """
    if not (path / "images").is_dir():
        raise InputError(f"{path}: not a scene folder; photos must be in images/")
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
    """Write ``testsets.yaml`` of a scene folder, with a note as comment in its first line."""
    write_file(path / TESTSETS, f"# {note}\n{write_yaml({VERSION: FORMAT, **buckets})}")


def _is_in_bucket(name: str, bucket: str) -> bool:
    """Return True if `name` is the bucket, or a group such as ``triplets/0-5`` of the bucket."""
    return name == bucket or name.startswith(bucket + "/")


def _read_sets(file: Path) -> Iterator[tuple[str, int, list[str]]]:
    """Yield overlap bucket, index and image names of each test set in ``testsets.yaml``."""
    try:
        # The YAML base loader reads all scalars as text, so that an image name such as 0008 is not
        # a number.
        content = yaml.load(file.read_text(encoding="utf-8"), Loader=yaml.BaseLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise InputError(f"{file} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"{file}: the file must map buckets to lists of test sets")
    check_version(content, FORMAT, file)
    content.pop(VERSION, None)
    for bucket, entries in content.items():
        groups = entries if isinstance(entries, dict) else {"": entries}
        for group, sets in groups.items():
            name = f"{bucket}/{group}" if group != "" else str(bucket)
            if not isinstance(sets, list):
                raise InputError(f"{file}: {name}: the bucket must be a list of test sets")
            for number, entry in enumerate(sets):
                images = entry.get("images") if isinstance(entry, dict) else entry
                if not isinstance(images, list) or len(images) < 2:
                    raise InputError(f"{file}: {name}: set {number} needs two or more images")
                yield name, number, images
