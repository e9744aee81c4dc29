"""Options of the built-in providers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options


class SiftOptions(Options):
    """Options of SIFT. Defaults are those of COLMAP unless another source is given."""

    max_keypoints: int = Field(8192, gt=0)
    """Largest number of keypoints; the ones with the largest scale remain [COLMAP]."""
    resize: int | None = Field(3200, ge=32)
    """Longer side in pixels of the image for detection, never enlarged; null keeps the size of the
    view."""
    root: bool = True
    """True normalizes to RootSIFT: square root of L1-normalized descriptors [COLMAP L1_ROOT]."""
    first_octave: int = -1
    """First octave; -1 doubles the image first and detects the smallest keypoints."""
    octave_resolution: int = Field(3, ge=1)
    """Levels per octave; more levels detect more keypoints and take longer."""
    peak_threshold: float = Field(0.02 / 3, ge=0)
    """Smallest contrast of a keypoint; raising it gives fewer, stronger keypoints."""
    edge_threshold: float = Field(10.0, gt=0)
    """Largest ratio of principal curvatures; raising it accepts keypoints on edges."""
    upright: bool = False
    """True skips orientations, which is more distinctive if no camera is rolled."""
    affine: bool = False
    """True estimates affine shapes, for wide baselines; about five times slower."""


class MutualNearestOptions(Options):
    """Options of mutual nearest neighbors."""

    ratio: float | None = Field(0.8, gt=0, le=1)
    """Largest ratio of nearest to second nearest distance, in both directions [COLMAP max_ratio].
    Raising it accepts more ambiguous matches; null disables the test, for learned features."""
    max_distance: float | None = Field(None, gt=0)
    """Largest Euclidean distance of matching descriptors; null for no limit."""


class FileOptions(Options):
    """Location of the file of each image."""

    directory: Path
    """Folder with the same subfolders as the image folder."""
    suffix: str | None = None
    """Suffix after the image name with or without its extension, such as ``.png`` or
    ``_depth.exr``; null tries ``.npz``, ``.npy``, ``.exr``, ``.png`` and ``.tif``."""


class DepthFileOptions(FileOptions):
    """Depth maps along z in 16-bit PNG or TIFF, EXR, NPY or NPZ.

    Values that are zero or not finite are invalid. An NPZ file has ``depth`` and optionally
    ``variance``, in the stored unit, and ``valid``.
    """

    scale: float = Field(1.0, gt=0)
    """Meters per stored unit: 0.001 for millimeters."""
    metric: bool = True
    """False if the unit of the scaled values is unknown."""
    relative_std: float | None = Field(None, ge=0)
    """Std relative to depth; required if the files have no variance."""
    std_floor: float = Field(0.0, ge=0)
    """Smallest std, in scaled units."""
    variance: FileOptions | None = None
    """Separate files with variance maps, in the stored unit."""


class NormalFileOptions(FileOptions):
    """Normal maps in the camera frame in NPZ, NPY, EXR, PNG or TIFF.

    An NPZ file has ``normals`` and optionally ``variance`` (rad^2) and ``valid``. PNG and TIFF of 8
    or 16 bit encode ``(n / 2 + 0.5) * maximum`` as RGB.
    """

    frame: Literal["opencv", "opengl"] = "opencv"
    """``opencv``: x right, y down, z forward. ``opengl``: x right, y up, z backward."""
    std_deg: float | None = Field(None, gt=0)
    """Std of the angle in degrees if the files have no variance."""


class MaskFileOptions(FileOptions):
    """Masks in any image format, NPY, or NPZ with ``mask``: nonzero pixels may be used."""

    invert: bool = False
    """True means that pixels with value 0 may be used instead."""


class NormalsFromDepthOptions(Options):
    """Options of normals from the depth prior."""

    radius: float = Field(0.012, gt=0)
    """Half the side of the largest window relative to the longer side of the map. Raising it
    reduces noise and loses small surfaces [tuned: rendered kitchen]."""
    edge: float = Field(0.015, gt=0)
    """Relative deviation of inverse depth from the mean of the neighbors that makes a depth edge.
    Raising it fits planes across small steps [reference: continuity ratio 1.015]."""
    slope_std: float = Field(4.0, ge=0)
    """Angular std in radians per relative std of depth. Raising it trusts the normals less [tuned:
    FastDepth on the rendered kitchen]."""
