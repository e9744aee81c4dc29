"""True depth and normals from map files that the provider ``files`` reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mpsfm_core.calibration.samples import DepthTruth, NormalTruth
from mpsfm_core.data import Bool, Float64, Int64, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.data.options import parse_settings
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.geometry import pixel_centers, sample_nearest, scale_pixels
from mpsfm_core.providers.builtin.map_files import find_file
from mpsfm_core.providers.builtin.options import DepthFileOptions, FileOptions, NormalFileOptions
from mpsfm_core.providers.kinds.depth import run_depth
from mpsfm_core.providers.kinds.normals import run_normals
from mpsfm_core.providers.provider_config import ProviderConfig

EXACT = 1e-4
"""Default relative std of true depth, negligible compared with the std of priors."""


class FileTruth:
    """Reader of true depth or normal maps that samples pixels of an image.

    Args:
        context: Extraction context.
        kind: ``depth`` or ``normals``.
        options: Options of the provider ``files``, which reads the true maps.
        count: Maximum number of sampled pixels per image.
        seed: Random seed of the pixel sampling.
    """

    def __init__(
        self,
        context: ExtractionContext,
        kind: str,
        options: Mapping[str, Any],
        count: int,
        seed: int,
    ) -> None:
        depth = kind == "depth"
        values = {"relative_std": EXACT, **options} if depth else dict(options)
        model = DepthFileOptions if depth else NormalFileOptions
        self._options: FileOptions = parse_settings(model, values, ("ground_truth",))
        if not self._options.directory.is_dir():
            raise InputError(f"ground truth folder {self._options.directory} does not exist")
        backend = ProviderConfig(use="files", options=self._options.model_dump(mode="json"))
        self._provider = context.provider("depth" if depth else "normals", backend)
        self._count, self._seed = count, seed

    def has(self, view: View) -> bool:
        """Return True if a view has a true depth or normal map."""
        try:
            find_file(self._options, view, "ground truth")
        except InputError:
            return False
        return True

    def depth(self, view: View, index: int) -> DepthTruth:
        """Sample true depth at valid, unmasked pixels of a view."""
        true = run_depth(self._provider.spec, self._provider.instance, view)
        rows, xy = self._sample_pixels(true.valid, view, index)
        depth = true.depth[rows].astype(np.float64)
        assert true.variance is not None  # The provider ``files`` always declares a variance.
        return DepthTruth(xy, depth, np.sqrt(true.variance[rows]) / depth)

    def normals(self, view: View, index: int) -> NormalTruth:
        """Sample true normals at valid, unmasked pixels of a view."""
        true = run_normals(self._provider.spec, self._provider.instance, view)
        rows, xy = self._sample_pixels(true.valid, view, index)
        std = np.zeros(len(xy)) if true.variance is None else np.sqrt(true.variance[rows])
        return NormalTruth(xy, true.normals[rows].astype(np.float64), std.astype(np.float64))

    def _sample_pixels(
        self, valid: Bool, view: View, index: int
    ) -> tuple[tuple[Int64, Int64], Float64]:
        """Sample valid pixels and return array indices and COLMAP pixels (n, 2) of the view."""
        height, width = valid.shape
        centers = scale_pixels(pixel_centers(width, height), (width, height), view.camera.size)
        if view.mask is not None:
            allowed = sample_nearest(view.mask, centers.reshape(-1, 2))
            valid = valid & allowed.reshape(valid.shape)
        found = np.flatnonzero(valid)
        if len(found) > self._count:
            rng = np.random.default_rng([self._seed, index])
            found = np.sort(rng.choice(found, self._count, replace=False))
        rows, columns = np.unravel_index(found, valid.shape)
        return (rows, columns), centers[rows, columns]
