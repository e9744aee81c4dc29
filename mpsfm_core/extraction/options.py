"""Options of extraction: pairs, geometric verification, keypoint adjustment and prior maps."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options, expert


class PairOptions(Options):
    """Selection of the image pairs to match."""

    mode: Literal["auto", "exhaustive", "sequential", "retrieval"] = "exhaustive"
    """``exhaustive``: all pairs. ``sequential``: neighbors in the order of the images.
    ``retrieval``: the most similar images by global descriptors [reference]. ``auto``: the most
    similar images by a few local features (or by ``retrieval``, if configured) and neighbors with
    numbered names; pairs between unconnected components are tried afterwards."""
    partners: int = Field(30, ge=1)
    """``auto``: minimum number of images that each image is matched with. Raising it finds more
    pairs of small overlap and takes proportionally longer. [tuned: benchmarks.pairs]"""
    overlap: int = Field(2, ge=1)
    """``sequential`` and ``auto``: number of following images. [reference noverlap]"""
    quadratic: bool = expert(False)
    """``sequential`` and ``auto``: pair with the following images 1, 2, 4, 8 ... instead.
    [COLMAP quadratic_overlap]"""
    top_k: int = Field(20, ge=1)
    """``retrieval``: number of most similar images per image. [reference nquery]"""
    min_similarity: float = expert(0.0)
    """``retrieval``: minimum dot product of global descriptors. [reference]"""


class VerificationOptions(Options):
    """Two-view geometric verification of matches."""

    max_error_px: float = expert(4.0, gt=0)
    """Inlier threshold for keypoints with a std of 1 px; scales with their std.
    [COLMAP two-view max_error]"""
    min_inliers: int = expert(15, ge=5)
    """Pairs with fewer inliers are dropped. Raising it removes false and true pairs of small
    overlap. [COLMAP min_num_inliers]"""
    max_chance: float = expert(1e-8, ge=0, le=1)
    """Maximum probability that one given epipolar geometry gets the inliers from random matches
    (a-contrario test). 1 switches the test off. [tuned: benchmarks.pairs]"""


class AdjustmentOptions(Options):
    """Keypoint adjustment by aligning the patches of verified matches."""

    enabled: bool = True
    """Adjust keypoints to a fraction of a pixel; off keeps the detected positions [reference].
    Imported keypoints are never adjusted."""


class ExtractionOptions(Options):
    """Grid of the prior maps, groups of a multi-view network, keypoints from dense matches."""

    integration_size: int = expert(387, ge=16)
    """Longer side of the prior maps that the mapper refines, in pixels. Raising it costs memory and
    time of depth integration. [reference normscale]"""
    group_size: int = expert(8, ge=1)
    """Images in a group of a multi-view network. Its memory grows with the square."""
    edge_ratio: float | None = expert(1.015, gt=1)
    """Ratio of neighboring depths from which normals have no weight; null keeps all normals.
    [reference continuity]"""
    dense_snap_px: float = expert(2.0, ge=0)
    """Without a sparse matcher: distance at which a dense match is assigned to keypoints of both
    images. [reference RoMa]"""
