"""Local and global refinement: bundle adjustment beside depth, and depth integration (section 3.3).

The paper does both in turn, each beside what the other made. A map refined on points agrees with
them, and holds them where they are; so, unless ``bundle_depth`` says otherwise, bundle adjustment
works beside the scaled priors and maps are refined on what comes out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import Bool, Float64, Int64
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.depth_noise import DepthNoise, measure_depth_noise
from mpsfm_core.mapping.refinement.filtering import filter_points
from mpsfm_core.mapping.refinement.keypoint_noise import measure_loss_scale
from mpsfm_core.mapping.registration.image_selection import find_local_bundle
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.mapping.triangulation import complete_and_merge_tracks, lift_low_parallax
from mpsfm_core.optimize.bundle_adjustment import BundleProblem, adjust_bundle
from mpsfm_core.optimize.covariance import compute_point_covariances, propagate_depth_variance
from mpsfm_core.optimize.depth_integration import Anchors, DepthIntegrator
from mpsfm_core.optimize.options import SOFT_L1_OPTIONS, Loss
from mpsfm_core.optimize.subsampling import (
    compute_subsampling_step,
    subsample_camera,
    subsample_pixels,
    subsample_prior,
)
from mpsfm_core.support.threads import parallel_map

LOCAL_MAX_TRACK_LENGTH = 15
"""Longer tracks stay fixed in local bundle adjustment (COLMAP, reference)."""
NOISE_CHANGE = 1.25
"""Factor of the measured noise from which on the integration is set up anew (ours)."""
MIN_SCALE_POINTS = 20
"""Fewer well triangulated points do not change a scale again (ours)."""


class Refiner:
    """Refines a scene; remembers the integrators and how well depth and points agree.

    ``noise``: how good the priors are in this scene; ``loss_scale``: of the reprojection loss, in
    stds of a keypoint. Both are refreshed by global refinement.
    ``clean_matches``: whether all pairs were heard before an image was placed, so that the loss may
    be as wide as keypoints are clean; while images join one by one it holds wrong ones off.
    ``fixed``: (n,) bool, images whose pose never changes.
    """

    def __init__(self, scene: Scene, options: MapperOptions, scores: Float64) -> None:
        self.scene = scene
        self.options = options.refinement
        self.triangulation = options.triangulation
        self.scores = scores
        self.fixed: Bool = np.zeros(scene.num_images, dtype=np.bool_)
        groups = scene.depth_group_of
        self._shares_scale: Bool = np.bincount(groups, minlength=1)[groups] > 1
        self.noise = DepthNoise()
        self.loss_scale = options.refinement.bundle.reprojection_scale
        self.adapts_reprojection_loss = False
        self._assumed = DepthNoise()
        self._integrators: dict[int, DepthIntegrator] = {}

    @property
    def _alternates(self) -> bool:
        """Whether maps are also refined before each bundle adjustment, for it to agree with."""
        return self.options.bundle_depth == "refined"

    @property
    def std_factor(self) -> float:
        """How many times its declaration the std of depth is where a decision hangs on it.

        Never below 1: that priors agree where points are does not make them better elsewhere.
        """
        return max(1.0, self.noise.multiplier)

    def estimate_scale(self, image: int, others: list[int]) -> None:
        """Scale an image's prior so that it agrees with its points (paper eq. 1).

        Points whose scale is far from that of the ``others`` are ignored if the prior is metric;
        if none is left, the image takes their mean. A registered image whose depth has the same
        unit has its scale already.
        """
        scene = self.scene
        depth_map = scene.maps[image]
        same = scene.registered & (scene.depth_group_of == scene.depth_group_of[image])
        for other in map(int, np.flatnonzero(same)):
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
        """Scale the priors of posed images to their triangulated points.

        An image that sees none takes the median scale of the others.
        """
        for image in images:
            self.estimate_scale(image, [])
        scales = [scene_map.scale for scene_map in self.scene.maps if scene_map.active]
        for image in images:
            if scales and not self.scene.maps[image].active:
                self.scene.maps[image].set_scale(float(np.median(scales)))

    def estimate_shared_scales(self) -> None:
        """Estimate scales that several images share anew, from points that rays determine.

        Those of single images are unknowns of bundle adjustment.
        """
        scene, tracks = self.scene, self.scene.tracks
        stable = scene.track_angles_deg() >= self.options.anchor_min_angle_deg
        found: dict[int, list[Float64]] = {}
        for image in map(int, np.flatnonzero(self._shares_scale & scene.registered)):
            depth_map = scene.maps[image]
            if not depth_map.active:
                continue
            keypoints, z = self._observed_depth(image)
            rows = keypoints - scene.graph.offsets[image]
            prior = depth_map.prior_at_keypoints(rows)
            good = depth_map.keypoint_valid[rows] & (z > 0) & (prior > 0)
            good &= stable[tracks.point_of[keypoints]]
            good[good] &= self._near(z[good] / (depth_map.scale * prior[good]))
            group = int(scene.depth_group_of[image])
            found.setdefault(group, []).append(np.log(z[good] / prior[good]))
        for group, parts in found.items():
            together = np.concatenate(parts)
            if len(together) >= MIN_SCALE_POINTS:
                for image in map(int, np.flatnonzero(scene.depth_group_of == group)):
                    if scene.maps[image].active:
                        scene.maps[image].set_scale(float(np.exp(np.median(together))))

    def integrate(self, images: list[int]) -> None:
        """Refine the depth maps of some images against the current points.

        Those whose scale is unknown stay as they are.
        """
        if not self.options.integrate:
            return
        images = [image for image in images if self.scene.maps[image].active]
        covariances = self._covariances(images)
        parallel_map(lambda image: self._integrate(image, *covariances), images)

    def adjust(
        self,
        variable: list[int],
        *,
        local: bool = False,
        focal: bool = False,
        reprojection_scale: float = 1.0,
        depth_scale: float = 1.0,
        max_iterations: int | None = None,
    ) -> None:
        """Bundle-adjust poses of some images, scales of their depth and the points they see.

        ``local``: long tracks stay. ``focal``: guessed focal lengths
        are refined too. ``reprojection_scale``, ``depth_scale`` multiply the scales of the losses.
        ``max_iterations``: at most, instead of the options'.
        """
        scene, tracks = self.scene, self.scene.tracks
        observations = tracks.observations()
        image_of = scene.graph.image_of[observations]
        seen = np.zeros(len(tracks.xyz), dtype=np.bool_)
        seen[tracks.point_of[observations[scene.mask(variable)[image_of]]]] = True
        observations = observations[seen[tracks.point_of[observations]]]
        if not len(observations):
            return
        images, image_rows = np.unique(scene.graph.image_of[observations], return_inverse=True)
        points, point_rows = np.unique(tracks.point_of[observations], return_inverse=True)
        moving = (scene.mask(variable) & ~self.fixed)[images]
        if moving.all():
            moving[0] = False
        long_track = np.bincount(point_rows) >= LOCAL_MAX_TRACK_LENGTH
        log_depth, log_std = self._depth_observations(observations, self._alternates and not focal)
        regularized = self.options.depth_regularization and bool(np.isfinite(log_depth).any())
        free_scale = not regularized and moving.any() and np.count_nonzero(~moving) == 1
        options = self.options.bundle
        depth_scale *= options.depth_scale * self.noise.loss_factor
        weight = scene.graph.keypoint_weight[observations]
        expected, std = self._expected_log_scales(images)
        _, first, camera_rows = np.unique(
            scene.camera_of[images], return_index=True, return_inverse=True
        )
        result = adjust_bundle(
            BundleProblem(
                rotations=scene.rotations[images],
                translations=scene.translations[images],
                intrinsics=scene.intrinsics[images][first],
                camera_of_image=camera_rows,
                points=tracks.xyz[points],
                obs_image=image_rows,
                obs_point=point_rows,
                obs_xy=scene.keypoints[observations],
                obs_std_px=scene.keypoint_std_px[images][image_rows] / np.sqrt(weight),
                obs_log_depth=log_depth if regularized else None,
                obs_std_log_depth=log_std * self.noise.std_factor,
                variable_pose=moving,
                expected_log_scales=expected,
                std_log_scales=std,
                variable_scale=self._has_free_scale(variable)[images],
                variable_point=~long_track if local else None,
                scale_anchor=int(np.argmax(moving)) if free_scale else None,
                variable_focal=self._guessed(images)[first] if focal else None,
            ),
            options.model_copy(
                update={
                    "reprojection_scale": self.loss_scale * reprojection_scale,
                    "depth_scale": depth_scale,
                    "max_iterations": max_iterations or options.max_iterations,
                }
            ),
        )
        if focal and not self._take_focal(images, result.intrinsics[camera_rows]):
            return
        scene.rotations[images] = result.rotations
        scene.translations[images] = result.translations
        tracks.xyz[points] = result.points
        for row in np.flatnonzero(result.log_scales):
            depth_map = scene.maps[images[row]]
            depth_map.set_scale(depth_map.scale * float(np.exp(result.log_scales[row])))

    def refine_locally(self, image: int) -> None:
        """Refine an image and its neighbours until little changes.

        Its map was refined when it was registered, and will be again with all others.
        """
        options = self.options
        bundle = find_local_bundle(self.scene, image, options.local_images - 1, self.scores)
        complete_and_merge_tracks(self.scene, self.triangulation, images=bundle)
        for _ in range(options.local_iterations):
            bundle = find_local_bundle(self.scene, image, options.local_images - 1, self.scores)
            if self._alternates:
                self.integrate([image])
            self.adjust(bundle, local=True)
            changed = filter_points(self.scene, self.triangulation, bundle)
            changed += complete_and_merge_tracks(self.scene, self.triangulation, images=bundle)
            if changed < options.local_max_change * max(self._num_observations(), 1):
                break

    def refine_globally(self, *, final: bool = False) -> None:
        """Refine everything until little changes; ``final`` sharpens the depth loss."""
        options = self.options
        images = [int(i) for i in self.scene.registered_images()]
        complete_and_merge_tracks(self.scene, self.triangulation, create=True)
        lift_low_parallax(self.scene, self.triangulation)
        if self.focal_is_stable():
            self.adjust(images, focal=True)
        for _ in range(options.global_iterations):
            self.estimate_shared_scales()
            self._measure_keypoint_noise()
            self._measure_noise()
            if self._alternates:
                self.integrate(images)
            self.adjust(images, depth_scale=options.final_depth_scale if final else 1.0)
            changed = filter_points(self.scene, self.triangulation)
            changed += complete_and_merge_tracks(self.scene, self.triangulation)
            if changed < options.global_max_change * max(self._num_observations(), 1):
                break
        self.integrate(images)

    def discard_integrator(self, image: int) -> None:
        """Drop what is remembered of an image that left the scene."""
        self._integrators.pop(image, None)

    def reset(self) -> None:
        """Drop what is remembered of the scene, which starts anew."""
        self._integrators.clear()
        self.noise = self._assumed = DepthNoise()
        self.loss_scale = self.options.bundle.reprojection_scale
        self.adapts_reprojection_loss = False

    def _integrate(self, image: int, covariances: Float64, angles: Float64) -> None:
        scene, tracks = self.scene, self.scene.tracks
        depth_map = scene.maps[image]
        keypoints, z = self._observed_depth(image)
        points = tracks.point_of[keypoints]
        rows = keypoints - scene.graph.offsets[image]
        rotation = np.broadcast_to(scene.rotations[image], (len(points), 3, 3))
        variance = propagate_depth_variance(covariances[points], rotation)
        ratio = z / np.maximum(depth_map.scale * depth_map.prior_at_keypoints(rows), 1e-12)
        good = (angles[points] >= self.options.anchor_min_angle_deg) & (z > 0)
        good &= np.isfinite(variance) & (variance > 0)
        good &= ~depth_map.keypoint_valid[rows] | self._near(ratio)
        xy = subsample_pixels(depth_map.keypoints[rows][good], self._step(image))
        anchors = Anchors(xy, z[good], variance[good])
        refined = self._integrator(image).refine(
            anchors, scale=depth_map.scale, start=depth_map.refined
        )
        depth_map.set_refined(refined)

    def _guessed(self, images: Int64) -> Bool:
        """(m,) bool, images whose focal length is a guess."""
        known = [self.scene.problem.images[i].focal_known for i in images]
        return ~np.array(known, dtype=np.bool_)

    def focal_is_stable(self) -> bool:
        """Whether guessed focal lengths can be told from the images registered so far."""
        images, options = self.scene.registered_images(), self.options
        if not options.refine_focal or len(images) < options.focal_min_images:
            return False
        angles = self.scene.track_angles_deg()[self.scene.tracks.lengths() > 0]
        wide = len(angles) > 0 and float(np.median(angles)) >= options.focal_min_angle_deg
        return wide and bool(self._guessed(images).any())

    def _take_focal(self, images: Int64, intrinsics: Float64) -> bool:
        """Use refined focal lengths, also for images not yet registered; no if one ran away."""
        scene, limit = self.scene, self.options.focal_max_change
        rows = np.flatnonzero(self._guessed(images))
        guesses = np.array([scene.problem.images[image].camera.fx for image in images[rows]])
        ratios = intrinsics[rows, 0] / guesses
        if not ((1 / limit < ratios) & (ratios < limit)).all():
            return False
        for row in rows:
            scene.set_shared_focal(int(images[row]), *map(float, intrinsics[row, :2]))
        return True

    def _measure_keypoint_noise(self) -> None:
        """Let the reprojection loss suit the keypoints, whose tails Cauchy's loss knows."""
        bundle = self.options.bundle
        measure = self.options.measure_keypoint_noise and self.adapts_reprojection_loss
        if measure and bundle.reprojection_loss == Loss.CAUCHY:
            self.loss_scale = measure_loss_scale(self.scene, bundle.reprojection_scale)

    def _measure_noise(self) -> None:
        """Measure how good the priors are; integrators that assumed much else are made anew."""
        if not self.options.measure_depth_noise:
            return
        self.noise = measure_depth_noise(self.scene)
        ratio = self.noise.multiplier / self._assumed.multiplier
        if not 1 / NOISE_CHANGE < ratio < NOISE_CHANGE:
            self._assumed = self.noise
            self._integrators.clear()

    def _integrator(self, image: int) -> DepthIntegrator:
        """The integrator of an image; the measured noise scales what its depth prior is worth."""
        depth_map, step = self.scene.maps[image], self._step(image)
        camera = subsample_camera(depth_map.camera, step)
        integrator = self._integrators.get(image)
        if integrator is not None and integrator.camera == camera:
            return integrator
        prior, noise = subsample_prior(depth_map.prior, step), self._assumed
        assert prior.variance is not None  # MappingImage checks it
        options = self.options.integration
        worth = max(noise.independent_pixels(prior.depth.size), options.independent_depths)
        integrator = self._integrators[image] = DepthIntegrator(
            replace(prior, variance=prior.variance * np.float32(noise.multiplier**2)),
            subsample_prior(depth_map.normals, step),
            camera,
            options.model_copy(update={"independent_depths": worth}),
        )
        return integrator

    def _step(self, image: int) -> int:
        """How far apart the pixels are on which an image's depth is refined."""
        return compute_subsampling_step(
            self.scene.maps[image].prior.shape[1], self.options.map_width
        )

    def _observed_depth(self, image: int) -> tuple[Int64, Float64]:
        """Keypoints of an image that observe points, and the points' depth in the image."""
        scene, tracks = self.scene, self.scene.tracks
        of_image = scene.graph.keypoints_of(image)
        keypoints = of_image.start + np.flatnonzero(tracks.point_of[of_image] >= 0)
        points = tracks.xyz[tracks.point_of[keypoints]]
        z = points @ scene.rotations[image][2] + scene.translations[image, 2]
        return keypoints, z

    def _depth_observations(self, observations: Int64, refined: bool) -> tuple[Float64, Float64]:
        """Log depth of the maps at observations (NaN where not to be used) and its std."""
        scene, tracks = self.scene, self.scene.tracks
        _, z = scene.project(observations, tracks.xyz[tracks.point_of[observations]])
        if refined:
            depth, _ = scene.depth_at(observations)
        else:
            scales = scene.scales()[scene.graph.image_of[observations]]
            depth = scene.keypoint_prior[observations] * scales
        usable = scene.keypoint_valid[observations] & (depth > 0) & (z > 0)
        usable[usable] &= self._near(z[usable] / depth[usable])
        log_depth, log_std = np.full(len(z), np.nan), np.ones(len(z))
        log_depth[usable] = np.log(depth[usable])
        log_std[usable] = scene.keypoint_log_std[observations[usable]]
        return log_depth, np.maximum(log_std, 1e-6)

    def _has_free_scale(self, variable: list[int]) -> Bool:
        """(n,) bool, images of whose depth bundle adjustment estimates the scale."""
        if not self.options.free_scales:
            return np.zeros(self.scene.num_images, dtype=np.bool_)
        return self.scene.mask(variable) & ~self._shares_scale

    def _expected_log_scales(self, images: Int64) -> tuple[Float64, Float64]:
        """By how much the logarithms of some images' scales are expected to change, and the std of
        that: (m,) each.

        Metric priors agree on a metre, the mean of what registered images take for it (the median
        would pull at all of them, and nothing else holds the unit), give or take their spread.
        What priors declare, by the measured noise, counts as one more of them (a unit information
        prior). Of relative ones nothing is known.
        """
        maps, scene = self.scene.maps, self.scene
        metric = np.array([m.prior.metric and m.typical_log_std > 0 for m in maps], dtype=np.bool_)
        posed = np.array([m.active for m in maps], dtype=np.bool_) & metric & scene.registered
        log_scales = np.log(scene.scales())
        expected, std = np.zeros(len(images)), np.full(len(images), np.inf)
        if posed.any():
            mean = log_scales[posed].mean()
            off = log_scales[posed] - mean
            declared = np.median(
                [m.typical_log_std for m, of in zip(maps, posed, strict=True) if of]
            )
            squares = (self.noise.multiplier * declared) ** 2 + (off**2).sum()
            std[metric[images]] = np.sqrt(squares / len(off))
            expected[:] = mean - log_scales[images]
        return expected, std

    def _near(self, ratio: Float64) -> Bool:
        limit = self.options.max_depth_ratio
        near: Bool = (ratio > 1 / limit) & (ratio < limit)
        return near

    def _covariances(self, seen_by: list[int]) -> tuple[Float64, Float64]:
        """Covariance (p, 3, 3) of points by reprojection alone, and their angle (p,).

        Only those of points that some image of ``seen_by`` observes mean something.
        """
        scene, tracks = self.scene, self.scene.tracks
        observations = tracks.observations()
        images = scene.graph.image_of[observations]
        wanted = np.zeros(len(tracks.xyz), dtype=np.bool_)
        wanted[tracks.point_of[observations[scene.mask(seen_by)[images]]]] = True
        observations = observations[wanted[tracks.point_of[observations]]]
        images = scene.graph.image_of[observations]
        covariances = compute_point_covariances(
            BundleProblem(
                rotations=scene.rotations,
                translations=scene.translations,
                intrinsics=scene.intrinsics,
                camera_of_image=np.arange(scene.num_images),
                points=tracks.xyz,
                obs_image=images,
                obs_point=tracks.point_of[observations],
                obs_xy=scene.keypoints[observations],
                obs_std_px=scene.keypoint_std_px[images],
            ),
            SOFT_L1_OPTIONS,
        )
        return covariances, scene.track_angles_deg()

    def _num_observations(self) -> int:
        return int((self.scene.tracks.point_of >= 0).sum())
