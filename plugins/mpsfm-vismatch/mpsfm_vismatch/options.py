"""Options of the matchers; imports nothing heavy."""

from __future__ import annotations

from mpsfm_mast3r import options as mast3r
from mpsfm_roma import options as roma
from pydantic import Field

from mpsfm_core import Options


class CollectionOptions(Options):
    """Options of a network of the collection."""

    network: str = "superpoint-lightglue"
    """Name in the collection (``vismatch.available_models``), or a matcher class with the same
    interface, ``package.module:Class``.
    """
    max_keypoints: int = Field(2048, ge=1)
    """Maximum number of keypoints, or of samples of a warp."""
    resize: int | None = Field(1024, ge=32)
    """Longest side of the views in pixels, never enlarged; null: full size. Dense networks resize
    again.
    """


class SnapOptions(CollectionOptions):
    """Options of matching at keypoints."""

    snap_px: float = Field(2.0, gt=0)
    """Maximum distance in pixels between a keypoint and a matched position. [RoMa reference]"""


class RomaNetwork(Options):
    """Name of RoMa or a variant."""

    network: str = "roma"
    """``roma``, ``minima-roma``, ``redimatch``, ``redimatch-indoor``, or a matcher class."""


class RomaDenseOptions(RomaNetwork, roma.DenseSearch):
    """Options of ``vismatch-roma``."""


class RomaSparseOptions(RomaNetwork, roma.SparseSearch):
    """Options of ``vismatch-roma-sparse``."""


class Mast3rNetwork(Options):
    """Name of MASt3R."""

    network: str = "master"
    """Name in the collection, or a matcher class."""


class Mast3rDenseOptions(Mast3rNetwork, mast3r.DenseSearch):
    """Options of ``vismatch-mast3r``."""


class Mast3rSparseOptions(Mast3rNetwork, mast3r.SparseSearch):
    """Options of ``vismatch-mast3r-sparse``."""
