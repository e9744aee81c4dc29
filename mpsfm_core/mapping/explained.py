"""How many of the matches a reconstruction explains: what its runs are compared by."""

from __future__ import annotations

from mpsfm_core.data import MappingProblem
from mpsfm_core.scene.reconstruction import Reconstruction


def explained_score(model: Reconstruction, problem: MappingProblem) -> float:
    """Summed scores of the matches of which both keypoints see the same point of a model."""
    points = {image.index: image.point_ids for image in model.images}
    total = 0.0
    for pair in problem.pairs:
        if pair.image_a in points and pair.image_b in points:
            seen_a = points[pair.image_a][pair.matches[:, 0]]
            seen_b = points[pair.image_b][pair.matches[:, 1]]
            total += float(pair.scores[(seen_a >= 0) & (seen_a == seen_b)].sum(dtype=float))
    return total


def total_score(problem: MappingProblem) -> float:
    """Summed scores of all matches."""
    return sum(float(pair.scores.sum(dtype=float)) for pair in problem.pairs)
