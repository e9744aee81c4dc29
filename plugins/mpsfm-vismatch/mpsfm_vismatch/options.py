"""Options of the vismatch providers, importable without torch."""

from __future__ import annotations

from mpsfm_mast3r import options as mast3r
from mpsfm_roma import options as roma
from pydantic import Field

from mpsfm_core import Options


class CollectionOptions(Options):
    """Options of a vismatch network."""

    network: str = "superpoint-lightglue"
    """Name of the network in vismatch (``vismatch.available_models``), or a matcher class
    ``package.module:Class`` with the same interface.
    """
    max_keypoints: int = Field(2048, ge=1)
    """Maximum number of keypoints of a detector, or of matches that are sampled from a warp."""
    resize: int | None = Field(1024, ge=32)
    """Longer side of the resized images in pixels. Images are never enlarged, and null keeps their
    size. Dense matching networks resize the resized images again.
    """


class SnapOptions(CollectionOptions):
    """Options of matching given keypoints by a vismatch network."""

    snap_px: float = Field(2.0, gt=0)
    """Maximum distance in pixels between a keypoint and the position of a dense match."""


class RomaNetwork(Options):
    """Option that selects RoMa or one of its variants."""

    network: str = "roma"
    """Name of the network, ``roma``, ``minima-roma``, ``redimatch`` or ``redimatch-indoor``, or a
    matcher class."""


class RomaDenseOptions(RomaNetwork, roma.DenseSearch):
    """Options of ``vismatch-roma``."""


class RomaSparseOptions(RomaNetwork, roma.SparseSearch):
    """Options of ``vismatch-roma-sparse``."""


class Mast3rNetwork(Options):
    """Name of MASt3R."""

    network: str = "master"
    """Name of the network in vismatch, or a matcher class ``package.module:Class``."""


class Mast3rDenseOptions(Mast3rNetwork, mast3r.DenseSearch):
    """Options of ``vismatch-mast3r``."""


class Mast3rSparseOptions(Mast3rNetwork, mast3r.SparseSearch):
    """Options of ``vismatch-mast3r-sparse``."""
