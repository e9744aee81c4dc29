"""Options of the result folder."""

from __future__ import annotations

from mpsfm_core.data.options import Options, expert


class ResultOptions(Options):
    """Options of the result files in addition to the binary COLMAP model."""

    text_model: bool = expert(False)
    """Write the COLMAP model also as text, into ``sparse_text/``."""
    nerfstudio: bool = False
    """Write ``transforms.json`` for nerfstudio and other programs with this format."""
    depth_maps: bool = expert(True)
    """Write the refined depth maps into ``depth/``."""
    report: bool = True
    """Write ``report.html``, and small images, priors and matches into ``views/``."""
    dense_cloud: bool = True
    """Write ``dense.ply``."""
    dense_max_points: int = expert(2_000_000, ge=1)
    """Maximum number of points in ``dense.ply``, 32 bytes each. If more depth pixels remain, a
    random subset is used."""
    georeference: bool = True
    """Transform the result to meters east, north, up if GPS positions spread enough."""
