"""Dense and sparse matchers that run any network of vismatch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from scipy.spatial import cKDTree

from mpsfm_core import (
    DenseMatches,
    Features,
    PairMatches,
    ProviderContext,
    SparseMatches,
    View,
)
from mpsfm_core.data import Float32, Float64
from mpsfm_core.geometry import inside, resize_map, scale_pixels
from mpsfm_core.providers import require_features
from mpsfm_core.providers.torch_runtime import inference
from mpsfm_vismatch.collection import load
from mpsfm_vismatch.options import CollectionOptions, SnapOptions

_STD_DETECTED_PX, _STD_DENSE_PX = 1.0, 0.5
"""Std of keypoints in pixels of the resized image, for detectors and for dense networks."""
_OF_CORNERS = ("roma", "redimatch", "gim-dkm", "loftr", "xoftr", "aspanformer", "matchformer")
_OF_CORNERS += ("topicfm", "edm", "matchanything", "dedode", "steerers", "loma")
"""Substrings of the names of networks with COLMAP's pixel convention, the center of the first pixel
at (0.5, 0.5). The other vismatch networks have the center of the first pixel at (0, 0).
"""
_OF_OPENCV = ("sift", "doghardnet-lightglue")
"""Substrings of the names of matchers with OpenCV's SIFT. OpenCV doubles the image for SIFT, so
keypoint positions are a quarter pixel too small.
"""


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seed the random numbers of numpy and torch, and restore their earlier states at the end."""
    state = np.random.get_state()
    try:
        with torch.random.fork_rng():
            np.random.seed(seed)
            torch.manual_seed(seed)
            yield
    finally:
        np.random.set_state(state)


class DenseMatcher:
    """Dense matcher that returns all matches of a network, with score 1 if it predicts none."""

    def __init__(self, options: CollectionOptions, context: ProviderContext) -> None:
        self._matcher = load(options.network, context, options.max_keypoints)
        self._matcher.skip_ransac = True  # vismatch's RANSAC would fit a homography
        self._resize, self._seed = options.resize, context.seed
        self._first = _first_pixel(options.network)

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match two views by a vismatch network, ignoring any given features."""
        return PairMatches(dense=self._matched(view_a, view_b))

    def _matched(self, *views: View) -> DenseMatches:
        images = [self._shown(view) for view in views]
        with inference(), _seeded(self._seed):  # some matching networks sample matches randomly
            output = self._matcher(*images)
        points = [
            self._in_view(view, image, output[f"matched_kpts{side}"])
            for side, (view, image) in enumerate(zip(views, images, strict=True))
        ]
        scores = output["matched_confidences"]
        if scores is None:
            scores = np.ones(len(points[0]))
        keep = inside(points[0], views[0].camera.size) & inside(points[1], views[1].camera.size)
        pixel = max(v.camera.width / i.shape[2] for v, i in zip(views, images, strict=True))
        std_px = _STD_DETECTED_PX if len(output["all_kpts0"]) else _STD_DENSE_PX
        certain: Float32 = np.clip(scores, 0, 1).astype(np.float32)
        return DenseMatches(
            points[0][keep], points[1][keep], certain[keep], max(1.0, std_px * pixel)
        )

    def _shown(self, view: View) -> torch.Tensor:
        """Resize the image of a view to (3, h, w) float32, RGB in [0, 1]."""
        scale = min(1.0, (self._resize or np.inf) / max(view.camera.size))
        width, height = (max(1, round(side * scale)) for side in view.camera.size)
        image = resize_map(view.image, width, height) / np.float32(255)
        return torch.from_numpy(image).permute(2, 0, 1).contiguous()

    def _in_view(self, view: View, image: torch.Tensor, xy: Float64) -> Float64:
        shown = np.asarray(xy, dtype=np.float64).reshape(-1, 2) + self._first
        return scale_pixels(shown, (image.shape[2], image.shape[1]), view.camera.size)


def _first_pixel(network: str) -> float:
    """Return the offset in pixels from a network's pixel positions to COLMAP's."""
    if any(part in network for part in _OF_OPENCV):
        return 0.25
    of_corners = any(part in network for part in _OF_CORNERS)
    return 0.0 if of_corners and not network.startswith("xfeat") else 0.5  # xfeat-steerers


class SparseMatcher(DenseMatcher):
    """Sparse matcher of the keypoints that are close to both positions of a dense match."""

    def __init__(self, options: SnapOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._snap_px = options.snap_px

    def match(
        self,
        view_a: View,
        view_b: View,
        features_a: Features | None = None,
        features_b: Features | None = None,
    ) -> PairMatches:
        """Match keypoints one-to-one, in the order of decreasing score."""
        given = require_features("vismatch-sparse matches keypoints", features_a, features_b)
        matches = self._matched(view_a, view_b)
        nearest = np.empty((len(matches), 2), dtype=np.int64)
        near = np.ones(len(matches), dtype=np.bool_)
        for side, (features, xy) in enumerate(
            zip(given, (matches.points_a, matches.points_b), strict=True)
        ):
            if not len(features):
                near[:] = False
                continue
            distance, nearest[:, side] = cKDTree(features.keypoints).query(xy)
            near &= distance <= self._snap_px
        return PairMatches(
            sparse=SparseMatches.from_best_scores(nearest[near], matches.scores[near])
        )
