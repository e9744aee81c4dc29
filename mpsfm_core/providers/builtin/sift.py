"""Features provider that runs COLMAP's SIFT extractor on the CPU."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from mpsfm_core.data import Features, Float32, UInt8, View
from mpsfm_core.geometry import scale_pixels
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.builtin.options import SiftOptions

_WARNING = 1
"""Log level of glog that hides the line that COLMAP prints for each image."""


class Sift:
    """Features provider that runs COLMAP's deterministic CPU extractor of SIFT (VLFeat)."""

    def __init__(self, options: SiftOptions, context: ProviderContext) -> None:
        self._resize = options.resize
        self._settings = pycolmap.FeatureExtractionOptions()
        self._settings.use_gpu = False
        self._settings.num_threads = context.threads
        sift = self._settings.sift
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
        # At its default log level, COLMAP prints a line for each image.
        if "GLOG_minloglevel" not in os.environ:
            pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, _WARNING)

    def extract(self, view: View) -> Features:
        """Extract SIFT keypoints with descriptors (n, 128) of unit length and 8 bit precision."""
        gray = self._detection_image(view)
        keypoints, descriptors = _run_colmap(gray, self._settings)
        size = gray.shape[1], gray.shape[0]
        factor = view.camera.width / size[0]
        # COLMAP stores a keypoint as x, y, a11, a12, a21, a22. The columns of the affine shape a
        # are the axes of the keypoint.
        axes = np.hypot(keypoints[:, 2:4], keypoints[:, 4:6])
        xy = scale_pixels(keypoints[:, :2].astype(np.float64), size, view.camera.size)
        norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
        return Features(
            # Sub-pixel refinement may move a SIFT keypoint out of the image by a fraction of a
            # pixel.
            np.clip(xy, 0, view.camera.size),
            descriptors / np.maximum(norms, np.float32(1e-6)),
            scales=axes.mean(axis=1) * np.float32(factor),
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


def _run_colmap(
    gray: UInt8, settings: pycolmap.FeatureExtractionOptions
) -> tuple[Float32, Float32]:
    """Extract SIFT keypoints (n, 6) and descriptors (n, 128) of a gray image.

    The class ``pycolmap.Sift`` keeps Python's GIL while it computes, so threads would wait for each
    other. The function ``pycolmap.extract_features`` releases the GIL, but only works on files.
    """
    with tempfile.TemporaryDirectory(prefix="mpsfm-sift-") as folder:
        images, database = Path(folder, "images"), Path(folder, "database.db")
        images.mkdir()
        (images / "image.pgm").write_bytes(cv2.imencode(".pgm", gray)[1].tobytes())
        pycolmap.extract_features(
            database, images, extraction_options=settings, device=pycolmap.Device.cpu
        )
        with pycolmap.Database.open(database) as opened:
            image = opened.read_all_images()[0]
            keypoints = np.asarray(opened.read_keypoints(image.image_id), dtype=np.float32)
            descriptors = np.asarray(opened.read_descriptors(image.image_id).data, dtype=np.float32)
    return keypoints.reshape(-1, 6), descriptors.reshape(-1, 128)
