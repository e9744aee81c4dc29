"""Importers that convert scenes of public datasets to scene folders.

The docstring of an importer module describes the folder layout of the dataset.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.evaluation.importers import (
    eth3d,
    euroc,
    lamar,
    realestate10k,
    scannet,
    seven_scenes,
    smerf,
    tanks_and_temples,
    tum_rgbd,
)
from mpsfm_core.evaluation.importers.frames import Frame, write_frames
from mpsfm_core.evaluation.scene_folder import SceneFolder, read_scene

IMPORTERS: Mapping[str, Callable[[Path], list[Frame]]] = MappingProxyType(
    {
        "eth3d": eth3d.read_frames,
        "smerf": smerf.read_frames,
        "tanks-and-temples": tanks_and_temples.read_frames,
        "realestate10k": realestate10k.read_frames,
        "7-scenes": seven_scenes.read_frames,
        "scannet": scannet.read_frames,
        "tum-rgbd": tum_rgbd.read_frames,
        "eth3d-slam": tum_rgbd.read_frames,
        "euroc": euroc.read_frames,
        "lamar": lamar.read_frames,
    }
)
"""Function that reads the frames of a scene, by name of the dataset."""


def import_scene(kind: str, source: Path, target: Path, every: int = 1) -> SceneFolder:
    """Convert one scene of a dataset to a scene folder; images are hard-linked or copied.

    Args:
        kind: Name of the dataset.
        source: Scene as distributed.
        target: Path of the scene folder that is written.
        every: Step between imported images; n imports every n-th image.

    Raises:
        InputError: The dataset is unknown, the source folder does not have the layout of the
            dataset, or the target folder is not empty.
    """
    if kind not in IMPORTERS:
        raise InputError(f"no dataset {kind!r}{did_you_mean(kind, IMPORTERS)}")
    if target.exists() and any(target.iterdir()):
        raise InputError(f"{target}: the target folder is not empty; choose a new folder")
    try:
        frames = IMPORTERS[kind](source)[::every]
    except (OSError, ValueError) as error:
        raise InputError(f"{source}: cannot be read as {kind}: {error}") from error
    if len(frames) < 2:
        raise InputError(f"{source}: {len(frames)} usable images; two or more are needed")
    write_frames(target, frames)
    return read_scene(target)
