"""Correspondence graph of the verified matches between the keypoints of all images."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64, Int64, MappingProblem, VerifiedPair

MIN_SCORE = 0.05
"""Lower bound of match scores, because every match passed geometric verification. [ours]"""
BLOCK_MATCHES = 2**18
"""Number of matches that are processed together, so that temporary arrays stay small. [ours]"""


class CorrespondenceGraph:
    """Verified matches as an edge list over globally numbered keypoints.

    Keypoint ``k`` of image ``i`` has the global number ``offsets[i] + k``. The edge list contains
    each match in both directions, sorted by source, so that the edges of an image are one slice.

    Attributes:
        offsets: (n + 1,) int64 global number of the first keypoint of each image, and the total
            number of keypoints.
        num_images: Number of images.
        image_of: (k,) int64 image index of each global keypoint.
        source: (e,) int64 global number of the first keypoint of each match.
        target: (e,) int64 global number of the second keypoint of each match.
        score: (e,) float64 score of each match, in [0.05, 1].
        pair_scores: (p,) float64 summed match scores of each image pair.
        pairs_of: Verified pairs that contain each image.
        keypoint_weight: (k,) float64 weight of the squared reprojection error of each keypoint. The
            weight is the score of the best match relative to the mean score, divided by the ratio
            of the keypoint variances after and before keypoint adjustment.
    """

    def __init__(self, problem: MappingProblem, *, weigh_by_score: bool = True) -> None:
        counts = [problem.num_keypoints(i) for i in range(len(problem.images))]
        self.offsets: Int64 = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.num_images = len(problem.images)
        self.image_of: Int64 = np.repeat(np.arange(self.num_images), counts)
        source, target, score = [], [], []
        for pair in problem.pairs:
            a = pair.matches[:, 0] + self.offsets[pair.image_a]
            b = pair.matches[:, 1] + self.offsets[pair.image_b]
            source += [a, b]
            target += [b, a]
            score += [pair.scores, pair.scores]
        empty = np.zeros(0, dtype=np.int64)
        self.source: Int64 = np.concatenate([empty, *source])
        self.target: Int64 = np.concatenate([empty, *target])
        self.score: Float64 = np.concatenate([np.zeros(0), *score])
        if not weigh_by_score:
            self.score[:] = 1.0
        self.score = np.maximum(self.score, MIN_SCORE)
        order = np.lexsort((self.target, self.source))
        self.source, self.target = self.source[order], self.target[order]
        self.score = self.score[order]
        self._first_edge = np.searchsorted(self.source, self.offsets)
        self.pair_scores: Float64 = np.array(
            [pair.scores.sum(dtype=np.float64) for pair in problem.pairs]
        )
        self.pairs_of: list[list[VerifiedPair]] = [[] for _ in problem.images]
        for pair in problem.pairs:
            self.pairs_of[pair.image_a].append(pair)
            self.pairs_of[pair.image_b].append(pair)
        self.keypoint_weight: Float64 = np.zeros(len(self.image_of))
        np.maximum.at(self.keypoint_weight, self.source, self.score)
        if len(self.score):
            self.keypoint_weight /= self.score.mean()
        for index, image in enumerate(problem.images):
            if image.keypoint_std_factor is not None:
                self.keypoint_weight[self.keypoints_of(index)] /= image.keypoint_std_factor**2

    def edges_of(self, image: int) -> slice:
        """Return the slice of the edge list with the matches of one image."""
        return slice(int(self._first_edge[image]), int(self._first_edge[image + 1]))

    def keypoints_of(self, image: int) -> slice:
        """Return the global numbers of the keypoints of an image."""
        return slice(int(self.offsets[image]), int(self.offsets[image + 1]))
