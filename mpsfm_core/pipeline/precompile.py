"""Precompile the numba kernels of extraction, mapping and the dense stage.

A run without compiled kernels compiles all kernels in parallel to extraction, and waits for the
compilation before mapping. ``python -m mpsfm_core.pipeline.precompile`` compiles all kernels at
installation. Two processes reconstruct a small synthetic scene and share the kernels on disk. The
first process compiles the kernels of bundle adjustment first, the second process those of depth
integration and multi-view stereo.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np

from mpsfm_core.data import Float64, MappingProblem, PinholeCamera, View
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.geometry.patch_alignment import align_patches
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.initialization.view_graph_calibration import estimate_shared_lens
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.optimize.bundle_kernels import update_points
from mpsfm_core.optimize.depth_integration import DepthIntegrator
from mpsfm_core.providers.builtin.mutual_nearest import mutual_nearest

_FIRST_KERNELS = ("bundles", "depth")
"""Numba kernels that the first and the second process compile first."""
_PACKAGES = ("geometry", "providers/builtin", "extraction", "optimize", "mapping", "dense")
_SOURCES = tuple(f"{package}/**/*.py" for package in _PACKAGES)
_CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 160.0, 120.0)


class Compilation(NamedTuple):
    """Compilation of numba kernels in background processes."""

    processes: tuple[subprocess.Popen[bytes], ...]
    stamp: Path
    """File whose existence marks a finished compilation."""

    def wait(self) -> None:
        """Wait for the end of compilation; after a failure, kernels compile at first use."""
        codes = [process.wait() for process in self.processes]
        if not any(codes):
            self.stamp.touch()

    def stop(self) -> None:
        """End the compilation processes that are still running."""
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.wait()


def start_compilation() -> Compilation | None:
    """Start compiling the kernels in background processes.

    Returns:
        The running compilation, or None if the kernels are already compiled or cannot be stored on
        disk.
    """
    stamp = _stamp_path()
    if stamp is None or stamp.exists():
        return None
    command = [sys.executable, "-m", "mpsfm_core.pipeline.precompile"]
    quiet = subprocess.DEVNULL
    processes = tuple(
        subprocess.Popen([*command, first], stdout=quiet, stderr=quiet) for first in _FIRST_KERNELS
    )
    return Compilation(processes, stamp)


def compile_kernels(first: str) -> None:
    """Compile all kernels by reconstructing a small synthetic scene.

    Args:
        first: Kernels to compile first, ``bundles`` (bundle adjustment) or ``depth`` (depth
            integration and multi-view stereo).
    """
    # Runs with compiled kernels do not import the package mpsfm_core.testing.
    from mpsfm_core.testing.synthetic.problems import make_mapping_problem
    from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

    scene, poses = room_scene(), arc_poses(3, 10.0)
    problem = make_mapping_problem(scene, _CAMERA, poses, points_per_view=60, map_width=64)
    views = {
        image.name: View(image.name, scene.render(_CAMERA, pose).rgb, _CAMERA)
        for image, pose in zip(problem.images, poses, strict=True)
    }
    if first == "depth":
        mutual_nearest(*np.ones((2, 1, 1), np.float32))
        gray, no_points = np.ones((1, 1), np.float32), np.zeros((0, 2))
        align_patches(gray, gray, no_points, no_points, np.zeros((0, 2, 2)), 3, 1.0)
        depth, normals = problem.images[0].depth, problem.images[0].normals
        height, width = depth.shape
        DepthIntegrator(depth, normals, _CAMERA.resized(width, height)).refine()
        _compile_dense(_known_reconstruction(problem, poses), views)
        estimate_shared_lens(problem, problem.pairs)
    for is_global in (True, False):
        options = MapperOptions(global_initialization=is_global)
        mapping = mapper.reconstruct(problem, options)
    _compile_dense(mapping.reconstructions[0], views)


def _known_reconstruction(problem: MappingProblem, poses: Sequence[Float64]) -> Reconstruction:
    """Make a reconstruction without points from depth priors and known poses."""
    unmatched = [np.full(len(image.keypoints), -1) for image in problem.images]
    images = [
        RegisteredImage(
            index, image.name, _CAMERA, pose[:, :3], pose[:, 3], point_ids, image.depth, 1.0
        )
        for index, (image, pose, point_ids) in enumerate(
            zip(problem.images, poses, unmatched, strict=True)
        )
    ]
    return Reconstruction(tuple(images), np.zeros((0, 3)), np.zeros(0))


def _compile_dense(reconstruction: Reconstruction, views: Mapping[str, View]) -> None:
    dense, _ = densify(reconstruction, views.__getitem__, DenseOptions())
    fuse_depth_maps(dense, views.__getitem__)


def _stamp_path() -> Path | None:
    """Return the stamp file next to the kernels, named by a hash of sources and versions."""
    folder = update_points.stats.cache_path  # type: ignore[attr-defined]
    if folder is None:
        return None
    fingerprint = hashlib.sha256(f"{sys.version} {numba.__version__}".encode())
    package = Path(__file__).parents[1]
    for path in sorted(path for pattern in _SOURCES for path in package.glob(pattern)):
        stat = path.stat()
        fingerprint.update(f"{path} {stat.st_mtime_ns} {stat.st_size}".encode())
    return Path(folder) / f"precompiled-{fingerprint.hexdigest()[:16]}"


if __name__ == "__main__":
    if len(sys.argv) > 1:
        compile_kernels(sys.argv[1])
    elif (compilation := start_compilation()) is not None:
        compilation.wait()
