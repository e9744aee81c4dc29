"""Extract and match SIFT features of all image pairs with COLMAP."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pycolmap


def extract(
    database: Path, images: Path, model: str, params: Sequence[float], names: Sequence[str] = ()
) -> None:
    """Extract SIFT features of the named images (default: all) with one known camera."""
    pycolmap.extract_features(
        database,
        images,
        image_names=list(names),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=pycolmap.ImageReaderOptions(
            camera_model=model, camera_params=",".join(map(str, params))
        ),
        extraction_options=pycolmap.FeatureExtractionOptions(use_gpu=False),
    )


def match(database: Path) -> None:
    """Match all pairs."""
    pycolmap.match_exhaustive(
        database, matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False)
    )
