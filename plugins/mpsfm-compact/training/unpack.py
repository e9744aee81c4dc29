"""Conversion of training shards to scene folders for ``mpsfm calibrate``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import yaml

from training.samples import Shard


def unpack(shards: Sequence[Path], output: Path, most: int) -> int:
    """Write at most ``most`` evenly spaced training samples of each shard to a scene folder.

    The scene folder has ``images/``, ``gt_depth/`` (16-bit PNG, millimeters), ``gt_normals/`` and
    ``intrinsics.yaml``.

    Returns:
        The number of written training samples.
    """
    cameras = {}
    for folder in shards:
        shard = Shard(folder)
        chosen = np.unique(np.linspace(0, len(shard) - 1, min(most, len(shard))).astype(int))
        for index in chosen:
            sample = shard[int(index)]
            name = f"{folder.name}/{index:04d}"
            normals = sample["normals"].astype(np.float32) / 127
            known = (np.linalg.norm(normals, axis=-1) > 0.9)[..., None]
            coded = np.where(known, np.rint((normals / 2 + 0.5) * 255), 127).astype(np.uint8)
            millimetres = 1000 * sample["depth"].astype(np.float64)
            millimetres[millimetres > np.iinfo(np.uint16).max] = 0
            pictures = {
                f"images/{name}.png": sample["image"][..., ::-1],
                f"gt_depth/{name}.png": np.rint(millimetres).astype(np.uint16),
                f"gt_normals/{name}.png": coded[..., ::-1],
            }
            for path, picture in pictures.items():
                (output / path).parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(output / path), picture)
            params = [float(value) for value in sample["camera"]]
            cameras[len(cameras) + 1] = {"params": params, "images": [f"{name}.png"]}
    (output / "intrinsics.yaml").write_text(yaml.safe_dump(cameras), encoding="utf-8")
    return len(cameras)
