"""Local and global refinement by bundle adjustment and depth integration (paper 3.3).

The paper alternates bundle adjustment and depth integration. A depth map that was refined with
points agrees with these points, and keeps the points from moving in the next bundle adjustment.
Therefore bundle adjustment uses the scaled depth priors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from mpsfm_core.data import Bool, DepthPrior, Float64, Int64, NormalPrior, PinholeCamera
from mpsfm_core.data.camera_models import IntrinsicParameter
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.depth_noise import (
    DepthNoise,
    measure_depth_noise,
    measure_outlier_ratio,
)
from mpsfm_core.mapping.refinement.filtering import filter_points
from mpsfm_core.mapping.refinement.keypoint_noise import measure_loss_scale
from mpsfm_core.mapping.refinement.self_calibration import (
    calibrate_cameras,
    compute_intrinsic_priors,
    mask_guessed_focals,
)
from mpsfm_core.mapping.scene.depth_map import DepthRefinement
from mpsfm_core.mapping.scene.estimated_intrinsics import (
    MIN_FOCAL_IMAGES,
    PredictedErrors,
)
from mpsfm_core.mapping.scene.local_bundle import find_local_bundle
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.state import StateDict
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks, lift_low_parallax
from mpsfm_core.optimize.bundle_adjustment import BundleProblem, BundleResult, adjust_bundle
from mpsfm_core.optimize.calibration_errors import predict_calibration_errors
from mpsfm_core.optimize.covariance import (
    CalibrationStd,
    compute_point_covariances,
    compute_pose_covariance,
    propagate_depth_variance,
)
from mpsfm_core.optimize.depth_integration import Anchors, DepthIntegrator, RefinedDepth
from mpsfm_core.optimize.options import (
    SOFT_L1_OPTIONS,
    BundleOptions,
    IntegrationOptions,
    Loss,
)
from mpsfm_core.optimize.subsampling import (
    compute_subsampling_step,
    subsample_camera,
    subsample_pixels,
    subsample_prior,
)
from mpsfm_core.support.lru_cache import LruCache

MAX_LOCAL_TRACK_LENGTH = 15
"""Track length above which a point stays fixed in local bundle adjustment.
[COLMAP max_num_observations]"""
MAX_LOCAL_REFINEMENTS = 2
"""Maximum number of iterations of local refinement. [COLMAP ba_local_max_refinements]"""
MAX_LOCAL_CHANGE = 0.001
"""Share of changed observations below which local refinement stops.
[COLMAP ba_local_max_refinement_change]"""
MAX_GLOBAL_REFINEMENTS = 5
"""Maximum number of iterations of global refinement. [COLMAP ba_global_max_refinements]"""
MAX_GLOBAL_CHANGE = 0.0005
"""Share of changed observations below which global refinement stops.
[COLMAP ba_global_max_refinement_change]"""
ROUGH_TOLERANCE = 1e-4
"""Relative decrease of the cost at which a rough bundle adjustment stops, with more images than
``BundleOptions.dense_poses``. [tuned: benchmarks.walks]"""
MAX_DEPTH_RATIO = 1.5
"""Largest ratio between the depth of a point and the depth map for which bundle adjustment uses the
depth. [reference scale_filter]"""
MIN_ANCHOR_ANGLE_DEG = 2.0
"""Smallest triangulation angle of a point that constrains depth integration.
[reference robust_triangles]"""
MAX_NOISE_CHANGE = 1.25
"""Factor by which the measured depth noise must change before depth integration is set up again.
[ours]"""
MIN_SCALE_POINTS = 20
"""Smallest number of well triangulated points for which the depth scale shared by several images is
estimated again. [ours]"""

CACHED_BYTES = 1 << 26
"""Size limit of the cached depth integrators of all images, bytes. [ours]"""
MEDIAN_ERROR = float(np.sqrt(2 * np.log(2)))
"""Median length of a vector of two standard normal variables, such as a reprojection error."""
_OBSERVATION_FIELDS = (
    "obs_image",
    "obs_point",
    "obs_xy",
    "obs_std_px",
    "obs_log_depth",
    "obs_std_log_depth",
)


@dataclass(frozen=True, eq=False)
class _CachedIntegrator:
    """Depth integrator of an image, which is created when used and may be evicted from a cache."""

    cache: LruCache[tuple[int, PinholeCamera], DepthIntegrator]
    image: int
    prior: DepthPrior
    normals: NormalPrior
    camera: PinholeCamera
    """Camera of the subsampled depth map."""
    step: int
    """Subsampling step of the depth map."""
    std_factor: float
    """Factor on the declared standard deviation of the depth prior."""
    options: IntegrationOptions

    def refine(self, anchors: Anchors, *, scale: float, start: RefinedDepth | None) -> RefinedDepth:
        """Refine the depth map, see :meth:`DepthIntegrator.refine`."""
        integrator = self.cache.get((self.image, self.camera), self._create)
        return integrator.refine(anchors, scale=scale, start=start)

    def _create(self) -> DepthIntegrator:
        prior = subsample_prior(self.prior, self.step)
        assert prior.variance is not None  # MappingImage checks it
        variance = prior.variance * np.float32(self.std_factor**2)
        normals = subsample_prior(self.normals, self.step)
        return DepthIntegrator(
            replace(prior, variance=variance), normals, self.camera, self.options
        )


def _create_cache() -> LruCache[tuple[int, PinholeCamera], DepthIntegrator]:
    return LruCache(CACHED_BYTES, lambda integrator: integrator.nbytes)


class _Bundle(NamedTuple):
    """Bundle adjustment problem of some images of the scene."""

    problem: BundleProblem
    images: Int64
    """(n,) scene index of each image of the problem."""
    points: Int64
    """(p,) row in the tracks of each point of the problem."""
    representatives: Int64
    """(k,) scene index of one image of each camera of the problem."""


class _MeasuredPoints(NamedTuple):
    """Points that the refinement of depth maps reads, measured without depth observations."""

    points: Int64
    """(m,) rows in the tracks, in ascending order."""
    covariances: Float64
    """(m, 3, 3) covariances in the world frame, in squared world units."""
    angles_deg: Float64
    """(m,) largest triangulation angles in degrees."""


class Refiner:
    """Bundle adjustment and depth integration of a scene.

    Attributes:
        fixed: (n,) bool mask of the images whose pose never changes.
        noise: Measured noise of the depth priors, which global refinement updates.
        loss_scale: Scale of the reprojection loss in standard deviations of the keypoint position,
            which global refinement updates.
        adapts_reprojection_loss: Whether global refinement may widen the reprojection loss. While
            images are registered one by one, a narrow reprojection loss protects against wrong
            matches.
        keeps_depth_map: (n,) bool mask of the images whose depth maps global refinement does not
            change, because the mapper of a part has refined them.
        calibrates_with_long_tracks: Whether self-calibration estimates intrinsics from long tracks
            (see :func:`calibrate_cameras`).
    """

    def __init__(self, scene: Scene, options: MapperOptions, scores: csr_array) -> None:
        self.scene = scene
        self.options = options.refinement
        self.triangulation = options.triangulation
        self._max_depth_deviation = options.consistency.max_deviation
        self.scores = scores
        self.fixed: Bool = np.zeros(scene.num_images, dtype=np.bool_)
        groups = scene.depth_group_of
        self._shares_scale: Bool = np.bincount(groups, minlength=1)[groups] > 1
        self.noise = DepthNoise()
        self.loss_scale = options.refinement.bundle.reprojection_scale
        self.adapts_reprojection_loss = False
        self.calibrates_with_long_tracks = False
        self.keeps_depth_map: Bool = np.zeros(scene.num_images, dtype=np.bool_)
        self._integrator_noise = DepthNoise()
        self._integrators = _create_cache()

    @property
    def std_factor(self) -> float:
        """Factor on the declared standard deviation of depth in the depth consistency check.

        The factor is at least 1, because depth priors that are accurate at points may be worse
        between points.
        """
        return max(1.0, self.noise.multiplier)

    def estimate_scale(self, image: int, others: list[int]) -> None:
        """Estimate the scale of a depth prior from the points that the image observes.

        The scale is the median ratio of point depth and prior (paper eq. 1). The scale of a
        registered image whose depth prior has the same unit is reused.

        Args:
            image: A registered image.
            others: Images whose mean depth scale is compared with the scale of a metric prior.
                Points whose scale differs from the mean scale by more than ``MAX_DEPTH_RATIO`` are
                ignored. If all points are ignored, the image takes the mean scale.
        """
        scene = self.scene
        depth_map = scene.maps[image]
        shares_unit = scene.registered & (scene.depth_group_of == scene.depth_group_of[image])
        for other in map(int, np.flatnonzero(shares_unit)):
            if other != image and scene.maps[other].active:
                depth_map.set_scale(scene.maps[other].scale)
                return
        keypoints, z = self._observed_depth(image)
        rows = keypoints - scene.graph.offsets[image]
        valid = depth_map.keypoint_valid[rows] & (z > 0)
        log_scales = np.log(z[valid] / depth_map.prior_at_keypoints(rows)[valid])
        if depth_map.prior.metric and others:
            mean = float(np.mean([np.log(scene.maps[other].scale) for other in others]))
            near = self._near(np.exp(log_scales - mean))
            log_scales = log_scales[near] if near.any() else np.array([mean])
        if len(log_scales):
            depth_map.set_scale(float(np.exp(np.median(log_scales))))

    def estimate_scales(self, images: list[int]) -> None:
        """Estimate the depth scales of images, or the median scale for images without points."""
        for image in images:
            self.estimate_scale(image, [])
        scales = [scene_map.scale for scene_map in self.scene.maps if scene_map.active]
        for image in images:
            if scales and not self.scene.maps[image].active:
                self.scene.maps[image].set_scale(float(np.median(scales)))

    def estimate_shared_scales(self) -> None:
        """Estimate the depth scales that several images share, from well triangulated points.

        Depth scales of single images are parameters of bundle adjustment.
        """
        scene, tracks = self.scene, self.scene.tracks
        is_stable = scene.track_angles_deg() >= MIN_ANCHOR_ANGLE_DEG
        log_ratios: dict[int, list[Float64]] = {}
        for image in map(int, np.flatnonzero(self._shares_scale & scene.registered)):
            depth_map = scene.maps[image]
            if not depth_map.active:
                continue
            keypoints, z = self._observed_depth(image)
            rows = keypoints - scene.graph.offsets[image]
            prior = depth_map.prior_at_keypoints(rows)
            good = depth_map.keypoint_valid[rows] & (z > 0) & (prior > 0)
            good &= is_stable[tracks.point_of[keypoints]]
            good[good] &= self._near(z[good] / (depth_map.scale * prior[good]))
            group = int(scene.depth_group_of[image])
            log_ratios.setdefault(group, []).append(np.log(z[good] / prior[good]))
        for group, parts in log_ratios.items():
            log_scales = np.concatenate(parts)
            if len(log_scales) >= MIN_SCALE_POINTS:
                for image in map(int, np.flatnonzero(scene.depth_group_of == group)):
                    if scene.maps[image].active:
                        scene.maps[image].set_scale(float(np.exp(np.median(log_scales))))

    def integrate(self, images: list[int]) -> None:
        """Request the refinement of depth maps by depth integration with the current points.

        The depth maps are refined when they are first used. Images whose depth scale is unknown are
        skipped.
        """
        if not self.options.integrate:
            return
        images = [image for image in images if self.scene.maps[image].active]
        points = self._measure_points(images)
        for image in images:
            self._integrate(image, points)

    def refine_depth(self, images: list[int]) -> None:
        """Measure depth noise, and refine the depth maps of images with the current points."""
        self._measure_noise()
        self.integrate(images)

    def adjust(
        self,
        variable: list[int],
        *,
        local: bool = False,
        focal: bool = False,
        rough: bool = False,
        reprojection_scale: float = 1.0,
        max_iterations: int | None = None,
    ) -> None:
        """Adjust poses and depth scales of images, and the points that the images observe.

        Other images that observe the same points stay fixed.

        Args:
            variable: Images to adjust.
            local: Keep points with long tracks fixed (local bundle adjustment).
            focal: Refine guessed intrinsics that the observations determine, in addition to poses
                and points.
            rough: Stop early with many images, because another bundle adjustment of all images
                follows.
            reprojection_scale: Factor on the scale of the reprojection loss.
            max_iterations: Maximum number of bundle adjustment iterations, or None to use the
                option.
        """
        scene = self.scene
        variable = scene.rigs.complete(variable)
        bundle = self._collect_bundle(variable, local=local)
        if bundle is None:
            return
        options = self._scale_losses(reprojection_scale)
        if rough and len(variable) > options.dense_poses:
            tolerance = max(options.function_tolerance, ROUGH_TOLERANCE)
            options = options.model_copy(update={"function_tolerance": tolerance})
        if max_iterations is not None:
            options = options.model_copy(update={"max_iterations": max_iterations})
        if focal:
            result = calibrate_cameras(
                scene,
                bundle.problem,
                options,
                bundle.representatives,
                refine_distortion=self.options.refine_distortion,
                refine_principal_point=self.options.refine_principal_point,
                long_tracks=self.calibrates_with_long_tracks,
            )
        else:
            result = adjust_bundle(bundle.problem, options)
        images = bundle.images
        scene.rotations[images] = result.rotations
        scene.translations[images] = result.translations
        scene.tracks.xyz[bundle.points] = result.points
        if bundle.problem.rig is not None:
            self._update_rigs(bundle, result)
        for row in np.flatnonzero(result.log_scales):
            depth_map = scene.maps[images[row]]
            depth_map.set_scale(depth_map.scale * float(np.exp(result.log_scales[row])))

    def _update_rigs(self, bundle: _Bundle, result: BundleResult) -> None:
        """Update rigs, and the poses of images that observe no points."""
        scene, rig = self.scene, bundle.problem.rig
        assert rig is not None
        if result.rig is not None:
            adjusted = result.rig
            scene.rigs.set_sensor_poses(bundle.images, adjusted.rotations, adjusted.translations)
            if rig.variable_scale and adjusted.scale > 0:
                scene.set_rig_scale(adjusted.scale, result.std_rig_scale)
        _, first = np.unique(rig.frame_of_image, return_index=True)
        for image in map(int, bundle.images[first]):
            scene.register(image, scene.rotations[image].copy(), scene.translations[image].copy())

    def predict_calibration_errors(self) -> PredictedErrors:
        """Predict the errors of poses and guessed intrinsics of the registered images."""
        scene = self.scene
        bundle = self._collect_bundle([int(image) for image in scene.registered_images()])
        predicted = PredictedErrors.unknown(scene.num_images)
        if bundle is None:
            return predicted
        cameras = [scene.problem.images[image] for image in bundle.representatives]
        means, stds = compute_intrinsic_priors(cameras)
        problem = replace(
            bundle.problem, prior_intrinsics=means, prior_std_intrinsics=stds, rig=None
        )
        errors = predict_calibration_errors(
            problem,
            self._scale_losses(),
            ~mask_guessed_focals(scene, bundle.representatives),
            np.array([image.camera.size for image in cameras], dtype=np.float64),
            self.noise.design_effect**-0.5,
        )
        if errors is not None:
            predicted.pose_deg[bundle.images] = errors.pose_deg
            radial = errors.radial[problem.camera_of_image]
            predicted.stds[bundle.images, IntrinsicParameter.FOCAL_LENGTH] = errors.log_focal
            predicted.stds[bundle.images, IntrinsicParameter.RADIAL_DISTORTION] = radial
        return predicted

    def compute_pose_covariance(self, image: int) -> Float64:
        """Compute the covariance (6, 6) of the pose of an image from the points that it observes.

        The points that other images of its frame observe determine the pose, too. The poses of
        other frames are treated as exact. The covariance of a point results from the keypoints and
        depth of the other images. See
        :func:`~mpsfm_core.optimize.covariance.compute_pose_covariance` for the parameters.
        """
        members = self.scene.rigs.images_of(image)
        covariances = [self._compute_own_covariance(member) for member in members]
        if len(members) == 1:
            return covariances[0]
        information = np.zeros((6, 6))
        for member, covariance in zip(members, covariances, strict=True):
            if np.isfinite(covariance).all():
                turn, _ = self.scene.rigs.relative_pose(image, member)
                change = block_diag(turn, turn)  # both parameters are in the frame of the camera
                information += change.T @ np.linalg.pinv(covariance) @ change
        if np.linalg.matrix_rank(information) < len(information):
            return np.full((6, 6), np.inf)
        return np.asarray(np.linalg.inv(information), dtype=np.float64)

    def _compute_own_covariance(self, image: int) -> Float64:
        """Compute the covariance (6, 6) of a pose from the points that the image observes."""
        scene = self.scene
        bundle = self._collect_bundle([image])
        if bundle is None:
            return np.full((6, 6), np.inf)
        problem, options = replace(bundle.problem, rig=None), self._scale_losses()
        own = problem.obs_image == int(np.flatnonzero(bundle.images == image)[0])
        observations: dict[str, Any] = {
            name: values[~own]
            for name in _OBSERVATION_FIELDS
            if isinstance(values := getattr(problem, name), np.ndarray)
        }
        covariances = compute_point_covariances(replace(problem, **observations), options)
        rows = problem.obs_point[own]
        std_px = np.broadcast_to(problem.obs_std_px, own.shape)[own]
        keypoints, _ = self._observed_depth(image)
        errors_px, _ = scene.project(keypoints, scene.tracks.xyz[scene.tracks.point_of[keypoints]])
        noise = max(1.0, float(np.median(errors_px / std_px)) / MEDIAN_ERROR)
        given = scene.problem.images[image]
        prior_stds = compute_intrinsic_priors([given])[1][0]
        guessed = CalibrationStd(
            log_focal=float(prior_stds[IntrinsicParameter.FOCAL_LENGTH]),
            center_px=float(prior_stds[IntrinsicParameter.PRINCIPAL_POINT_X]),
            radial=float(prior_stds[IntrinsicParameter.RADIAL_DISTORTION]),
        )
        return compute_pose_covariance(
            (scene.rotations[image], scene.translations[image]),
            scene.intrinsics[image],
            problem.points[rows],
            covariances[rows],
            noise * std_px,
            None if given.focal_known else guessed,
            self._compute_scale_errors(problem, own, bundle.images)[rows],
        )

    def _compute_scale_errors(self, problem: BundleProblem, own: Bool, images: Int64) -> Float64:
        """Compute the shifts of points that a standard deviation of a depth scale causes.

        A scale error of the depth map of an image moves all points that only this image observes.
        Points that other images observe, too, determine the scale.

        Args:
            problem: Bundle adjustment problem of a new image with points of other images.
            own: (m,) bool mask of the observations of the new image.
            images: (n,) scene index of each image of the problem.

        Returns:
            (p, 3, n) shift of each point in the world frame, for each depth scale.
        """
        scene, tracks = self.scene, self.scene.tracks
        lengths = np.bincount(problem.obs_point[~own], minlength=len(problem.points))
        is_single = ~own & (lengths[problem.obs_point] == 1)
        points, rows = problem.obs_point[is_single], problem.obs_image[is_single]
        track_lengths = tracks.lengths()
        shifts = np.zeros((len(problem.points), 3, len(images)))
        for row in map(int, np.unique(rows)):
            image = int(images[row])
            observed = tracks.point_of[scene.graph.keypoints_of(image)]
            num_shared = np.count_nonzero(track_lengths[observed[observed >= 0]] > 2)
            std = np.nan_to_num(self.noise.multiplier * scene.maps[image].typical_log_std)
            std /= np.sqrt(1 + num_shared / self.noise.design_effect)
            of_image = points[rows == row]
            shifts[of_image, :, row] = std * (problem.points[of_image] - scene.centers()[image])
        return shifts

    def _scale_losses(self, reprojection_scale: float = 1.0) -> BundleOptions:
        """Return the options of bundle adjustment with losses scaled by a factor and by noise."""
        options = self.options.bundle
        return options.model_copy(
            update={
                "reprojection_scale": self.loss_scale * reprojection_scale,
                "depth_scale": options.depth_scale * self.noise.loss_factor,
            }
        )

    def _collect_bundle(self, variable: list[int], *, local: bool = False) -> _Bundle | None:
        """Return the bundle adjustment problem of images, or None if they observe no points.

        Args:
            variable: Images with variable pose.
            local: Keep points with long tracks fixed.
        """
        scene, tracks = self.scene, self.scene.tracks
        points = scene.points_of(variable)
        if not len(points):
            return None
        observations, point_rows = tracks.observations_of(points)
        images, image_rows = np.unique(scene.graph.image_of[observations], return_inverse=True)
        moving = (scene.mask(variable) & ~self.fixed)[images]
        if moving.all():
            moving[scene.rigs.frame_of[images] == scene.rigs.frame_of[images[0]]] = False
        num_movable = np.count_nonzero(scene.registered & ~self.fixed)
        refines_all = not local and np.count_nonzero(~self.fixed[variable]) == num_movable
        rig = scene.rigs.constrain(images, moving, refine_rigs=refines_all)
        long_track = np.bincount(point_rows) >= MAX_LOCAL_TRACK_LENGTH
        log_depth, log_std = self._depth_observations(observations)
        regularized = self.options.depth_regularization and bool(np.isfinite(log_depth).any())
        num_constant = len(np.unique(scene.rigs.frame_of[images[~moving]]))
        free_scale = not regularized and moving.any() and num_constant == 1
        free_scale &= rig is None or not rig.fixes_scale
        weight = scene.graph.keypoint_weight[observations]
        expected, std = self._expected_log_scales(images)
        _, first, camera_rows = np.unique(
            scene.camera_of[images], return_index=True, return_inverse=True
        )
        problem = BundleProblem(
            rotations=scene.rotations[images],
            translations=scene.translations[images],
            intrinsics=scene.intrinsics[images][first],
            distortion=scene.distortion[images][first],
            fisheye=scene.fisheye[images][first],
            camera_of_image=camera_rows,
            points=tracks.xyz[points],
            obs_image=image_rows,
            obs_point=point_rows,
            obs_xy=scene.distorted_keypoints[observations],
            obs_std_px=scene.keypoint_std_px[images][image_rows] / np.sqrt(weight),
            obs_log_depth=log_depth if regularized else None,
            obs_std_log_depth=log_std * self.noise.std_factor,
            variable_pose=moving,
            expected_log_scales=expected,
            std_log_scales=std,
            variable_scale=self._has_free_scale(variable)[images],
            variable_point=~long_track if local else None,
            scale_anchor=int(np.argmax(moving)) if free_scale else None,
            rig=rig,
        )
        return _Bundle(problem, images, points, images[first])

    def refine_locally(self, image: int) -> None:
        """Adjust the local bundle of an image and update its tracks until few tracks change.

        The depth map of the image is only refined again in global refinement.
        """
        bundle = find_local_bundle(self.scene, image, self.scores)
        complete_and_merge_tracks(self.scene, self.triangulation, images=bundle)
        for _ in range(MAX_LOCAL_REFINEMENTS):
            bundle = find_local_bundle(self.scene, image, self.scores)
            self.adjust(bundle, local=True)
            changed = filter_points(self.scene, self.triangulation, bundle)
            changed += complete_and_merge_tracks(self.scene, self.triangulation, images=bundle)
            if changed < MAX_LOCAL_CHANGE * max(self._num_observations(), 1):
                break

    def refine_globally(self) -> None:
        """Adjust all images and update tracks until few tracks change, then refine depth maps."""
        images = [int(i) for i in self.scene.registered_images()]
        complete_and_merge_tracks(self.scene, self.triangulation, create=True)
        lift_low_parallax(self.scene, self.triangulation)
        refines_focals = self.can_refine_focals()
        rough = refines_focals and not self.calibrates_with_long_tracks
        if refines_focals:
            self.adjust(images, focal=True, rough=rough)
        for _ in range(MAX_GLOBAL_REFINEMENTS):
            self.estimate_shared_scales()
            self._measure_keypoint_noise()
            self._measure_noise()
            self.adjust(images, focal=refines_focals, rough=rough)
            changed = filter_points(self.scene, self.triangulation)
            changed += complete_and_merge_tracks(self.scene, self.triangulation)
            if changed < MAX_GLOBAL_CHANGE * max(self._num_observations(), 1):
                break
        self.integrate([image for image in images if not self.keeps_depth_map[image]])

    def reset(self) -> None:
        """Discard all noise measurements and depth integrators, for an empty scene."""
        self._integrators = _create_cache()
        self.noise = self._integrator_noise = DepthNoise()
        self.loss_scale = self.options.bundle.reprojection_scale
        self.adapts_reprojection_loss = False
        self.calibrates_with_long_tracks = False
        self.keeps_depth_map[:] = False

    def state_dict(self) -> StateDict:
        """Return the depth noise measurements and the fixed poses for a checkpoint."""
        return {
            "fixed": self.fixed,
            "noise": list(self.noise),
            "integrator_noise": list(self._integrator_noise),
            "loss_scale": self.loss_scale,
            "adapts_reprojection_loss": self.adapts_reprojection_loss,
            "calibrates_with_long_tracks": self.calibrates_with_long_tracks,
            "keeps_depth_map": self.keeps_depth_map,
        }

    def load_state_dict(self, state: StateDict) -> None:
        """Restore the depth noise measurements and the fixed poses from a checkpoint."""
        self.fixed = state["fixed"]
        self.noise = DepthNoise(*state["noise"])
        self._integrator_noise = DepthNoise(*state["integrator_noise"])
        self.loss_scale = state["loss_scale"]
        self.adapts_reprojection_loss = state["adapts_reprojection_loss"]
        self.calibrates_with_long_tracks = state["calibrates_with_long_tracks"]
        self.keeps_depth_map = state["keeps_depth_map"]

    def _integrate(self, image: int, points: _MeasuredPoints) -> None:
        scene = self.scene
        depth_map = scene.maps[image]
        keypoints, z = self._observed_depth(image)
        measured = np.searchsorted(points.points, scene.tracks.point_of[keypoints])
        rows = keypoints - scene.graph.offsets[image]
        rotation = np.broadcast_to(scene.rotations[image], (len(keypoints), 3, 3))
        variance = propagate_depth_variance(points.covariances[measured], rotation)
        ratio = z / np.maximum(depth_map.scale * depth_map.prior_at_keypoints(rows), 1e-12)
        good = (points.angles_deg[measured] >= MIN_ANCHOR_ANGLE_DEG) & (z > 0)
        good &= np.isfinite(variance) & (variance > 0)
        good &= ~depth_map.keypoint_valid[rows] | self._near(ratio)
        xy = subsample_pixels(depth_map.keypoints[rows][good], self._step(image))
        anchors = Anchors(xy, z[good], variance[good])
        depth_map.set_refinement(
            DepthRefinement(self._integrator(image), anchors, depth_map.scale, depth_map.refinement)
        )

    def can_refine_focals(self) -> bool:
        """Return whether enough images are registered to refine a guessed focal length."""
        images = self.scene.registered_images()
        if not self.options.refine_focal or len(images) < MIN_FOCAL_IMAGES:
            return False
        return bool(mask_guessed_focals(self.scene, images).any())

    def _measure_keypoint_noise(self) -> None:
        """Measure the scale of the Cauchy loss from the epipolar errors of matches."""
        bundle = self.options.bundle
        is_enabled = self.options.measure_keypoint_noise and self.adapts_reprojection_loss
        if is_enabled and bundle.reprojection_loss == Loss.CAUCHY:
            self.loss_scale = measure_loss_scale(self.scene, bundle.reprojection_scale)

    def _measure_noise(self) -> None:
        """Measure the depth noise, and discard depth integrators if the noise has changed."""
        if not self.options.measure_depth_noise:
            return
        self.noise = measure_depth_noise(self.scene)
        outlier_ratio = measure_outlier_ratio(
            self.scene, self.std_factor, self._max_depth_deviation
        )
        self.noise = self.noise._replace(outlier_ratio=outlier_ratio)
        ratio = self.noise.multiplier / self._integrator_noise.multiplier
        if not 1 / MAX_NOISE_CHANGE < ratio < MAX_NOISE_CHANGE:
            self._integrator_noise = self.noise
            self._integrators = _create_cache()

    def _integrator(self, image: int) -> _CachedIntegrator:
        """Return the depth integrator of an image, with variance scaled by the measured noise."""
        depth_map, step, noise = self.scene.maps[image], self._step(image), self._integrator_noise
        camera = subsample_camera(depth_map.camera, step)
        options = self.options.integration
        independent_depths = max(
            noise.independent_pixels(camera.width * camera.height), options.independent_depths
        )
        return _CachedIntegrator(
            self._integrators,
            image,
            depth_map.prior,
            depth_map.normals,
            camera,
            step,
            noise.multiplier,
            options.model_copy(update={"independent_depths": independent_depths}),
        )

    def _step(self, image: int) -> int:
        """Return the subsampling step of the depth map of an image."""
        return compute_subsampling_step(
            self.scene.maps[image].prior.shape[1], self.options.map_width
        )

    def _observed_depth(self, image: int) -> tuple[Int64, Float64]:
        """Return the keypoints of an image that observe points, and the depth of these points."""
        scene, tracks = self.scene, self.scene.tracks
        of_image = scene.graph.keypoints_of(image)
        keypoints = of_image.start + np.flatnonzero(tracks.point_of[of_image] >= 0)
        points = tracks.xyz[tracks.point_of[keypoints]]
        z = points @ scene.rotations[image][2] + scene.translations[image, 2]
        return keypoints, z

    def _depth_observations(self, observations: Int64) -> tuple[Float64, Float64]:
        """Return the log prior depth at observations, NaN if unusable, and its std."""
        scene, tracks = self.scene, self.scene.tracks
        _, z = scene.project(observations, tracks.xyz[tracks.point_of[observations]])
        scales = scene.scales()[scene.graph.image_of[observations]]
        depth = scene.keypoint_prior[observations] * scales
        usable = scene.keypoint_valid[observations] & (depth > 0) & (z > 0)
        usable[usable] &= self._near(z[usable] / depth[usable])
        log_depth, log_std = np.full(len(z), np.nan), np.ones(len(z))
        log_depth[usable] = np.log(depth[usable])
        log_std[usable] = scene.keypoint_log_std[observations[usable]]
        return log_depth, np.maximum(log_std, 1e-6)

    def _has_free_scale(self, variable: list[int]) -> Bool:
        """Return a bool mask (n,) of images whose depth scale bundle adjustment estimates."""
        return self.scene.mask(variable) & ~self._shares_scale

    def _expected_log_scales(self, images: Int64) -> tuple[Float64, Float64]:
        """Return the expected change of the log depth scales of images, and its prior std.

        Metric depth priors share one unit, so their log scales are expected to equal the mean log
        scale of the registered images. Unlike the median, the mean log scale keeps the undetermined
        unit of the world constant. The standard deviation is the spread of the log scales of the
        registered images, with the declared noise of the depth prior as an additional sample (a
        unit information prior). The log scale of a relative depth prior has an infinite standard
        deviation.

        Returns:
            Expected changes (m,) of the log scales, and standard deviations (m,).
        """
        maps, scene = self.scene.maps, self.scene
        is_metric = np.array(
            [m.prior.metric and m.typical_log_std > 0 for m in maps], dtype=np.bool_
        )
        is_used = np.array([m.active for m in maps], dtype=np.bool_) & is_metric & scene.registered
        log_scales = np.log(scene.scales())
        expected, std = np.zeros(len(images)), np.full(len(images), np.inf)
        if is_used.any():
            mean = log_scales[is_used].mean()
            deviations = log_scales[is_used] - mean
            declared = np.median(
                [m.typical_log_std for m, used in zip(maps, is_used, strict=True) if used]
            )
            squares = (self.noise.multiplier * declared) ** 2 + (deviations**2).sum()
            std[is_metric[images]] = np.sqrt(squares / len(deviations))
            expected[:] = mean - log_scales[images]
        return expected, std

    def _near(self, ratio: Float64) -> Bool:
        limit = MAX_DEPTH_RATIO
        near: Bool = (ratio > 1 / limit) & (ratio < limit)
        return near

    def _measure_points(self, images: list[int]) -> _MeasuredPoints:
        """Measure the points that images observe, without the observations of depth."""
        scene = self.scene
        points = scene.points_of(images)
        observations, rows = scene.tracks.observations_of(points)
        observing_images = scene.graph.image_of[observations]
        covariances = compute_point_covariances(
            BundleProblem(
                rotations=scene.rotations,
                translations=scene.translations,
                intrinsics=scene.intrinsics,
                camera_of_image=np.arange(scene.num_images),
                points=scene.tracks.xyz[points],
                obs_image=observing_images,
                obs_point=rows,
                obs_xy=scene.keypoints[observations],
                obs_std_px=scene.keypoint_std_px[observing_images],
            ),
            SOFT_L1_OPTIONS,
        )
        angles_deg, _ = scene.angles_deg_of(points, (observations, rows))
        return _MeasuredPoints(points, covariances, angles_deg)

    def _num_observations(self) -> int:
        return int((self.scene.tracks.point_of >= 0).sum())
