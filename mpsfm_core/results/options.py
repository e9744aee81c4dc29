"""Options of the result folder."""

from __future__ import annotations

from mpsfm_core.data.options import Options, expert


class ResultOptions(Options):
    """Options of the result files in addition to the binary COLMAP model."""

    text_model: bool = expert(False)
    """Write the COLMAP model also as text, into ``sparse_text/``."""
    nerfstudio: bool = False
    """Write ``transforms.json`` for nerfstudio and other programs with this format."""
    depth_maps: bool = True
    """Write the refined depth maps into ``depth/``."""
    report: bool = True
    """Write ``report.html``, and small images, priors and matches into ``views/``."""
    dense_cloud: bool = True
    """Write ``dense.ply``."""
    dense_max_points: int = expert(2_000_000, ge=1)
    """Maximum number of points in ``dense.ply``, 32 bytes each. If more depth pixels remain, a
    random subset is used."""
    dense_max_relative_std: float = expert(0.1, gt=0)
    """Maximum relative depth std of pixels in ``dense.ply``. A larger maximum gives more and less
    accurate points. If more than three quarters of the pixels exceed the maximum, the most certain
    quarter is used [twice the std of the weaker networks in paper C]."""
    dense_consistency_sigmas: float = expert(3.0, gt=0)
    """Depth difference in standard deviations from which the depth map of another image contradicts
    a pixel. Pixels with more contradicting than confirming images are dropped from
    ``dense.ply``."""
    georeference: bool = True
    """Transform the result to meters east, north, up if GPS positions spread enough."""
