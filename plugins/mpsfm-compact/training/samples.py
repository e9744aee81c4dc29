"""Training samples on disk, stored in shards of memory-mapped arrays.

A sample is an image of 320 x 240 pixels with its depth and normal labels.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 320, 240
UNKNOWN, SURFACE, EMPTY, ROUGH = 0, 1, 2, 3
"""Values of ``Sample.kind``: unknown, surface with measured depth, no measurable surface (sky,
mirrors, glass), and surface whose depth was predicted by another network.
"""


@dataclass(frozen=True)
class Sample:
    """One training image.

    ``image`` (240, 320, 3) is uint8 RGB. ``depth`` (240, 320) is float32 z-depth in meters, 0 if
    unknown. ``normals`` (240, 320, 3) are in the camera frame, 0 if unknown. ``kind`` (240, 320) is
    UNKNOWN, SURFACE, EMPTY or ROUGH per pixel. ``camera`` is (fx, fy, cx, cy) in pixels, with the
    center of the first pixel at (0.5, 0.5). ``metric`` is True if depth has metric scale.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    kind: NDArray[np.uint8]
    camera: NDArray[np.float32]
    metric: bool = True


def write_shard(folder: Path, samples: Iterable[Sample]) -> int:
    """Write samples atomically as one shard folder, and return their number."""
    stored = list(samples)
    if not stored:
        return 0
    building = folder.with_name(folder.name + ".part")
    building.mkdir(parents=True, exist_ok=True)
    np.save(building / "image.npy", np.stack([s.image for s in stored]))
    np.save(building / "depth.npy", np.stack([s.depth for s in stored]).astype(np.float16))
    coded = [np.round(127 * s.normals).astype(np.int8) for s in stored]
    np.save(building / "normals.npy", np.stack(coded))
    np.save(building / "kind.npy", np.stack([s.kind for s in stored]))
    np.save(building / "camera.npy", np.stack([s.camera for s in stored]).astype(np.float32))
    np.save(building / "metric.npy", np.array([s.metric for s in stored]))
    (building / "shard.json").write_text(json.dumps({"samples": len(stored)}))
    building.rename(folder)
    return len(stored)


class Shard:
    """Memory-mapped shard."""

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        names = ("image", "depth", "normals", "kind", "camera", "metric")
        self._arrays = {n: np.load(folder / f"{n}.npy", mmap_mode="r") for n in names}

    def __len__(self) -> int:
        return len(self._arrays["metric"])

    def __getitem__(self, index: int) -> dict[str, NDArray[np.generic]]:
        """Return the arrays of one sample, with float16 depth and normals times 127 as int8."""
        return {name: np.asarray(array[index]) for name, array in self._arrays.items()}


def find_shards(folder: Path) -> Iterator[Path]:
    """Find the complete shards below a folder, sorted by path."""
    return (
        path.parent
        for path in sorted(folder.glob("**/shard.json"))
        if path.parent.suffix != ".part"
    )
