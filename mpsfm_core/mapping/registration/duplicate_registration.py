"""Registration of duplicates with the poses of their originals.

A duplicate shows the view of its original, and adds no parallax. The mapper therefore reconstructs
the scene without duplicates, and then registers the duplicates without optimization.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.decisions import Reason
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import MappingReport, Reconstruction


def remove_duplicates(problem: MappingProblem, options: MapperOptions) -> MappingProblem:
    """Remove the pairs and initial poses of duplicates, so that duplicates are not registered.

    Duplicates are kept if the user provides poses, or if no pair of different views remains.
    """
    is_posed = any(image.known_pose is not None for image in problem.images)
    originals = tuple(
        replace(image, known_pose=None) if image.duplicate_of else image for image in problem.images
    )
    pairs = tuple(
        pair
        for pair in problem.pairs
        if not any(originals[i].duplicate_of for i in (pair.image_a, pair.image_b))
    )
    if not pairs or (is_posed and options.known_poses != "guess"):
        return problem
    return MappingProblem(originals, pairs, problem.rigs)


def register_duplicates(
    model: Reconstruction, problem: MappingProblem, max_error_px: float
) -> Reconstruction:
    """Register the duplicates of the registered images in the poses of their originals.

    Args:
        model: Reconstruction without some or all duplicates.
        problem: Mapping problem with the matches of duplicates and originals.
        max_error_px: Maximum distance in pixels of matched keypoints that observe the same point,
            for keypoints with a standard deviation of 1 px.
    """
    registered = {image.name: image for image in model.images}
    pairs = {(pair.image_a, pair.image_b): pair for pair in problem.pairs}
    duplicates = []
    for index, image in enumerate(problem.images):
        original = registered.get(image.duplicate_of or "")
        pair = pairs.get((original.index, index)) if original else None
        if original and pair and image.name not in registered:
            ends = image.keypoints[pair.matches[:, 1]]
            offsets = ends - problem.images[original.index].keypoints[pair.matches[:, 0]]
            is_near = (offsets**2).sum(axis=1) <= (max_error_px * image.keypoint_std_px) ** 2
            point_ids = np.full(len(image.keypoints), -1, dtype=np.int64)
            point_ids[pair.matches[is_near, 1]] = original.point_ids[pair.matches[is_near, 0]]
            copy = replace(original, index=index, name=image.name, point_ids=point_ids)
            duplicates.append(copy)
    images = sorted([*model.images, *duplicates], key=lambda image: image.index)
    return replace(model, images=tuple(images))


def report_duplicates(
    report: MappingReport, models: Sequence[Reconstruction], problem: MappingProblem
) -> dict[str, Reason]:
    """Return the reasons of unregistered images, and give duplicates those of originals.

    Args:
        report: Report of the mapper run without duplicates.
        models: Reconstructions with the duplicates.
        problem: Mapping problem with the duplicates.
    """
    registered = {image.name for model in models for image in model.images}
    reasons = dict(report.image_reasons)
    for image in problem.images:
        original = image.duplicate_of or ""
        if original in report.image_reasons:
            reasons[image.name] = report.image_reasons[original]
        elif original and image.name in registered:
            del reasons[image.name]
    return reasons
