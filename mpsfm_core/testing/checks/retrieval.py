"""Contract checks of image retrieval providers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core.data import View
from mpsfm_core.testing.contract_case import ContractCase
from mpsfm_core.testing.examples import Example, outdoor_example
from mpsfm_core.testing.outcome import CheckFailed

_MIN_MARGIN = 1e-4
"""Smallest accepted relative difference between the similarities to a neighboring view and to
another scene. The precision of dot products of float32 descriptors is about 1e-6."""


def check_retrieval_dimension(case: ContractCase) -> str:
    """Require the same length of the image descriptor for every view."""
    others = (case.example.sized(104, 120), outdoor_example("textured"))
    lengths = {len(case.run(example)) for example in (case.example, *others)}
    if len(lengths) > 1:
        raise CheckFailed(f"descriptors have {' and '.join(map(str, sorted(lengths)))} values")
    return f"{lengths.pop()} values"


def check_retrieval_self_similarity(case: ContractCase) -> str:
    """Require that no view is more similar to another view than to itself.

    Descriptors of unit norm always pass the check. If descriptors have different norms, the
    descriptors of bright or detailed views can be similar to those of all views. One of the views
    has low contrast, another one 1.8 megapixels.
    """
    flat = replace(case.example.view, image=np.full_like(case.example.view.image, 255))
    image = case.example.view.image
    faint = replace(case.example.view, image=(96 + 0.25 * image).astype(np.uint8))
    descriptors = np.stack(
        [
            case.run(case.example),
            case.run(case.example.partner),
            case.run(outdoor_example("textured")),
            case.run_on_view(flat, case.example),
            case.run_on_view(faint, case.example),
            case.run_on_view(_enlarge(case.example), case.example),
        ]
    ).astype(np.float64)
    similarity = descriptors @ descriptors.T
    excess = float((similarity - similarity.diagonal()[:, None]).max())
    if excess > 1e-3 * abs(similarity.diagonal()).max():
        lengths = np.linalg.norm(descriptors, axis=1)
        text = f"lengths of descriptors are {lengths.min():.3g} to {lengths.max():.3g}"
        raise CheckFailed(f"a view is more similar to another view than to itself: {text}")
    return "no view is more similar to another than to itself"


def check_retrieval_overlap(case: ContractCase) -> str:
    """Require a higher similarity to neighboring views than to another scene.

    The cameras of the neighboring views are moved sideways by one and by two steps.
    """
    case.require_truth("image", "prepared")
    example, other = case.example, outdoor_example("textured", case.example.camera.size)
    examples = (example.partner, example.partner.partner, other, other.partner)
    similarity = [float(case.run(example).astype(np.float64) @ case.run(e)) for e in examples]
    neighbor, unrelated = min(similarity[:2]), max(similarity[2:])
    if neighbor <= unrelated + _MIN_MARGIN * abs(unrelated):
        raise CheckFailed(
            f"the similarity is {neighbor:.6g} to a neighboring view, but {unrelated:.6g} "
            f"to another scene"
        )
    return f"similarity {neighbor:.3f} to a neighboring view, {unrelated:.3f} to another scene"


def check_retrieval_sizes(case: ContractCase) -> str:
    """Require a higher similarity to a smaller, larger or cropped copy than to another scene.

    Photos of one scene may have different sizes and landscape or portrait format. Smaller and
    larger copies must also be more similar than a view that is moved by three steps.
    """
    case.require_truth("image", "prepared")
    width, height = case.example.camera.size
    example, other = case.example, outdoor_example("textured", (width, height))
    copies = {
        "smaller": example.sized(2 * width // 3, 2 * height // 3),
        "larger": example.sized(2 * width, 2 * height),
        "portrait": example.crop(width // 4, 0, 2 * width // 3, height),
    }
    vector = case.run(example).astype(np.float64)
    unrelated = max(float(vector @ case.run(e)) for e in (other, other.sized(height, width)))
    similarity = {name: float(vector @ case.run(copy)) for name, copy in copies.items()}
    similarity["eight times larger"] = float(vector @ case.run_on_view(_enlarge(example), example))
    for name, value in similarity.items():
        if value <= unrelated:
            raise CheckFailed(
                f"the similarity is {value:.3f} to a {name} copy of the view, but {unrelated:.3f} "
                f"to another scene"
            )
    moved = float(vector @ case.run(example.partner.partner.partner))
    for name in ("smaller", "larger", "eight times larger"):
        if similarity[name] <= moved - _MIN_MARGIN * abs(moved):
            raise CheckFailed(
                f"the similarity is {similarity[name]:.3f} to a {name} copy of the view, but "
                f"{moved:.3f} to a view moved by three steps"
            )
    return f"similarity at least {min(similarity.values()):.3f} to copies of other sizes"


def _enlarge(example: Example) -> View:
    """Return a view of 1536 x 1152 pixels with the content of the example."""
    import cv2  # The import is local, because pytest loads this module when it collects tests.

    camera = example.camera.resized(8 * example.camera.width, 8 * example.camera.height)
    image = cv2.resize(example.view.image, camera.size, interpolation=cv2.INTER_CUBIC)
    return View("large.png", image, camera)


CHECKS = (
    check_retrieval_dimension,
    check_retrieval_self_similarity,
    check_retrieval_overlap,
    check_retrieval_sizes,
)
