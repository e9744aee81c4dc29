"""Localize photos in a model that does not contain them, and compare with hloc's pipeline.

    python -m benchmarks.localize [SCENE ...] [--draws 5] [--config sift] [--records DIR]

A model has the true poses of 3, 6, or half of the images of a scene, which are drawn at random.
Other images of the scene are localized in this model, with their true camera and with an unknown
focal length. Two photos of another place are localized, too. The recipe of hloc triangulates points
with COLMAP and estimates poses with pycolmap. Results of earlier calls in DIR are not computed
again.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

import mpsfm_core as mpsfm
from benchmarks._scenes import shared_folder
from mpsfm_core.data import Pose
from mpsfm_core.extraction.match_graph import MatchGraph
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.pycolmap_conversion import colmap_from_pinhole, pose_from
from mpsfm_core.inputs.images import ImageSet, SourceImage, load_images
from mpsfm_core.inputs.models import reconstruction_poses
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.results.match_files import write_match_database

SCENES = ("rendered_kitchen", "hololens_room", "fountain")
OTHER_PLACE = {
    "rendered_kitchen": "fountain",
    "hololens_room": "fountain",
    "fountain": "hololens_room",
}
NUM_QUERIES = 6
NUM_NEGATIVES = 2
THRESHOLDS = ((0.05, 1.0), (0.25, 2.0), (0.5, 5.0))
"""Maximum position errors in meters and rotation errors in degrees of localized images."""
Record = dict[str, Any]


def main() -> None:
    """Localize images of all draws and print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--config", default="sift")
    parser.add_argument("--records", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.records or Path(temporary)
        records = []
        for draw in range(arguments.draws):
            for scene in arguments.scenes:
                for size in (3, 6, 0):
                    records += load_or_run(scene, size, draw, arguments.config, folder)
    print(make_table(records))


def load_or_run(scene: str, size: int, draw: int, config: str, folder: Path) -> list[Record]:
    """Localize the photos of one random draw, or read the errors that an earlier call stored."""
    path = folder / f"{scene}-{size}-{draw}-{config}.json"
    if not path.is_file():
        records = list(run_draw(scene, size, draw, config))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(records))
        print(path.stem, file=sys.stderr)
    loaded: list[Record] = json.loads(path.read_text())
    return loaded


def run_draw(scene: str, size: int, draw: int, config: str) -> Iterator[Record]:
    """Localize images in the model of one draw, with both methods, and yield their errors."""
    data = shared_folder() / "data"
    truth = pycolmap.Reconstruction(str(data / scene / "gt"))
    poses = reconstruction_poses(truth)
    files = {path.stem: path.name for path in (data / scene / "images").iterdir()}
    names = sorted(poses)
    order = np.random.default_rng([draw, size]).permutation(len(names))
    count = size or len(names) // 2
    chosen = sorted(names[row] for row in order[:count])
    queries = sorted(names[row] for row in order[count : count + NUM_QUERIES])
    other = sorted((data / OTHER_PLACE[scene] / "images").iterdir())[draw::7][:NUM_NEGATIVES]
    model = pycolmap.Reconstruction(truth)
    for image in list(model.images.values()):
        if str(image.name) not in chosen:
            model.deregister_frame(image.frame_id)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for part in ("model", "queries"):
            (folder / part).mkdir()
        model.write(str(folder / "model"))
        for name in queries:
            file = data / scene / "images" / files[Path(name).stem]
            (folder / "queries" / name).symlink_to(file.resolve())
        for file in other:
            (folder / "queries" / f"other_{file.name}").symlink_to(file.resolve())
        for known in (True, False):
            setting = {"scene": scene, "size": size, "draw": draw, "known": known}
            cameras = _cameras(data, scene, truth, queries, other) if known else None
            for method in (localize_with_mpsfm, localize_with_hloc):
                start = time.process_time()
                found = method(folder, data / scene / "images", cameras, config)
                seconds = (time.process_time() - start) / (len(queries) + len(other))
                for name in [*queries, *(f"other_{file.name}" for file in other)]:
                    record = {**setting, "method": method.__name__, "name": name}
                    record |= {"is_other": name.startswith("other_"), "seconds": seconds}
                    yield record | measure(found.get(name), poses.get(name))


def measure(found: tuple[Pose, float] | None, true_pose: Pose | None) -> Record:
    """Return errors of rotation and position, and the predicted std of the position."""
    if found is None:
        return {"found": False}
    if true_pose is None:
        return {"found": True}
    pose, std = found
    position = np.linalg.norm(camera_center(*pose) - camera_center(*true_pose))
    rotation = rotation_angle_deg(pose[0] @ true_pose[0].T)
    return {"found": True, "position": float(position), "rotation": float(rotation), "std": std}


def localize_with_mpsfm(
    folder: Path, images: Path, cameras: Mapping[str, Any] | None, config: str
) -> dict[str, tuple[Pose, float]]:
    """Localize the queries with MP-SfM."""
    result = mpsfm.localize(
        folder / "model", folder / "queries", config=config, images=images, cameras=cameras
    )
    stds = {name: photo.center_covariance for name, photo in result.photos.items()}
    return {
        name: (photo.pose, float(np.sqrt(np.trace(stds[name]))))
        for name, photo in result.photos.items()
    }


def localize_with_hloc(
    folder: Path, images: Path, cameras: Mapping[str, Any] | None, config: str
) -> dict[str, tuple[Pose, float]]:
    """Localize the queries as hloc does, with COLMAP's points and pycolmap's pose estimation."""
    overrides = ["adjustment.enabled=false", "pairs.mode=exhaustive"]
    model = pycolmap.Reconstruction(str(folder / "model"))
    names = sorted(str(model.images[i].name) for i in model.reg_image_ids())
    references = load_images(images, folder / "model", names=names)
    graph = mpsfm.match_images(references, config=config, overrides=overrides)
    database = folder / "database.db"
    write_match_database(database, references, graph)
    triangulated = pycolmap.triangulate_points(
        build_model(references, reconstruction_poses(model)),
        database,
        images,
        folder / "triangulated",
    )
    queries = folder / "queries"
    listed = sorted(path.name for path in queries.iterdir())
    loaded = load_images(queries, cameras, names=listed)
    joint = ImageSet([*references, *loaded], InputOptions())
    pairs = [(a, b) for a in names for b in listed]
    graph = mpsfm.match_images(joint, pairs=pairs, config=config, overrides=overrides)
    poses = {}
    for query in loaded:
        pose = _estimate_pose(query, graph, triangulated, is_known=cameras is not None)
        if pose is not None:
            poses[query.name] = pose, np.nan
    return poses


def build_model(images: ImageSet, poses: Mapping[str, Pose]) -> pycolmap.Reconstruction:
    """Build a COLMAP model with the poses and cameras of images, and with the ids of a database."""
    built = pycolmap.Reconstruction()
    for number, image in enumerate(images, start=1):
        if image.camera.camera_id not in built.cameras:
            built.add_camera_with_trivial_rig(image.camera)
        row = pycolmap.Image(name=image.name, camera_id=image.camera.camera_id, image_id=number)
        built.add_image_with_trivial_frame(
            row, pycolmap.Rigid3d(np.column_stack(poses[image.name]))
        )
    return built


def _estimate_pose(
    query: SourceImage, graph: MatchGraph, model: pycolmap.Reconstruction, *, is_known: bool
) -> Pose | None:
    """Estimate the pose of a query from its matches to triangulated points."""
    xy, points = [], []
    for image in model.images.values():
        pair = (str(image.name), query.name)
        for row, matched in graph.matches[pair].indices:
            if image.points2D[row].has_point3D():
                xy.append(graph.features[query.name].keypoints[matched])
                points.append(model.points3D[image.points2D[row].point3D_id].xyz)
    if len(xy) < 4:
        return None
    estimation = pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=not is_known)
    estimation.ransac.random_seed = 0
    result = pycolmap.estimate_and_refine_absolute_pose(
        np.array(xy),
        np.array(points),
        colmap_from_pinhole(query.pinhole),
        estimation,
        pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=not is_known),
    )
    return None if result is None else pose_from(query.name, result["cam_from_world"])


def _cameras(
    data: Path,
    scene: str,
    truth: pycolmap.Reconstruction,
    queries: Sequence[str],
    other: Sequence[Path],
) -> dict[str, pycolmap.Camera]:
    """Return the true camera of each query by name."""
    by_name = {str(image.name): image.camera for image in truth.images.values()}
    foreign = pycolmap.Reconstruction(str(data / OTHER_PLACE[scene] / "gt"))
    camera = next(iter(foreign.cameras.values()))
    return {name: by_name[name] for name in queries} | {
        f"other_{file.name}": camera for file in other
    }


def make_table(records: Sequence[Record]) -> str:
    """Return a table in Markdown with recall and median errors of both methods."""
    groups: dict[tuple[str, int], list[Record]] = defaultdict(list)
    for record in records:
        groups[record["scene"], record["size"]].append(record)
    lines = [
        "| scene | model | known: MP-SfM | hloc | median | unknown: MP-SfM | hloc | median | "
        "other place | CPU s |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for scene, size in sorted(groups, key=lambda key: (SCENES.index(key[0]), key[1] or 1000)):
        cells = [scene, str(size or "half")]
        rows = groups[scene, size]
        ours, theirs = (
            [row for row in rows if row["method"] == method.__name__]
            for method in (localize_with_mpsfm, localize_with_hloc)
        )
        for known in (True, False):
            pair = [[row for row in part if row["known"] == known] for part in (ours, theirs)]
            cells += [*map(format_recall, pair), ", ".join(map(format_median, pair))]
        cells += [f"{_count_false(ours)}, {_count_false(theirs)}"]
        cells += [f"{np.mean([row['seconds'] for row in ours]):.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def format_recall(records: Sequence[Record]) -> str:
    """Return the percentages of the queries within each threshold."""
    queries = [record for record in records if not record["is_other"]]
    shares = [
        np.mean([r["found"] and r["position"] <= m and r["rotation"] <= deg for r in queries])
        for m, deg in THRESHOLDS
    ]
    return " / ".join(f"{100 * share:.0f}" for share in shares)


def format_median(records: Sequence[Record]) -> str:
    """Return the median position error in centimeters of the localized queries."""
    found = [row["position"] for row in records if row["found"] and not row["is_other"]]
    return f"{100 * np.median(found):.1f}" if found else "none"


def _count_false(records: Sequence[Record]) -> str:
    """Return how many of the photos of another scene were localized, which is wrong."""
    other = [record["found"] for record in records if record["is_other"]]
    return f"{sum(other)} of {len(other)}"


if __name__ == "__main__":
    main()
