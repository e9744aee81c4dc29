"""Mapper runs of one reconstruction, from the first pass to refined depth maps.

1. The first pass maps all images. If a video camera jumps in the result, the images are mapped
   again without the matches across the jump, and once more with those that this model confirms.
2. If the estimated distortion is strong, depth is predicted again in undistorted views, and the
   images are mapped again.
3. With a fast first pass, the second pass matches images with too few points by the configured
   matcher, and maps again from the poses of the first pass.
4. Depth maps are refined in views that are undistorted with the refined cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from mpsfm_core.config import Config
from mpsfm_core.data import Bool, MappingProblem
from mpsfm_core.extraction.runner import Extraction, extend_matches, predict_priors_again
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.mapping.camera_jumps import (
    Jump,
    find_jumps,
    join_shots,
    remove_matches_across,
    restore_right_matches,
)
from mpsfm_core.mapping.initialization.refined_focal_lengths import estimate_relative_poses
from mpsfm_core.mapping.initialization.rig_calibration import calibrate_rigs
from mpsfm_core.mapping.initialization.seed_poses import apply_seed_poses, select_seed_images
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts import part_mapping
from mpsfm_core.mapping.scene.reconstruction import MappingResult
from mpsfm_core.pipeline.checkpoints import MappingCheckpoints, RunCheckpoints
from mpsfm_core.pipeline.input_reader import InputReader
from mpsfm_core.pipeline.parts import PartMapper, PartRecord, choose_part_size
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.provider_config import FROM_MATCHER, FROM_MULTIVIEW
from mpsfm_core.providers.registry import Registry
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.refined_views import (
    measure_distortion,
    refine_reconstructions,
    take_refined_camera,
    undistort_images,
    undistort_problem,
)

_MIN_DISTORTION = 0.1
"""Relative displacement of the image corners by lens distortion from which depth is predicted again
in undistorted images. [tuned: benchmarks.distortion]"""
_MAX_JUMP_RUNS = 3
"""Maximum number of times that a video is mapped again without the matches across a camera jump.
[ours]"""


@dataclass(frozen=True)
class MappedImages:
    """Result of one pass."""

    extracted_views: ImageSet
    """Images in whose undistorted views keypoints and priors of ``extraction`` are."""
    extraction: Extraction
    mapped_views: ImageSet
    """Images in whose undistorted views keypoints and depth maps of ``mapping`` are."""
    mapping: MappingResult


class MappingPasses:
    """All mapper runs of one reconstruction.

    Args:
        config: Configuration of the run.
        registry: Installed providers.
        stages: Receiver of progress and messages.
        inputs: Known poses, rigs and videos of the run.
        checkpoints: Checkpoints of the run, to which those of the mapper are added.
    """

    def __init__(
        self,
        config: Config,
        registry: Registry,
        stages: Stages,
        inputs: InputReader,
        checkpoints: RunCheckpoints,
    ) -> None:
        self._config, self._registry, self._stages = config, registry, stages
        self._inputs, self._checkpoints = inputs, checkpoints
        # Known poses contradict false matches by themselves.
        self._shots = [] if inputs.known_poses else inputs.shots
        self.jumps: list[Jump] = []
        """Jumps of a video camera in the last result of the mapper."""
        self.part_records: list[PartRecord] = []
        """Time and memory of the parts in the last run of the mapper."""

    def run(
        self, images: ImageSet, extraction: Extraction
    ) -> tuple[Extraction, MappingResult, OriginalImages]:
        """Run all passes.

        Returns:
            Extraction with the matches of all passes, result of the last mapper run, and the images
            with refined cameras.
        """
        mapped = self._run_first_pass(images, extraction)
        mapped = self._map_undistorted(mapped)
        if self._config.has_second_pass:
            mapped = self._run_second_pass(mapped)
        problem, views, mapping = mapped.extraction.problem, mapped.mapped_views, mapped.mapping
        with self._stages.stage("mapping"):
            refined = undistort_images(views, problem, mapping.reconstructions)
            problem = undistort_problem(mapped.extracted_views, refined, problem)
            if refined is not views:
                mapping = self._refine_depth_maps(refined, problem, mapping)
        return mapped.extraction, mapping, OriginalImages(refined, problem)

    def _run_first_pass(self, images: ImageSet, extraction: Extraction) -> MappedImages:
        problem = extraction.problem.with_poses(self._inputs.known_poses)
        return self._map_without_jumps(images, extraction, images, problem)

    def _map_undistorted(self, mapped: MappedImages) -> MappedImages:
        """Predict depth and map again in undistorted views, if the mapper found strong distortion.

        Depth networks are trained on images without distortion.
        """
        config = self._config
        images, extraction, mapping = mapped.mapped_views, mapped.extraction, mapped.mapping
        refined = undistort_images(images, extraction.problem, mapping.reconstructions)
        changed = _find_changes(images, refined)
        distortion = max(map(measure_distortion, compress(refined, changed)), default=0.0)
        if distortion < _MIN_DISTORTION or not self._predicts_from_one_view():
            return mapped
        self._stages.notice(
            f"the lens moves the image corners by {distortion:.0%}, so {config.depth.use} predicts "
            "depth again, from undistorted images"
        )
        with self._stages.stage("extraction"):
            problem = undistort_problem(images, refined, extraction.problem)
            problem = predict_priors_again(refined, config, self._registry, problem, self._stages)
            problem = self._use_refined_cameras(problem, changed, mapping)
        return self._map_without_jumps(
            refined,
            replace(extraction, problem=problem),
            refined,
            problem.with_poses(self._inputs.known_poses),
        )

    def _predicts_from_one_view(self) -> bool:
        """Return whether depth and normals are predicted from single views, and not from files."""
        depth, normals = self._config.depth.use, self._config.normals.use
        if depth in (FROM_MATCHER, FROM_MULTIVIEW):
            return False
        specs = self._registry.spec("depth", depth), self._registry.spec("normals", normals)
        return not any("uncached" in spec.capabilities for spec in specs)

    def _run_second_pass(self, mapped: MappedImages) -> MappedImages:
        """Match images with too few points after the fast pass, and map again from seed poses."""
        config = self._config
        images, mapping = mapped.mapped_views, mapped.mapping
        seeds = select_seed_images(mapping)
        unconstrained = frozenset(range(len(images))) - {image.index for image in seeds}
        if not unconstrained:
            return mapped
        matchers = (config.matcher, config.dense_matcher)
        names = " and ".join(matcher.use for matcher in matchers if matcher is not None)
        self._stages.notice(
            f"{len(unconstrained)} of {len(images)} images have too few points after the fast "
            f"pass: {names} matches these images again"
        )
        with self._stages.stage("extraction"):
            extraction = extend_matches(
                images, config, self._registry, mapped.extraction, unconstrained, self._stages
            )
        refined = undistort_images(images, extraction.problem, mapping.reconstructions)
        problem = undistort_problem(images, refined, extraction.problem)
        problem = self._use_refined_cameras(problem, _find_changes(images, refined), mapping)
        problem = problem.with_poses(self._inputs.known_poses)
        options = config.mapper_options()
        if not self._inputs.known_poses:
            options = options.model_copy(update={"known_poses": "guess"})
        if options.known_poses != "fixed":
            seeds = [take_refined_camera(refined, seed) for seed in seeds]
            problem = apply_seed_poses(problem, seeds)
        return self._map_without_jumps(images, extraction, refined, problem, options)

    def _use_refined_cameras(
        self, problem: MappingProblem, changed: Bool, mapping: MappingResult
    ) -> MappingProblem:
        """Estimate relative poses of pairs and cameras of rigs again after cameras changed."""
        problem = estimate_relative_poses(problem, changed, self._config.runtime.seed)
        return calibrate_rigs(problem, mapping.reconstructions) or problem

    def _refine_depth_maps(
        self, refined: ImageSet, problem: MappingProblem, mapping: MappingResult
    ) -> MappingResult:
        """Refine depth maps again in views that are undistorted with the refined cameras."""
        options = self._config.mapper_options()
        parts = refine_reconstructions(refined, problem, mapping.reconstructions, options)
        return replace(mapping, reconstructions=parts)

    def _map_without_jumps(
        self,
        extracted_views: ImageSet,
        extraction: Extraction,
        mapped_views: ImageSet,
        problem: MappingProblem,
        options: MapperOptions | None = None,
    ) -> MappedImages:
        """Map the images, and map again without false matches if the camera of a video jumps.

        Args:
            extracted_views: Images in whose undistorted views the extraction is.
            extraction: Keypoints, matches and priors.
            mapped_views: Images in whose undistorted views the problem is.
            problem: Mapping problem with poses and refined cameras.
            options: Options of the mapper, by default those of the configuration.
        """
        options = options or self._config.mapper_options()
        shots = join_shots(self._shots, problem)
        complete, first = problem, self._map(problem, options)
        mapping = first
        for _ in range(_MAX_JUMP_RUNS):
            jumps = find_jumps(mapping.reconstructions, shots)
            shorter = remove_matches_across(problem, jumps, shots)
            num_removed = len(problem.pairs) - len(shorter.pairs)
            if not num_removed:
                break
            jump = next(jump for jump in jumps if not jump.is_drift)
            self._stages.notice(
                f"the camera jumps between the frames {jump.before} and {jump.after}, so the "
                f"matches of {num_removed} pairs of distant frames across a jump are not used"
            )
            problem, mapping = shorter, self._map(shorter, options)
        restored = restore_right_matches(problem, complete, mapping.reconstructions, shots)
        num_restored = len(restored.pairs) - len(problem.pairs)
        if num_restored:
            self._stages.notice(
                f"{num_restored} of these pairs match places that are close to each other in the "
                "model without them, so they are used again"
            )
            is_complete = len(restored.pairs) == len(complete.pairs)
            problem, mapping = restored, first if is_complete else self._map(restored, options)
        self.jumps = find_jumps(mapping.reconstructions, shots)
        if len(problem.pairs) < len(complete.pairs):
            extraction = replace(extraction, problem=_select_pairs(extraction.problem, problem))
        return MappedImages(extracted_views, extraction, mapped_views, mapping)

    def _map(self, problem: MappingProblem, options: MapperOptions) -> MappingResult:
        """Run the mapper, in one piece or in parts."""
        runtime = self._config.runtime
        options = choose_part_size(options, runtime, len(problem.images))
        with self._stages.stage("mapping"):
            part_mapper = self._checkpoints.add(
                PartMapper(runtime, self._registry, self._stages, fresh=self._checkpoints.fresh)
            )
            result = part_mapping.reconstruct(
                problem,
                options,
                self._stages,
                self._mapping_checkpoints(problem, options),
                part_mapper,
            )
            self.part_records = part_mapper.records
            return result

    def _mapping_checkpoints(
        self, problem: MappingProblem, options: MapperOptions
    ) -> MappingCheckpoints | None:
        runtime = self._config.runtime
        if runtime.checkpoint_s is None:
            return None
        return self._checkpoints.add(
            MappingCheckpoints(
                runtime.cache_dir, problem, options, self._stages, runtime.checkpoint_s
            )
        )


def _select_pairs(problem: MappingProblem, mapped: MappingProblem) -> MappingProblem:
    """Return the problem with the pairs of images that the mapped problem has."""
    kept = {(pair.image_a, pair.image_b) for pair in mapped.pairs}
    pairs = (pair for pair in problem.pairs if (pair.image_a, pair.image_b) in kept)
    return replace(problem, pairs=tuple(pairs))


def _find_changes(images: ImageSet, refined: ImageSet) -> Bool:
    """Return which images (n,) have a refined camera."""
    return np.array([new is not old for new, old in zip(refined, images, strict=True)], bool)
