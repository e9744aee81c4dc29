"""Options of the mapper, with the source of each default.

``[paper ...]`` cites a section of MP-SfM and ``[reference ...]`` its published code. ``[COLMAP
...]`` names an option of COLMAP's incremental mapper. ``[tuned: ...]`` names the benchmark that
chose the value. ``[ours]`` marks a choice without a benchmark. Triangulation angles are true
angles, while the published code overestimates them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from mpsfm_core.data.options import Options, expert
from mpsfm_core.optimize.options import BundleOptions, IntegrationOptions


class RegistrationOptions(Options):
    """Options of the registration of the next image."""

    min_inliers: int = expert(30, ge=3)
    """Smallest number of inliers of an image pose; raising it registers fewer, more reliable
    images. [COLMAP abs_pose_min_num_inliers]"""
    min_pose_inlier_ratio: float = expert(0.7, ge=0, le=1)
    """Smallest inlier ratio of the 2D-3D matches with which PnP may register an image. A larger
    ratio rejects more wrong poses, and more correct poses of images with repeated structure.
    [tuned: benchmarks.ablation]"""
    max_error_px: float = expert(12.0, gt=0)
    """Largest reprojection error of an inlier of PnP; raising it accepts less accurate points.
    [COLMAP abs_pose_max_error]"""
    max_depth_deviation: float = expert(2.0, ge=0)
    """Half length of the depth interval of a matched keypoint, in standard deviations of log depth;
    raising it lowers the influence of depth. [ours]"""
    max_resampled_attempts: int = expert(3, ge=0)
    """Number of registration attempts of an image that draw new random halves of the matches.
    [ours]"""
    num_locally_optimized: int = expert(8, ge=0)
    """Number of distinct pose hypotheses whose support is maximized; 0 keeps the poses of RANSAC.
    [tuned: benchmarks.ablation]"""
    min_inlier_ratio: float = expert(0.25, gt=0, le=1)
    """Assumed inlier ratio from which RANSAC computes its number of trials; raising the ratio makes
    RANSAC faster, but RANSAC may miss poses. [COLMAP abs_pose_min_inlier_ratio]"""
    estimate_focal: bool = expert(True)
    """Estimate a guessed focal length with the pose, unless a registered image shares the camera.
    If ``estimate_focal`` is False, images are registered with their guessed focal length. Needs
    ``refinement.refine_focal``. [ours]"""
    lifting: bool = expert(True)
    """Use 3D points that are lifted from the depth map of a single image. [paper 3.2]"""
    max_relaxations: int = expert(6, ge=0)
    """Number of times that ``min_inliers`` and ``min_pose_inlier_ratio`` are divided by 1.2 if no
    image registers; raising it registers more, but less reliable images. [reference]"""


class TriangulationOptions(Options):
    """Options of the triangulation and filtering of tracks."""

    min_angle_deg: float = expert(1.5, ge=0)
    """Triangulation angle below which a point is lifted from depth; raising it relies more on
    depth. [COLMAP tri_min_angle] [reference hard_angle]"""
    max_angle_error_deg: float = expert(2.0, gt=0)
    """Largest angular error of an observation in a new image, before refinement.
    [COLMAP tri_create_max_angle_error, tri_continue_max_angle_error]"""
    max_error_px: float = expert(4.0, gt=0)
    """Largest reprojection error of an observation, in standard deviations of the keypoint
    position; raising it keeps more, but less accurate points. [COLMAP filter_max_reproj_error]"""


class RefinementOptions(Options):
    """Options of bundle adjustment and depth integration (paper 3.3)."""

    integrate: bool = expert(True)
    """True refines depth maps; False keeps the scaled depth priors, which is faster."""
    map_width: int = expert(200, ge=16)
    """Width in pixels to which depth maps are subsampled for refinement. Wider depth maps are
    slower to refine and show finer details. [tuned: benchmarks.ablation]"""
    depth_regularization: bool = expert(True)
    """Use the depth regularization ``C_reg`` in bundle adjustment. [paper 3.3]"""
    measure_depth_noise: bool = expert(True)
    """Scale the declared variance of depth priors by the measured agreement between images
    (:mod:`mpsfm_core.mapping.refinement.depth_noise`). [tuned: benchmarks.ablation]"""
    measure_keypoint_noise: bool = expert(True)
    """Widen the robust reprojection loss if the keypoint errors are normally distributed
    (:mod:`mpsfm_core.mapping.refinement.keypoint_noise`). [tuned: benchmarks.ablation]"""
    first_reprojection_scale: float = expert(5.0, ge=1)
    """Factor on the scale of the reprojection loss in the first bundle adjustment of a new image,
    whose reprojection errors may be several pixels. [tuned: benchmarks.ablation]"""
    refine_focal: bool = Field(True)
    """Refine guessed focal lengths that the images determine; known focal lengths stay fixed."""
    refine_distortion: bool = Field(True)
    """Estimate the distortion of the camera model (``inputs.camera_model``) for cameras whose focal
    length is refined."""
    refine_principal_point: bool = False
    """Estimate the principal point of cameras whose focal length is refined. [COLMAP
    Mapper.ba_refine_principal_point]"""
    bundle: BundleOptions = BundleOptions()
    """Options of bundle adjustment."""
    integration: IntegrationOptions = IntegrationOptions()
    """Options of depth integration."""


class ConsistencyOptions(Options):
    """Options of the dense depth consistency check between images (paper 3.4)."""

    enabled: bool = expert(True)
    """Reject images whose depth contradicts registered images, while False registers more wrong
    images."""
    weigh_evidence: bool = expert(True)
    """Measure the noise of a depth prior for each pixel from nearby well-constrained points
    (:func:`~mpsfm_core.mapping.refinement.depth_noise.measure_local_depth_noise`). If
    ``weigh_evidence`` is False, one noise level of depth is measured for the whole scene. [tuned:
    benchmarks.symmetry]"""
    check_pairs: bool = expert(True)
    """If the global initialization fails, check the depth consistency of image pairs and reweight
    their matches (:mod:`~mpsfm_core.mapping.consistency.pair_consistency`). [tuned:
    benchmarks.accuracy]"""
    check_at_end: bool = expert(True)
    """Repeat the depth check of every image after the last registration. [paper 3.4]"""
    max_violations: float = expert(0.05, gt=0)
    """Share of pixels that contradict the depth of another image above which an image is rejected;
    raising it registers more images, also wrong ones. The measured share of wrong depth is added.
    [paper beta] [tuned: benchmarks.symmetry]"""
    max_deviation: float = expert(2.7, gt=0)
    """Smallest depth error of a pixel that counts as a violation of depth consistency, in standard
    deviations of both depth priors. [paper gamma] [reference: 0.6 * 15 / 3.33]"""
    map_width: int = expert(160, ge=16)
    """Width in pixels to which depth maps are subsampled for the depth consistency check. [ours]"""


class MappingOptions(Options):
    """The ``mapping`` section of a configuration."""

    known_poses: Literal["start", "fixed", "guess"] = "start"
    """Use of the known poses of images. ``start`` refines the known poses and registers the other
    images. ``fixed`` keeps known poses and their unit of length, and leaves out images without a
    known pose. ``guess`` also re-registers misregistered images, and scales the world to meters if
    depth is metric."""
    parts: Annotated[int, Field(ge=20)] | Literal["auto"] | None = "auto"
    """Number of images per part, to map more images in overlapping parts that are joined. Parts run
    on the workers of ``runtime.executor``. ``auto`` maps more than 2000 images in parts of 1000, if
    an executor with workers is set. null maps all images in one piece, as images with known poses
    that are no guesses. [tuned: benchmarks.scale]"""
    min_model_size: int = Field(2, ge=2)
    """Number of registered images below which a component is discarded. [COLMAP min_model_size]"""
    weigh_by_score: bool = expert(True)
    """Weight matches by their scores in pose support and in bundle adjustment.
    [tuned: benchmarks.ablation]"""
    global_initialization: bool = expert(True)
    """Initialize from averaged poses of all well connected images, or from an image pair if these
    poses fail verification. Without global initialization, an image pair initializes every
    component. [tuned: benchmarks.ablation]"""
    max_components: int = expert(10, ge=1)
    """Maximum number of disconnected components. [COLMAP max_num_models]"""
    max_runs: int = expert(3, ge=1)
    """Maximum number of mapper runs with different seeds; raising it takes longer and may register
    more images of difficult scenes. [tuned: benchmarks.accuracy]"""
    enough_explained: float = expert(0.75, ge=0, le=1)
    """Share of the summed match scores whose keypoints must observe common 3D points, so that no
    further mapper run is needed. [tuned: benchmarks.accuracy]"""
    register_tentatively: bool = False
    """Register images that cannot be verified in the best supported poses. Unverified images
    observe no points, and ``summary.json`` lists these images as unconfirmed."""
    predict_errors: bool = expert(True)
    """Predict the errors of poses and intrinsics for the report. Parts of a reconstruction are
    mapped without predictions, because the last refinement predicts the errors of all images."""
    registration: RegistrationOptions = RegistrationOptions()
    """Options of the registration of images."""
    triangulation: TriangulationOptions = TriangulationOptions()
    """Options of triangulation."""
    refinement: RefinementOptions = RefinementOptions()
    """Options of refinement."""
    consistency: ConsistencyOptions = ConsistencyOptions()
    """Options of the depth consistency check."""


class MapperOptions(MappingOptions):
    """Options of :func:`mpsfm_core.mapping.mapper.reconstruct`."""

    seed: int = 0
    """Random seed of the mapper, which is the seed of the whole pipeline run."""

    @property
    def checks_pairs(self) -> bool:
        """True if image pairs are checked for depth consistency."""
        return self.consistency.enabled and self.consistency.check_pairs
