"""Verify depth, normals, poses and declared variances of a scene folder.

``python verify.py [FOLDER]`` prints the numbers of README.md. Needs numpy, OpenCV, pycolmap.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations, permutations
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

SAME_SURFACE = 0.05
"""Maximum relative depth difference of a pixel that is visible in another view."""


@dataclass(frozen=True)
class View:
    """View with intrinsics ``K``, pose (``x_camera = R x + t``), exact maps, and priors."""

    name: str
    K: Float
    R: Float
    t: Float
    depth: Float
    normals: Float
    depth_prior: dict[str, NDArray]
    normal_prior: dict[str, NDArray]


def load_views(folder: Path) -> list[View]:
    """Read all views of a scene folder."""
    model = pycolmap.Reconstruction(folder / "gt")
    views = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        stem = Path(image.name).stem
        pose = image.cam_from_world()
        depth = cv2.imread(str(folder / "gt_depth" / f"{stem}.png"), cv2.IMREAD_UNCHANGED) / 1000
        colour = cv2.imread(str(folder / "gt_normals" / f"{stem}.png"))[..., ::-1]
        views.append(
            View(
                image.name,
                image.camera.calibration_matrix(),
                pose.rotation.matrix(),
                pose.translation,
                depth,
                _unit(colour / 255 * 2 - 1),
                _prior(folder / "priors" / "depth" / f"{stem}.npz"),
                _prior(folder / "priors" / "normals" / f"{stem}.npz"),
            )
        )
    return views


def seen_depth(a: View, b: View) -> tuple[Float, Float]:
    """Project the pixels of view ``a`` to ``b``; return projected and stored depth in ``b``.

    Both depths are NaN for pixels outside the image, and for pixels without depth in a map.
    """
    rays = pixel_rays(a)
    world = (rays * np.where(a.depth > 0, a.depth, np.nan)[..., None] - a.t) @ a.R
    point = world @ b.R.T + b.t
    z = np.where(point[..., 2] > 0, point[..., 2], np.nan)
    x, y = (point / z[..., None] @ b.K.T)[..., :2].transpose(2, 0, 1)
    inverse = np.where(b.depth > 0, 1 / np.where(b.depth > 0, b.depth, 1), np.nan)
    # OpenCV has the first pixel center at 0; inverse depth is linear in the pixels of a plane.
    at = [np.nan_to_num(v - 0.5, nan=-9).astype(np.float32) for v in (x, y)]
    found = cv2.remap(inverse, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return z, np.where(found > 0, 1 / np.where(found > 0, found, 1), np.nan)


def seen_in(a: View, b: View) -> Bool:
    """Return the mask of the pixels of view ``a`` that are visible in view ``b``."""
    expected, found = seen_depth(a, b)
    return np.abs(found - expected) < SAME_SURFACE * expected


def pixel_rays(view: View) -> Float:
    """Compute the rays through the pixel centers in the camera frame, (h, w, 3) with z = 1."""
    h, w = view.depth.shape
    u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    return np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.K).T


def overlaps(views: list[View]) -> tuple[Float, float]:
    """Compute the two-view overlaps (n, n), and the largest three-view overlap of any triplet."""
    count = range(len(views))
    area = [(v.depth > 0).sum() for v in views]
    seen = {(i, j): seen_in(views[i], views[j]) for i, j in permutations(count, 2)}
    two = np.eye(len(views))
    for i, j in seen:
        two[i, j] = min(seen[i, j].sum() / area[i], seen[j, i].sum() / area[j])
    three = [
        (seen[i, j] & seen[i, k]).sum() / area[i]
        for i in count
        for j, k in combinations([c for c in count if c != i], 2)
    ]
    return two, float(max(three))


def depth_errors(views: list[View]) -> Float:
    """Compute relative differences of reprojected and stored depth over shared pixels."""
    errors = []
    for a, b in permutations(views, 2):
        expected, found = seen_depth(a, b)
        relative = np.abs(found / expected - 1)
        errors.append(relative[relative < SAME_SURFACE])
    return np.concatenate(errors)


def depth_scores(view: View) -> tuple[Float, Float]:
    """Compute relative error, and error over declared std, of the depth prior's valid pixels."""
    prior = view.depth_prior
    truth, known = _reduced(view.depth, prior["depth"].shape)
    use = known & prior["valid"]
    error = prior["depth"][use] - truth[use]
    return error / truth[use], error / np.sqrt(prior["variance"][use])


def normal_scores(view: View) -> tuple[Float, Float]:
    """Compute angular error in degrees and normalized angle of the valid normals of the prior.

    The normalized angle is the angle divided by the std of both tangent axes; its mean square is 1
    for a correct variance.
    """
    prior = view.normal_prior
    shape = prior["normals"].shape[:2]
    known = _reduced(view.depth, shape)[1] & prior["valid"]
    truth = _unit(np.dstack([_reduced(n, shape)[0] for n in np.moveaxis(view.normals, 2, 0)]))
    cosine = (truth * _unit(prior["normals"])).sum(2)[known]
    angle = np.arccos(cosine.clip(-1, 1))
    return np.degrees(angle), angle / np.sqrt(2 * prior["variance"][known])


def rms(values: Float) -> float:
    """Compute the root mean square of an array."""
    return float(np.sqrt(np.mean(values**2)))


def run_colmap(folder: Path, views: list[View]) -> tuple[list[float], list[int]]:
    """Run incremental COLMAP with SIFT, exhaustive matching and known intrinsics.

    Returns:
        Returns the median distance in pixels of the matches to the exact epipolar lines for each
        verified pair of neighbors, and the number of images of each model.
    """
    camera = pycolmap.Reconstruction(folder / "gt").cameras[1]
    reader = pycolmap.ImageReaderOptions(
        camera_model="PINHOLE", camera_params=",".join(str(p) for p in camera.params)
    )
    images, single = folder / "images", pycolmap.CameraMode.SINGLE
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "database.db"
        pycolmap.set_random_seed(0)
        pycolmap.extract_features(path, images, camera_mode=single, reader_options=reader)
        pycolmap.match_exhaustive(path)
        with pycolmap.Database.open(path) as database:
            pairs = zip(views, [*views[1:], views[0]], strict=True)
            distances = [float(np.median(_match_errors(database, a, b))) for a, b in pairs]
        models = pycolmap.incremental_mapping(path, images, scratch)
    return distances, sorted((m.num_reg_images() for m in models.values()), reverse=True)


def epipolar_distance(a: View, b: View, x_a: Float, x_b: Float) -> Float:
    """Compute the distance in pixels of ``x_b`` (n, 2) to the exact epipolar lines of ``x_a``."""
    rotation = b.R @ a.R.T
    tx, ty, tz = b.t - rotation @ a.t
    essential = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ rotation
    fundamental = np.linalg.inv(b.K).T @ essential @ np.linalg.inv(a.K)
    lines = np.insert(x_a, 2, 1, axis=1) @ fundamental.T
    signed = (lines * np.insert(x_b, 2, 1, axis=1)).sum(1)
    return np.abs(signed) / np.linalg.norm(lines[:, :2], axis=1)


def _match_errors(database: pycolmap.Database, a: View, b: View) -> Float:
    ids = [database.read_image_with_name(view.name).image_id for view in (a, b)]
    matches = database.read_two_view_geometry(*ids).inlier_matches
    x_a, x_b = (database.read_keypoints(i)[m, :2] for i, m in zip(ids, matches.T, strict=True))
    return epipolar_distance(a, b, x_a.astype(float), x_b.astype(float))


def _prior(path: Path) -> dict[str, NDArray]:
    with np.load(path) as arrays:
        return {k: v if v.dtype == bool else v.astype(float) for k, v in arrays.items()}


def _reduced(values: Float, shape: tuple[int, ...]) -> tuple[Float, Bool]:
    """Compute means over blocks of pixels, and the mask of blocks without unknown pixels (0)."""
    h, w = shape
    blocks = values.reshape(h, values.shape[0] // h, w, values.shape[1] // w)
    return blocks.mean((1, 3)), (blocks != 0).all((1, 3))


def _unit(vectors: Float) -> Float:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(1e-9)


def _pooled(parts: Iterable[tuple[Float, Float]]) -> tuple[Float, Float]:
    errors, scores = zip(*parts, strict=True)
    return np.concatenate(errors), np.concatenate(scores)


def main() -> None:
    """Print the measurements."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    views = load_views(folder)
    two, three = overlaps(views)
    print("two-view overlap\n", np.array2string(two, precision=2, suppress_small=True))
    print(f"largest three-view overlap {three:.3f}")
    print(f"reprojected depth, median relative error {np.median(depth_errors(views)):.5f}")
    for view in views:
        relative, score = depth_scores(view)
        scale = np.exp(np.median(np.log1p(relative)))
        shape_error = rms((1 + relative) / scale - 1)
        print(f"{view.name} scale {scale:.3f}, rms error without it {shape_error:.3f}", end=", ")
        print(f"z rms {rms(score):.2f}; normals rms {rms(normal_scores(view)[0]):.2f} deg")
    relative, score = _pooled(depth_scores(v) for v in views)
    print(f"depth prior: rms error {rms(relative):.3f}, z rms {rms(score):.2f}", end=", ")
    print(f"|z| < 2: {np.mean(np.abs(score) < 2):.3f}")
    angle, score = _pooled(normal_scores(v) for v in views)
    print(f"normal prior: median {np.median(angle):.2f} deg, rms {rms(angle):.2f} deg", end=", ")
    print(f"z rms {rms(score):.2f}, |z| < 2: {np.mean(np.abs(score) < 2):.3f}")
    distances, registered = run_colmap(folder, views)
    print("SIFT matches to exact epipolar lines, px:", np.round(distances, 2))
    print("images per model of plain COLMAP:", registered or "no model")


if __name__ == "__main__":
    main()
