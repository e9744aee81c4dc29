"""What a finished reconstruction holds in place, as the start of another with more matches."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from mpsfm_core.data import MappingProblem
from mpsfm_core.mapping.scene.reconstruction import MappingResult, RegisteredImage


def select_seed_images(mapping: MappingResult, least: int) -> list[RegisteredImage]:
    """The confirmed images of the largest reconstruction that see at least ``least`` points which
    three images see."""
    return [
        image
        for part in mapping.reconstructions[:1]
        for image, count in zip(part.images, part.num_multi_view_points(), strict=True)
        if image.confirmed and count >= least
    ]


def with_seed_poses(problem: MappingProblem, held: Collection[RegisteredImage]) -> MappingProblem:
    """The problem with the poses of these images as known, beside those that are, and with their
    focal lengths for all images of their cameras."""
    cameras = {problem.images[image.index].camera: image.camera for image in held}
    poses = {image.index: (image.rotation, image.translation) for image in held}
    images = tuple(
        replace(
            image,
            camera=cameras.get(image.camera, image.camera),
            known_pose=poses.get(index, image.known_pose),
        )
        for index, image in enumerate(problem.images)
    )
    return replace(problem, images=images)
