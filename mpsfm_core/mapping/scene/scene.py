"""The state of a reconstruction in progress: poses, points with tracks, depth maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem, PinholeCamera
from mpsfm_core.geometry import camera_center
from mpsfm_core.mapping.scene.depth_map import DepthMap
from mpsfm_core.mapping.scene.graph import CorrespondenceGraph
from mpsfm_core.mapping.scene.kernels import compute_max_triangulation_angles
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.scene.tracks import Tracks
from mpsfm_core.optimize.depth_integration import RefinedDepth


class Snapshot(NamedTuple):
    """A copy of what registering an image changes in a :class:`Scene`; opaque to others."""

    rotations: Float64
    translations: Float64
    registered: Bool
    intrinsics: Float64
    xyz: Float64
    point_of: Int64
    maps: Sequence[tuple[float, bool, RefinedDepth | None]]


class Scene:
    """Everything the mapper changes.

    ``weigh_by_score``: matches count by their scores, else all the same.

    Attributes:
        rotations: (n, 3, 3), translations: (n, 3) float64, ``cam_from_world`` of each image.
        registered: (n,) bool.
        intrinsics: (n, 4) float64, fx, fy, cx, cy of each image.
        camera_of: (n,) int64, images of the same number have the same camera: those whose focal
            length is a guess, and the same guess.
        depth_group_of: (n,) int64, images of the same number have depth in one unit: they share
            the scale of their priors.
        keypoints: (k, 2) float64, of all images, numbered as in :attr:`graph`.
        maps: the depth map of each image.
        keypoint_prior, keypoint_log_std, keypoint_valid: (k,) unscaled prior depth at the
            keypoints, std of its logarithm, and where they mean something.
    """

    def __init__(self, problem: MappingProblem, *, weigh_by_score: bool = True) -> None:
        self.problem = problem
        self.graph = CorrespondenceGraph(problem, weigh_by_score=weigh_by_score)
        count = len(problem.images)
        self.keypoints: Float64 = np.concatenate(
            [np.zeros((0, 2)), *(image.keypoints for image in problem.images)]
        )
        self.keypoint_std_px: Float64 = np.array([i.keypoint_std_px for i in problem.images])
        self.intrinsics: Float64 = np.array([image.camera.params for image in problem.images])
        self.camera_of: Int64 = _shared_cameras(problem)
        self.depth_group_of: Int64 = _depth_groups(problem)
        self.maps = [DepthMap(image) for image in problem.images]
        self.keypoint_log_std: Float64 = np.concatenate(
            [np.zeros(0), *(depth_map.keypoint_log_std for depth_map in self.maps)]
        )
        self.keypoint_prior: Float64 = np.concatenate(
            [np.zeros(0), *(depth_map.prior_at_keypoints() for depth_map in self.maps)]
        )
        self.keypoint_valid: Bool = np.concatenate(
            [np.zeros(0, np.bool_), *(depth_map.keypoint_valid for depth_map in self.maps)]
        )
        self.rotations: Float64 = np.tile(np.eye(3), (count, 1, 1))
        self.translations: Float64 = np.zeros((count, 3))
        self.registered: Bool = np.zeros(count, dtype=np.bool_)
        self.tracks = Tracks(len(self.keypoints))

    @property
    def num_images(self) -> int:
        """Number of images, registered or not."""
        return len(self.registered)

    def registered_images(self) -> Int64:
        """Registered images in ascending order."""
        return np.flatnonzero(self.registered)

    def mask(self, images: Sequence[int] | Int64) -> Bool:
        """(n,) bool, true for the images."""
        chosen = np.zeros(self.num_images, dtype=np.bool_)
        chosen[images] = True
        return chosen

    def register(self, image: int, rotation: Float64, translation: Float64) -> None:
        """Give an image a pose."""
        self.rotations[image], self.translations[image] = rotation, translation
        self.registered[image] = True

    def deregister(self, image: int) -> None:
        """Take an image out, with its observations and the points only it kept alive."""
        self.registered[image] = False
        self.maps[image].reset()
        keypoints = self.graph.keypoints_of(image)
        self.tracks.remove_observations(np.arange(keypoints.start, keypoints.stop))

    def camera(self, image: int) -> PinholeCamera:
        """Intrinsics of an image, as refined so far."""
        size = self.problem.images[image].camera.size
        return PinholeCamera(*size, *map(float, self.intrinsics[image]))

    def set_focal(self, image: int, fx: float, fy: float) -> None:
        """Change the focal length of one image, in pixels."""
        self.intrinsics[image, :2] = fx, fy
        self.maps[image].set_camera(self.camera(image))

    def set_shared_focal(self, image: int, fx: float, fy: float) -> None:
        """Change the focal length of an image and of all that have its camera."""
        same = self.camera_of == self.camera_of[image]
        for other in np.flatnonzero(same & (self.intrinsics[:, :2] != (fx, fy)).any(axis=1)):
            self.set_focal(int(other), fx, fy)

    def centers(self) -> Float64:
        """(n, 3) camera centres in the world."""
        return camera_center(self.rotations, self.translations)

    def rays(self, keypoints: Int64) -> Float64:
        """Rays with z = 1 through keypoints (m,) in their camera frames, (m, 3)."""
        fx, fy, cx, cy = self.intrinsics[self.graph.image_of[keypoints]].T
        xy = self.keypoints[keypoints]
        return np.stack([(xy[:, 0] - cx) / fx, (xy[:, 1] - cy) / fy, np.ones(len(xy))], axis=1)

    def world_rays(self, keypoints: Int64) -> Float64:
        """The same rays in the world's frame, (m, 3)."""
        rotations = self.rotations[self.graph.image_of[keypoints]]
        rays: Float64 = np.einsum("nji,nj->ni", rotations, self.rays(keypoints))
        return rays

    def depth_at(self, keypoints: Int64) -> tuple[Float64, Bool]:
        """Best depth (m,) of keypoints in their images, world units, 0 where not valid; and where
        it is."""
        images = self.graph.image_of[keypoints]
        depth = np.zeros(len(keypoints))
        for image in map(int, np.unique(images)):
            if not self.maps[image].active:
                continue
            of_image = images == image
            rows = keypoints[of_image] - self.graph.offsets[image]
            valid = self.maps[image].keypoint_valid[rows]
            depth[of_image] = np.where(valid, self.maps[image].at_keypoints(rows), 0.0)
        return np.maximum(depth, 0.0), depth > 0

    def at_depth(self, keypoints: Int64, depth: Float64) -> Float64:
        """World points (m, 3) on the rays of keypoints at a depth (m,) in their images."""
        images = self.graph.image_of[keypoints]
        camera_points = self.rays(keypoints) * depth[:, None]
        rotations, translations = self.rotations[images], self.translations[images]
        world: Float64 = np.einsum("nji,nj->ni", rotations, camera_points - translations)
        return world

    def lift(self, keypoints: Int64) -> tuple[Float64, Bool]:
        """World points (m, 3) of keypoints at the best depth of their image, and where valid."""
        depth, valid = self.depth_at(keypoints)
        return self.at_depth(keypoints, depth), valid

    def project(self, keypoints: Int64, points: Float64) -> tuple[Float64, Float64]:
        """Reproject world points (m, 3) into the images of keypoints (m,).

        Returns:
            ``(errors_px, depth)``, both (m,) float64; the error is inf behind the camera.
        """
        images = self.graph.image_of[keypoints]
        camera = np.einsum("nij,nj->ni", self.rotations[images], points)
        camera += self.translations[images]
        fx, fy, cx, cy = self.intrinsics[images].T
        front = camera[:, 2] > 1e-9
        z = np.where(front, camera[:, 2], 1.0)
        dx = fx * camera[:, 0] / z + cx - self.keypoints[keypoints, 0]
        dy = fy * camera[:, 1] / z + cy - self.keypoints[keypoints, 1]
        return np.where(front, np.hypot(dx, dy), np.inf), camera[:, 2]

    def scales(self) -> Float64:
        """(n,) of the priors, 1 where not set yet."""
        return np.array([depth_map.scale for depth_map in self.maps])

    def explained_edges(self) -> Bool:
        """(e,) bool, edges of the graph whose two keypoints see the same point."""
        points = self.tracks.point_of[self.graph.source]
        same: Bool = (points >= 0) & (points == self.tracks.point_of[self.graph.target])
        return same

    def track_angles_deg(self) -> Float64:
        """(p,) largest triangulation angle of each point of the tracks, degrees."""
        observations = self.tracks.observations()
        centers = self.centers()[self.graph.image_of[observations]]
        angles: Float64 = compute_max_triangulation_angles(
            self.tracks.xyz, self.tracks.point_of[observations], centers
        )
        return angles

    def angles_deg_of(self, points: Int64) -> tuple[Float64, Int64]:
        """Largest triangulation angle of some points (m,), each once, in degrees; track lengths."""
        keypoints, rows = self.tracks.observations_of(points)
        centers = self.centers()[self.graph.image_of[keypoints]]
        angles: Float64 = compute_max_triangulation_angles(self.tracks.xyz[points], rows, centers)
        return angles, np.bincount(rows, minlength=len(points)).astype(np.int64)

    def resume(self, reconstruction: Reconstruction) -> None:
        """Start from a finished reconstruction: its poses, focal lengths, scales and points."""
        self.tracks.xyz = reconstruction.points.copy()
        for image in reconstruction.images:
            self.register(image.index, image.rotation, image.translation)
            self.maps[image.index].set_scale(image.scale)
            self.tracks.point_of[self.graph.keypoints_of(image.index)] = image.point_ids
            self.set_shared_focal(image.index, image.camera.fx, image.camera.fy)

    def snapshot(self) -> Snapshot:
        """What :meth:`restore` needs to undo everything that happens from now on."""
        maps = [(m.scale, m.active, m.refined) for m in self.maps]
        return Snapshot(
            self.rotations.copy(),
            self.translations.copy(),
            self.registered.copy(),
            self.intrinsics.copy(),
            self.tracks.xyz.copy(),
            self.tracks.point_of.copy(),
            maps,
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Return to an earlier state."""
        self.rotations = snapshot.rotations.copy()
        self.translations = snapshot.translations.copy()
        self.registered = snapshot.registered.copy()
        for image in np.flatnonzero((self.intrinsics != snapshot.intrinsics).any(axis=1)):
            self.set_focal(int(image), *map(float, snapshot.intrinsics[image, :2]))
        self.tracks.xyz = snapshot.xyz.copy()
        self.tracks.point_of = snapshot.point_of.copy()
        for depth_map, (scale, active, refined) in zip(self.maps, snapshot.maps, strict=True):
            same = (depth_map.scale, depth_map.active) == (scale, active)
            if not same or depth_map.refined is not refined:
                depth_map.reset()
                if refined is not None:
                    depth_map.set_refined(refined)
                if active:
                    depth_map.set_scale(scale)


def _depth_groups(problem: MappingProblem) -> Int64:
    alone = len(problem.images)
    numbers: dict[int, int] = {}
    keys = [
        alone + number if image.depth_group is None else image.depth_group
        for number, image in enumerate(problem.images)
    ]
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)


def _shared_cameras(problem: MappingProblem) -> Int64:
    numbers: dict[object, int] = {}
    keys = [
        number if image.focal_known else image.camera for number, image in enumerate(problem.images)
    ]
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)
