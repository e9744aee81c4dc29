"""2D-3D correspondences of a registered frame with the depth of a new frame.

The frames of rigs often see few common points, for example through a door. The depth of the frame
that is nearer to these points is more accurate. If this frame is the new frame, the pose of the
registered frame relative to the new frame is estimated, with points that are lifted from the depth
of the new frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from mpsfm_core.mapping.options import RegistrationOptions
from mpsfm_core.mapping.registration.correspondences import (
    PoseCorrespondences,
    find_correspondences,
)
from mpsfm_core.mapping.registration.rig_scale import set_frame_scales
from mpsfm_core.mapping.scene.scene import Scene


def find_reverse_reference(scene: Scene, correspondences: PoseCorrespondences) -> int | None:
    """Return the registered image whose frame has the most correspondences with a new frame.

    Args:
        scene: The scene with the registered images.
        correspondences: Correspondences of the new frame.

    Returns:
        The first image of the registered frame, or None if both frames have one image or if the
        depth of the new frame has no metric scale.
    """
    maps, image = scene.maps, correspondences.image
    if not (scene.rigs.exist and len(correspondences.keypoints) and maps[image].prior.metric):
        return None
    reference = int(np.bincount(correspondences.frames(scene)).argmax())
    has_rig = any(len(scene.rigs.images_of(k)) > 1 for k in (image, reference))
    has_scale = any(m.active and m.prior.metric for m in maps)
    return reference if has_rig and has_scale else None


@contextmanager
def reverse_registration(
    scene: Scene, image: int, reference: int, options: RegistrationOptions
) -> Iterator[PoseCorrespondences]:
    """Register a new frame at the origin inside a ``with`` block.

    The metric depth priors of the new frame take the mean scale of the registered images.

    Args:
        scene: The scene with the registered images.
        image: Image of the new frame.
        reference: Image of the registered frame.
        options: Registration options of :func:`find_correspondences`.

    Yields:
        Correspondences of the registered frame with the points of the new frame.
    """
    before = scene.snapshot()
    scales = [m.scale for m in scene.maps if m.active and m.prior.metric]
    try:
        scene.register(image, np.eye(3), np.zeros(3))
        scene.maps[image].set_scale(float(np.exp(np.log(scales).mean())))
        set_frame_scales(scene, image)
        yield find_correspondences(scene, reference, [image], options)
    finally:
        scene.restore(before)
