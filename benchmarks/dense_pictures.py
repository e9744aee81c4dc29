"""Create the pictures of clouds and meshes in the gallery of the documentation.

    python -m benchmarks.dense_pictures [--scenes room street_0 ...] [--output DIR]

The scenes are the sample scene and the generated streets of :mod:`benchmarks.street`. A picture
shows, from left to right, the point cloud with the option ``dense.check_validity`` off, the point
cloud with the option on, and the textured mesh. The option removes points that no other view
confirms, and points next to depth edges.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

import mpsfm_core as mpsfm
from benchmarks.street import make_street
from mpsfm_core.data import Float64, PinholeCamera, Pose, UInt8, View
from mpsfm_core.dense.densify import densify
from mpsfm_core.dense.fusion import fuse_depth_maps
from mpsfm_core.dense.mesh import mesh_depth_maps
from mpsfm_core.dense.options import DenseOptions, MeshOptions
from mpsfm_core.dense.stereo import StereoDepth
from mpsfm_core.dense.texture import build_texture
from mpsfm_core.geometry import camera_center
from mpsfm_core.geometry.rendering import Geometry, render
from mpsfm_core.inputs.images import load_images
from mpsfm_core.mapping.scene.reconstruction import Reconstruction
from mpsfm_core.testing.synthetic.scenes import look_at

ROOT = Path(__file__).resolve().parents[1]
SAMPLE_SCENE = ROOT / "examples" / "sample_scene"
ROOM, STREET = "room", "street_"
SCENES = [ROOM, *(f"{STREET}{seed}" for seed in range(5))]
"""The sample scene, and generated streets with their seeds."""
WIDTH = 366
"""Width of one rendering in pixels; a picture has three renderings."""
MOVED = {"back": 0.3, "right": 0.35, "up": 0.25}
"""Distance of the rendered camera from the middle photo, relative to the median depth."""
_QUALITY = 80


class Scene(NamedTuple):
    """Reconstruction of a scene before multi-view stereo, and its views by image name."""

    reconstruction: Reconstruction
    view_of: Callable[[str], View]
    up: Float64 | None
    """(3,) direction of the zenith, or None if it is upwards in the middle photo."""


class _StereoMemory:
    """Stereo depth of all images, which does not depend on the option ``check_validity``."""

    def __init__(self) -> None:
        self._depths: dict[str, StereoDepth] = {}

    def load(self, name: str) -> StereoDepth | None:
        return self._depths.get(name)

    def save(self, name: str, depth: StereoDepth) -> None:
        self._depths[name] = depth


def main() -> None:
    """Write a picture of each scene that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=SCENES, metavar="SCENE")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "pictures")
    arguments = parser.parse_args()
    for name in arguments.scenes:
        scene = _reconstruct_sample_scene() if name == ROOM else _generate_street(name)
        picture = cv2.cvtColor(draw_scene(scene), cv2.COLOR_RGB2BGR)
        path = arguments.output / f"dense_{name}.jpg"
        cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        print(path, flush=True)


def _generate_street(name: str) -> Scene:
    street = make_street(int(name.removeprefix(STREET)))
    return Scene(street.reconstruction, street.views.__getitem__, np.array([0.0, 0, 1]))


def _reconstruct_sample_scene() -> Scene:
    """Reconstruct the sample scene without the stage ``dense``."""
    photos, intrinsics = SAMPLE_SCENE / "images", SAMPLE_SCENE / "intrinsics.yaml"
    config = mpsfm.load_config("fast-cpu", ["dense.enabled=false"])
    result = mpsfm.reconstruct(photos, None, config, intrinsics=intrinsics)
    images = load_images(photos, intrinsics)
    rows = {name: row for row, name in enumerate(images.names)}
    view_of = lambda name: images.view(rows[name])  # noqa: E731
    return Scene(result.mapping.reconstructions[0], view_of, None)


def draw_scene(scene: Scene) -> UInt8:
    """Render the cloud with all points, the cloud without doubtful points, and the mesh."""
    camera, pose = _place_camera(scene)
    renderings, stereo = [], _StereoMemory()
    for check_validity in (False, True):
        dense_options = DenseOptions(check_validity=check_validity)
        dense, _ = densify(scene.reconstruction, scene.view_of, dense_options, checkpoints=stereo)
        cloud = fuse_depth_maps(dense, scene.view_of)
        none = np.zeros((0, 3), np.int64)
        renderings.append(render(Geometry(cloud.points, cloud.colors, none), camera, pose))
    options = MeshOptions()
    mesh = mesh_depth_maps(dense, scene.view_of, options)
    textured = build_texture(mesh, dense, scene.view_of, options.max_texture_size)
    gray = np.full((len(textured.vertices), 3), 128, np.uint8)
    surface = Geometry(textured.vertices, gray, textured.triangles, textured.uv, textured.texture)
    renderings.append(render(surface, camera, pose))
    shown = [np.where(each.covered[..., None], each.colors, 255) for each in renderings]
    picture: UInt8 = np.round(np.hstack(shown)).astype(np.uint8)
    return picture


def _place_camera(scene: Scene) -> tuple[PinholeCamera, Pose]:
    """Return a camera that looks at the scene from the right of the middle photo, and above it."""
    image = scene.reconstruction.images[len(scene.reconstruction.images) // 2]
    right, down, forward = image.rotation
    up = -down if scene.up is None else scene.up
    depth = float(np.median(image.depth.depth[image.depth.valid]))
    target = camera_center(image.rotation, image.translation) + depth * forward
    offset = MOVED["right"] * right + MOVED["up"] * up - (1 + MOVED["back"]) * forward
    size = WIDTH, round(WIDTH * image.camera.height / image.camera.width)
    pose = look_at(target + depth * offset, target, up)
    return image.camera.resized(*size), (pose[:, :3], pose[:, 3])


if __name__ == "__main__":
    main()
