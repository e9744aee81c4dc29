"""Work folder of the commands ``mpsfm extract``, ``mpsfm match`` and ``mpsfm map``.

::

    WORK/work.json         photos, cameras and configuration of the work folder
         features.h5       keypoints, descriptors and scores, as hloc writes them
         priors/depth/     depth prior of each photo, NAME.npz with depth, variance and valid
         priors/normals/   normal prior of each photo, NAME.npz with normals, variance and valid
         matches.h5        matches before verification, as hloc writes them
         database.db       COLMAP database with keypoints and verified matches
         result/           result folder of the reconstruction

Each command reads the files that earlier commands wrote. Other programs may replace files of the
work folder between two commands. Results of providers are cached, so a repeated command continues
where the interrupted command stopped.
"""

from __future__ import annotations

import json
from pathlib import Path

from mpsfm_core.data.errors import InputError
from mpsfm_core.data.options import Options, parse_settings
from mpsfm_core.extraction.match_graph import Priors
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version
from mpsfm_core.support.npz import write_npz

FORMAT = 1
"""Format version of the file ``work.json``."""
SETTINGS = "work.json"
FEATURES = "features.h5"
MATCHES = "matches.h5"
DATABASE = "database.db"
DEPTH = "priors/depth"
NORMALS = "priors/normals"
RESULT = "result"


class WorkSettings(Options):
    """Content of ``work.json``, which ``mpsfm match`` and ``mpsfm map`` read."""

    images: Path
    """Folder of the images."""
    intrinsics: Path | None = None
    """Camera intrinsics as ``intrinsics.yaml``, a COLMAP model or ``transforms.json``."""
    image_list: Path | None = None
    """Text file with one image name per line, or None to use all images of the folder."""
    config: str = "default"
    """Name or file of the configuration."""
    overrides: tuple[str, ...] = ()
    """Settings such as ``"runtime.workers=2"`` that override the configuration."""
    metric_depth: bool = True
    """True if the depth priors are in meters."""


def read_settings(work: Path) -> WorkSettings:
    """Read ``work.json`` of a work folder.

    Raises:
        InputError: the file ``work.json`` is missing or damaged.
    """
    path = work / SETTINGS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        check_version(content, FORMAT, path)
        content.pop(VERSION, None)
    except FileNotFoundError as error:
        raise InputError(f"{work} is no work folder: run 'mpsfm extract' first") from error
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{path} cannot be read ({error}): run 'mpsfm extract' again") from error
    return parse_settings(WorkSettings, content, (SETTINGS,))


def write_settings(work: Path, settings: WorkSettings) -> None:
    """Write ``work.json`` into a work folder, which is created if needed."""
    content = {VERSION: FORMAT, **settings.model_dump(mode="json")}
    write_file(work / SETTINGS, json.dumps(content, indent=2) + "\n")


def write_priors(work: Path, priors: Priors) -> None:
    """Write depth and normal priors as NPZ files, which providers named ``files`` read."""
    for name, depth in priors.depth.items():
        assert depth.variance is not None
        arrays = {"depth": depth.depth, "variance": depth.variance, "valid": depth.valid}
        write_npz(work / DEPTH / f"{name}.npz", **arrays)
    for name, normals in priors.normals.items():
        assert normals.variance is not None
        arrays = {"normals": normals.normals, "variance": normals.variance, "valid": normals.valid}
        write_npz(work / NORMALS / f"{name}.npz", **arrays)
