"""Read COLMAP models and ``transforms.json``, and match their image names to files."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import numpy as np
import pycolmap

from mpsfm_core.data import Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import (
    COMPONENTS,
    SPARSE,
    SPARSE_TEXT,
    SUMMARY,
    TRANSFORMS,
    UNDISTORTED,
)
from mpsfm_core.geometry.pycolmap_conversion import pose_from
from mpsfm_core.inputs.colmap_files import check_binary_model
from mpsfm_core.inputs.model_orientation import orient_model
from mpsfm_core.inputs.nerfstudio import read_transforms
from mpsfm_core.inputs.text_files import read_text_file

Poses: TypeAlias = pycolmap.Reconstruction | Mapping[str, Any]
"""Poses of the caller: a COLMAP model, or ``cam_from_world`` by image name, see
:func:`~mpsfm_core.geometry.pycolmap_conversion.pose_from`."""

_TEXT_FILES = ("cameras", "images", "points3D", "frames", "rigs")
_NUM_IMAGE_FIELDS = 10
"""Number of fields of an image line in ``images.txt``; the last field is the name."""


def read_poses(model: Path | Poses, images_folder: Path | None = None) -> dict[str, Pose]:
    """Read the poses ``cam_from_world`` of the registered images of a model by image name.

    Args:
        model: Poses of the caller, or path as in :func:`read_model`.
        images_folder: as :func:`read_model`.

    Raises:
        InputError: as :func:`read_model`, or a pose of the caller has a wrong shape.
    """
    if isinstance(model, Mapping):
        return {name: pose_from(name, pose) for name, pose in model.items()}
    return reconstruction_poses(read_model(model, images_folder))


def read_model(
    path: Path | pycolmap.Reconstruction, images_folder: Path | None = None
) -> pycolmap.Reconstruction:
    """Read a COLMAP model (see :func:`find_model_folder`) or a ``transforms.json``.

    Args:
        path: folder of the COLMAP model, path of the ``transforms.json``, or model in memory.
        images_folder: folder of the images. If ``images_folder`` is given, a model of stored pixels
            is converted to upright images (see :func:`orient_model`). A ``transforms.json`` without
            image sizes needs the folder.

    Raises:
        InputError: the model does not exist or cannot be read.
    """
    in_memory = isinstance(path, pycolmap.Reconstruction)
    model = path if in_memory else _read_stored_model(path, images_folder)
    if images_folder is None or not images_folder.is_dir() or (not in_memory and _is_result(path)):
        return model
    return orient_model(model, images_folder, match_names)


def _is_result(path: Path) -> bool:
    """Return whether a model is in a result folder of MP-SfM, and so has upright images."""
    path = path.resolve()
    if (path / SUMMARY).is_file():
        return True
    if path.parent.name in (COMPONENTS, UNDISTORTED):
        return (path.parent.parent / SUMMARY).is_file()
    return path.name in (SPARSE, SPARSE_TEXT, TRANSFORMS) and (path.parent / SUMMARY).is_file()


def _read_stored_model(path: Path, images_folder: Path | None) -> pycolmap.Reconstruction:
    """Read a model without conversion to upright images."""
    if path.suffix == ".json":
        return read_transforms(path, images_folder)
    folder = find_model_folder(path)
    try:
        check_binary_model(folder)
        if (folder / "images.bin").is_file():
            model = pycolmap.Reconstruction(str(folder))
        else:
            model = _read_text_model(folder)
        for image in model.images.values():
            str(image.name)  # pycolmap decodes an image name on access, and decoding can fail
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise InputError(f"{folder}: the COLMAP model cannot be read: {error}") from error
    return model


def find_model_folder(folder: Path) -> Path:
    """Find a COLMAP model (binary or text) in a folder or in its ``sparse`` or ``sparse/0``.

    Raises:
        InputError: the folder has no COLMAP model.
    """
    for candidate in (folder, folder / "sparse", folder / "sparse" / "0"):
        if any((candidate / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
            return candidate
    raise InputError(f"folder {folder} has no COLMAP model (images.bin or images.txt)")


def read_image_lines(path: Path) -> dict[int, tuple[int, str]]:
    """Read camera id and name of each image in COLMAP's ``images.txt``, by image id.

    Names may contain spaces, which COLMAP's reader does not support.

    Raises:
        ValueError: a line of ``images.txt`` is not an image line.
    """
    images: dict[int, tuple[int, str]] = {}
    lines = iter(read_text_file(path).splitlines())
    for line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(maxsplit=_NUM_IMAGE_FIELDS - 1)
        if len(fields) != _NUM_IMAGE_FIELDS:
            raise ValueError(f"{path}: {line!r} is not an image line of a COLMAP model")
        images[int(fields[0])] = int(fields[-2]), fields[-1].strip()
        next(lines, None)  # skip the line of observations of the image, which may be empty
    return images


def _read_text_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP text model, whose files may have byte-order marks and names with spaces."""
    images = read_image_lines(folder / "images.txt")
    texts = {
        name: read_text_file(path) if (path := folder / f"{name}.txt").is_file() else None
        for name in _TEXT_FILES
    }
    texts["points3D"] = texts["points3D"] or ""
    if any(re.search(r"\s", name) for _, name in images.values()):
        texts["images"] = _replace_names(texts["images"] or "", images)
    with tempfile.TemporaryDirectory() as copy:
        for name, text in texts.items():
            if text is not None:
                Path(copy, f"{name}.txt").write_text(text, encoding="utf-8", newline="\n")
        model = pycolmap.Reconstruction(copy)
    for image_id, image in model.images.items():
        image.name = images[image_id][1]
    return model


def _replace_names(text: str, images: dict[int, tuple[int, str]]) -> str:
    """Replace the image names in ``images.txt`` by image ids."""
    for image_id, (camera_id, name) in images.items():
        text = text.replace(f" {camera_id} {name}", f" {camera_id} {image_id}", 1)
    return text


def describe_name_difference(ours: Collection[str], theirs: Collection[str]) -> str:
    """Describe why no image names match, with an example name from each source."""
    if not theirs:
        return "it has no images"
    example, other = min(ours, default="none"), min(theirs)
    return f"its names differ from ours: {other!r} there, {example!r} here"


def reconstruction_poses(model: pycolmap.Reconstruction) -> dict[str, Pose]:
    """Return the poses ``cam_from_world`` of the registered images by name, sorted by name."""
    poses = {}
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        if image.has_pose:
            matrix = np.asarray(image.cam_from_world().matrix(), dtype=np.float64)
            poses[str(image.name)] = (matrix[:, :3], matrix[:, 3])
    return poses


def match_names(wanted: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Match image names to the names in another source, such as a COLMAP model.

    An image name matches itself, else the same name with another extension, in another folder, or
    in another case, in this order. Backslashes of Windows paths count as slashes. An available name
    that equals an image name matches no other image name.

    Args:
        wanted: names of the images of the run.
        available: image names in the other source.

    Returns:
        Available names by image name, without image names that have no or several matches.
    """
    remaining = list(wanted)
    names = {name: name.replace("\\", "/") for name in available}
    matched = _match_names(remaining, names)
    unmatched = [name for name in remaining if name not in matched]
    if unmatched:
        used = set(matched.values())
        folded = {name: form.casefold() for name, form in names.items() if name not in used}
        by_folded = {name.casefold(): name for name in unmatched}
        if len(by_folded) == len(unmatched):
            loose = _match_names(list(by_folded), folded)
            matched |= {by_folded[form]: name for form, name in loose.items()}
    return matched


def _match_names(wanted: list[str], available: dict[str, str]) -> dict[str, str]:
    """Match image names to normalized available names; return available names by image name."""
    exact = {form: name for name, form in available.items()}
    by_stem: dict[str, list[str]] = {}
    by_tail: dict[str, list[str]] = {}
    for form in exact.keys() - set(wanted):
        by_stem.setdefault(_stem(form), []).append(exact[form])
        parts = _stem(form).split("/")
        for start in range(1, len(parts)):
            by_tail.setdefault("/".join(parts[start:]), []).append(exact[form])
    matched = {}
    for name in wanted:
        forms = name, _stem(name)
        loose = next((d[form] for d in (by_stem, by_tail) for form in forms if form in d), [])
        candidates = [exact[name]] if name in exact else loose
        if len(candidates) == 1:
            matched[name] = candidates[0]
    return matched


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
