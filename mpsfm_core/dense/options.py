"""Options of densification and meshing.

Defaults without a source tag are ours; `benchmarks.dense` measures them.
"""

from __future__ import annotations

from pydantic import Field

from mpsfm_core.data.options import Options, expert


class DenseOptions(Options):
    """Multi-view stereo after mapping."""

    enabled: bool = True
    """Run multi-view stereo; if off, the depth maps stay as the mapper refined them."""
    max_size: int = Field(640, ge=64)
    """Maximum of the longer side of the depth maps in pixels; higher is finer and slower."""
    num_sources: int = expert(5, ge=1)
    """Maximum number of source views per view; higher is more complete and slower."""
    range_stds: float = expert(2.0, gt=0)
    """Half width of the depth search range in stds of the refined depth."""
    max_labels: int = expert(96, ge=8)
    """Maximum number of depth hypotheses per pixel; higher samples wide ranges more finely."""
    window_radius: int = expert(3, ge=1)
    """Radius of the NCC window in pixels of the pyramid level; higher is smoother."""
    grey_noise: float = expert(2.0, gt=0)
    """Std of image noise in gray levels of 255; higher treats more texture as noise."""
    view_share: float = expert(0.5, gt=0, le=1)
    """Ratio of the views that see a point whose costs are averaged, the lowest costs first.

    The other views count as occluded. Higher is less robust to occlusion."""
    prior_weight: float = expert(0.02, ge=0)
    """Weight of the squared deviation from the refined depth in stds; costs are in [0, 1]."""
    small_step: float = expert(0.04, ge=0)
    """Penalty P1 of semi-global matching for neighbors one label apart."""
    large_step: float = expert(1.6, ge=0)
    """Penalty P2 of semi-global matching for larger steps; image edges reduce the penalty."""
    match_std_px: float = expert(0.5, gt=0)
    """Nominal std of a match in pixels, for the tolerance of the geometric consistency check."""
    correlation_px: float = expert(40.0, gt=0)
    """Correlation length of the error of the refined depth, in pixels of the depth map."""


class MeshOptions(Options):
    """Triangle mesh from the depth maps."""

    voxel_px: float = Field(2.0, gt=0)
    """Voxel size in pixels of the depth maps at their median depth.

    Lower resolves noise rather than surface, and memory grows with the third power."""
    max_triangles: int = Field(500_000, ge=4)
    """Maximum number of triangles; a larger mesh is simplified (about 20 bytes each on disk)."""
