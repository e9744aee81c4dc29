"""Models with cameras and poses, of COLMAP or as ``transforms.json``, and whose images they are."""

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
    """``cam_from_world`` of the registered images of a model, by image name.

    Raises what :func:`read_model` raises.
    """
    return reconstruction_poses(read_model(path))


def read_model(path: Path) -> pycolmap.Reconstruction:
    """The COLMAP model of a folder (see :func:`find_model_folder`), or a ``transforms.json``.

    Raises :class:`~mpsfm_core.data.errors.InputError` when it is not there or cannot be read.
    """
    if path.suffix == ".json":
        return read_transforms(path)
    folder = find_model_folder(path)
    try:
        check_binary_model(folder)
        model = pycolmap.Reconstruction(str(folder))
        for image in model.images.values():
            str(image.name)  # decoded when asked for
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise InputError(f"{folder}: not a readable COLMAP model: {error}") from error
    return model


def find_model_folder(folder: Path) -> Path:
    """Where a COLMAP model (binary or text) lies: here, in ``sparse`` or in ``sparse/0``.

    Raises :class:`~mpsfm_core.data.errors.InputError` when there is none.
    """
    for candidate in (folder, folder / "sparse", folder / "sparse" / "0"):
        if any((candidate / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
            return candidate
    raise InputError(f"{folder}: no COLMAP model here (images.bin or images.txt)")


def reconstruction_poses(model: pycolmap.Reconstruction) -> dict[str, Pose]:
    """``cam_from_world`` of the registered images, by name, in the order of their names."""
    poses = {}
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        if image.has_pose:
            matrix = np.asarray(image.cam_from_world().matrix(), dtype=np.float64)
            poses[str(image.name)] = (matrix[:, :3], matrix[:, 3])
    return poses


def match_names(wanted: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Wanted name -> the one available name that means it.

    That is the name itself, else with another extension or none, else in some folder: lists of
    images in the wild hold stems, and paths from elsewhere. Names that nothing or more than one
    thing answers to are left out, and an available name that is itself wanted answers to no other.
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
