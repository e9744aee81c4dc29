"""Compiles the kernels of extraction and mapping before they are needed.

A run that finds them not compiled starts this beside its extraction and waits for it before it
maps; ``python -m mpsfm_core.pipeline.precompile`` does it at installation. Two processes map a tiny
scene, of which one begins with what the other compiles last, and share what they have on disk."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np

from mpsfm_core.data import PinholeCamera, View
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.geometry.patch_alignment import align_patches
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.options import InitializationOptions, MapperOptions
from mpsfm_core.optimize.bundle_kernels import update_points
from mpsfm_core.optimize.depth_integration import DepthIntegrator
from mpsfm_core.providers.builtin.mutual_nearest import mutual_nearest
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

_ENDS = ("bundles", "depth")
_PACKAGES = ("geometry", "providers/builtin", "extraction", "optimize", "mapping", "dense")
_SOURCES = tuple(f"{package}/**/*.py" for package in _PACKAGES)
_CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


class Compilation(NamedTuple):
    """What runs in the background, and the file that says that it was done."""

    processes: tuple[subprocess.Popen[bytes], ...]
    stamp: Path

    def wait(self) -> None:
        """Until it is done. Where it fails, mapping compiles what it meets."""
        codes = [process.wait() for process in self.processes]
        if not any(codes):
            self.stamp.touch()


def start_compilation() -> Compilation | None:
    """Start compiling in the background; None if it was done before, or cannot be kept."""
    stamp = _stamp()
    if stamp is None or stamp.exists():
        return None
    command = [sys.executable, "-m", "mpsfm_core.pipeline.precompile"]
    quiet = subprocess.DEVNULL
    return Compilation(
        tuple(subprocess.Popen([*command, end], stdout=quiet, stderr=quiet) for end in _ENDS), stamp
    )


def compile_kernels(end: str) -> None:
    """Compile all kernels, beginning with those of ``bundles`` or of ``depth``."""
    scene, poses = room_scene(), arc_poses(3, 10.0)
    problem = make_mapping_problem(scene, _CAMERA, poses, points_per_view=60, map_width=64)
    if end == "depth":
        depth, normals = problem.images[0].depth, problem.images[0].normals
        height, width = depth.shape
        DepthIntegrator(depth, normals, _CAMERA.resized(width, height)).refine()
    for at_once in (True, False):
        start = InitializationOptions(global_initialization=at_once)
        mapping = mapper.reconstruct(problem, MapperOptions(initialization=start))
    views = {
        image.name: View(image.name, scene.render(_CAMERA, pose).rgb, _CAMERA)
        for image, pose in zip(problem.images, poses, strict=True)
    }
    dense, _ = densify(mapping.reconstructions[0], views.__getitem__, DenseOptions())
    fuse_depth_maps(dense, views.__getitem__, ResultOptions())
    mutual_nearest(*np.ones((2, 1, 1), np.float32))
    grey, nothing = np.ones((1, 1), np.float32), np.zeros((0, 2))
    align_patches(grey, grey, nothing, nothing, np.zeros((0, 2, 2)), 3, 1.0)


def _stamp() -> Path | None:
    """Beside the compiled kernels; its name holds all that they depend on."""
    folder = update_points.stats.cache_path  # type: ignore[attr-defined]
    if folder is None:
        return None
    found = hashlib.sha256(f"{sys.version} {numba.__version__}".encode())
    package = Path(__file__).parents[1]
    for path in sorted(path for pattern in _SOURCES for path in package.glob(pattern)):
        stat = path.stat()
        found.update(f"{path} {stat.st_mtime_ns} {stat.st_size}".encode())
    return Path(folder) / f"precompiled-{found.hexdigest()[:16]}"


if __name__ == "__main__":
    if len(sys.argv) > 1:
        compile_kernels(sys.argv[1])
    elif (compilation := start_compilation()) is not None:
        compilation.wait()
