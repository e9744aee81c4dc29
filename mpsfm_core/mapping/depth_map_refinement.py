"""Refinement of the depth maps of a finished reconstruction."""

from __future__ import annotations

from dataclasses import replace

from mpsfm_core.data import MappingProblem
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.refinement.refinement import Refiner
from mpsfm_core.mapping.registration.image_selection import compute_pair_scores
from mpsfm_core.mapping.scene.conversion import convert_image
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.scene.scene import Scene


def refine_depth_maps(
    problem: MappingProblem, reconstruction: Reconstruction, options: MapperOptions
) -> Reconstruction:
    """Refine the depth maps of a reconstruction again, with fixed poses, points and scales.

    Tentatively registered images observe no points, so their depth maps are the scaled depth
    priors.

    Args:
        problem: Mapping problem whose views have the cameras of the reconstruction.
        reconstruction: Reconstruction with poses, points and depth scales, whose depth maps are
            replaced.
        options: Options of the mapper.
    """
    scene = Scene(problem, weigh_by_score=options.weigh_by_score)
    scene.resume(reconstruction)
    scores = compute_pair_scores(scene)
    refiner = Refiner(scene, options, scores)
    refiner.refine_depth([image.index for image in reconstruction.confirmed_images])
    is_metric = reconstruction.metric is not None and reconstruction.metric.trusted
    images = (
        replace(image, depth=convert_image(scene, image.index, 1.0, is_metric).depth)
        for image in reconstruction.images
    )
    return replace(reconstruction, images=tuple(images))
