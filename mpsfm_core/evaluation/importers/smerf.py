"""Importer of the Zip-NeRF scenes of SMERF (Berlin, London, New York, Alameda).

The source is a folder with a COLMAP model in ``sparse/0`` (or ``colmap/sparse/0``) and the images
in ``images`` or the largest available of ``images_2``, ``images_4`` and ``images_8``. The importer
supports the fisheye and the undistorted version of a scene. SMERF scenes have no true depth, so the
points of the COLMAP model determine image overlap.
"""

from __future__ import annotations

from pathlib import Path

from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers.colmap_model import model_frames
from mpsfm_core.evaluation.importers.frames import Frame

_MODELS = ("sparse/0", "colmap/sparse/0", "sparse")
_PHOTOS = ("images", "images_2", "images_4", "images_8")


def read_frames(source: Path) -> list[Frame]:
    """Read the frames of a SMERF scene."""
    model = next((source / m for m in _MODELS if has_model(source / m)), None)
    photos = next((source / p for p in _PHOTOS if (source / p).is_dir()), None)
    if model is None or photos is None:
        raise InputError(f"{source}: sparse/0 with a COLMAP model and images/ are needed")
    return model_frames(model, lambda name: photos / name)


def has_model(folder: Path) -> bool:
    """Return True if a folder contains a COLMAP model."""
    return any((folder / f"images.{suffix}").is_file() for suffix in ("bin", "txt"))
