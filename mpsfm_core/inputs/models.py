"""Reader of models with cameras and poses, and matching of their image names to files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap

from mpsfm_core.data import Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.inputs.colmap_files import check_binary_model
from mpsfm_core.inputs.nerfstudio import read_transforms


def read_poses(path: Path) -> dict[str, Pose]:
    """Read ``cam_from_world`` of the registered images of a model, by image name.

    Raises:
        InputError: as :func:`read_model`.
    """
    return reconstruction_poses(read_model(path))


def read_model(path: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model (see :func:`find_model_folder`) or a ``transforms.json``.

    Raises:
        InputError: the model does not exist or cannot be read.
    """
    if path.suffix == ".json":
        return read_transforms(path)
    folder = find_model_folder(path)
    try:
        check_binary_model(folder)
        model = pycolmap.Reconstruction(str(folder))
        for image in model.images.values():
            str(image.name)  # pycolmap decodes a name on access, and this can fail
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise InputError(f"{folder}: the COLMAP model cannot be read: {error}") from error
    return model


def find_model_folder(folder: Path) -> Path:
    """Find a COLMAP model (binary or text) in a folder, its ``sparse`` or ``sparse/0``.

    Raises:
        InputError: there is none.
    """
    for candidate in (folder, folder / "sparse", folder / "sparse" / "0"):
        if any((candidate / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
            return candidate
    raise InputError(f"{folder} has no COLMAP model (images.bin or images.txt)")


def reconstruction_poses(model: pycolmap.Reconstruction) -> dict[str, Pose]:
    """Return ``cam_from_world`` of the registered images by name, sorted by name."""
    poses = {}
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        if image.has_pose:
            matrix = np.asarray(image.cam_from_world().matrix(), dtype=np.float64)
            poses[str(image.name)] = (matrix[:, :3], matrix[:, 3])
    return poses


def match_names(wanted: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Match image names to the names in another source, such as a model or a database.

    A name matches itself, else the same name with another extension, else the same name in another
    folder. An available name that is itself wanted matches nothing else.

    Args:
        wanted: names of the images of the run.
        available: names in the other source.

    Returns:
        Wanted name -> available name, without names that have no match or an ambiguous one.
    """
    asked, names = list(wanted), set(available)
    by_stem: dict[str, list[str]] = {}
    by_tail: dict[str, list[str]] = {}
    for name in names - set(asked):
        by_stem.setdefault(_stem(name), []).append(name)
        parts = _stem(name).split("/")
        for start in range(1, len(parts)):
            by_tail.setdefault("/".join(parts[start:]), []).append(name)
    matched = {}
    for name in asked:
        forms = name, _stem(name)
        loose = next((d[form] for d in (by_stem, by_tail) for form in forms if form in d), [])
        candidates = [name] if name in names else loose
        if len(candidates) == 1:
            matched[name] = candidates[0]
    return matched


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
