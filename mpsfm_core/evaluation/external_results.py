"""Models that another program made of the sets of a scene, as records of a benchmark.

What can be read: COLMAP models (also as MASt3R-SfM, VGGSfM, VGGT and GLOMAP write them) and
``transforms.json`` of nerfstudio and its kin.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from mpsfm_core.data import Pose
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.records import BenchmarkRecord
from mpsfm_core.evaluation.scene_folder import EvaluationSet, SceneFolder
from mpsfm_core.inputs.models import match_names, read_poses

TRANSFORMS = "transforms.json"


def read_external_records(
    label: str, folder: Path, scene: SceneFolder, sets: Sequence[EvaluationSet], config: str
) -> list[BenchmarkRecord]:
    """A record for each set. Where there is no model of a set, all its images are unregistered.

    ``folder``: holds ``SCENE/SET/``, ``SET/`` or, of a single set, ``SCENE/`` or the model itself.
    Times are not known, and 0.

    Raises:
        InputError: there is a model of no set, or one cannot be read.
    """
    found = {item.name: _place(folder, scene.name, item.name, len(sets) == 1) for item in sets}
    if not any(found.values()):
        raise InputError(
            f"{folder}: no model of a set of {scene.name}; expected as "
            f"{folder / scene.name / sets[0].name} (a COLMAP model or {TRANSFORMS})"
        )
    return [_record(label, scene, item, found[item.name], config) for item in sets]


def _record(
    label: str, scene: SceneFolder, item: EvaluationSet, place: Path | None, config: str
) -> BenchmarkRecord:
    truth = {name: scene.truth[name] for name in item.images}
    models: list[dict[str, Pose]] = []
    for path in _models(place) if place is not None else ():
        poses = read_poses(path)
        models.append({name: poses[own] for name, own in match_names(truth, poses).items()})
    models.sort(key=lambda model: -len(model))
    error = "" if place is not None else "no model of this set"
    return BenchmarkRecord(
        scene.name,
        config,
        item.bucket,
        item.name,
        label,
        str(place),
        models[0] if models else {},
        truth,
        0,
        0.0,
        0.0,
        error,
        models[1:],
    )


def _place(folder: Path, scene: str, name: str, alone: bool) -> Path | None:
    """The first folder that holds models."""
    places = [folder / scene / name, folder / name]
    if alone:
        places += [folder / scene, folder]
    return next((place for place in places if any(_models(place))), None)


def _models(place: Path) -> Iterator[Path]:
    """A model, or the numbered ones of a mapper that made several."""
    if (place / TRANSFORMS).is_file():
        yield place / TRANSFORMS
        return
    for folder in (place, place / "sparse"):
        if _is_model(folder):
            yield folder
            return
        numbered = sorted(path for path in folder.glob("[0-9]*") if _is_model(path))
        if numbered:
            yield from numbered
            return


def _is_model(folder: Path) -> bool:
    return any((folder / f"images.{suffix}").is_file() for suffix in ("bin", "txt"))
