import cv2
import numpy as np

from mpsfm_core import Features, Options


class ${Class}Options(Options):
    max_keypoints: int = 1000
    radius: int = 7  # half the patch size around a keypoint, in pixels


class $Class:
    """Detect corners and describe each by its image patch: put your detector here."""

    def __init__(self, options, context):
        self._options = options

    def extract(self, view):
        gray = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(gray, self._options.max_keypoints, 0.01, 3)
        columns, rows = _none(corners).reshape(-1, 2).astype(np.int64).T
        return Features(
            keypoints=np.stack([columns, rows], axis=1) + 0.5,  # COLMAP: pixel centers
            descriptors=self._describe(gray, columns, rows),
        )

    def _describe(self, gray, columns, rows):
        radius = self._options.radius
        padded = np.pad(gray.astype(np.float32), radius, mode="reflect" if gray.size > 1 else "edge")
        side = np.arange(2 * radius + 1)
        patches = padded[rows[:, None, None] + side[:, None], columns[:, None, None] + side]
        patches = patches.reshape(len(rows), side.size**2)
        patches -= patches.mean(axis=1, keepdims=True)
        return patches / np.maximum(np.linalg.norm(patches, axis=1, keepdims=True), 1e-6)


def _none(corners):
    return np.empty((0, 2)) if corners is None else corners
