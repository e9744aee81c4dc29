"""State of a mapping problem, for storage in a file that a worker reads."""

from __future__ import annotations

from typing import Any

from mpsfm_core.data import (
    DepthPrior,
    MappingImage,
    MappingProblem,
    NormalPrior,
    PinholeCamera,
    Rig,
    VerifiedPair,
)
from mpsfm_core.data.camera_models import CameraModel
from mpsfm_core.mapping.state import StateDict
from mpsfm_core.support.disk_arrays import current_store, store_fields

_TUPLES = ("known_pose", "proposed_pose", "distortion", "initial_distortion")


def problem_to_state(problem: MappingProblem) -> StateDict:
    """Return the fields of a mapping problem as nested dictionaries."""
    return {
        "images": [_image_to_state(image) for image in problem.images],
        "pairs": [{**vars(pair)} for pair in problem.pairs],
        "rigs": [rig_to_state(rig) for rig in problem.rigs],
    }


def problem_from_state(state: StateDict) -> MappingProblem:
    """Restore a mapping problem, identical to the stored problem.

    The prior maps are stored by :func:`~mpsfm_core.support.disk_arrays.current_store`.
    """
    return MappingProblem(
        tuple(_image_from_state(image) for image in state["images"]),
        tuple(VerifiedPair(**pair) for pair in state["pairs"]),
        tuple(rig_from_state(rig) for rig in state["rigs"]),
    )


def rig_to_state(rig: Rig) -> StateDict:
    """Return the fields of a rig as a dictionary."""
    return {**vars(rig)}


def rig_from_state(state: StateDict) -> Rig:
    """Restore a rig."""
    sensors = tuple(pose and tuple(pose) for pose in state["sensor_from_rig"])
    return Rig(sensors, tuple(map(tuple, state["frames"])), state["is_estimated"])


def _image_to_state(image: MappingImage) -> StateDict:
    parts = {name: {**vars(getattr(image, name))} for name in ("camera", "depth", "normals")}
    return {**vars(image), **parts, "camera_model": image.camera_model.value}


def _image_from_state(state: StateDict) -> MappingImage:
    parts: dict[str, Any] = {
        "camera": PinholeCamera(**state["camera"]),
        "depth": store_fields(DepthPrior(**state["depth"]), current_store()),
        "normals": store_fields(NormalPrior(**state["normals"]), current_store()),
        "camera_model": CameraModel(state["camera_model"]),
    }
    tuples = {name: state[name] and tuple(state[name]) for name in _TUPLES}
    return MappingImage(**{**state, **parts, **tuples})
