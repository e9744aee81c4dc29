"""Public functions of the package ``mpsfm_core``, which re-exports them.

Each function imports its dependencies when called, because the descriptor module of a plugin
imports ``mpsfm_core``, and listing plugins must not load slow modules such as the mapper.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpsfm_core.config import Config
    from mpsfm_core.pipeline.run import ReconstructionResult
    from mpsfm_core.providers.registry import Registry


def load_config(
    name_or_path: str | Path, overrides: Sequence[str] = (), registry: Registry | None = None
) -> Config:
    """Read, merge and check a configuration.

    Args:
        name_or_path: Name of a shipped configuration, or a YAML file.
        overrides: Settings such as ``"runtime.workers=2"``, which replace those of the file.
        registry: Providers that the configuration may name, by default all installed ones.

    Returns:
        The configuration, with the default value of every setting that the file omits.

    Raises:
        ConfigError: a setting is wrong. The error message has file and line of the wrong setting
            and the nearest valid key.
    """
    from mpsfm_core.config import load_config

    return load_config(name_or_path, overrides, registry)


def reconstruct(
    images: str | Path,
    output: str | Path | None = None,
    config: str | Path | Config = "default",
    *,
    intrinsics: str | Path | None = None,
    image_list: str | Path | None = None,
    poses: str | Path | None = None,
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    fresh: bool = False,
    database: str | Path | None = None,
    hloc: tuple[str | Path, str | Path] | None = None,
) -> ReconstructionResult:
    """Reconstruct a folder of photos, or a video.

    Args:
        images: Folder of photos, including subfolders; or a video, whose keyframes are selected
            by ``inputs.video`` and written into ``frames/`` of the output.
        output: Result folder, used by one run at a time, or None to write nothing.
        config: Name of a shipped configuration, a YAML file, or a loaded configuration.
        intrinsics: Camera intrinsics as ``intrinsics.yaml``, a COLMAP model or ``transforms.json``.
            If missing, focal lengths are taken from ``poses``, else from EXIF, else estimated by
            the depth provider, else set to a default.
        image_list: Text file with one image name per line, by default all images of the folder.
        poses: COLMAP model or ``transforms.json`` with poses of some or all images;
            ``mapping.known_poses`` chooses whether known poses are fixed or refined.
        overrides: Settings such as ``"runtime.workers=2"``; not allowed with a loaded
            configuration.
        registry: Providers that the configuration may name, by default all installed ones.
        fresh: If true, ignore the checkpoint of an interrupted run and start mapping again.
        database: COLMAP database whose keypoints and matches replace features and matchers. The
            matches of the database are verified again. The cameras of the database are ignored
            unless ``intrinsics`` names the database too.
        hloc: Features file and matches file of hloc, as an alternative to ``database``.

    Returns:
        COLMAP models of the original photos, arrays of the mapper, and the summary.

    Raises:
        InputError: images, intrinsics, poses, configuration, weights or output are wrong. Missing
            providers are found before any image is decoded.
        ReconstructionError: no reconstruction was possible; the reasons are in ``summary.json``.
        MpsfmError: a provider failed or violated the provider contract, or the disk is full.
    """
    from mpsfm_core.pipeline.run import reconstruct

    return reconstruct(
        images,
        output,
        config,
        intrinsics=intrinsics,
        image_list=image_list,
        poses=poses,
        overrides=overrides,
        registry=registry,
        fresh=fresh,
        database=database,
        hloc=hloc,
    )
