"""Registration of duplicates with the poses of their originals.

A duplicate shows the view of its original, and adds no parallax. The mapper therefore reconstructs
the scene without duplicates, and then registers the duplicates without optimization.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mpsfm_core.data import MappingProblem
from mpsfm_core.data.decisions import Reason
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import MappingReport, Reconstruction


def remove_duplicates(problem: MappingProblem, options: MapperOptions) -> MappingProblem:
    """Remove the pairs and initial poses of duplicates, so that duplicates are not registered.

    Duplicates are kept if the user provides poses, or if no pair of different views remains.
    """
    is_posed = any(image.known_pose is not None for image in problem.images)
    pairs = problem.distinct_pairs
    if not pairs or (is_posed and options.known_poses != "guess"):
        return problem
    images = tuple(
        replace(image, known_pose=None) if image.duplicate_of else image for image in problem.images
    )
    return MappingProblem(images, pairs, problem.rigs)


def register_duplicates(model: Reconstruction, problem: MappingProblem) -> Reconstruction:
    """Register the duplicates of the registered images with poses and points of their originals.

    Args:
        model: Reconstruction without some or all duplicates.
        problem: Mapping problem with duplicates, which have the keypoints of their originals.
    """
    registered = {image.index: image for image in model.images}
    duplicates = [
        replace(registered[original], index=index, name=problem.images[index].name)
        for index, original in problem.originals.items()
        if original in registered and index not in registered
    ]
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
        if image.duplicate_of is None:
            continue
        if image.name in registered:  # with its original, or with the frame of its rig
            reasons.pop(image.name, None)
        elif image.duplicate_of in report.image_reasons:
            reasons[image.name] = report.image_reasons[image.duplicate_of]
    return reasons
