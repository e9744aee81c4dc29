"""Options of the mapper, with the source of each default.

``[paper ...]`` cites a section of MP-SfM and ``[reference ...]`` its published code.
``[COLMAP ...]`` names an option of COLMAP's incremental mapper. ``[tuned: ...]`` names the
benchmark that chose the value; ``[ours]`` marks a choice without a benchmark. Angles are true
angles; the reference overestimates them.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options, expert
from mpsfm_core.optimize.options import BundleOptions, IntegrationOptions


class InitializationOptions(Options):
    """Initialization of a component."""

    global_initialization: bool = expert(True)
    """Register all well connected images together; if the result fails verification, initialize
    from a pair. False always initializes from a pair. [tuned: benchmarks.ablation]"""
    max_pairs: int = expert(50, ge=1)
    """Maximum number of pairs to try; raising it tries harder before images are given up. [ours]"""
    num_compared: int = expert(5, ge=1)
    """Number of pairs with most matches whose poses are compared; the best supported pair is tried
    first. [tuned: benchmarks.accuracy]"""
    high_parallax_deg: float = expert(1.5, gt=0)
    """Smallest triangulation angle of a point that supports a pair if ``lifting`` is off.
    [COLMAP init_min_tri_angle]"""


class RegistrationOptions(Options):
    """Absolute pose of the next image."""

    next_view: Literal["match-scores", "inlier-matches", "visible-points"] = expert("match-scores")
    """Order of registration: by summed match scores or number of matches with the best registered
    image, or by number of visible 3D points. [paper, next view selection]"""
    min_inliers: int = Field(30, ge=3)
    """Smallest number of inliers of a pose; raising it registers fewer and surer images.
    [COLMAP abs_pose_min_num_inliers]"""
    min_pose_inlier_ratio: float = expert(0.7, ge=0, le=1)
    """Smallest share of the 2D-3D matches that are inliers; raising it rejects more wrong poses and
    more images with repeated structure. [tuned: benchmarks.ablation]"""
    max_error_px: float = expert(12.0, gt=0)
    """Largest reprojection error of an inlier of PnP; raising it accepts less exact points.
    [COLMAP abs_pose_max_error]"""
    max_support_error_px: float = expert(4.0, gt=0)
    """Largest distance of a supporting keypoint to the projected depth interval of its match.
    [COLMAP two-view max_error]"""
    max_depth_deviation: float = expert(2.0, ge=0)
    """Half length of that interval in standard deviations of log depth; raising it lowers the
    influence of depth. [ours]"""
    confident_inlier_ratio: float = expert(0.85, ge=0, le=1)
    """Inlier ratio above which no hypotheses from resampled matches are generated. [ours]"""
    num_resamples: int = expert(8, ge=0)
    """Number of random halves of the matches that generate hypotheses per attempt. [ours]"""
    max_resampled_attempts: int = expert(3, ge=0)
    """Number of attempts at an image that draw new halves. [ours]"""
    num_locally_optimized: int = expert(8, ge=0)
    """Number of distinct hypotheses whose support is maximized; 0 keeps the poses of RANSAC.
    [tuned: benchmarks.ablation]"""
    num_bundle_adjusted: int = expert(3, ge=1)
    """Number of distinct poses that bundle adjustment refines before one is chosen. [ours]"""
    max_bundle_iterations: int = expert(10, ge=1)
    """Maximum number of iterations of that bundle adjustment. [ours]"""
    min_inlier_ratio: float = expert(0.25, gt=0, le=1)
    """Inlier ratio from which RANSAC computes its number of trials; raising it is faster and may
    miss poses. [COLMAP abs_pose_min_inlier_ratio]"""
    estimate_focal: bool = expert(True)
    """Estimate a guessed focal length with the pose, unless a registered image shares the camera.
    False registers with the guess. Needs ``refinement.refine_focal``. [ours]"""
    lifting: bool = expert(True)
    """Use points that depth lifts from a single view. [paper 3.2]"""
    min_point_angle_deg: float = expert(1.0, ge=0)
    """Triangulation angle below which a lifted point replaces a triangulated one.
    [reference robust_triangles]"""
    num_neighbors: int = expert(4, ge=0)
    """Number of neighbors of the reference image whose points are used. [reference: bundle of 5]"""
    max_relaxations: int = expert(6, ge=0)
    """Number of times that ``min_inliers`` and ``min_pose_inlier_ratio`` are divided by 1.2 if no
    image registers; raising it registers more and less certain images. [reference]"""


class TriangulationOptions(Options):
    """Triangulation and filtering of tracks."""

    min_angle_deg: float = expert(1.5, ge=0)
    """Triangulation angle below which depth lifts a point; raising it relies more on depth.
    [COLMAP tri_min_angle] [reference hard_angle]"""
    max_angle_error_deg: float = expert(2.0, gt=0)
    """Largest angular error of an observation of a new image, before refinement.
    [COLMAP tri_create_max_angle_error, tri_continue_max_angle_error]"""
    max_error_px: float = Field(4.0, gt=0)
    """Largest reprojection error of an observation, times the standard deviation of its keypoint;
    raising it keeps more and less exact points. [COLMAP filter_max_reproj_error]"""


class RefinementOptions(Options):
    """Bundle adjustment and depth integration (paper 3.3)."""

    integrate: bool = Field(True)
    """Refine depth maps; False keeps the scaled priors, which is faster."""
    map_width: int = expert(200, ge=16)
    """Width to which maps are subsampled for refinement; the change is interpolated. Raising it is
    slower. [tuned: benchmarks.ablation]"""
    bundle_depth: Literal["prior", "refined"] = expert("prior")
    """Depth that regularizes bundle adjustment: the scaled priors, or the refined maps in
    alternation with depth integration as in the paper. [tuned: benchmarks.ablation]"""
    depth_regularization: bool = expert(True)
    """Use ``C_reg`` in bundle adjustment. [paper 3.3]"""
    measure_depth_noise: bool = expert(True)
    """Scale the declared variance of depth priors by how well views agree
    (:mod:`mpsfm_core.mapping.refinement.depth_noise`). [tuned: benchmarks.ablation]"""
    measure_keypoint_noise: bool = expert(True)
    """Widen the reprojection loss if the errors of keypoints are normally distributed
    (:mod:`mpsfm_core.mapping.refinement.keypoint_noise`). [tuned: benchmarks.ablation]"""
    free_scales: bool = expert(True)
    """Estimate the scales of depth priors in bundle adjustment. False alternates, as the reference
    does, and converges slowly because poses and points compensate scale errors.
    [tuned: benchmarks.ablation]"""
    local_images: int = expert(5, ge=2)
    """Number of images of a local bundle, with the new image. [reference]
    [COLMAP ba_local_num_images]"""
    first_reprojection_scale: float = expert(5.0, ge=1)
    """Factor on the scale of the reprojection loss in the first bundle adjustment of a new image,
    whose pose may be off by pixels. [tuned: benchmarks.ablation]"""
    global_growth: float = expert(0.3, gt=0)
    """Relative growth of images or points after which all images are refined; raising it is faster
    and less accurate. [reference]"""
    refine_focal: bool = Field(True)
    """Refine guessed focal lengths that the images determine; given ones stay."""
    final_robust: bool = expert(False)
    """End with a global refinement with a sharper depth loss.
    [paper, robust reconstruction] [tuned: benchmarks.ablation]"""
    bundle: BundleOptions = BundleOptions()
    """Options of bundle adjustment."""
    integration: IntegrationOptions = IntegrationOptions()
    """Options of depth integration."""


class ConsistencyOptions(Options):
    """Dense depth consistency check (paper 3.4)."""

    enabled: bool = True
    """Reject images whose depth contradicts the model; False registers more wrong images."""
    weigh_evidence: bool = expert(True)
    """Measure the noise of a prior locally, from well-constrained points
    (:func:`~mpsfm_core.mapping.refinement.depth_noise.measure_local_depth_noise`); False measures
    it for the whole scene. [tuned: benchmarks.symmetry]"""
    check_pairs: bool = expert(True)
    """If the global initialization fails, check pairs against depth and reweight their matches
    (:mod:`~mpsfm_core.mapping.consistency.pair_consistency`). [tuned: benchmarks.accuracy]"""
    check_at_end: bool = expert(True)
    """Check every image again at the end. [paper 3.4]"""
    max_violations: float = expert(0.05, gt=0)
    """Share of pixels that contradict another image above which an image is rejected; raising it
    registers more images and more wrong ones. [paper beta] [tuned: benchmarks.symmetry]"""
    max_violations_pair: float = expert(0.01, gt=0)
    """The same for a pair before any image is registered. [tuned: benchmarks.accuracy]"""
    max_deviation: float = expert(2.7, gt=0)
    """Smallest depth error that counts as a violation, in standard deviations of both priors.
    [paper gamma] [reference: 0.6 * 15 / 3.33]"""
    min_gap: float = expert(0.05, ge=0)
    """Smallest relative depth error that counts as a violation. [tuned: benchmarks.symmetry]"""
    num_views: int = expert(16, ge=1)
    """Number of images with the largest overlap that an image is compared with. [ours]"""
    map_width: int = expert(160, ge=16)
    """Width to which depth maps are subsampled for the check. [ours]"""


class MappingOptions(Options):
    """The ``mapping`` section of a configuration."""

    known_poses: Literal["start", "fixed", "guess"] = "start"
    """Use of poses that come with images. ``start`` refines them and registers the other images.
    ``fixed`` keeps poses, world and unit, and leaves out images without a pose. ``guess`` is
    ``start``, but may change the unit, to meters if depth is metric, and move images."""
    min_model_size: int = Field(2, ge=2)
    """Number of images below which a component is discarded. [COLMAP min_model_size]"""
    weigh_by_score: bool = expert(True)
    """Weight matches by their scores in pose support and in bundle adjustment.
    [tuned: benchmarks.ablation]"""
    max_components: int = Field(10, ge=1)
    """Maximum number of disconnected components. [COLMAP max_num_models]"""
    max_runs: int = Field(3, ge=1)
    """Maximum number of runs with different seeds; raising it takes longer and may register more
    images of difficult scenes. [tuned: benchmarks.accuracy]"""
    enough_explained: float = expert(0.75, ge=0, le=1)
    """Share of the match scores that a model must explain so that no further run is needed.
    [tuned: benchmarks.accuracy]"""
    register_tentatively: bool = False
    """Also register the remaining images where their matches fit best. They observe no points; the
    summary lists them as unconfirmed."""
    initialization: InitializationOptions = InitializationOptions()
    """Options of the initialization."""
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
    """Seed of every random choice; a configuration has one for the whole run."""

    @property
    def checks_pairs(self) -> bool:
        """True if pairs are checked against depth."""
        return self.consistency.enabled and self.consistency.check_pairs
