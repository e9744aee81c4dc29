"""SIFT features by COLMAP's CPU extractor."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap

from mpsfm_core.builtin.options import SiftOptions
from mpsfm_core.data import Features, UInt8, View
from mpsfm_core.geometry import scale_pixels
from mpsfm_core.providers import ProviderContext


class Sift:
    """Detects with COLMAP's VLFeat-based extractor; deterministic."""

    def __init__(self, options: SiftOptions, context: ProviderContext) -> None:
        self._resize = options.resize
        settings = pycolmap.FeatureExtractionOptions()
        settings.use_gpu = False
        settings.num_threads = context.threads
        sift = settings.sift
        sift.max_num_features = options.max_keypoints
        sift.first_octave = options.first_octave
        sift.octave_resolution = options.octave_resolution
        sift.peak_threshold = options.peak_threshold
        sift.edge_threshold = options.edge_threshold
        sift.upright = options.upright
        sift.estimate_affine_shape = options.affine
        sift.normalization = (
            pycolmap.Normalization.L1_ROOT if options.root else pycolmap.Normalization.L2
        )
        self._extractor = pycolmap.FeatureExtractor.create(settings, pycolmap.Device.cpu)

    def extract(self, view: View) -> Features:
        """Keypoints with unit descriptors (n, 128), as COLMAP rounds them to 8 bit."""
        gray = self._detection_image(view)
        found, described = self._extractor.extract(pycolmap.Bitmap.from_array(gray))
        size = gray.shape[1], gray.shape[0]
        xy = np.array([(k.x, k.y) for k in found], dtype=np.float64).reshape(-1, 2)
        scales = np.array([k.compute_scale() for k in found], dtype=np.float32)
        descriptors = np.array(described.data, dtype=np.float32).reshape(-1, 128)
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-6)
        factor = view.camera.width / size[0]
        return Features(
            # The detector's sub-pixel fit may end just outside of the image.
            np.clip(scale_pixels(xy, size, view.camera.size), 0, view.camera.size),
            descriptors,
            scales=scales * np.float32(factor),
            std_px=max(1.0, factor),
        )

    def _detection_image(self, view: View) -> UInt8:
        gray: UInt8 = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        longest = max(view.camera.size)
        if self._resize is None or longest <= self._resize:
            return gray
        factor = self._resize / longest
        size = tuple(max(1, round(side * factor)) for side in view.camera.size)
        reduced: UInt8 = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        return reduced
