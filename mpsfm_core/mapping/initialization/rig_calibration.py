"""Calibration of rigs: relative poses of the sensors from a reconstruction of single images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mpsfm_core.data import MappingProblem, Pose, Rig
from mpsfm_core.geometry import angle_between_deg, compose, invert, transform
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage

MAX_DEVIATION_DEG = 0.3
"""Largest median angle by which points deviate from a constant relative pose of two sensors. The
deviation is at most 0.1 degrees for rigs, and 0.65 degrees for a single camera that moves evenly.
[tuned: benchmarks.rigs]"""


def calibrate_rigs(
    problem: MappingProblem, models: Sequence[Reconstruction]
) -> MappingProblem | None:
    """Estimate the relative poses of rigs with an unknown relative pose.

    The sensors of a rig get the median relative pose over all frames of the largest model. A sensor
    without a common frame with the first sensor is linked by other sensors. A rig whose images do
    not move as one stays uncalibrated.

    Args:
        problem: The mapping problem that was reconstructed without these rigs.
        models: The components of the reconstruction.

    Returns:
        The problem with estimated rigs, or None if no further rig can be calibrated.
    """
    if not models or all(rig.is_calibrated for rig in problem.rigs):
        return None
    model = models[0]
    rigs = [rig if rig.is_calibrated else _calibrate(rig, model) or rig for rig in problem.rigs]
    is_new = [new is not old for new, old in zip(rigs, problem.rigs, strict=True)]
    return replace(problem, rigs=tuple(rigs)) if any(is_new) else None


def _calibrate(rig: Rig, model: Reconstruction) -> Rig | None:
    """Estimate the relative poses of a rig, or return None if no constant poses connect sensors."""
    images = {image.name: image for image in model.images}
    frames = [
        {s: images[name] for s, name in enumerate(frame) if name is not None and name in images}
        for frame in rig.frames
    ]
    count = len(rig.sensor_from_rig)
    common = np.zeros((count, count), dtype=np.int64)
    for frame in frames:
        sensors = list(frame)
        common[np.ix_(sensors, sensors)] += 1
    estimated: dict[int, Pose] = {0: (np.eye(3), np.zeros(3))}
    while len(estimated) < count:
        known, unknown = list(estimated), [s for s in range(count) if s not in estimated]
        counts = common[np.ix_(known, unknown)]
        row, column = np.unravel_index(int(np.argmax(counts)), counts.shape)
        if not counts[row, column]:
            return None
        link, sensor = known[row], unknown[column]
        pairs = [(f[link], f[sensor]) for f in frames if link in f and sensor in f]
        relative = _median_pose(
            [
                compose((b.rotation, b.translation), invert(a.rotation, a.translation))
                for a, b in pairs
            ]
        )
        deviations = [_measure_deviation_deg(model, a, b, relative) for a, b in pairs]
        if not np.median(deviations) <= MAX_DEVIATION_DEG:
            return None
        estimated[sensor] = compose(relative, estimated[link])
    return replace(
        rig, sensor_from_rig=tuple(estimated[s] for s in range(count)), is_estimated=True
    )


def _measure_deviation_deg(
    model: Reconstruction, first: RegisteredImage, second: RegisteredImage, relative: Pose
) -> float:
    """Measure how far a relative pose moves the points that an image observes.

    Returns:
        Median angle in degrees between the directions of points in ``second`` with its pose, and
        with the pose that follows from ``first`` and the relative pose.
    """
    points = model.points[second.point_ids[second.point_ids >= 0]]
    pose = compose(relative, (first.rotation, first.translation))
    actual = transform(second.rotation, second.translation, points)
    return float(np.median(angle_between_deg(actual, transform(*pose, points))))


def _median_pose(poses: Sequence[Pose]) -> Pose:
    """Return the median of poses.

    The median rotation is the rotation with the smallest sum of angles to all rotations. The median
    translation is the median of each coordinate.
    """
    rotations = np.array([rotation for rotation, _ in poses])
    angles = [Rotation.from_matrix(rotations @ r.T).magnitude().sum() for r in rotations]
    translation = np.median([translation for _, translation in poses], axis=0)
    return rotations[int(np.argmin(angles))], translation
