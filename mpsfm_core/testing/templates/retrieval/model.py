import cv2
import numpy as np

from mpsfm_core import Options


class ${Class}Options(Options):
    size: int = 8  # width and height of the thumbnail, in pixels


class $Class:
    """Describe a view by a thumbnail: put your global descriptor here."""

    def __init__(self, options, context):
        self._size = options.size

    def describe(self, view):
        size = (self._size, self._size)
        small = cv2.resize(view.image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        vector = small.ravel() - small.mean()
        return vector / max(np.linalg.norm(vector), np.float32(1))  # unit length
