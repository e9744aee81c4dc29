"""Option classes of the built-in providers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from mpsfm_core.data.cameras import MapOrientation
from mpsfm_core.data.options import Options


class SiftOptions(Options):
    """Options of the SIFT features provider.

    Defaults of SIFT options are those of COLMAP unless another source is given.
    """

    max_keypoints: int = Field(8192, gt=0)
    """Approximate number of keypoints per image. COLMAP keeps whole levels of scale space, the
    largest scales first, and one keypoint for each orientation, so that the number may be higher
    [COLMAP]."""
    resize: int | None = Field(3200, ge=32)
    """Longer side in pixels to which a larger image is downsampled for keypoint detection; null
    keeps the image size."""
    root: bool = True
    """True takes the square root of L1-normalized SIFT descriptors (RootSIFT) [COLMAP L1_ROOT]."""
    first_octave: int = -1
    """First octave of the SIFT scale space; -1 doubles the image size and detects the smallest
    keypoints."""
    octave_resolution: int = Field(3, ge=1)
    """Number of SIFT scale-space levels per octave. More levels give more keypoints and take
    longer."""
    peak_threshold: float = Field(0.02 / 3, ge=0)
    """Smallest contrast of a SIFT keypoint. A larger threshold gives fewer, stronger keypoints."""
    edge_threshold: float = Field(10.0, gt=0)
    """Largest ratio of principal curvatures at a SIFT keypoint. A larger threshold accepts
    keypoints on edges."""
    upright: bool = False
    """True sets the orientation of every keypoint to zero, which makes descriptors more distinctive
    but requires cameras without roll."""
    affine: bool = False
    """True estimates affine shapes of keypoints for wide baselines, which is about five times
    slower."""


class MutualNearestOptions(Options):
    """Options of the matcher of mutual nearest descriptors."""

    ratio: float | None = Field(0.8, gt=0, le=1)
    """Largest ratio of nearest to second nearest descriptor distance, in both directions [COLMAP
    max_ratio]. A larger ratio accepts more ambiguous matches. Null disables the ratio test, as is
    usual for learned features."""
    max_distance: float | None = Field(None, gt=0)
    """Largest Euclidean distance of matching descriptors; null accepts any distance."""


class FileOptions(Options):
    """Options that locate the depth, normal or mask file of each image."""

    directory: Path
    """Folder of the depth, normal or mask files, with the same subfolders as the image folder."""
    suffix: str | None = None
    """Suffix that follows the image name in the file name of a map, such as ``.png`` or
    ``_depth.exr``. The image name may be written with or without its extension. Null tries the
    suffixes ``.npz``, ``.npy``, ``.exr``, ``.png``, ``.tif`` and ``.tiff``."""
    orientation: MapOrientation = "auto"
    """Orientation of the map files of photos that EXIF rotates, either ``stored`` (before EXIF
    rotation) or ``upright`` (after). The value ``auto`` compares the aspect ratios of map and
    photo, and uses ``stored`` if both orientations fit [COLMAP, which ignores EXIF orientation]."""


class DepthFileOptions(FileOptions):
    """Options of files with z-depth maps in 16-bit PNG or TIFF, EXR, NPY or NPZ.

    Depth values that are zero or not finite are invalid. An NPZ file has the array ``depth`` and
    optionally the arrays ``variance`` (squared unit of depth) and ``valid``.
    """

    scale: float = Field(1.0, gt=0)
    """Meters per stored depth unit, such as 0.001 for millimeters."""
    metric: bool = True
    """False declares that depth values, multiplied by ``scale``, are not in meters."""
    relative_std: float | None = Field(None, ge=0)
    """Depth std divided by depth. Either ``relative_std`` or ``std_floor`` is required if the depth
    files have no variance."""
    std_floor: float = Field(0.0, ge=0)
    """Smallest depth std, in the unit of depth multiplied by ``scale``."""
    variance: FileOptions | None = None
    """Location of separate files with depth variance maps, in the squared unit of the stored
    depth."""


class NormalFileOptions(FileOptions):
    """Options of files with normal maps in the camera frame in NPZ, NPY, EXR, PNG or TIFF.

    An NPZ file has the array ``normals`` and optionally the arrays ``variance`` (rad^2) and
    ``valid``. Images of 8 or 16 bit encode a normal ``n`` as RGB color ``(n / 2 + 0.5) * maximum``.
    """

    frame: Literal["opencv", "opengl"] = "opencv"
    """Camera axes of the stored normals, which are x right, y down, z forward for ``opencv`` and x
    right, y up, z backward for ``opengl``."""
    std_deg: float | None = Field(None, gt=0)
    """Angular std in degrees of normals from files without variance."""


class MaskFileOptions(FileOptions):
    """Options of files with masks in any image format, NPY, or NPZ with the array ``mask``.

    The reconstruction may use the pixels where the mask is not zero.
    """

    invert: bool = False
    """True inverts the mask, so that the reconstruction uses the pixels where the mask is zero."""


class NormalsFromDepthOptions(Options):
    """Options of the normals provider that fits planes to the depth prior."""

    radius: float = Field(0.012, gt=0)
    """Half the side of the largest plane-fit window divided by the longer side of the depth map.
    Raising the window size reduces noise of the normals and loses small surfaces [tuned: rendered
    kitchen]."""
    edge: float = Field(0.015, gt=0)
    """Relative deviation of inverse depth from the neighbors' mean above which a pixel is on a
    depth edge. Raising the edge threshold fits planes across small depth steps [reference:
    continuity ratio 1.015]."""
    slope_std: float = Field(4.0, ge=0)
    """Angular std of normals in radians divided by the relative std of depth. Raising ``slope_std``
    lowers the weight of the normals [tuned: rendered kitchen with FastDepth]."""
