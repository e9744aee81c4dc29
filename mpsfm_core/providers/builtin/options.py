"""Option classes of the built-in providers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options


class SiftOptions(Options):
    """Options of SIFT.

    Option defaults are those of COLMAP unless another source is given.
    """

    max_keypoints: int = Field(8192, gt=0)
    """Largest number of keypoints per image; keypoints with the largest scale remain [COLMAP]."""
    resize: int | None = Field(3200, ge=32)
    """Longer side in pixels to which the image is reduced for detection; null keeps the image
    size."""
    root: bool = True
    """True takes the square root of L1-normalized descriptors (RootSIFT) [COLMAP L1_ROOT]."""
    first_octave: int = -1
    """First octave of the scale space; -1 doubles the image and detects the smallest keypoints."""
    octave_resolution: int = Field(3, ge=1)
    """Scale-space levels per octave; raising it detects more keypoints and takes longer."""
    peak_threshold: float = Field(0.02 / 3, ge=0)
    """Smallest contrast of a keypoint; raising it gives fewer, stronger keypoints."""
    edge_threshold: float = Field(10.0, gt=0)
    """Largest ratio of principal curvatures; raising it accepts keypoints on edges."""
    upright: bool = False
    """True skips keypoint orientations: more distinctive descriptors, but only for cameras without
    roll."""
    affine: bool = False
    """True estimates affine shapes of keypoints for wide baselines; about five times slower."""


class MutualNearestOptions(Options):
    """Options of the matcher of mutual nearest neighbors."""

    ratio: float | None = Field(0.8, gt=0, le=1)
    """Largest ratio of nearest to second nearest descriptor distance, in both directions [COLMAP
    max_ratio]. Raising the ratio accepts more ambiguous matches; null disables the ratio test, for
    learned features."""
    max_distance: float | None = Field(None, gt=0)
    """Largest Euclidean distance of matching descriptors; null sets no limit."""


class FileOptions(Options):
    """Options that locate the map file of each image."""

    directory: Path
    """Folder of the map files, with the same subfolders as the image folder."""
    suffix: str | None = None
    """File name suffix after the image name with or without its extension, such as ``.png`` or
    ``_depth.exr``. Null tries ``.npz``, ``.npy``, ``.exr``, ``.png`` and ``.tif``."""


class DepthFileOptions(FileOptions):
    """Options of depth map files: z-depth in 16-bit PNG or TIFF, EXR, NPY or NPZ.

    Depth values that are zero or not finite are invalid. An NPZ file has ``depth`` and optionally
    ``variance`` (squared unit of depth) and ``valid``.
    """

    scale: float = Field(1.0, gt=0)
    """Meters per stored depth unit, such as 0.001 for millimeters."""
    metric: bool = True
    """False if the scaled depth has no metric unit."""
    relative_std: float | None = Field(None, ge=0)
    """Std relative to depth; required if the files have no variance."""
    std_floor: float = Field(0.0, ge=0)
    """Smallest depth std, in the unit of the scaled depth."""
    variance: FileOptions | None = None
    """Separate files with depth variance maps, in the squared stored unit."""


class NormalFileOptions(FileOptions):
    """Options of normal map files in the camera frame: NPZ, NPY, EXR, PNG or TIFF.

    An NPZ file has ``normals`` and optionally ``variance`` (rad^2) and ``valid``. PNG and TIFF of 8
    or 16 bit encode ``(n / 2 + 0.5) * maximum`` as RGB.
    """

    frame: Literal["opencv", "opengl"] = "opencv"
    """Axes of the stored normals. ``opencv``: x right, y down, z forward. ``opengl``: x right, y
    up, z backward."""
    std_deg: float | None = Field(None, gt=0)
    """Angular std in degrees of the normals if the files have no variance."""


class MaskFileOptions(FileOptions):
    """Options of mask files in any image format, NPY, or NPZ with the array ``mask``.

    Nonzero pixels of a mask may be used.
    """

    invert: bool = False
    """True inverts the mask: pixels with value 0 may be used."""


class NormalsFromDepthOptions(Options):
    """Options of normals that are fitted to the depth prior."""

    radius: float = Field(0.012, gt=0)
    """Half the side of the largest fit window relative to the longer side of the depth map. Raising
    the window size reduces noise and loses small surfaces [tuned: rendered kitchen]."""
    edge: float = Field(0.015, gt=0)
    """Relative deviation of inverse depth from the neighbors' mean that counts as a depth edge.
    Raising the edge threshold fits planes across small steps [reference: continuity ratio
    1.015]."""
    slope_std: float = Field(4.0, ge=0)
    """Angular std of normals in radians per relative std of depth. Raising this factor lowers the
    weight of the normals [tuned: rendered kitchen with FastDepth]."""
