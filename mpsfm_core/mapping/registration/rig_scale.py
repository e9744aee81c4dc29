"""Scales of rigs and of depth priors, from matches between the images of one frame."""

from __future__ import annotations

import numpy as np

from mpsfm_core.data import Float64, VerifiedPair
from mpsfm_core.mapping.scene.scene import Scene

MIN_MATCHES = 10
"""Minimum number of matches within a frame that measure a scale. [ours]"""


def estimate_rig_scale(scene: Scene, image: int) -> float | None:
    """Estimate the scale of a rig from the depth of an image and matches within its frame.

    A keypoint of the image is lifted to a 3D point ``X`` by its depth. The matching keypoint in
    another image of the frame has the ray ``x``. ``x`` is parallel to ``R X + k t``, where ``(R,
    t)`` is the relative pose in meters, and the cross product is linear in the scale ``k``.

    Args:
        scene: The scene, in which the depth scale of the image is known.
        image: A registered image.

    Returns:
        Median over the matches in world units per meter, or None with too few matches.
    """
    members = set(scene.rigs.images_of(image))
    estimates = [
        _estimate_from_pair(scene, image, pair)
        for pair in scene.problem.pairs
        if image in (pair.image_a, pair.image_b) and {pair.image_a, pair.image_b} <= members
    ]
    scales = np.concatenate([np.zeros(0), *estimates])
    return float(np.median(scales)) if len(scales) >= MIN_MATCHES else None


def set_frame_scales(scene: Scene, image: int) -> None:
    """Set the depth scales of the images of a frame from the depth scale of one of its images.

    The points of an image with a known scale are lifted. The scale of another image is the median
    ratio of the depth of these points and the depth prior, over the matches of both images. A
    metric prior without enough matches takes the scale of the given image, if its prior is metric.

    Args:
        scene: The scene.
        image: Registered image with a known depth scale.
    """
    maps, members = scene.maps, scene.rigs.images_of(image)
    pairs = [
        pair
        for pair in scene.problem.pairs
        if len(pair) >= MIN_MATCHES and {pair.image_a, pair.image_b} <= set(members)
    ]
    pairs.sort(key=len, reverse=True)
    while measured := next(
        (
            (other, scale)
            for pair in pairs
            for known, other in ((pair.image_a, pair.image_b), (pair.image_b, pair.image_a))
            if maps[known].active and not maps[other].active
            if (scale := _estimate_depth_scale(scene, pair, known, other)) is not None
        ),
        None,
    ):
        other, scale = measured
        maps[other].set_scale(scale)
    for other in members:
        if not maps[other].active and maps[other].prior.metric and maps[image].prior.metric:
            maps[other].set_scale(maps[image].scale)


def _estimate_depth_scale(scene: Scene, pair: VerifiedPair, known: int, other: int) -> float | None:
    """Return the depth scale of an image from the points of another image of its frame."""
    rows = pair.matches if pair.image_a == known else pair.matches[:, ::-1]
    keypoints, others = (rows + scene.graph.offsets[[known, other]]).T
    depth, valid = scene.depth_at(keypoints)
    valid &= scene.keypoint_valid[others]
    points = scene.at_depth(keypoints[valid], depth[valid])
    _, z = scene.project(others[valid], points)
    ratios = z[z > 0] / scene.keypoint_prior[others[valid][z > 0]]
    return float(np.median(ratios)) if len(ratios) >= MIN_MATCHES else None


def _estimate_from_pair(scene: Scene, image: int, pair: VerifiedPair) -> Float64:
    """Return the positive scales of the rig that single matches of a pair determine."""
    other = pair.image_b if pair.image_a == image else pair.image_a
    own, theirs = pair.matches.T if pair.image_a == image else pair.matches.T[::-1]
    rigs = scene.rigs
    turn = rigs.rotations[other] @ rigs.rotations[image].T
    shift = rigs.translations[other] - turn @ rigs.translations[image]
    if not np.linalg.norm(shift) > 0:
        return np.zeros(0)
    keypoints = own + scene.graph.offsets[image]
    depth, valid = scene.depth_at(keypoints)
    points = (scene.rays(keypoints) * depth[:, None])[valid] @ turn.T
    rays = scene.rays(theirs + scene.graph.offsets[other])[valid]
    across, along = np.cross(rays, points), np.cross(rays, shift)
    scales: Float64 = -np.einsum("ni,ni->n", across, along) / (along**2).sum(axis=1)
    return scales[scales > 0]
