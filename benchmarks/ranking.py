"""Rank correct and wrong reconstructions of the same images by their score.

    python -m benchmarks.ranking [--scenes halls "two rooms" rendered_kitchen hololens_room]
        [--draws 3] [--output FILE]

Each problem gets a correct reconstruction, from true poses, and wrong reconstructions, from poses
of which one image or one group of images is changed (:data:`CHANGES`). These reconstructions are
triangulated and refined by the mapper, without depth checks. In addition, each problem gets wrong
reconstructions that the mapper finds with several seeds. A reconstruction counts as wrong if its
pose AUC at 20 degrees is at least 2 points below that of the correct reconstruction. The table
lists how often the correct reconstruction has the higher score, by the change of the poses, for the
score and its terms, and for the number of explained matches. All images are also reconstructed with
depth that is wrong by half in a tenth of each map.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks._scenes import shared_folder
from mpsfm_core.data import DepthPrior, Float64, MappingProblem, Pose
from mpsfm_core.evaluation.benchmark import SetPairFilter, prepare_sets
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.evaluation.scene_folder import read_scene
from mpsfm_core.geometry import camera_center
from mpsfm_core.mapping.events import NullMappingEvents
from mpsfm_core.mapping.mapper import Mapper
from mpsfm_core.mapping.model_selection import compute_explained_score
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.reconstruction_score import score_reconstruction
from mpsfm_core.mapping.scene.conversion import convert_scene
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.mapping.scene.scene import Scene
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.synthetic.degraded_depth import DepthErrors
from mpsfm_core.testing.synthetic.halls import CALIBRATED_PRIORS, make_hall_problem
from mpsfm_core.testing.synthetic.two_rooms import make_twin_room_problem, shift_pose

CONVENTION = CONVENTIONS["paper"]
MIN_DIFFERENCE = 0.02
"""Difference of pose AUC at 20 degrees from which a reconstruction counts as wrong."""
PATCH_AREA, PATCH_FACTOR = 0.1, 1.5
"""Share of a depth map that is wrong, and factor of the wrong depth."""
Poses = dict[int, Pose]


class Case(NamedTuple):
    """Mapping problem with true poses."""

    name: str
    problem: MappingProblem
    truth: Poses
    room: tuple[int, ...] = ()
    """Number of the room in which each image was taken, -1 for the corridor; empty for all scenes
    except the one with two rooms."""


def rotate(pose: Pose, axis: Float64, angle_deg: float, center: Float64) -> Pose:
    """Rotate a camera about an axis through a point."""
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(angle_deg)).as_matrix()
    rotation = pose[0] @ turn.T
    moved = turn @ (camera_center(*pose) - center) + center
    return rotation, -rotation @ moved


def group_of(case: Case, image: int, share: float) -> list[int]:
    """Return an image and the images with the most matches to it, a share of all images."""
    counts = np.zeros(len(case.problem.images))
    for pair in case.problem.pairs:
        if image in (pair.image_a, pair.image_b):
            counts[pair.image_a + pair.image_b - image] = len(pair)
    counts[image] = np.inf
    return [int(i) for i in np.argsort(-counts, kind="stable")[: max(2, int(share * len(counts)))]]


def neighbor_of(case: Case, image: int) -> int:
    """Return the image with the most matches to an image."""
    return group_of(case, image, 0.0)[1]


def rotate_slightly(case: Case, rng: np.random.Generator) -> Poses:
    """Rotate and move one image slightly around its neighbor."""
    image = int(rng.integers(len(case.truth)))
    center = camera_center(*case.truth[neighbor_of(case, image)])
    return {image: rotate(case.truth[image], rng.normal(size=3), rng.uniform(5, 15), center)}


def move_to_other_image(case: Case, rng: np.random.Generator) -> Poses:
    """Give one image the pose of another image, rotated by some degrees."""
    image, other = map(int, rng.choice(len(case.truth), 2, replace=False))
    pose = case.truth[other]
    return {image: rotate(pose, rng.normal(size=3), rng.uniform(5, 20), camera_center(*pose))}


def mirror(case: Case, rng: np.random.Generator) -> Poses:
    """Rotate one image by 180 degrees about the baseline to its neighbor (twisted pair)."""
    image = int(rng.integers(len(case.truth)))
    center = camera_center(*case.truth[image])
    axis = camera_center(*case.truth[neighbor_of(case, image)]) - center
    return {image: rotate(case.truth[image], axis + 1e-9, 180.0, center)}


def swap(case: Case, rng: np.random.Generator) -> Poses:
    """Exchange the poses of two images, or move one image to the look-alike room."""
    if case.room:
        image = int(rng.choice(np.flatnonzero(np.array(case.room) >= 0)))
        return {image: _other_room(case, image)}
    a, b = map(int, rng.choice(len(case.truth), 2, replace=False))
    return {a: case.truth[b], b: case.truth[a]}


def move_group(case: Case, rng: np.random.Generator) -> Poses:
    """Rotate a group of images about its center, or move a group to the look-alike room."""
    if case.room:
        group = [i for i in group_of(case, int(rng.integers(14)), 0.3) if case.room[i] >= 0]
        rooms = [case.room[i] for i in group]
        return {i: _other_room(case, i) for i in group if case.room[i] == rooms[0]}
    group = group_of(case, int(rng.integers(len(case.truth))), 0.3)
    center = np.mean([camera_center(*case.truth[i]) for i in group], axis=0)
    axis, angle_deg = rng.normal(size=3), rng.uniform(20, 60)
    return {i: rotate(case.truth[i], axis, angle_deg, center) for i in group}


def _other_room(case: Case, image: int) -> Pose:
    pose = np.hstack([case.truth[image][0], case.truth[image][1][:, None]])
    shifted = shift_pose(pose, 1 - 2 * case.room[image])
    return shifted[:, :3], shifted[:, 3]


CHANGES: Mapping[str, Callable[[Case, np.random.Generator], Poses]] = {
    "slightly rotated": rotate_slightly,
    "moved to another image": move_to_other_image,
    "mirrored": mirror,
    "swapped": swap,
    "group moved": move_group,
}


def reconstruct_at(case: Case, poses: Poses) -> Reconstruction | None:
    """Triangulate and refine a reconstruction from initial poses of all images."""
    images = tuple(
        replace(image, known_pose=(pose[0].copy(), pose[1].copy()))
        for image, pose in zip(
            case.problem.images, (poses[i] for i in range(len(poses))), strict=True
        )
    )
    options = MapperOptions.model_validate({"consistency": {"enabled": False}})
    mapper = Mapper(replace(case.problem, images=images), options, NullMappingEvents())
    component = mapper._create_component()
    if not component.initialize_from_known_poses(mapper.unregistered):
        return None
    return convert_scene(component.scene)


def measure(case: Case, model: Reconstruction) -> tuple[float, dict[str, float]]:
    """Return pose AUC at 20 degrees, and the criteria that rank a reconstruction."""
    truth = {case.problem.images[i].name: pose for i, pose in case.truth.items()}
    auc = pose_auc(pose_errors_deg(model.poses, truth, CONVENTION), CONVENTION)[20]
    score = score_reconstruction(model, Scene(case.problem))
    return auc, {
        "score": score.total,
        "matches": score.matches,
        "depth": score.depth,
        "explained": compute_explained_score(model, case.problem),
    }


def wrong_by_half(problem: MappingProblem, seed: int) -> MappingProblem:
    """Make the depth of each image wrong by half in an ellipse of a tenth of the map."""
    rng = np.random.default_rng(seed)
    images = []
    for image in problem.images:
        rows, columns = image.depth.shape
        y, x = np.mgrid[:rows, :columns] / np.reshape([rows, columns], (2, 1, 1))
        center, radius = rng.uniform(0.2, 0.8, 2), np.sqrt(PATCH_AREA / np.pi)
        inside = np.hypot(x - center[0], y - center[1]) < radius
        factor = np.where(inside, PATCH_FACTOR ** rng.choice([-1, 1]), 1.0).astype(np.float32)
        depth = image.depth
        assert depth.variance is not None
        wrong = DepthPrior(
            depth.depth * factor, depth.variance * factor**2, depth.valid, depth.metric
        )
        images.append(replace(image, depth=wrong))
    return replace(problem, images=tuple(images))


def synthetic_cases(scene: str) -> Iterator[Case]:
    """Yield generated problems of halls or of two rooms that look alike."""
    for seed in range(3):
        if scene == "halls":
            hall = make_hall_problem(25, CALIBRATED_PRIORS, seed=20 + seed)
            names = [image.name for image in hall.problem.images]
            yield Case("halls", hall.problem, {i: hall.truth[n] for i, n in enumerate(names)})
        else:
            rooms = make_twin_room_problem(30 + seed, errors=DepthErrors() if seed else None)
            truth = {i: (pose[:, :3], pose[:, 3]) for i, pose in enumerate(rooms.poses)}
            yield Case("two rooms", rooms.problem, truth, tuple(rooms.room))


def real_cases(scene: str, work: Path) -> Iterator[Case]:
    """Yield a case for each test set of a real scene, whose depth priors are the true depth."""
    folder = read_scene(shared_folder() / "data" / scene)
    sets = folder.select_sets(("minimal", "leq10", "leq30", "all"))
    registry, pair_filter = Registry.discover(), SetPairFilter()
    registry.register(pair_filter, name="pairs of sets")
    pair_filter.allow(sets)
    prepared = prepare_sets(folder, sets, "sensor", "benchmark", (), work / scene, registry)
    for image_set in sets:
        problem = prepared.build_problem(image_set)
        truth = {i: folder.truth[image.name] for i, image in enumerate(problem.images)}
        yield Case(scene, problem, truth)


def main() -> None:
    """Rank reconstructions of all scenes, and print the table of correct decisions."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    names = ["halls", "two rooms", "rendered_kitchen", "hololens_room"]
    parser.add_argument("--scenes", nargs="+", choices=names, default=names)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--work", type=Path, default=Path("build/benchmarks/ranking"))
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    rows: dict[tuple[str, str], list[dict[str, bool]]] = {}
    for scene in arguments.scenes:
        is_real = scene.endswith(("kitchen", "room"))
        for case in real_cases(scene, arguments.work) if is_real else synthetic_cases(scene):
            for label, problem in (
                (scene, case.problem),
                (f"{scene}, depth wrong by half", wrong_by_half(case.problem, 0)),
            ):
                for change, won in compare(case._replace(problem=problem), arguments.draws):
                    rows.setdefault((label, change), []).append(won)
    text = format_table(rows)
    print(text)
    if arguments.output:
        arguments.output.write_text(text + "\n", encoding="utf-8")


def compare(case: Case, draws: int) -> Iterator[tuple[str, dict[str, bool]]]:
    """Yield each change that makes a reconstruction wrong, and which criteria detect it."""
    right = reconstruct_at(case, case.truth)
    if right is None:
        return
    best, expected = measure(case, right)
    for change, wrong in make_reconstructions(case, draws):
        auc, criteria = measure(case, wrong)
        if auc < best - MIN_DIFFERENCE:
            yield change, {name: expected[name] > value for name, value in criteria.items()}


def make_reconstructions(case: Case, draws: int) -> Iterator[tuple[str, Reconstruction]]:
    """Yield reconstructions from changed poses, and those that the mapper finds."""
    for number, (change, make) in enumerate(CHANGES.items()):
        for draw in range(draws):
            rng = np.random.default_rng([number, draw])
            model = reconstruct_at(case, {**case.truth, **make(case, rng)})
            if model is not None:
                yield change, model
    for seed in range(draws):
        models = Mapper(case.problem, MapperOptions(seed=seed), NullMappingEvents()).run().models
        if models:
            yield "found by the mapper", models[0]


def format_table(rows: Mapping[tuple[str, str], list[dict[str, bool]]]) -> str:
    """Format the share of the comparisons that each criterion decides correctly."""
    criteria = list(next(iter(rows.values()))[0])
    lines = [
        f"| scene | change | wrong | {' | '.join(criteria)} |",
        "|---" * (3 + len(criteria)) + "|",
    ]
    for (scene, change), won in rows.items():
        cells = [f"{np.mean([one[name] for one in won]):.0%}" for name in criteria]
        lines.append(f"| {scene} | {change} | {len(won)} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
