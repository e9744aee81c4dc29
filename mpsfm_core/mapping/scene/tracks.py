"""3D points and their tracks, stored as one point number per keypoint.

That single array is the whole state: a keypoint observes at most one point, and a track is the
set of keypoints with the same number. Everything else (track lists, lengths) is derived.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.mapping.scene.kernels import sort_keypoints_by_point

NO_POINT = -1


class Tracks:
    """Points and the keypoints that observe them.

    Attributes:
        xyz: (p, 3) float64 world coordinates; rows of deleted points stay until :meth:`compact`.
        point_of: (k,) int64, for each global keypoint its row in ``xyz`` or -1.
    """

    def __init__(self, num_keypoints: int) -> None:
        self.xyz: Float64 = np.zeros((0, 3))
        self.point_of: Int64 = np.full(num_keypoints, NO_POINT, dtype=np.int64)

    def __len__(self) -> int:
        """Number of points that are observed."""
        return int((self.lengths() > 0).sum())

    def lengths(self) -> Int64:
        """(p,) int64, track length of each point; 0 for deleted ones."""
        observed = self.point_of[self.point_of >= 0]
        return np.bincount(observed, minlength=len(self.xyz)).astype(np.int64)

    def observations(self) -> Int64:
        """Global keypoints that observe a point, sorted by point, then keypoint."""
        keypoints: Int64 = sort_keypoints_by_point(self.point_of, len(self.xyz))
        return keypoints

    def observations_of(self, points: Int64) -> tuple[Int64, Int64]:
        """Global keypoints that observe some points (m,), each named once, and the row in 0..m-1
        of the point that each observes; sorted by row, then keypoint."""
        row_of = np.full(len(self.xyz) + 1, NO_POINT, dtype=np.int64)
        row_of[points] = np.arange(len(points))
        row_of_keypoint = row_of[self.point_of]  # of those without a point, the last entry
        keypoints = sort_keypoints_by_point(row_of_keypoint, len(points))
        return keypoints, row_of_keypoint[keypoints]

    def add(self, xyz: Float64, keypoints: Int64, track: Int64) -> Int64:
        """New points (m, 3) observed by ``keypoints`` (o,); ``track`` (o,) in 0..m-1 says which.

        Returns the new rows (m,).
        """
        first = len(self.xyz)
        self.xyz = np.concatenate([self.xyz, xyz])
        self.point_of[keypoints] = first + track
        return np.arange(first, first + len(xyz))

    def delete(self, points: Bool) -> None:
        """Delete the points marked in ``points`` (p,)."""
        observed = self.point_of >= 0
        gone = np.zeros_like(observed)
        gone[observed] = points[self.point_of[observed]]
        self.point_of[gone] = NO_POINT

    def remove_observations(self, keypoints: Int64, min_length: int = 2) -> int:
        """Remove observations, and points whose tracks become too short; returns how many went."""
        before = int((self.point_of >= 0).sum())
        self.point_of[keypoints] = NO_POINT
        lengths = self.lengths()
        self.delete(lengths < min_length)
        return before - int((self.point_of >= 0).sum())

    def compact(self) -> None:
        """Forget deleted points; the order of the others stays."""
        alive = self.lengths() > 0
        renumber = np.cumsum(alive) - 1
        observed = self.point_of >= 0
        self.point_of[observed] = renumber[self.point_of[observed]]
        self.xyz = self.xyz[alive]
