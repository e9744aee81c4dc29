"""Settings of the extraction room; "reference" is the published system's default."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options


class PairOptions(Options):
    """Which pairs of images are matched."""

    mode: Literal["auto", "exhaustive", "sequential", "retrieval"] = "exhaustive"
    """``auto``: each image with its ``partners``, found by a first look at a few of its features
    (or by the retrieval provider, if there is one), and with its neighbours where names are
    numbered; what stays apart is tried again. ``exhaustive``: all. ``sequential``: neighbours in
    the order of the images. ``retrieval``: the most similar by the retrieval provider
    (reference)."""
    partners: int = Field(30, ge=1)
    """Auto: how many others an image is matched with at least, all where there are no more (ours:
    30 are 17 to 19 pairs an image)."""
    overlap: int = Field(2, ge=1)
    """Sequential and auto: how many of the following images (reference: noverlap)."""
    quadratic: bool = False
    """Sequential and auto: the 1st, 2nd, 4th, 8th ... following image instead (reference: off)."""
    top_k: int = Field(20, ge=1)
    """Retrieval: how many for each image (reference: nquery)."""
    min_similarity: float = 0.0
    """Retrieval: smallest dot product (reference)."""


class VerificationOptions(Options):
    """Two-view geometric verification of matches."""

    max_error_px: float = Field(4.0, gt=0)
    """Inlier threshold for keypoints of std 1 px; it grows with their std (reference, COLMAP)."""
    min_inliers: int = Field(15, ge=5)
    """Pairs with fewer are dropped (reference, COLMAP)."""
    min_inlier_ratio: float = Field(0.1, ge=0, lt=1)
    """Share of inliers the number of RANSAC trials is made for (reference)."""
    max_chance: float = Field(1e-8, ge=0, le=1)
    """Probability that one given epipolar geometry has the inliers by chance, above which the
    pair is dropped; RANSAC tries thousands of geometries. 1 switches it off. (Ours: 250 random
    matches have 23 to 30 inliers, so that ``min_inliers`` alone lets them pass.)"""
    max_trials: int = Field(20_000, ge=1)
    """RANSAC (reference)."""
    confidence: float = Field(0.999, gt=0, lt=1)
    """RANSAC (COLMAP)."""
    min_e_f_ratio: float = Field(0.95, ge=0)
    """Inliers of the essential over those of the fundamental matrix, for a calibrated pair
    (reference, COLMAP)."""
    max_h_ratio: float = Field(0.8, ge=0)
    """Inliers of a homography over those of the epipolar model, above which the pair is planar or
    panoramic (reference, COLMAP)."""


class AdjustmentOptions(Options):
    """Keypoints to a fraction of a pixel, by aligning the patches of verified matches."""

    enabled: bool = True
    """Off: keypoints stay where they were found (reference). Imported ones always do."""
    max_alignments: int = Field(4, ge=1)
    """A match is aligned if it is among so many best of one of its keypoints (ours: with SIFT on
    rendered_kitchen, pairs of 54 photos, half of the time of aligning all, and as exact)."""
    radius: int = Field(9, ge=3, le=50)
    """Of the round patches, in stds of a keypoint (ours: on rendered_kitchen 8, 9 and 10 leave
    0.048, 0.042 and 0.038 px to the true epipolar line in 77, 76 and 75 % of the matches, 0.4 px
    are the keypoints' own; cost grows with the square, and a larger patch is less often a plane).
    """
    min_correlation: float = Field(0.8, ge=0, lt=1)
    """Patches that are less alike say nothing (ours)."""
    max_shift: float = Field(3.0, gt=0)
    """Nor do those that lie farther from where they were looked for, in stds of a keypoint
    (ours)."""
    std_factor: float = Field(0.25, gt=0, le=1)
    """Noise of an adjusted keypoint in terms of what it was before, in bundle adjustment (ours:
    distances from the true epipolar line fall to a seventh)."""


class ExtractionOptions(Options):
    """Grid of the prior maps, and how dense matches become keypoints."""

    integration_size: int = Field(387, ge=16)
    """Longer side of the maps that the mapper refines (reference: normscale)."""
    group_size: int = Field(8, ge=1)
    """Photos that a multi-view network is shown at once (ours: its attention, and so its memory,
    grows with the square of their number)."""
    edge_ratio: float | None = Field(1.015, gt=1)
    """Normals next to a larger ratio of neighbouring depths are not trusted; null trusts all
    (reference: continuity)."""
    dense_snap_px: float = Field(2.0, ge=0)
    """A dense match this near to keypoints in both images matches them, if there is no sparse
    matcher (reference: RoMa)."""
    dense_sparse_px: float = Field(6.0, ge=0)
    """Dense matches nearer to a keypoint of the same image are left out (reference:
    sparse_nms_radius)."""
    dense_nms_px: float = Field(8.0, ge=0)
    """Of dense matches nearer to each other only the most certain is kept (reference)."""
    dense_min_score: float = Field(0.1, ge=0, le=1)
    """Less certain dense matches are left out (reference: RoMa)."""
