"""Settings of the built-in providers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options


class SiftOptions(Options):
    """SIFT; unnamed sources are COLMAP's defaults."""

    max_keypoints: int = Field(8192, gt=0)
    """The largest are kept."""
    resize: int | None = Field(3200, ge=32)
    """Longer side in pixels at which to detect, never enlarged; null keeps the view's size."""
    root: bool = True
    """RootSIFT: descriptors are compared by the Hellinger kernel (COLMAP: L1_ROOT)."""
    first_octave: int = -1
    """-1 doubles the image first and finds the smallest keypoints."""
    octave_resolution: int = Field(3, ge=1)
    peak_threshold: float = Field(0.02 / 3, ge=0)
    edge_threshold: float = Field(10.0, gt=0)
    upright: bool = False
    """Do not estimate orientations: better when no camera is rolled."""
    affine: bool = False
    """Estimate affine shapes, for wide baselines; about five times slower."""


class MutualNearestOptions(Options):
    """Mutual nearest neighbours."""

    ratio: float | None = Field(0.8, gt=0, le=1)
    """Distance to the nearest over distance to the second nearest, in both directions; null
    switches the test off, for learned features (COLMAP: max_ratio)."""
    max_distance: float | None = Field(None, gt=0)
    """Largest Euclidean distance of descriptors; null for no limit."""


class FileOptions(Options):
    """Where the file of an image is."""

    directory: Path
    """Folder with the tree of the images folder."""
    suffix: str | None = None
    """Added to the image's name with or without its extension, e.g. ``.png`` or ``_depth.exr``;
    null tries ``.npz``, ``.npy``, ``.exr``, ``.png`` and ``.tif``."""


class DepthFileOptions(FileOptions):
    """Depth maps along z, in 16-bit PNG or TIFF, EXR, NPY, or NPZ with ``depth`` and maybe
    ``variance`` (of the stored unit) and ``valid``; 0 and not finite is invalid."""

    scale: float = Field(1.0, gt=0)
    """Metres per stored unit: 0.001 for millimetres."""
    metric: bool = True
    """False when the unit of the scaled values is unknown."""
    relative_std: float | None = Field(None, ge=0)
    """Declared std as a share of depth; needed where the files have no variance."""
    std_floor: float = Field(0.0, ge=0)
    """Smallest std, in scaled units."""
    variance: FileOptions | None = None
    """Variance maps (of the stored unit) in files of their own."""


class NormalFileOptions(FileOptions):
    """Normal maps of the camera frame, in NPZ with ``normals`` and maybe ``variance`` (rad^2) and
    ``valid``, NPY, EXR, or PNG and TIFF of 8 or 16 bit with ``(n / 2 + 0.5) * maximum`` as RGB."""

    frame: Literal["opencv", "opengl"] = "opencv"
    """``opencv``: x right, y down, z forward (ours). ``opengl``: x right, y up, z backward."""
    std_deg: float | None = Field(None, gt=0)
    """Declared std of the angle, where the files have no variance."""


class MaskFileOptions(FileOptions):
    """Masks in any image format, NPY or NPZ with ``mask``: pixels that are not 0 may be used."""

    invert: bool = False
    """Pixels that are 0 may be used instead."""


class NormalsFromDepthOptions(Options):
    """Normals from the depth prior."""

    radius: float = Field(0.012, gt=0)
    """Half the side of the largest window, as a share of the map's longer side (ours: on the
    rendered kitchen the best of 0.008, 0.012, 0.02 over exact, noisy and predicted depth)."""
    edge: float = Field(0.015, gt=0)
    """A pixel whose inverse depth deviates by more than this share from the middle of its
    neighbours lies on a depth edge (reference: continuity ratio 1.015)."""
    slope_std: float = Field(4.0, ge=0)
    """Angular std in radians for a depth error of relative std 1 (ours: with it FastDepth's
    standardised angular errors have a median of 1.00 of the expected one on the rendered kitchen
    and of 1.08 against the sensor's normals in the HoloLens room)."""
