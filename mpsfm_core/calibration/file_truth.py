"""True depth and normals from files, read as the provider ``files`` reads them."""

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
from mpsfm_core.providers import validation
from mpsfm_core.providers.builtin.map_files import find_file
from mpsfm_core.providers.builtin.options import DepthFileOptions, FileOptions, NormalFileOptions
from mpsfm_core.providers.provider_config import ProviderConfig

EXACT = 1e-4
"""Relative std of depth files for which none is given: exact for every prior, and positive."""


class FileTruth:
    """Reads the true map of an image and chooses pixels of it.

    ``options``: of the provider ``files``. ``count``: pixels of an image at most.
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
        """Whether there is a file for a view."""
        try:
            find_file(self._options, view, "ground truth")
        except InputError:
            return False
        return True

    def depth(self, view: View, index: int) -> DepthTruth:
        """Depth at pixels of a view that the truth and the view's mask have."""
        true = validation.run_depth(self._provider.spec, self._provider.instance, view)
        rows, xy = self._choose(true.valid, view, index)
        depth = true.depth[rows].astype(np.float64)
        assert true.variance is not None  # the files provider declares one
        return DepthTruth(xy, depth, np.sqrt(true.variance[rows]) / depth)

    def normals(self, view: View, index: int) -> NormalTruth:
        """Normals at pixels of a view that the truth and the view's mask have."""
        true = validation.run_normals(self._provider.spec, self._provider.instance, view)
        rows, xy = self._choose(true.valid, view, index)
        std = np.zeros(len(xy)) if true.variance is None else np.sqrt(true.variance[rows])
        return NormalTruth(xy, true.normals[rows].astype(np.float64), std.astype(np.float64))

    def _choose(self, valid: Bool, view: View, index: int) -> tuple[tuple[Int64, Int64], Float64]:
        """Rows and columns of chosen pixels, and their places (n, 2) in the view."""
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
