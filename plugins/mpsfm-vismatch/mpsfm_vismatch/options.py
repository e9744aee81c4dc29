"""What a user can set. Imports nothing heavy."""

from __future__ import annotations

from mpsfm_mast3r import options as mast3r
from mpsfm_roma import options as roma
from pydantic import Field

from mpsfm_core import Options


class CollectionOptions(Options):
    """A network of the collection, shown views of its own or the given size."""

    network: str = "superpoint-lightglue"
    """Name in the collection (``vismatch.available_models``), or a matcher class of one's own with
    its interface as ``package.module:Class``."""
    max_keypoints: int = Field(2048, ge=1)
    """Largest number of keypoints, or of samples of a warp, that the network is asked for."""
    resize: int | None = Field(1024, ge=32)
    """Longest side of the views as the network is given them, never enlarged; None for all pixels.
    Dense networks scale them to a size of their own."""


class SnapOptions(CollectionOptions):
    """Matches of given keypoints."""

    snap_px: float = Field(2.0, gt=0)
    """Farthest that a keypoint may be from a position that the network matched (RoMa's
    reference)."""


class RomaNetwork(Options):
    """RoMa or a network of its making."""

    network: str = "roma"
    """``roma``, ``minima-roma``, ``redimatch``, ``redimatch-indoor``; or a class of one's own."""


class RomaDenseOptions(RomaNetwork, roma.DenseSearch):
    """Of ``vismatch-roma``."""


class RomaSparseOptions(RomaNetwork, roma.SparseSearch):
    """Of ``vismatch-roma-sparse``."""


class Mast3rNetwork(Options):
    """MASt3R."""

    network: str = "master"
    """The collection's name of it; or a class of one's own."""


class Mast3rDenseOptions(Mast3rNetwork, mast3r.DenseSearch):
    """Of ``vismatch-mast3r``."""


class Mast3rSparseOptions(Mast3rNetwork, mast3r.SparseSearch):
    """Of ``vismatch-mast3r-sparse``."""
