"""Depth priors of known quality, made from the true depth of a scene.

The quality ``sensor`` is true depth with a declared relative std of 1 %, an upper bound of prior
quality. The quality ``degraded`` is true depth with the errors of a good monocular network
(:mod:`mpsfm_core.testing.synthetic.degraded_depth`). The declared std of degraded depth is the std
of its errors after the best scale per image. The quality ``degraded-N`` uses the random seed N
instead of 0. The quality ``config`` is depth from the provider of the configuration.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from mpsfm_core.data import Float32
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.scene_folder import SceneFolder
from mpsfm_core.inputs.image_decoding import check_size, read_bytes
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.support.files import write_file
from mpsfm_core.testing.synthetic.degraded_depth import DepthErrors, degrade_depth

QUALITIES = ("sensor", "degraded", "config")
"""Names of the qualities of depth priors."""
SENSOR_STD = 0.01
"""Relative std that is declared for true depth."""
_MILLIMETER = 0.001
"""Length of one millimeter, the unit of depth files, in meters."""


def parse_error_seed(quality: str) -> int | None:
    """Return the random seed N of a prior quality ``degraded-N``, or None for other qualities."""
    match = re.fullmatch(r"degraded(?:-(\d+))?", quality)
    return int(match[1] or 0) if match else None


def prior_overrides(
    quality: str, scene: SceneFolder, images: Iterable[str], work: Path
) -> tuple[str, ...]:
    """Return the settings ``KEY=VALUE`` that select depth priors of the given quality.

    Args:
        quality: Prior quality.
        scene: Scene folder.
        images: Names of the images of the scene.
        work: Folder to which degraded depth maps are written.

    Raises:
        InputError: The scene has no true depth.
    """
    if quality == "config":
        return ()
    seed = parse_error_seed(quality)
    if scene.depth is None:
        raise InputError(f"{scene.path}: prior {quality!r} needs true depth in gt_depth/")
    if quality == "sensor":
        return _depth_file_settings(scene.depth, SENSOR_STD)
    errors = DepthErrors()
    for image in images:
        stem = PurePosixPath(image).with_suffix("")
        target = work / f"{stem}.png"
        if not target.is_file():
            depth = read_depth(scene.depth / f"{stem}.png")
            write_depth(target, degrade_depth(depth, str(stem), errors, seed or 0))
    return _depth_file_settings(work, round(errors.std, 3))


def read_depth(path: Path) -> Float32:
    """Read a 16-bit depth image.

    Returns:
        (h, w) float32 depth in meters, 0 where unknown.

    Raises:
        InputError: The file is missing or not a 16-bit image.
    """
    stored = None
    if path.is_file():
        check_size(read_bytes(path), path, InputOptions().max_pixels)
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.ndim != 2 or stored.dtype != np.uint16:
        raise InputError(
            f"{path}: the file is not a 16-bit depth image; expected PNG in millimeters"
        )
    return np.asarray(stored * np.float32(_MILLIMETER))


def write_depth(path: Path, depth: Float32) -> None:
    """Write depth in meters as 16-bit PNG in millimeters; values out of range become 0."""
    stored = np.rint(np.nan_to_num(depth, nan=0.0, posinf=0.0) / _MILLIMETER)
    stored = np.where((stored > 0) & (stored <= np.iinfo(np.uint16).max), stored, 0)
    ok, data = cv2.imencode(".png", stored.astype(np.uint16))
    assert ok
    write_file(path, data.tobytes())


def _depth_file_settings(folder: Path, std: float) -> tuple[str, ...]:
    """Return the settings ``KEY=VALUE`` that read depth from files with a relative std."""
    return (
        "depth.use=files",
        f"depth.options.directory={json.dumps(str(folder.resolve()))}",
        "depth.options.suffix=.png",
        f"depth.options.scale={_MILLIMETER}",
        f"depth.options.relative_std={std}",
        # The declared std already contains all errors of the depth files.
        "depth.calibration={std_scale: 1, relative_std: 0, std_floor: 0}",
        "normals.use=from-depth",
    )
