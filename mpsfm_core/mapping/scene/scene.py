"""Scene of the mapper with poses, points, tracks and depth maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64, MappingProblem, PinholeCamera
from mpsfm_core.data.camera_models import IntrinsicParameter
from mpsfm_core.geometry import camera_center
from mpsfm_core.geometry.distortion import distort_rays, undistort_rays
from mpsfm_core.mapping.scene.depth_map import DepthMap, DepthRefinement
from mpsfm_core.mapping.scene.estimated_intrinsics import EstimatedIntrinsics
from mpsfm_core.mapping.scene.graph import CorrespondenceGraph
from mpsfm_core.mapping.scene.kernels import (
    compute_max_triangulation_angles,
    project_to_keypoints,
)
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.scene.rig_frames import RigFrames
from mpsfm_core.mapping.scene.tracks import Tracks
from mpsfm_core.mapping.state import StateDict
from mpsfm_core.optimize.depth_integration import RefinedDepth
from mpsfm_core.support.threads import parallel_map


class Snapshot(NamedTuple):
    """Copy of the state of a :class:`Scene`, for a rollback."""

    rotations: Float64
    translations: Float64
    registered: Bool
    intrinsics: Float64
    xyz: Float64
    point_of: Int64
    maps: Sequence[tuple[float, bool, DepthRefinement | None]]
    distortion: Float64
    estimated_intrinsics: StateDict
    rigs: StateDict


class Scene:
    """Poses, tracks, depth maps and intrinsics of all images, registered or not.

    Args:
        problem: Images with depth and normal priors, and geometrically verified matches.
        weigh_by_score: True weights matches by their scores, False weights all matches equally.

    Attributes:
        graph: Correspondence graph, whose global keypoint numbers index all keypoint arrays.
        tracks: 3D points and the keypoints that observe them.
        rigs: Frames of the rigs. All images of a frame are registered together.
        rotations: (n, 3, 3) float64 rotation of ``cam_from_world`` of each image.
        translations: (n, 3) float64 translation of ``cam_from_world`` of each image.
        registered: (n,) bool mask of the registered images.
        intrinsics: (n, 4) float64 intrinsics fx, fy, cx, cy of each image in pixels.
        distortion: (n, 4) float64 distortion coefficients k1, k2, p1, p2 of OPENCV of each image,
            or k1, k2, k3, k4 of OPENCV_FISHEYE.
        fisheye: (n,) bool mask of the images with the camera model OPENCV_FISHEYE.
        camera_of: (n,) int64 camera index of each image. Images with the same camera index share
            estimated intrinsics.
        estimated_intrinsics: Estimates of self-calibration for the camera of each image.
        depth_group_of: (n,) int64 depth group of each image. The depth priors of a group have the
            same unit and share their scale.
        distorted_keypoints: (k, 2) float64 keypoints of all images in pixels, with the radial
            distortion of the lens.
        keypoints: (k, 2) float64 keypoints of all images in pixels, without radial distortion.
        image_sizes: (n, 2) float64 width and height of each image in pixels.
        keypoint_std_px: (n,) float64 standard deviation of the keypoint positions of each image, in
            pixels.
        maps: Depth map of each image.
        keypoint_prior: (k,) float64 unscaled prior depth at the keypoints.
        keypoint_log_std: (k,) float64 standard deviation of the log prior depth at the keypoints.
        keypoint_valid: (k,) bool mask of the keypoints at which the depth prior is valid.
    """

    def __init__(self, problem: MappingProblem, *, weigh_by_score: bool = True) -> None:
        self.problem = problem
        self.graph = CorrespondenceGraph(problem, weigh_by_score=weigh_by_score)
        count = len(problem.images)
        self.keypoints: Float64 = np.concatenate(
            [np.zeros((0, 2)), *(image.keypoints for image in problem.images)]
        )
        self.distorted_keypoints: Float64 = self.keypoints.copy()
        self.image_sizes: Float64 = np.array(
            [image.camera.size for image in problem.images], dtype=np.float64
        ).reshape(-1, 2)
        self.keypoint_std_px: Float64 = np.array([i.keypoint_std_px for i in problem.images])
        self.intrinsics: Float64 = np.array([image.camera.params for image in problem.images])
        self.distortion: Float64 = np.array([image.distortion for image in problem.images])
        self.fisheye: Bool = np.array([i.camera_model.is_fisheye for i in problem.images], np.bool_)
        self.camera_of: Int64 = _shared_cameras(problem)
        self.depth_group_of: Int64 = _depth_groups(problem)
        self.rigs = RigFrames(problem)
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
        self.estimated_intrinsics = EstimatedIntrinsics(count)
        self._distort_keypoints()
        for index, image in enumerate(problem.images):
            if image.initial_distortion is not None:
                distortion = np.array(image.initial_distortion)
                self.set_intrinsics(index, self.intrinsics[index].copy(), distortion)
        self.tracks = Tracks(len(self.keypoints))

    @property
    def num_images(self) -> int:
        """Number of all images, registered or not."""
        return len(self.registered)

    def registered_images(self) -> Int64:
        """Return the registered images in ascending order."""
        return np.flatnonzero(self.registered)

    def mask(self, images: Sequence[int] | Int64) -> Bool:
        """Return a bool mask (n,) of the given images among all images."""
        chosen = np.zeros(self.num_images, dtype=np.bool_)
        chosen[images] = True
        return chosen

    def register(
        self,
        image: int,
        rotation: Float64,
        translation: Float64,
        focal_px: float | None = None,
    ) -> None:
        """Register an image, and the other images of its frame, with a pose ``cam_from_world``.

        Args:
            image: The image.
            rotation: (3, 3) rotation.
            translation: (3,) translation.
            focal_px: Focal length ``fx`` that was estimated with the pose, or None to keep the
                present focal length.
        """
        if focal_px is not None:
            intrinsics = self.intrinsics_with_focal(image, focal_px)
            self.set_shared_intrinsics(image, intrinsics, self.distortion[image])
        self.rotations[image], self.translations[image] = rotation, translation
        self.registered[image] = True
        for other in self.rigs.images_of(image)[1:]:
            pose = self.rigs.derive_pose(image, (rotation, translation), other)
            self.rotations[other], self.translations[other] = pose
            self.registered[other] = True

    def deregister(self, image: int) -> None:
        """Deregister the images of a frame, with their observations and points without a track."""
        for member in self.rigs.images_of(image):
            self.registered[member] = False
            self.maps[member].reset()
            keypoints = self.graph.keypoints_of(member)
            self.tracks.remove_observations(np.arange(keypoints.start, keypoints.stop))

    def set_rig_scale(self, scale: float, std: float = np.inf) -> None:
        """Set the world units per meter of rigs, and move registered images to fit the rigs.

        The first image of a frame keeps its pose.

        Args:
            scale: World units per meter.
            std: Standard deviation of the scale.
        """
        self.rigs.scale, self.rigs.scale_std = scale, std
        for image in map(int, np.flatnonzero(self.registered & self.rigs.is_first)):
            self.register(image, self.rotations[image].copy(), self.translations[image].copy())

    def camera(self, image: int) -> PinholeCamera:
        """Return the current intrinsics of an image."""
        size = self.problem.images[image].camera.size
        return PinholeCamera(*size, *map(float, self.intrinsics[image]))

    def intrinsics_with_focal(self, image: int, focal_px: float | None) -> Float64:
        """Return fx, fy, cx, cy of an image, with another ``fx`` and the same aspect ratio.

        Args:
            image: The image.
            focal_px: Focal length ``fx`` in pixels, or None to keep the present focal length.
        """
        intrinsics: Float64 = self.intrinsics[image].copy()
        if focal_px is not None:
            intrinsics[:2] *= focal_px / intrinsics[0]
        return intrinsics

    def has_free_focal(self, image: int) -> bool:
        """Return whether the focal length is a guess and no registered image shares the camera."""
        is_guess = not self.problem.images[image].focal_known
        return is_guess and not bool((self.shares_camera(image) & self.registered).any())

    def has_determined_focal(self, images: Int64) -> Bool:
        """Return a bool mask (m,) of the images whose focal length is known or refined."""
        known = np.array([image.focal_known for image in self.problem.images], dtype=np.bool_)
        refined = self.estimated_intrinsics.is_refined(IntrinsicParameter.FOCAL_LENGTH)
        determined: Bool = (known | refined)[images]
        return determined

    def set_intrinsics(self, image: int, intrinsics: Float64, distortion: Float64) -> None:
        """Set intrinsics and distortion of one image, and undistort its keypoints.

        Args:
            image: The image.
            intrinsics: (4,) camera parameters fx, fy, cx, cy in pixels.
            distortion: (4,) distortion coefficients.
        """
        self.intrinsics[image], self.distortion[image] = intrinsics, distortion
        self.maps[image].set_camera(self.camera(image))
        rows = self.graph.keypoints_of(image)
        given = self.problem.images[image]
        focal_px, center = self.intrinsics[image, :2], self.intrinsics[image, 2:]
        # copy the keypoints of the problem exactly, because a resumed mapper starts from them
        is_given = (self.intrinsics[image] == given.camera.params).all()
        fisheye = bool(self.fisheye[image])
        if is_given and (distortion == given.distortion).all():
            self.keypoints[rows] = given.keypoints
        elif not fisheye and not np.any(distortion):
            self.keypoints[rows] = self.distorted_keypoints[rows]
        else:
            distorted = (self.distorted_keypoints[rows] - center) / focal_px
            rays = undistort_rays(distorted, distortion.tolist(), fisheye=fisheye)
            self.keypoints[rows] = center + focal_px * rays

    def set_shared_intrinsics(self, image: int, intrinsics: Float64, distortion: Float64) -> None:
        """Set intrinsics and distortion of all images that share the camera of an image.

        Args:
            image: Index of an image that was taken by the camera.
            intrinsics: (4,) camera parameters fx, fy, cx, cy in pixels.
            distortion: (4,) distortion coefficients.
        """
        shared = self.shares_camera(image)[:, None]
        self._change_intrinsics(
            np.where(shared, intrinsics, self.intrinsics),
            np.where(shared, distortion, self.distortion),
        )

    def _change_intrinsics(self, intrinsics: Float64, distortion: Float64) -> None:
        """Set the intrinsics and distortion (n, 4) of all images in which they differ."""
        changed = (self.intrinsics != intrinsics).any(axis=1)
        changed |= (self.distortion != distortion).any(axis=1)
        for image in map(int, np.flatnonzero(changed)):
            self.set_intrinsics(image, intrinsics[image], distortion[image])

    def shares_camera(self, image: int) -> Bool:
        """Return a bool mask (n,) of the images that share the camera of an image."""
        shared: Bool = self.camera_of == self.camera_of[image]
        return shared

    def centers(self) -> Float64:
        """Return the camera centers (n, 3) in world coordinates."""
        return camera_center(self.rotations, self.translations)

    def rays(self, keypoints: Int64) -> Float64:
        """Return the rays (m, 3) with z = 1 through keypoints (m,), in their camera frames."""
        fx, fy, cx, cy = self.intrinsics[self.graph.image_of[keypoints]].T
        xy = self.keypoints[keypoints]
        return np.stack([(xy[:, 0] - cx) / fx, (xy[:, 1] - cy) / fy, np.ones(len(xy))], axis=1)

    def world_rays(self, keypoints: Int64) -> Float64:
        """Return the rays (m, 3) through keypoints (m,) in the world frame."""
        rotations = self.rotations[self.graph.image_of[keypoints]]
        rays: Float64 = np.einsum("nji,nj->ni", rotations, self.rays(keypoints))
        return rays

    def depth_at(self, keypoints: Int64) -> tuple[Float64, Bool]:
        """Return the depth of keypoints (m,) in world units.

        Returns:
            Depth (m,), 0 where invalid, and a mask (m,) of the valid depths.
        """
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
        """Return the world points (m, 3) of keypoints (m,) at given depths (m,)."""
        images = self.graph.image_of[keypoints]
        camera_points = self.rays(keypoints) * depth[:, None]
        rotations, translations = self.rotations[images], self.translations[images]
        world: Float64 = np.einsum("nji,nj->ni", rotations, camera_points - translations)
        return world

    def lift(self, keypoints: Int64) -> tuple[Float64, Bool]:
        """Lift keypoints (m,) to world points (m, 3) by their scaled depth priors.

        Bundle adjustment moves the points to the depth that all observations support.

        Returns:
            World points (m, 3), and a mask (m,) of the points with known depth.
        """
        images, rows = np.unique(self.graph.image_of[keypoints], return_inverse=True)
        maps = [self.maps[image] for image in images.tolist()]
        is_active = np.array([depth_map.active for depth_map in maps], dtype=np.bool_)[rows]
        scales = np.array([depth_map.scale for depth_map in maps])[rows]
        depth = self.keypoint_prior[keypoints] * scales
        valid = self.keypoint_valid[keypoints] & is_active & (depth > 0)
        return self.at_depth(keypoints, np.where(valid, depth, 0.0)), valid

    def project(self, keypoints: Int64, points: Float64) -> tuple[Float64, Float64]:
        """Project world points (m, 3) into the images of keypoints (m,).

        Returns:
            Reprojection errors (m,) in pixels, inf behind the camera, and depth (m,) of the points.
        """
        errors_px, depth = project_to_keypoints(
            np.ascontiguousarray(points),
            keypoints,
            self.keypoints,
            self.graph.image_of,
            self.rotations,
            self.translations,
            self.intrinsics,
        )
        return errors_px, depth

    def scales(self) -> Float64:
        """Return the scales (n,) of the depth priors of all images, 1 without an estimate."""
        return np.array([depth_map.scale for depth_map in self.maps])

    def explained_edges(self) -> Bool:
        """Return a bool mask (e,) of the matches whose keypoints observe the same 3D point."""
        points = self.tracks.point_of[self.graph.source]
        same: Bool = (points >= 0) & (points == self.tracks.point_of[self.graph.target])
        return same

    def track_angles_deg(self) -> Float64:
        """Return the largest triangulation angle (p,) in degrees of each point's track."""
        observations = self.tracks.observations()
        centers = self.centers()[self.graph.image_of[observations]]
        angles: Float64 = compute_max_triangulation_angles(
            self.tracks.xyz, self.tracks.point_of[observations], centers
        )
        return angles

    def points_of(self, images: Sequence[int] | Int64) -> Int64:
        """Return the points (m,) that given images observe, in ascending order."""
        is_observed = np.zeros(len(self.tracks.xyz) + 1, dtype=np.bool_)
        for image in images:
            is_observed[self.tracks.point_of[self.graph.keypoints_of(image)]] = True
        return np.flatnonzero(is_observed[:-1])  # the last entry is that of NO_POINT = -1

    def angles_deg_of(
        self, points: Int64, observations: tuple[Int64, Int64] | None = None
    ) -> tuple[Float64, Int64]:
        """Return triangulation angles in degrees and track lengths of distinct points (m,).

        Args:
            points: Rows of the points in the tracks.
            observations: Result of :meth:`Tracks.observations_of` for the points, or None to
                compute it.
        """
        keypoints, rows = observations or self.tracks.observations_of(points)
        centers = self.centers()[self.graph.image_of[keypoints]]
        angles: Float64 = compute_max_triangulation_angles(self.tracks.xyz[points], rows, centers)
        return angles, np.bincount(rows, minlength=len(points)).astype(np.int64)

    def resume(
        self, reconstruction: Reconstruction, *, refined_map_width: int | None = None
    ) -> None:
        """Load poses, focal lengths, scales and points of a reconstruction.

        Args:
            reconstruction: The reconstruction.
            refined_map_width: Width to which refined depth maps are subsampled, or None to start
                from the scaled depth priors.
        """
        self.tracks.xyz = reconstruction.points.copy()
        rows = np.array([image.index for image in reconstruction.images], dtype=np.int64)
        translations = np.array([image.translation for image in reconstruction.images])
        self.rigs.resume(reconstruction.rigs)
        self.rigs.scale = self.rigs.measure_scale(rows, translations) or 1.0
        for image in reconstruction.images:
            self.register(image.index, image.rotation, image.translation)
            self.maps[image.index].set_scale(image.scale)
            if refined_map_width is not None:
                self.maps[image.index].resume(image.depth, image.scale, refined_map_width)
            self.tracks.point_of[self.graph.keypoints_of(image.index)] = image.point_ids
            for parameter, calibrated in image.calibration.items():
                if calibrated.is_refined:
                    self.estimated_intrinsics.set(
                        self.shares_camera(image.index), parameter, calibrated.estimate
                    )
        self._resume_intrinsics(reconstruction)

    def _resume_intrinsics(self, reconstruction: Reconstruction) -> None:
        """Set the intrinsics of the images of a reconstruction, and of images that share a camera.

        Images of one camera have different intrinsics in the reconstruction if the mapper split
        the camera, or if each part of the images has its own estimate.
        """
        by_camera = {int(self.camera_of[image.index]): image for image in reconstruction.images}
        for image in by_camera.values():
            self.set_shared_intrinsics(image.index, image.camera.params, image.distortion)
        intrinsics, distortion = self.intrinsics.copy(), self.distortion.copy()
        for image in reconstruction.images:
            intrinsics[image.index] = image.camera.params
            distortion[image.index] = image.distortion
        self._change_intrinsics(intrinsics, distortion)

    def _distort_keypoints(self) -> None:
        """Distort the keypoints by the distortion that was removed from them."""
        for image in map(int, np.flatnonzero(self.distortion.any(axis=1) | self.fisheye)):
            rows = self.graph.keypoints_of(image)
            focal_px, center = self.intrinsics[image, :2], self.intrinsics[image, 2:]
            rays = (self.keypoints[rows] - center) / focal_px
            distortion, fisheye = self.distortion[image].tolist(), bool(self.fisheye[image])
            distorted = distort_rays(rays, distortion, fisheye=fisheye)
            self.distorted_keypoints[rows] = center + focal_px * distorted

    def snapshot(self) -> Snapshot:
        """Return a copy of the scene's state for :meth:`restore`."""
        maps = [(m.scale, m.active, m.refinement) for m in self.maps]
        return Snapshot(
            self.rotations.copy(),
            self.translations.copy(),
            self.registered.copy(),
            self.intrinsics.copy(),
            self.tracks.xyz.copy(),
            self.tracks.point_of.copy(),
            maps,
            self.distortion.copy(),
            self.estimated_intrinsics.state_dict(),
            self.rigs.state_dict(),
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Roll back the scene to the state of an earlier snapshot."""
        self.rotations = snapshot.rotations.copy()
        self.translations = snapshot.translations.copy()
        self.registered = snapshot.registered.copy()
        self.rigs.load_state_dict(snapshot.rigs)
        self._change_intrinsics(snapshot.intrinsics, snapshot.distortion)
        self.estimated_intrinsics.load_state_dict(snapshot.estimated_intrinsics)
        self.tracks.xyz = snapshot.xyz.copy()
        self.tracks.point_of = snapshot.point_of.copy()
        for depth_map, (scale, active, refinement) in zip(self.maps, snapshot.maps, strict=True):
            is_same = (depth_map.scale, depth_map.active) == (scale, active)
            if not is_same or depth_map.refinement is not refinement:
                depth_map.reset()
                if refinement is not None:
                    depth_map.set_refinement(refinement)
                if active:
                    depth_map.set_scale(scale)

    def state_dict(self) -> StateDict:
        """Return the state of the scene for a checkpoint; pending depth maps are refined."""

        def describe(depth_map: DepthMap) -> StateDict:
            refined = depth_map.refinement and {**vars(depth_map.refinement.result)}
            return {"scale": depth_map.scale, "active": depth_map.active, "refined": refined}

        maps = parallel_map(describe, self.maps)
        return {**self.snapshot()._asdict(), "maps": maps}

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the state of the scene from a checkpoint of the same mapping problem."""
        maps = [
            (
                m["scale"],
                m["active"],
                m["refined"] and DepthRefinement.from_result(RefinedDepth(**m["refined"])),
            )
            for m in state["maps"]
        ]
        self.restore(Snapshot(**{**state, "maps": maps}))


def _depth_groups(problem: MappingProblem) -> Int64:
    """Assign a depth group to each image, where an image without a group gets its own."""
    first_single = len(problem.images)
    numbers: dict[int, int] = {}
    keys = [
        first_single + number if image.depth_group is None else image.depth_group
        for number, image in enumerate(problem.images)
    ]
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)


def _shared_cameras(problem: MappingProblem) -> Int64:
    """Assign a camera index to each image, equal for images that share estimated intrinsics."""
    numbers: dict[object, int] = {}
    keys = [
        number if image.focal_known else image.shared_camera
        for number, image in enumerate(problem.images)
    ]
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)
