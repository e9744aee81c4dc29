"""Local bundle of an image: the registered images that share most points with the image."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from mpsfm_core.mapping.scene.scene import Scene

NUM_NEIGHBORS = 4
"""Number of registered images in the local bundle of an image, in addition to the image.
[reference] [COLMAP ba_local_num_images]"""


def find_local_bundle(scene: Scene, image: int, scores: csr_array) -> list[int]:
    """Return an image and the registered images that share most 3D points with the image.

    If fewer than ``NUM_NEIGHBORS`` images share points, the images with the most matches are added.
    COLMAP's ``FindLocalBundle`` also ranks images by the number of shared points.
    """
    shared, _ = scene.tracks.observations_of(scene.points_of([image]))
    counts = np.bincount(scene.graph.image_of[shared], minlength=scene.num_images)
    score = scores[[image]].toarray()[0]
    order = np.lexsort((-score, -counts))
    usable = scene.registered & ((counts > 0) | (score > 0))
    usable[image] = False
    neighbors = [int(k) for k in order if usable[k]]
    return [image, *neighbors[:NUM_NEIGHBORS]]
