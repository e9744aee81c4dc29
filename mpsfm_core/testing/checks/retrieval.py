"""Checks of retrieval providers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.testing.case import Case
from mpsfm_core.testing.examples import outdoor_example
from mpsfm_core.testing.outcome import CheckFailed


def check_retrieval_dimension(case: Case) -> str:
    """Every view has a descriptor of the same length, as they are compared by dot products."""
    others = (case.main.sized(104, 120), outdoor_example("textured"))
    lengths = {len(case.ask(example)) for example in (case.main, *others)}
    if len(lengths) > 1:
        raise CheckFailed(f"descriptors have {' and '.join(map(str, sorted(lengths)))} values")
    return f"{lengths.pop()} values"


def check_retrieval_self_similarity(case: Case) -> str:
    """No view is more similar to another one than to itself, which holds for unit vectors: else
    bright or rich views would be partners of everything."""
    flat = replace(case.main.view, image=np.full_like(case.main.view.image, 200))
    descriptors = np.stack(
        [
            case.ask(case.main),
            case.ask(case.main.partner),
            case.ask(outdoor_example("textured")),
            case.ask_about(flat, case.main),
        ]
    ).astype(np.float64)
    similarity = descriptors @ descriptors.T
    excess = float((similarity - similarity.diagonal()[:, None]).max())
    if excess > 1e-3 * abs(similarity.diagonal()).max():
        lengths = np.linalg.norm(descriptors, axis=1)
        text = f"lengths of descriptors are {lengths.min():.3g} to {lengths.max():.3g}"
        raise CheckFailed(f"a view is more similar to another than to itself: {text}")
    return "no view is more similar to another than to itself"


def check_retrieval_overlap(case: Case) -> str:
    """A view is more similar to the same scene from one and two steps to the side than to two
    views of another scene."""
    case.needs("seen", "told")
    here, other = case.main, outdoor_example("textured", case.main.camera.size)
    examples = (here.partner, here.partner.partner, other, other.partner)
    similarity = [float(case.ask(here).astype(np.float64) @ case.ask(e)) for e in examples]
    beside, elsewhere = min(similarity[:2]), max(similarity[2:])
    if beside <= elsewhere:
        raise CheckFailed(f"similarity {beside:.3f} to its neighbour, {elsewhere:.3f} to another")
    return f"similarity {beside:.3f} to its neighbour, {elsewhere:.3f} to another scene"


CHECKS = (
    check_retrieval_dimension,
    check_retrieval_self_similarity,
    check_retrieval_overlap,
)
