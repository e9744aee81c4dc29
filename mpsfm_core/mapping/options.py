"""Every setting of the mapper, with its source.

"Reference" is the published system's default, "COLMAP" that of COLMAP 3.12's incremental mapper.
Angles of the reference's initialisation were tuned with a formula that over-estimates angles; the
values here are for true angles (chosen by ``benchmarks/ablation.py``).
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mpsfm_core.data.options import Options
from mpsfm_core.optimize.options import BundleOptions, IntegrationOptions


class InitializationOptions(Options):
    """How a group of images starts."""

    global_initialization: bool = True
    """Place all well connected images at once
    (:mod:`mpsfm_core.mapping.initialization.global_initialization`), and go on from a first pair
    only where that does not hold."""
    max_pairs: int = Field(50, ge=1)
    """How many pairs are tried, best first."""
    num_compared: int = Field(5, ge=1)
    """Pairs with most matches whose poses are compared; the best supported is tried first (ours: on
    hololens_room AUC@5/20 12.5/22.5 -> 23/40, mean of seeds)."""
    high_parallax_deg: float = Field(1.5, gt=0)
    """Without lifting, a point triangulated with at least this angle supports the pose."""


class RegistrationOptions(Options):
    """Absolute pose of the next image."""

    next_view: Literal["match-scores", "inlier-matches", "visible-points"] = "match-scores"
    """Rank by summed match scores, number of verified matches (both with the best registered
    image), or number of 3D points seen (paper, next view selection; default: the paper's)."""
    min_inliers: int = Field(30, ge=3)
    """Reference and COLMAP: abs_pose_min_num_inliers."""
    min_inlier_share: float = Field(0.7, ge=0, le=1)
    """Share of the 2D-3D matches that must be inliers. Ours: on rendered_kitchen 96 % of the right
    pairs pass, 30 % of the wrong ones."""
    max_error_px: float = Field(12.0, gt=0)
    """Reference and COLMAP: abs_pose_max_error."""
    max_support_error_px: float = Field(4.0, gt=0)
    """Distance of a supporting keypoint to the segment its match projects to (COLMAP: two-view
    max_error)."""
    depth_deviations: float = Field(2.0, ge=0)
    """Half length of that segment in standard deviations of log depth (ours)."""
    confident_share: float = Field(0.85, ge=0, le=1)
    """Support above which a pose needs no rivals from resampled matches (ours)."""
    num_resamples: int = Field(8, ge=0)
    """Random halves of the matches that are tried otherwise, others at each attempt (ours)."""
    resampled_attempts: int = Field(3, ge=0)
    """Attempts at an image after which no more halves are tried (ours)."""
    num_improved: int = Field(8, ge=0)
    """Best supported distinct poses that are moved to where matches support them most. Ours, beside
    PnP refined by reprojection errors, means of seeds: AUC@1 of rendered_kitchen leq30 with sensor
    depth 61 -> 63 (minimal 61 -> 57), AUC@20 of hololens_room 41 -> 45, FastDepth on leq10 of the
    former 42 -> 51, in less time."""
    num_polished: int = Field(3, ge=1)
    """Best supported distinct poses that are bundle-adjusted before one is chosen (ours)."""
    polishing: int = Field(10, ge=1)
    """Iterations of that bundle adjustment (ours)."""
    min_inlier_ratio: float = Field(0.25, gt=0, le=1)
    """Reference and COLMAP: used for RANSAC's number of trials."""
    lifting: bool = True
    """Use depth-lifted single-view points (paper section 3.2); off for ablation."""
    min_point_angle_deg: float = Field(1.0, ge=0)
    """Points of smaller angle are replaced by lifts (reference: robust_triangles)."""
    num_neighbors: int = Field(4, ge=0)
    """Images beside the reference image whose points are used (reference: bundle of 5)."""
    max_relaxations: int = Field(6, ge=0)
    """Failure ladder: min_inliers and min_inlier_share are divided by 1.2 this many times
    (reference)."""


class TriangulationOptions(Options):
    """Tracks and their points."""

    min_angle_deg: float = Field(1.5, ge=0)
    """Points of smaller angle are lifted from depth (reference: hard_angle; COLMAP: 1.5)."""
    max_angle_error_deg: float = Field(2.0, gt=0)
    """For a new image, before refinement (COLMAP: create/continue_max_angle_error)."""
    max_error_px: float = Field(4.0, gt=0)
    """For refined images: complete, merge, filter (COLMAP; times the keypoints' std)."""


class RefinementOptions(Options):
    """Alternation of depth integration and bundle adjustment (paper section 3.3)."""

    integrate: bool = True
    """Refine depth maps; off: the scaled priors are used."""
    map_width: int = Field(200, ge=16)
    """Columns that maps are thinned out to for that; the change is interpolated. Ours: beside whole
    maps of 387 columns mapping takes half the time and ends with the same poses, and the error of
    refined depth is 0.033 instead of 0.035 on rendered_kitchen with 5 % of error."""
    bundle_depth: Literal["prior", "refined"] = "prior"
    """Depth that regularises bundle adjustment. "refined": the refined maps, in turn with depth
    integration (paper). "prior": the scaled priors; maps are refined on what comes out (ours: a map
    refined on points holds them where they are, see ``benchmarks/ablation.py``)."""
    depth_regularization: bool = True
    """C_reg in bundle adjustment; off for ablation."""
    measure_depth_noise: bool = True
    """Weigh depth by how well views agree (:mod:`mpsfm_core.mapping.refinement.depth_noise`); off:
    by the declared variance alone."""
    measure_keypoint_noise: bool = True
    """Widen the reprojection loss where keypoints are clean
    (:mod:`mpsfm_core.mapping.refinement.keypoint_noise`); off: as ``bundle`` says."""
    free_scales: bool = True
    """Bundle adjustment estimates the scales of priors beside poses and points; off: they stay as
    estimated when the image was registered. (The reference estimates them in turn with it, which
    converges slowly: what a scale pulls askew, points and poses hold there.)"""
    local_images: int = Field(5, ge=2)
    """Images of a local bundle, the new one included (reference; COLMAP: 6)."""
    local_iterations: int = Field(2, ge=0)
    """Reference and COLMAP: ba_local_max_refinements."""
    local_max_change: float = Field(0.001, ge=0)
    """Reference and COLMAP: ba_local_max_refinement_change."""
    first_reprojection_scale: float = Field(5.0, ge=1)
    """Multiplies the scale of the reprojection loss in the first bundle adjustment of a new image,
    whose pose from lifted points may miss by pixels (ours)."""
    global_iterations: int = Field(5, ge=1)
    """Reference and COLMAP: ba_global_max_refinements."""
    global_max_change: float = Field(0.0005, ge=0)
    """Reference and COLMAP: ba_global_max_refinement_change."""
    global_growth: float = Field(0.3, gt=0)
    """Refine globally when images or points grew by this share (reference; COLMAP: 0.1)."""
    refine_focal: bool = True
    """Refine focal lengths that are guesses, in global refinement. Ours: EXIF is a guess. On
    rendered_kitchen (all images, degraded depth) a focal length 3 % too long takes AUC@1/5/20 from
    56/90/98 to 13/63/89, and refined it gives 58/91/98."""
    focal_min_images: int = Field(3, ge=2)
    """Registered images below which a guessed focal length stays (ours)."""
    focal_min_angle_deg: float = Field(2.0, ge=0)
    """Median triangulation angle below which a guessed focal length stays (ours)."""
    focal_max_change: float = Field(2.0, gt=1)
    """A refined focal length that changes by more than this factor is a failure and is undone
    (ours; COLMAP accepts ratios of 0.1 to 10 of the image size)."""
    max_depth_ratio: float = Field(1.5, gt=1)
    """Depth observations off by more than this factor are ignored (reference: scale_filter)."""
    final_robust: bool = False
    """End with a global refinement of sharper depth loss (paper, robust reconstruction). Ours:
    off; once the noise of depth is measured it costs accuracy (``benchmarks/ablation.py``)."""
    final_depth_scale: float = Field(0.125, gt=0)
    """Multiplies the depth loss scale then (reference: final_robustification)."""
    anchor_min_angle_deg: float = Field(2.0, ge=0)
    """Points of at least this angle anchor the integration (reference: robust_triangles)."""
    bundle: BundleOptions = BundleOptions()
    integration: IntegrationOptions = IntegrationOptions()


class ConsistencyOptions(Options):
    """Dense depth consistency check (paper section 3.4)."""

    enabled: bool = True
    weigh_evidence: bool = True
    """Take a prior's noise at a place from the points around that rays alone hold
    (:func:`~mpsfm_core.mapping.refinement.depth_noise.measure_local_depth_noise`); off: from the whole scene."""
    check_pairs: bool = True
    """Where not all images go together at once, hold pairs against depth before they count
    (:mod:`~mpsfm_core.mapping.consistency.pair_consistency`)."""
    check_at_end: bool = True
    """Also check every image once at the end (paper)."""
    max_violations: float = Field(0.05, gt=0)
    """Share of pixels contradicting any one view that rejects an image (paper beta). Ours: in
    ``benchmarks/symmetry.py`` views a room too far mostly exceed it, views in place stay below
    0.01, those of halls of 500 views below 0.02."""
    max_violations_initial: float = Field(0.03, gt=0)
    """The same for the first pair (the reference's ratio of both, 0.6)."""
    max_violations_pair: float = Field(0.01, gt=0)
    """The same for a pair that nothing else holds yet. Ours: right pairs of hololens_room stay
    below it at nine of ten; at 0.03 and 0.05 false ones are left that decide
    (``benchmarks/results/accuracy-draws.md``)."""
    max_violations_final: float = Field(0.08, gt=0)
    """The same at the end. Ours: an image that was accepted, and those it holds, should go on
    clearer evidence only (``benchmarks/symmetry.py`` ends the same up to 0.1)."""
    max_deviation: float = Field(2.7, gt=0)
    """Standard deviations of error, of both priors together, that it takes at least to explain a
    violation (paper gamma; the reference's 0.6 x 15 / 3.33 in terms of the calibrated std)."""
    min_gap: float = Field(0.05, ge=0)
    """Relative distance in front of it that a violation has at least: poses and maps are never as
    exact as the best priors say (ours, ``benchmarks/symmetry.py``)."""
    num_views: int = Field(16, ge=1)
    """Overlapping views an image is held against, most overlapping first (ours)."""
    map_width: int = Field(160, ge=16)
    """Columns that maps are thinned out to (ours)."""


class MappingOptions(Options):
    """What a configuration says of the mapper."""

    known_poses: Literal["start", "fixed", "guess"] = "start"
    """Of images that come with a pose: "start" refines them and adds the others, "fixed" keeps
    them, their world and its unit, and leaves images without a pose out; "guess" is "start" in
    another unit, metres if depth tells them."""
    min_model_size: int = Field(2, ge=2)
    """Smallest component that is kept."""
    weigh_by_score: bool = True
    """Let matches count by the matcher's scores: in the support of poses, and as weights of squared
    reprojection errors (ours)."""
    max_components: int = Field(10, ge=1)
    """Largest number of disconnected components."""
    max_runs: int = Field(3, ge=1)
    """Runs with other random choices, at most, until one explains enough of the matches or two come
    to the same; the one whose largest component explains most counts. Ours; on hololens_room `all`
    with sensor depth (mean of four seeds) 108 instead of 100 of 112 images and AUC@20 58 instead of
    47, elsewhere the same."""
    enough_explained: float = Field(0.75, ge=0, le=1)
    """Share of all matches, by score, of which both keypoints see the same point, with which one
    run is enough (ours; rendered_kitchen 0.80 to 0.98, hololens_room 0.5 to 0.9)."""
    register_tentatively: bool = False
    """At the end also place the images that are not in the largest component, in that, where their
    matches fit best; those of another component as a whole. The summary lists them; they see no
    points and change nothing else."""
    initialization: InitializationOptions = InitializationOptions()
    registration: RegistrationOptions = RegistrationOptions()
    triangulation: TriangulationOptions = TriangulationOptions()
    refinement: RefinementOptions = RefinementOptions()
    consistency: ConsistencyOptions = ConsistencyOptions()


class MapperOptions(MappingOptions):
    """Settings of :func:`mpsfm_core.mapping.mapper.reconstruct`."""

    seed: int = 0
    """Seed of every random choice (RANSAC); a configuration has one for the whole run."""

    @property
    def checks_pairs(self) -> bool:
        """Whether pairs are held against depth."""
        return self.consistency.enabled and self.consistency.check_pairs
