"""Import of models from other programs as benchmark records.

The supported formats are COLMAP models (also of MASt3R-SfM, VGGSfM, VGGT and GLOMAP) and
``transforms.json`` of nerfstudio.
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
    """Convert the models of another program to one benchmark record for each test set.

    Without a model, all images of a test set are unregistered. The recorded run times are 0,
    because the run times of the other program are unknown.

    Args:
        label: Label of the other program in the records.
        folder: Folder with the models in ``SCENE/SET/`` or ``SET/``; the model of a single test set
            may also be in ``SCENE/`` or in the folder itself.
        scene: Scene folder.
        sets: Test sets of the scene.
        config: Name of the configuration in the records.

    Raises:
        InputError: No test set has a model, or a model cannot be read.
    """
    folders = {
        item.name: _find_folder(folder, scene.name, item.name, len(sets) == 1) for item in sets
    }
    if not any(folders.values()):
        raise InputError(
            f"{folder}: no model of any test set of {scene.name}; expected as "
            f"{folder / scene.name / sets[0].name} (a COLMAP model or {TRANSFORMS})"
        )
    return [_build_record(label, scene, item, folders[item.name], config) for item in sets]


def _build_record(
    label: str, scene: SceneFolder, item: EvaluationSet, folder: Path | None, config: str
) -> BenchmarkRecord:
    truth = {name: scene.truth[name] for name in item.images}
    models: list[dict[str, Pose]] = []
    for path in _find_models(folder) if folder is not None else ():
        poses = read_poses(path)
        models.append({name: poses[other] for name, other in match_names(truth, poses).items()})
    models.sort(key=lambda model: -len(model))
    error = "" if folder is not None else "no model of this set"
    return BenchmarkRecord(
        scene.name,
        config,
        item.bucket,
        item.name,
        label,
        str(folder),
        models[0] if models else {},
        truth,
        0,
        0.0,
        0.0,
        error,
        models[1:],
    )


def _find_folder(root: Path, scene: str, name: str, single_set: bool) -> Path | None:
    """Find the first folder that contains models of a test set."""
    folders = [root / scene / name, root / name]
    if single_set:
        folders += [root / scene, root]
    return next((folder for folder in folders if any(_find_models(folder))), None)


def _find_models(root: Path) -> Iterator[Path]:
    """Yield the model in a folder, or the numbered models in its subfolders."""
    if (root / TRANSFORMS).is_file():
        yield root / TRANSFORMS
        return
    for folder in (root, root / "sparse"):
        if _is_model(folder):
            yield folder
            return
        numbered = sorted(path for path in folder.glob("[0-9]*") if _is_model(path))
        if numbered:
            yield from numbered
            return


def _is_model(folder: Path) -> bool:
    return any((folder / f"images.{suffix}").is_file() for suffix in ("bin", "txt"))
