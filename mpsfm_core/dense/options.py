"""Options of densification and meshing.

`benchmarks.dense` evaluates the default values, which are choices of MP-SfM.
"""

from __future__ import annotations

from pydantic import Field

from mpsfm_core.data.options import Options, expert

DEFAULT_MAX_TEXTURE_SIZE = 4096
"""Default maximum side of the texture of a mesh in pixels [ours]."""


class DenseOptions(Options):
    """Options of multi-view stereo after mapping."""

    enabled: bool = True
    """Run multi-view stereo; if False, the results contain the refined depth maps of the mapper."""
    max_size: int = Field(640, ge=64)
    """Maximum length of a depth map's longer side in pixels; larger maps are finer and slower."""
    hold_out_every: int | None = Field(None, ge=2)
    """Exclude every n-th registered image, in alphabetical order, from dense depth, cloud and mesh,
    so that ``mpsfm evaluate --held-out`` can render the excluded images; None excludes none."""
    check_validity: bool = expert(True)
    """Raise the depth std of pixels that match no source view or are next to a depth edge, so that
    cloud and mesh omit these pixels; False only for comparisons."""
    correlation_px: float = expert(40.0, gt=0)
    """Correlation length of the error of the refined depth, in pixels of the depth map."""


class MeshOptions(Options):
    """Options of the triangle mesh from depth maps."""

    voxel_px: float = Field(2.0, gt=0)
    """Voxel size in pixels of the depth maps at their median depth.

    Smaller voxels reproduce noise of the depth maps and need more memory. Large scenes get larger
    voxels, so that memory is bounded by ``max_triangles``."""
    max_hole_px: float = Field(32.0, ge=0)
    """Maximum width of a closed part of a hole in pixels of the depth maps; 0 closes no holes.

    A larger value closes larger holes, with depth of priors. A hole stays open at depth edges."""
    max_triangles: int = Field(500_000, ge=4)
    """Maximum number of triangles (about 20 bytes each on disk); a larger mesh is simplified."""
    max_texture_size: int = Field(DEFAULT_MAX_TEXTURE_SIZE, ge=0, le=16384)
    """Maximum side of the texture image in pixels; with 0 the mesh only has vertex colors."""
