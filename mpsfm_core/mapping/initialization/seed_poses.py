"""Seed poses from an earlier reconstruction of the same images with other matches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import replace

from mpsfm_core.data import MappingProblem, PinholeCamera
from mpsfm_core.mapping.initialization.camera_splitting import split_cameras
from mpsfm_core.mapping.scene.reconstruction import MappingResult, RegisteredImage

MIN_POINTS = 100
"""Minimum number of points with at least three observations that a seed image observes. [COLMAP
init_min_num_inliers]"""


def select_seed_images(
    mapping: MappingResult, min_points: int = MIN_POINTS
) -> list[RegisteredImage]:
    """Select the well-constrained images of the largest reconstruction.

    Args:
        mapping: The earlier result.
        min_points: Minimum number of points with at least three observations that a selected image
            observes.
    """
    return [
        image
        for reconstruction in mapping.reconstructions[:1]
        for image, num_points in zip(
            reconstruction.images, reconstruction.num_multi_view_points(), strict=True
        )
        if image.confirmed and num_points >= min_points
    ]


def apply_seed_poses(
    problem: MappingProblem, seed_images: Collection[RegisteredImage]
) -> MappingProblem:
    """Return the problem with the poses of the seed images as known poses.

    Known poses of images without a seed pose stay unchanged. All images that share the camera of a
    seed image take the focal length of the seed images. A seed image gets its own camera if its
    focal length differs from that of most seed images of its camera.
    """
    poses = {seed.index: (seed.rotation, seed.translation) for seed in seed_images}
    refined: dict[tuple[int, PinholeCamera], Counter[PinholeCamera]] = {}
    for seed in seed_images:
        key = problem.images[seed.index].shared_camera
        refined.setdefault(key, Counter())[seed.camera] += 1
    cameras = {key: counts.most_common(1)[0][0] for key, counts in refined.items()}
    images = tuple(
        replace(
            image.with_camera(cameras.get(image.shared_camera, image.camera)),
            known_pose=poses.get(index, image.known_pose),
        )
        for index, image in enumerate(problem.images)
    )
    own_focals = {
        seed.index: seed.camera.fx
        for seed in seed_images
        if seed.camera != images[seed.index].camera
    }
    return replace(problem, images=split_cameras(images, own_focals))
