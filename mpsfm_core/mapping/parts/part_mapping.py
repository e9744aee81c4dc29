"""Mapping in one piece, or in overlapping parts whose reconstructions are joined.

The steps of mapping in parts are::

    parts = partition_match_graph()     # overlapping clusters of well connected images
    map each part                       # mapper.reconstruct, on any worker
    join_reconstructions()              # similarity transforms from common images
    mapper.reconstruct(parts)           # tracks across parts, refinement and checks of all images
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mpsfm_core.data import Int64, MappingProblem
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.checkpoints import CheckpointStore
from mpsfm_core.mapping.events import MappingEvents
from mpsfm_core.mapping.model_selection import sum_step_times
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts.joining import join_reconstructions
from mpsfm_core.mapping.parts.partition import partition_match_graph
from mpsfm_core.mapping.registration.duplicate_registration import remove_duplicates
from mpsfm_core.mapping.scene.reconstruction import MappingResult, Reconstruction

MapParts = Callable[[Sequence[MappingProblem], MapperOptions], Sequence[MappingResult]]
"""Function that maps each part with the given options, and returns the results in order."""


def reconstruct(
    problem: MappingProblem,
    options: MapperOptions | None = None,
    events: MappingEvents | None = None,
    checkpoints: CheckpointStore | None = None,
    map_parts: MapParts | None = None,
) -> MappingResult:
    """Reconstruct all images, in overlapping parts with the option ``parts``.

    The result is identical for each ``map_parts``, because the parts do not depend on each other.

    Args:
        problem: Images with depth and normal priors, and geometrically verified matches.
        options: Options of the mapper.
        events: Receiver of progress events.
        checkpoints: Storage of checkpoints of the mapper in one piece, or of the final refinement.
        map_parts: Function that maps the parts, by default one after the other.
    """
    options = options or MapperOptions()
    parts = select_parts(problem, options)
    if len(parts) < 2:
        return mapper.reconstruct(problem, options, events, checkpoints)
    problems = [problem.subset([problem.images[i].name for i in part]) for part in parts]
    part_options = options.model_copy(
        update={"register_tentatively": False, "predict_errors": False}
    )
    if map_parts is None:
        results = [mapper.reconstruct(part, part_options, events) for part in problems]
    else:
        results = list(map_parts(problems, part_options))
    models = [
        _renumber_images(model, part)
        for part, result in zip(parts, results, strict=True)
        for model in result.reconstructions
    ]
    joined = mapper.JoinedParts(
        join_reconstructions(problem, models, options),
        [np.array([image.index for image in model.images], dtype=np.int64) for model in models],
    )
    result = mapper.reconstruct(problem, options, events, checkpoints, joined)
    reports = [part.report for part in results]
    report = sum_step_times(result.report, [*reports, result.report])
    return replace(result, report=replace(report, runs=result.report.runs))


def select_parts(problem: MappingProblem, options: MapperOptions) -> list[Int64]:
    """Return the image indices of each part, or no parts if the problem is mapped in one piece.

    Only the pipeline knows whether workers map the parts, so ``auto`` selects one piece.
    Known poses that are no guesses define the world, so these images are mapped in one piece.
    """
    size = None if options.parts == "auto" else options.parts
    has_poses = any(image.known_pose is not None for image in problem.images)
    if not size or len(problem.images) <= size or (has_poses and options.known_poses != "guess"):
        return []
    return partition_match_graph(remove_duplicates(problem, options), size)


def _renumber_images(model: Reconstruction, part: Int64) -> Reconstruction:
    """Replace the image indices of a part by those of the whole mapping problem."""
    images = tuple(replace(image, index=int(part[image.index])) for image in model.images)
    return replace(model, images=images)
