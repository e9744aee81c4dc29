"""Poses of all images at once, from what all pairs together say of them.

Verified pairs know how their images are turned, and in which direction one lies from the other;
depth priors say how far. Rotations are averaged over all pairs (COLMAP's rotation averaging); with
lengths known, the scales of the priors and the places of the images are linear in what the pairs
say, and follow from least squares that pairs leave which disagree. Images that several agreeing
pairs hold are placed so; the others are left to registration one by one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pycolmap
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from mpsfm_core.data import Bool, Float64, Int64, VerifiedPair
from mpsfm_core.geometry import camera_center, rotation_angle_deg, triangulation_angle_deg
from mpsfm_core.mapping.triangulation import midpoints
from mpsfm_core.scene.scene import Scene
from mpsfm_core.statistics import MAD_TO_STD, group_medians

MIN_ANGLE_DEG = 1.5
"""Between the rays of a match whose depth says how long a baseline is (as for points that are
triangulated)."""
MIN_MATCHES = 10
"""That say so, for their median to count (ours)."""
MIN_HOLDS = 2
"""Agreeing pairs that hold an image: one always agrees with itself."""
MAX_TURN_DEG = 5.0
"""Between what a pair says and where its images are placed, to agree (ours)."""
MAX_SHIFT = 0.3
"""The same of their distance, in terms of it: priors are off by a few percent, directions of short
baselines by several degrees (ours)."""
ROUNDS = 20
"""Of least squares, each of which weighs pairs by how well the last one agreed with them (ours)."""
_FATAL = 3


class Placement(NamedTuple):
    """Images (m,) with their poses, ``cam_from_world``, and the scales of their priors."""

    images: Int64
    rotations: Float64
    translations: Float64
    scales: Float64


class _Links(NamedTuple):
    """What pairs say: image ``b`` from ``a``, and the logarithm of their distance in terms of the
    prior of each. ``weight``: number of matches."""

    a: Int64
    b: Int64
    rotation: Float64
    translation: Float64
    log_length: Float64
    weight: Float64

    def select(self, chosen: Bool) -> _Links:
        """Some of them."""
        parts: list[Any] = [values[chosen] for values in self]
        return _Links(*parts)


def place_all(scene: Scene, left: Bool, seed: int) -> Placement | None:
    """Poses of the images of the largest group that agreeing pairs hold; None without one.

    ``left``: (n,) bool, images that may be placed. The scene stays as it is.
    """
    pairs = [p for p in scene.problem.pairs if p.calibrated and left[p.image_a] and left[p.image_b]]
    links = _links(scene, pairs)
    links = links.select(_well_held(links, scene.num_images))
    if not len(links.a):
        return None
    rotations = averaged_rotations(links, scene.num_images, seed)
    if rotations is None:
        return None
    differences = links.log_length[:, 0] - links.log_length[:, 1]
    unit = scene.depth_group_of  # priors in one unit share one scale
    scales = agreed(unit[links.a], unit[links.b], differences, links.weight, scene.num_images)
    log_scales = scales[unit]
    lengths = np.exp((log_scales[links.a] + log_scales[links.b] + links.log_length.sum(axis=1)) / 2)
    steps = -np.einsum("nji,nj->ni", rotations[links.b], links.translation) * lengths[:, None]
    centers = agreed(links.a, links.b, steps, links.weight / lengths, scene.num_images)
    turns = rotations[links.b] @ rotations[links.a].transpose(0, 2, 1)
    turned = rotation_angle_deg(turns.transpose(0, 2, 1) @ links.rotation)
    shifts = np.linalg.norm(centers[links.b] - centers[links.a] - steps, axis=1) / lengths
    agree = (turned <= MAX_TURN_DEG) & (shifts <= MAX_SHIFT)
    links = links.select(agree)
    links = links.select(_well_held(links, scene.num_images))
    images = np.unique(np.concatenate([links.a, links.b]))
    if not len(images):
        return None
    translations = -np.einsum("nij,nj->ni", rotations[images], centers[images])
    return Placement(images, rotations[images], translations, np.exp(log_scales[images]))


def averaged_rotations(links: _Links, num_images: int, seed: int) -> Float64 | None:
    """(n, 3, 3) rotations that agree best with those of the links, or None if that fails."""
    reconstruction, graph = pycolmap.Reconstruction(), pycolmap.PoseGraph()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=2, height=2, params=[1, 1, 1])
    camera.camera_id = 1
    reconstruction.add_camera_with_trivial_rig(camera)
    for image in map(int, np.unique(np.concatenate([links.a, links.b]))):
        reconstruction.add_image_with_trivial_frame(
            pycolmap.Image(name=str(image), camera_id=1, image_id=image + 1)
        )
    for a, b, rotation, weight in zip(
        links.a.tolist(), links.b.tolist(), links.rotation, links.weight, strict=True
    ):
        edge = pycolmap.PoseGraphEdge()
        edge.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.zeros(3))
        edge.num_matches = int(weight)
        graph.add_edge(a + 1, b + 1, edge)
    options = pycolmap.RotationEstimatorOptions()
    options.random_seed = seed
    level = pycolmap.logging.minloglevel
    # It tells on stderr what it left out, and that nothing is left.
    pycolmap.logging.minloglevel = max(level, _FATAL)
    try:
        if not pycolmap.run_rotation_averaging(options, graph, reconstruction, []):
            return None
    finally:
        pycolmap.logging.minloglevel = level
    rotations = np.tile(np.eye(3), (num_images, 1, 1))
    for number, image in reconstruction.images.items():
        if image.has_pose:
            rotations[number - 1] = image.cam_from_world().rotation.matrix()
    return rotations


def agreed(a: Int64, b: Int64, steps: Float64, weights: Float64, count: int) -> Float64:
    """Values (count, ...) whose differences ``x[b] - x[a]`` agree best with ``steps`` (m, ...).

    Least squares, weighted again and again as Cauchy's loss wants it, whose scale is the robust
    std of what is left. The mean of the values is 0; what no link holds stays there.
    """
    values = steps.reshape(len(steps), -1)
    found = np.zeros((count, values.shape[1]))
    robust = np.ones(len(a))
    ends = np.concatenate([a, b])
    for _ in range(ROUNDS):
        weight = weights * robust
        diagonal = np.bincount(ends, np.concatenate([weight, weight]), minlength=count)
        # a little of the identity: the links say nothing of the mean
        held = diagonal + 1e-9 * diagonal.max()
        own = np.arange(count)
        entries = np.concatenate([-weight, -weight, held])
        places = np.concatenate([a, b, own]), np.concatenate([b, a, own])
        laplacian = coo_matrix((entries, places), shape=(count, count)).tocsc()
        side = np.zeros_like(found)
        np.add.at(side, b, weight[:, None] * values)
        np.add.at(side, a, -weight[:, None] * values)
        found = splu(laplacian).solve(side)
        off = np.linalg.norm(found[b] - found[a] - values, axis=1)
        scale = max(MAD_TO_STD * float(np.median(off)), 1e-12)
        robust = 1 / (1 + (off / scale) ** 2)
    found -= found.mean(axis=0)
    return found.reshape(count, *steps.shape[1:])


def _links(scene: Scene, pairs: list[VerifiedPair]) -> _Links:
    """The pairs whose length depth tells in both images."""
    empty = np.zeros(0, np.int64)
    a = np.array([pair.image_a for pair in pairs], dtype=np.int64)
    b = np.array([pair.image_b for pair in pairs], dtype=np.int64)
    rotation = np.array([pair.rotation for pair in pairs]).reshape(-1, 3, 3)
    translation = np.array([pair.translation for pair in pairs]).reshape(-1, 3)
    translation = translation / np.maximum(np.linalg.norm(translation, axis=1), 1e-12)[:, None]
    of = np.repeat(np.arange(len(pairs)), [len(pair) for pair in pairs])
    offsets = scene.graph.offsets
    source = np.concatenate([empty, *(p.matches[:, 0] + offsets[p.image_a] for p in pairs)])
    target = np.concatenate([empty, *(p.matches[:, 1] + offsets[p.image_b] for p in pairs)])
    centers = camera_center(rotation, translation)[of]
    rays_b = np.einsum("nji,nj->ni", rotation[of], scene.rays(target))
    points = midpoints(np.zeros_like(rays_b), scene.rays(source), centers, rays_b)
    z_a = points[:, 2]
    z_b = np.einsum("nj,nj->n", rotation[of, 2], points) + translation[of, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        wide = triangulation_angle_deg(np.zeros_like(centers), centers, points) >= MIN_ANGLE_DEG
        use = wide & (z_a > 0) & (z_b > 0)
        use &= scene.keypoint_valid[source] & scene.keypoint_valid[target]
        logs = np.log(
            np.stack([scene.keypoint_prior[source] / z_a, scene.keypoint_prior[target] / z_b])
        )
    counts = np.bincount(of[use], minlength=len(pairs))
    lengths = np.stack([group_medians(values[use], of[use], len(pairs)) for values in logs], axis=1)
    weight = np.array([len(pair) for pair in pairs], dtype=np.float64)
    links = _Links(a, b, rotation, translation, lengths, weight)
    return links.select(counts >= MIN_MATCHES)


def _well_held(links: _Links, count: int) -> Bool:
    """(m,) bool, links of the largest group of images that :data:`MIN_HOLDS` links each hold."""
    chosen = np.ones(len(links.a), dtype=np.bool_)
    while True:
        ends = np.concatenate([links.a[chosen], links.b[chosen]])
        weak = np.bincount(ends, minlength=count) < MIN_HOLDS
        gone = chosen & (weak[links.a] | weak[links.b])
        if not gone.any():
            break
        chosen &= ~gone
    if chosen.any():
        a, b = links.a[chosen], links.b[chosen]
        matrix = coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
        group = connected_components(matrix, directed=False)[1]
        sizes = np.bincount(group[np.unique(np.concatenate([a, b]))])
        chosen &= group[links.a] == sizes.argmax()
    return chosen
