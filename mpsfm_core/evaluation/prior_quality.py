"""Depth of a stated quality for a scene whose true depth is known.

``sensor``: the true depth, declared good to 1 %: an upper bound. ``degraded``: the true depth with
the errors of :mod:`mpsfm_core.testing.synthetic.degraded_depth`, declared honestly, which means as
large as they are after the best scale of each image: stands for a good monocular network;
``degraded-N`` is the same with the errors of seed N, which is 0 otherwise. ``config``: what the
configuration's own provider predicts."""

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
SENSOR_STD = 0.01
"""Declared relative std of the true depth."""
_MILLIMETRE = 0.001


def parse_error_seed(quality: str) -> int | None:
    """Seed of the errors of degraded depth; None for other qualities."""
    found = re.fullmatch(r"degraded(?:-(\d+))?", quality)
    return int(found[1] or 0) if found else None


def prior_overrides(
    quality: str, scene: SceneFolder, images: Iterable[str], work: Path
) -> tuple[str, ...]:
    """Settings ``KEY=VALUE`` that make a configuration use depth of a quality.

    ``work``: folder where degraded maps of the images are written. Raises :class:`InputError`
    when the scene has no true depth to make it of.
    """
    if quality == "config":
        return ()
    seed = parse_error_seed(quality)
    if scene.depth is None:
        raise InputError(f"{scene.path}: prior {quality!r} needs true depth in gt_depth/")
    if quality == "sensor":
        return _from_files(scene.depth, SENSOR_STD)
    errors = DepthErrors()
    for image in images:
        stem = PurePosixPath(image).with_suffix("")
        target = work / f"{stem}.png"
        if not target.is_file():
            depth = read_depth(scene.depth / f"{stem}.png")
            write_depth(target, degrade_depth(depth, str(stem), errors, seed or 0))
    return _from_files(work, round(errors.std, 3))


def read_depth(path: Path) -> Float32:
    """True depth (h, w) in metres, 0 where unknown; raises :class:`InputError`."""
    stored = None
    if path.is_file():
        check_size(read_bytes(path), path, InputOptions().max_pixels)
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.ndim != 2 or stored.dtype != np.uint16:
        raise InputError(f"{path}: no 16-bit depth image")
    return np.asarray(stored * np.float32(_MILLIMETRE))


def write_depth(path: Path, depth: Float32) -> None:
    """Write depth in metres as 16-bit PNG in millimetres; what does not fit becomes 0."""
    stored = np.rint(np.nan_to_num(depth, nan=0.0, posinf=0.0) / _MILLIMETRE)
    stored = np.where((stored > 0) & (stored <= np.iinfo(np.uint16).max), stored, 0)
    ok, data = cv2.imencode(".png", stored.astype(np.uint16))
    assert ok
    write_file(path, data.tobytes())


def _from_files(folder: Path, std: float) -> tuple[str, ...]:
    return (
        "depth.use=files",
        f"depth.options.directory={json.dumps(str(folder.resolve()))}",
        "depth.options.suffix=.png",
        f"depth.options.scale={_MILLIMETRE}",
        f"depth.options.relative_std={std}",
        # The declared std is the total one already.
        "depth.calibration={std_scale: 1, relative_std: 0, std_floor: 0}",
        "normals.use=from-depth",
    )
