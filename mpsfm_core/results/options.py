"""Settings of the results room."""

from __future__ import annotations

from pydantic import Field

from mpsfm_core.data.options import Options


class ResultOptions(Options):
    """What is written beside the COLMAP model, and how much of it."""

    text_model: bool = False
    """Also write the COLMAP model as text, into ``sparse_text/``."""
    nerfstudio: bool = False
    """Also write ``transforms.json`` for nerfstudio and tools that read its format."""
    depth_maps: bool = True
    """Write the refined depth maps into ``depth/``."""
    report: bool = True
    """Write ``report.html``, and into ``views/`` what it shows: small photos, priors, matches."""
    dense_cloud: bool = True
    """Write ``dense.ply``."""
    dense_max_points: int = Field(2_000_000, ge=1)
    """Size limit of ``dense.ply`` (32 bytes a point: 64 MB); random pixels are left out above."""
    dense_max_relative_std: float = Field(0.1, gt=0)
    """Pixels whose depth has a larger relative std are left out of ``dense.ply``. Twice the
    relative std of the weaker networks of the paper's appendix C, so it takes the worst pixels.
    Where more than three quarters are worse, the surest quarter stays."""
    dense_consistency_sigmas: float = Field(3.0, gt=0)
    """A pixel that another image sees through, by more than this many standard deviations, is left
    out of ``dense.ply`` unless more images confirm than contradict it."""
    georeference: bool = True
    """Where the photos have GPS positions that spread enough: metres east, north and up."""
