"""Options of pair selection, two-view verification, keypoint adjustment and prior maps."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options, expert

CANDIDATES_PER_PARTNER = 8
"""Number of candidates per partner. The candidates of an image are the images with the most similar
global descriptors, and its partners are chosen among them. [tuned: benchmarks.pairs]"""


class PairOptions(Options):
    """Selection of the image pairs to match."""

    mode: Literal["auto", "exhaustive", "sequential", "retrieval"] = "exhaustive"
    """The mode ``exhaustive`` matches all image pairs, and ``sequential`` matches neighbors in the
    order of the images. The mode ``retrieval`` matches the most similar images by global
    descriptors [reference]. The mode ``auto`` matches the most similar images by a few local
    features (or by the retrieval provider, if configured), and neighbors by numbered file names.
    After verification, the mode ``auto`` also matches pairs between unconnected components of the
    match graph."""
    partners: int = Field(30, ge=1)
    """Minimum number of images that each image is matched with, in mode ``auto``. More partners per
    image find more pairs of small overlap, but matching takes proportionally longer. [tuned:
    benchmarks.pairs]"""
    overlap: int = expert(2, ge=1)
    """Number of following images that each image is paired with, in modes ``sequential`` and
    ``auto``. [reference noverlap]"""
    quadratic: bool = expert(False)
    """Pair each image with the images 1, 2, 4, 8 ... positions later, in modes ``sequential`` and
    ``auto``. [COLMAP quadratic_overlap]"""
    top_k: int = expert(20, ge=1)
    """Number of most similar images that each image is paired with, in mode ``retrieval``.
    [reference nquery]"""
    min_similarity: float = expert(0.0)
    """Minimum dot product of the global descriptors of a pair, in mode ``retrieval``.
    [reference]"""

    @property
    def num_candidates(self) -> int:
        """Number of images whose local features are compared with those of each image."""
        return CANDIDATES_PER_PARTNER * self.partners


class VerificationOptions(Options):
    """Two-view geometric verification of matches."""

    max_error_px: float = expert(4.0, gt=0)
    """Inlier threshold on the epipolar error, pixels, for keypoints with a standard deviation of 1
    px. The threshold scales with the standard deviation of the keypoints. [COLMAP two-view
    max_error]"""
    min_inliers: int = expert(15, ge=5)
    """Minimum number of inliers of a verified pair. Requiring more inliers drops false pairs, and
    also true pairs of small overlap. [COLMAP min_num_inliers]"""
    max_chance: float = expert(1e-8, ge=0, le=1)
    """Maximum probability that random matches give as many inliers for a fixed epipolar geometry
    (a-contrario test). A maximum probability of 1 disables the a-contrario test. [tuned:
    benchmarks.pairs]"""


class AdjustmentOptions(Options):
    """Keypoint adjustment by aligning the patches of verified matches."""

    enabled: bool = True
    """Refine keypoints to a fraction of a pixel; false uses the detected positions [reference].
    Keypoints imported from other programs are never refined."""


class ExtractionOptions(Options):
    """Options for the resolution of prior maps, multi-view networks and dense matches."""

    integration_size: int = expert(387, ge=16)
    """Longer side of the depth and normal maps of the mapper, pixels. Larger maps take more memory,
    and more time in depth integration. [reference normscale]"""
    group_size: int = expert(8, ge=1)
    """Number of images per forward pass of a multi-view network. The memory of the network grows
    with the square of the number of images per pass."""
    edge_ratio: float | None = expert(1.015, gt=1)
    """Ratio of neighboring depths above which normals get no weight; null weights all normals.
    [reference continuity]"""
    dense_snap_px: float = expert(2.0, ge=0)
    """Maximum distance in pixels between a dense match and the keypoints to which the match is
    assigned, if no sparse matcher is configured. [reference RoMa]"""
