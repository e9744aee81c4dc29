"""Sampling of test sets for a scene folder from its true depth or its COLMAP model."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.overlap import Overlap, overlap_from_depth, overlap_from_model
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.sampling import SamplingOptions, sample_buckets
from mpsfm_core.evaluation.scene_folder import TESTSETS, SceneFolder, read_scene, write_sets
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.models import read_model
from mpsfm_core.inputs.options import InputOptions

SOURCES = ("auto", "depth", "model")
"""Sources of overlap."""


def build_test_sets(
    folder: Path,
    source: str = "auto",
    options: SamplingOptions | None = None,
    *,
    replace: bool = False,
) -> dict[str, int]:
    """Sample test sets and write ``testsets.yaml`` of a scene folder.

    Args:
        folder: Scene folder.
        source: Source of overlap: Source of the overlap, ``depth`` (maps in ``gt_depth/``),
            ``model`` (points in ``gt/``) or ``auto`` (depth if available).
        options: Options for the sampling of test sets.
        replace: True to replace an existing ``testsets.yaml``.

    Returns:
        Number of test sets by overlap bucket.

    Raises:
        InputError: ``testsets.yaml`` exists and `replace` is False, or the source of overlap is
            missing.
    """
    if source not in SOURCES:
        raise InputError(f"no source {source!r} of overlap; there are {', '.join(SOURCES)}")
    file = folder / TESTSETS
    if file.exists() and not replace:
        raise InputError(f"{file} exists already; --replace builds the file again")
    scene = read_scene(folder, with_sets=False)
    options = options or SamplingOptions()
    if source == "auto":
        source = "depth" if scene.depth is not None else "model"
    overlap = _from_depth(scene) if source == "depth" else _from_model(scene)
    buckets = sample_buckets(overlap, options)
    note = (
        f"overlap from {source}; an image has a two-view overlap of at least "
        f"{options.min_two_view} with some other of its set; seed {options.seed}"
    )
    write_sets(folder, buckets, note)
    counts = {name: len(sets) for name, sets in buckets.items() if name != "triplets"}
    return counts | {f"triplets/{k}": len(v) for k, v in buckets.get("triplets", {}).items()}


def _from_depth(scene: SceneFolder) -> Overlap:
    """Compute the overlap of images from true depth; images without depth map are omitted."""
    if scene.depth is None:
        raise InputError(f"{scene.path}: there is no gt_depth/ to measure overlap with")
    folder = scene.depth
    files = {name: folder / PurePosixPath(name).with_suffix(".png") for name in scene.truth}
    names = [name for name in sorted(files) if files[name].is_file()]
    images = load_images(scene.images, scene.intrinsics, options=InputOptions(strict=True))
    cameras = {image.name: image.pinhole for image in images}
    return overlap_from_depth(names, scene.truth, cameras, lambda name: read_depth(files[name]))


def _from_model(scene: SceneFolder) -> Overlap:
    """Compute the overlap of images from the points of the true COLMAP model."""
    model = read_model(scene.path / "gt")
    if not model.num_points3D():
        raise InputError(f"{scene.path / 'gt'}: the model has no points to measure overlap with")
    return overlap_from_model(model, sorted(scene.truth))
