"""3D points and their tracks, stored as one point row per keypoint.

A keypoint observes at most one point. A track is the set of keypoints with the same point row. The
lists and lengths of tracks are computed on demand.
"""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64, Int64
from mpsfm_core.mapping.scene.kernels import sort_keypoints_by_point

NO_POINT = -1


class Tracks:
    """3D points and the keypoints that observe them.

    Attributes:
        xyz: (p, 3) float64 points in the world frame. Rows of deleted points remain until
            :meth:`compact` is called.
        point_of: (k,) int64 row in ``xyz`` of the point that each keypoint observes, or -1.
    """

    def __init__(self, num_keypoints: int) -> None:
        self._buffer: Float64 = np.zeros((0, 3))  # larger than xyz, so that few additions copy it
        self._num_points = 0
        self.point_of: Int64 = np.full(num_keypoints, NO_POINT, dtype=np.int64)

    @property
    def xyz(self) -> Float64:
        """(p, 3) float64 points in the world frame."""
        return self._buffer[: self._num_points]

    @xyz.setter
    def xyz(self, points: Float64) -> None:
        self._buffer, self._num_points = points, len(points)

    def __len__(self) -> int:
        """Return the number of points with observations."""
        return int((self.lengths() > 0).sum())

    def lengths(self) -> Int64:
        """Return the track length (p,) int64 of each point, 0 for deleted points."""
        observed = self.point_of[self.point_of >= 0]
        return np.bincount(observed, minlength=len(self.xyz)).astype(np.int64)

    def observations(self) -> Int64:
        """Return the global numbers of keypoints that observe a point, sorted by point."""
        keypoints: Int64 = sort_keypoints_by_point(self.point_of, len(self.xyz))
        return keypoints

    def observations_of(self, points: Int64) -> tuple[Int64, Int64]:
        """Return the observations of distinct points ``points`` (m,).

        Returns:
            Global keypoint numbers (o,), and the row (o,) in 0..m-1 of the point that each keypoint
            observes, sorted by row, then keypoint.
        """
        is_selected = np.zeros(len(self.xyz) + 1, dtype=np.bool_)
        is_selected[points] = True
        keypoints = np.flatnonzero(is_selected[self.point_of])  # NO_POINT = -1 reads the last entry
        row_of = np.empty(len(self.xyz), dtype=np.int64)
        row_of[points] = np.arange(len(points))
        rows = row_of[self.point_of[keypoints]]
        order = sort_keypoints_by_point(rows, len(points))
        return keypoints[order], rows[order]

    def add(self, xyz: Float64, keypoints: Int64, track: Int64) -> Int64:
        """Add points with their observations.

        Args:
            xyz: (m, 3) points in the world frame.
            keypoints: (o,) global numbers of the keypoints that observe the added points.
            track: (o,) row in 0..m-1 of the added point that each keypoint observes.

        Returns:
            Rows (m,) of the added points in :attr:`xyz`.
        """
        first, end = self._num_points, self._num_points + len(xyz)
        if end > len(self._buffer):
            self._buffer = np.concatenate([self.xyz, np.empty((end, 3))])
        self._buffer[first:end], self._num_points = xyz, end
        self.point_of[keypoints] = first + track
        return np.arange(first, end)

    def remove_observations(self, keypoints: Int64, min_length: int = 2) -> int:
        """Remove observations, and their points that keep fewer than ``min_length`` observations.

        Returns:
            The number of removed observations.
        """
        points = np.unique(self.point_of[keypoints])
        observations, rows = self.observations_of(points[points >= 0])
        self.point_of[keypoints] = NO_POINT
        lengths = np.bincount(rows, self.point_of[observations] >= 0)
        self.point_of[observations[lengths[rows] < min_length]] = NO_POINT
        return int(np.count_nonzero(self.point_of[observations] < 0))

    def compact(self) -> None:
        """Remove the rows of deleted points, with the order of all other points unchanged."""
        alive = self.lengths() > 0
        renumber = np.cumsum(alive) - 1
        observed = self.point_of >= 0
        self.point_of[observed] = renumber[self.point_of[observed]]
        self.xyz = self.xyz[alive]
