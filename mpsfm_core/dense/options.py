"""Settings of the dense stage and of the mesh. Those without a source are ours: first choices, and
what a few photos of one scene say; ``python -m benchmarks.dense`` measures them."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core.data.options import Options


class DenseOptions(Options):
    """Multi-view depth, after the mapper."""

    enabled: bool = True
    """Measure depth in the photos; off: the maps stay as the mapper refined them."""
    max_size: int = Field(640, ge=64)
    """Longer side of the maps in pixels; larger photos are reduced."""
    num_sources: int = Field(5, ge=1)
    """Views that a photo is matched with, at most."""
    range_stds: float = Field(2.0, gt=0)
    """Depth is searched within so many std of the refined depth."""
    max_labels: int = Field(96, ge=8)
    """Depths that are tried at a pixel, at most."""
    window_radius: int = Field(3, ge=1)
    """Of the windows that are compared, pixels of the level."""
    grey_noise: float = Field(2.0, gt=0)
    """Std of grey values (of 255) that counts as no texture."""
    view_share: float = Field(0.5, gt=0, le=1)
    """Share of the views that see a point, best first, that judge a depth: others are occluded."""
    prior_weight: float = Field(0.02, ge=0)
    """Of the squared deviation from the refined depth, in std, beside a cost of 0 to 1."""
    small_step: float = Field(0.04, ge=0)
    """Penalty of neighbours one label apart (semi-global matching, P1)."""
    large_step: float = Field(1.6, ge=0)
    """Of neighbours further apart (P2); lower across edges of the photo."""
    match_std_px: float = Field(0.5, gt=0)
    """Std of a match in pixels of the map, by which views agree; how they differ then says what
    it is."""
    correlation_px: float = Field(40.0, gt=0)
    """Distance over which errors of the refined depth hang together, pixels of the map."""


class MeshOptions(Options):
    """One triangle mesh from the maps."""

    voxel_px: float = Field(2.0, gt=0)
    """Size of a voxel, in pixels of the maps at their median depth: what one pixel tells apart is
    noise, and memory grows with the third power."""
    max_triangles: int = Field(500_000, ge=4)
    """More are joined where the surface is flat (about 20 bytes each in the files)."""
