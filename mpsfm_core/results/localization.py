"""Write poses of localized photos as text, COLMAP models and ``localization.json``."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from mpsfm_core.data import Float64, Pose
from mpsfm_core.data.decisions import DoubtReason, Reason
from mpsfm_core.data.result_layout import FRAME_TABLE, TRAJECTORY
from mpsfm_core.results.colmap_model import write_model
from mpsfm_core.results.trajectory import TrajectoryFrame, write_trajectory
from mpsfm_core.support.format_versions import VERSION

FORMAT = 1
"""Format version of the file ``localization.json``."""
POSES = "poses.txt"
"""Poses of localized images in the format of hloc, one line ``NAME qw qx qy qz tx ty tz`` each."""
REPORT = "localization.json"
"""Poses with covariance and inliers of localized images, and reasons of the other images."""
MODEL = "sparse"
"""COLMAP model of the localized images."""
EXTENDED = "extended"
"""COLMAP model in which the images were localized, with the localized images."""
ENTRIES = (POSES, REPORT, MODEL, EXTENDED, TRAJECTORY, FRAME_TABLE)
"""All files and folders that localization writes."""
MAX_DISTANCE_PX = 2.0
"""Largest distance between a matched keypoint and a keypoint of the model that observes a 3D point,
so that the localized image observes this point. [hloc match_dense max_error]"""
MAX_ERROR_PX = 4.0
"""Largest reprojection error of a point of the model in a localized image.
[COLMAP filter_max_reproj_error]"""


@dataclass(frozen=True, eq=False)
class LocalizedPhoto:
    """Pose of a photo in a model, with its covariance and its matches."""

    name: str
    """Path of the photo below its folder, with forward slashes."""
    pose: Pose
    """Pose ``cam_from_world`` as rotation (3, 3) and translation (3,), in units of the model."""
    covariance: Float64
    """(6, 6) covariance of ``w`` and ``dt`` in ``R <- exp(w) R, t <- t + dt``, in radians and units
    of the model."""
    camera: pycolmap.Camera
    """Camera of the upright original photo, with the estimated focal length."""
    num_inliers: int
    """Number of keypoints that observe a 3D point, triangulated or lifted from depth."""
    num_matches: int
    """Number of keypoints that match an image of the model."""
    matches: Mapping[str, tuple[Float64, Float64]] = field(repr=False)
    """Keypoints of the photo and of an image of the model that observe the same point, each (m, 2)
    in pixels of the original images, by name of the image of the model."""
    doubts: tuple[Reason, ...] = ()
    """Reasons (``DoubtReason``) to doubt the pose."""

    @property
    def center(self) -> Float64:
        """(3,) camera center in the world frame of the model."""
        center: Float64 = -self.pose[0].T @ self.pose[1]
        return center

    @property
    def center_covariance(self) -> Float64:
        """(3, 3) covariance of the camera center, in squared units of the model."""
        rotation, (x, y, z) = self.pose[0], self.pose[1]
        moving = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        jacobian = -rotation.T @ np.hstack([moving, np.eye(3)])
        covariance: Float64 = jacobian @ self.covariance @ jacobian.T
        return covariance

    @property
    def quaternion(self) -> Float64:
        """(4,) unit quaternion w, x, y, z of the rotation of the pose."""
        x, y, z, w = pycolmap.Rotation3d(self.pose[0]).quat
        return np.array([w, x, y, z])

    def describe(self) -> dict[str, Any]:
        """Describe the photo for ``localization.json``."""
        return {
            "quaternion_wxyz": self.quaternion.tolist(),
            "translation": self.pose[1].tolist(),
            "center": self.center.tolist(),
            "covariance": self.covariance.tolist(),
            "center_std": np.sqrt(np.diag(self.center_covariance)).tolist(),
            "num_inliers": self.num_inliers,
            "num_matches": self.num_matches,
            "camera": {
                "model": self.camera.model_name,
                "width": self.camera.width,
                "height": self.camera.height,
                "params": self.camera.params.tolist(),
            },
            "references": {name: len(rows[0]) for name, rows in self.matches.items()},
            "doubts": [doubt.to_json() for doubt in self.doubts],
        }


def find_pose_doubts(
    images: Collection[str], contradiction: tuple[str, float] | None = None, *, focal_known: bool
) -> tuple[Reason, ...]:
    """Return the reasons (``DoubtReason``) to doubt the pose of a localized photo.

    Args:
        images: Images of the model that observe the same points as the photo.
        contradiction: Image of the model whose depth contradicts the photo, and the ratio of the
            contradicting pixels.
        focal_known: True if the focal length of the photo was given.
    """
    doubts = []
    if not focal_known and len(images) == 1:
        doubts.append(DoubtReason.FOCAL_LENGTH_FROM_ONE_IMAGE.because(image=next(iter(images))))
    if contradiction is not None:
        other, ratio = contradiction
        reason = DoubtReason.DEPTH_CONTRADICTS_MODEL
        doubts.append(reason.because(violation_ratio=ratio, other_image=other))
    return tuple(doubts)


def write_localization(
    folder: Path,
    photos: Mapping[str, LocalizedPhoto],
    reasons: Mapping[str, Mapping[str, Any]],
    extended: pycolmap.Reconstruction | None,
    frames: Sequence[TrajectoryFrame] = (),
) -> None:
    """Write poses, COLMAP models and report of localized photos into a folder.

    Args:
        folder: The folder.
        photos: Localized photos by name.
        reasons: Code, fields and text of the reason why a photo has no pose, by name.
        extended: Model with the localized photos, or None to write no such model.
        frames: Frames of the video whose keyframes are the photos, empty without a video.
    """
    rows = [
        " ".join([name, *map(repr, [*photo.quaternion.tolist(), *photo.pose[1].tolist()])])
        for name, photo in photos.items()
    ]
    (folder / POSES).write_text("".join(f"{row}\n" for row in rows), encoding="utf-8")
    report = {
        VERSION: FORMAT,
        "localized": {name: photo.describe() for name, photo in photos.items()},
        "unlocalized": dict(reasons),
    }
    (folder / REPORT).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    write_model(folder / MODEL, extend_model(pycolmap.Reconstruction(), photos))
    if extended is not None:
        write_model(folder / EXTENDED, extended)
    if frames:
        write_trajectory(folder, frames)


def extend_model(
    model: pycolmap.Reconstruction, photos: Mapping[str, LocalizedPhoto]
) -> pycolmap.Reconstruction:
    """Copy a COLMAP model and add localized photos, which observe points of the model.

    A photo observes a point of the model if a matched keypoint of an image of the model is within
    :data:`MAX_DISTANCE_PX` of a keypoint that observes the point.

    Args:
        model: The COLMAP model.
        photos: Localized photos, whose names are not in the model.
    """
    extended = pycolmap.Reconstruction(model)
    by_name = {str(image.name): image.image_id for image in extended.images.values()}
    trees = {name: _observed_keypoints(model.images[number]) for name, number in by_name.items()}
    for photo in photos.values():
        camera = pycolmap.Camera(
            {**photo.camera.todict(), "camera_id": max(extended.cameras, default=0) + 1}
        )
        extended.add_camera_with_trivial_rig(camera)
        observed = _find_observations(model, photo, trees)
        xy = np.array([point for point, _ in observed], dtype=np.float64).reshape(-1, 2)
        number = max(extended.images, default=0) + 1
        extended.add_image_with_trivial_frame(
            pycolmap.Image(
                name=photo.name, keypoints=xy, camera_id=camera.camera_id, image_id=number
            ),
            pycolmap.Rigid3d(np.column_stack(photo.pose)),
        )
        for row, (_, point) in enumerate(observed):
            extended.add_observation(point, pycolmap.TrackElement(number, row))
    extended.update_point_3d_errors()
    return extended


def _observed_keypoints(image: pycolmap.Image) -> tuple[cKDTree, list[int]] | None:
    """Return the keypoints of an image that observe points, and the ids of these points."""
    observed = [point for point in image.points2D if point.has_point3D()]
    if not observed:
        return None
    return cKDTree([point.xy for point in observed]), [point.point3D_id for point in observed]


def _find_observations(
    model: pycolmap.Reconstruction,
    photo: LocalizedPhoto,
    trees: Mapping[str, tuple[cKDTree, list[int]] | None],
) -> list[tuple[Float64, int]]:
    """Return keypoints of a photo with the ids of the points of the model that they observe."""
    nearest: dict[int, tuple[float, Float64]] = {}
    for name, (xy, other_xy) in photo.matches.items():
        tree = trees.get(name)
        if tree is None:
            continue
        distances, rows = tree[0].query(other_xy, distance_upper_bound=MAX_DISTANCE_PX)
        for point_xy, distance, row in zip(xy, distances, rows, strict=True):
            if not np.isfinite(distance):
                continue
            point = tree[1][row]
            if point not in nearest or distance < nearest[point][0]:
                nearest[point] = float(distance), point_xy
    observations = []
    for point, (_, xy) in sorted(nearest.items()):
        camera_point = photo.pose[0] @ model.points3D[point].xyz + photo.pose[1]
        projected = photo.camera.img_from_cam(camera_point) if camera_point[2] > 0 else None
        if projected is not None and np.hypot(*(projected - xy)) <= MAX_ERROR_PX:
            observations.append((xy, point))
    return observations
