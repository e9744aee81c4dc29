"""Tests of whole runs on panoramas and fisheye images of a room with known poses."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core import reconstruct
from mpsfm_core.data import DepthPrior, Float64, Rig, UInt8, View
from mpsfm_core.geometry import camera_center, rotation_angle_deg
from mpsfm_core.geometry.fisheye import project_wide
from mpsfm_core.geometry.panorama import make_panorama_camera
from mpsfm_core.geometry.similarity import umeyama
from mpsfm_core.inputs.view_cutting import ViewCutter
from mpsfm_core.report.verdict import judge
from mpsfm_core.testing.synthetic.scenes import look_at, room_scene

PANORAMA = make_panorama_camera(1024, 512)
FISHEYE = pycolmap.Camera(
    model="OPENCV_FISHEYE",
    width=640,
    height=600,
    params=[170, 170, 320, 300, -0.02, 0.003, 0, 0],
)
"""Fisheye camera with a horizontal field of view of about 210 degrees."""
POSES = [
    np.asarray(look_at([-1.2 + 0.35 * k, -0.5 + 0.2 * (k % 2), 1.4 + 0.1 * k], [2.0, 0.4 * k, 1.2]))
    for k in range(4)
]


def render(camera: pycolmap.Camera, pose: Float64) -> UInt8:
    """Render an image of a panorama or fisheye camera from a fine grid of directions."""
    size = 4096, 2048
    grid = make_panorama_camera(*size)
    xy = np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).reshape(-1, 2) + 0.5
    if camera.is_spherical():
        xy = xy[(xy < [camera.width, camera.height]).all(axis=1)]
        directions = camera.cam_ray_from_img(xy)
    else:
        directions = grid.cam_ray_from_img(xy)
        directions = directions[directions[:, 2] > np.cos(np.radians(115))]
        xy = project_wide(camera, directions)
        inside = (xy >= 0).all(axis=1) & (xy < [camera.width, camera.height]).all(axis=1)
        directions, xy = directions[inside], xy[inside]
    scene, eye = room_scene(), camera_center(pose[:, :3], pose[:, 3])
    rays = directions @ pose[:, :3]
    distance, _, surface = scene.first_hit(eye, rays)
    rgb = scene.texture.colors(eye + distance[:, None] * rays, surface, distance * 0.006)
    columns, rows = np.floor(xy).astype(int).T
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    image[rows, columns] = rgb
    return image


class TrueDepth:
    """Depth provider that renders the true depth of views of wide-angle images."""

    def __init__(self, camera: pycolmap.Camera, poses: Mapping[str, Float64]) -> None:
        self._rotations = ViewCutter(camera).rotations
        self._poses = poses

    def predict(self, view: View) -> DepthPrior:
        """Return the true depth of a view named ``camera<number>/<image>.jpg``."""
        folder, name = view.name.split("/", 1)
        pose = self._rotations[int(folder.removeprefix("camera"))] @ self._poses[name[:-4]]
        depth = room_scene().render(view.camera.resized(80, 80), pose).depth
        return DepthPrior.from_arrays(depth, (0.02 * depth) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("camera", [PANORAMA, FISHEYE], ids=["panorama", "fisheye"])
def test_wide_images_get_their_true_poses(tmp_path: Path, camera: pycolmap.Camera) -> None:
    names = [f"{number}" for number in range(len(POSES))]
    (tmp_path / "photos").mkdir()
    for name, pose in zip(names, POSES, strict=True):
        bgr = cv2.cvtColor(render(camera, pose), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(tmp_path / "photos" / f"{name}.png"), bgr)
    is_panorama = bool(camera.is_spherical())
    result = reconstruct(
        *(tmp_path / "photos", tmp_path / "out", "sift"),
        cameras=None if is_panorama else camera,
        depth=TrueDepth(camera, dict(zip(names, POSES, strict=True))),
        overrides=(
            "dense.enabled=false",
            f"inputs.projection={'equirectangular' if is_panorama else 'auto'}",
        ),
    )
    assert judge(result.summary).level == "good"
    (rig,) = result.model.rigs.values()
    assert rig.num_sensors() == (8 if is_panorama else 7)
    poses = {}
    for frame in result.model.frames.values():
        image = result.model.images[next(iter(frame.image_ids)).id]
        poses[Path(image.name).stem] = frame.rig_from_world.matrix()
    assert sorted(poses) == names
    ours = np.array([camera_center(poses[n][:, :3], poses[n][:, 3]) for n in names])
    truth = np.array([camera_center(pose[:, :3], pose[:, 3]) for pose in POSES])
    aligned = umeyama(ours, truth)
    assert np.linalg.norm(aligned.apply(ours) - truth, axis=1).max() < 0.01
    for name, pose in zip(names, POSES, strict=True):
        turned = poses[name][:, :3] @ aligned.rotation.T
        assert rotation_angle_deg(turned @ pose[:, :3].T) < 0.2
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    frames = json.loads(text)["frames"]
    assert [frame["name"] for frame in frames] == [f"{name}.jpg" for name in names]
    for frame, center in zip(frames, ours, strict=True):
        np.testing.assert_allclose(np.reshape(frame["pose"], (3, 4))[:, 3], center, atol=1e-3)


@pytest.mark.slow
def test_dual_fisheye_photos_become_frames_in_meters(tmp_path: Path) -> None:
    turn, shift = np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, -0.2])
    lenses = {"front": np.eye(4)[:3], "back": np.column_stack([turn, shift])}
    poses = {}
    for number, pose in enumerate(POSES[:3]):
        for lens, lens_from_rig in lenses.items():
            name = f"{lens}/{number}"
            poses[name] = lens_from_rig @ np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
            path = tmp_path / "photos" / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), cv2.cvtColor(render(FISHEYE, poses[name]), cv2.COLOR_RGB2BGR))
    names = tuple(tuple(f"{lens}/{k}.png" for lens in lenses) for k in range(3))
    rig = Rig(tuple((pose[:, :3], pose[:, 3]) for pose in lenses.values()), names)
    result = reconstruct(
        *(tmp_path / "photos", tmp_path / "out", "sift"),
        cameras=FISHEYE,
        rigs=[rig],
        depth=TrueDepth(FISHEYE, poses),
        overrides=("dense.enabled=false", "results.report=false"),
    )
    (colmap_rig,) = result.model.rigs.values()
    assert colmap_rig.num_sensors() == 14
    assert result.model.num_frames() == 3
    images = {image.name: image for image in result.model.images.values()}
    ours = np.array(
        [
            camera_center(matrix[:, :3], matrix[:, 3])
            for name in poses
            for matrix in [images[f"camera0/{name}.jpg"].cam_from_world().matrix()]
        ]
    )
    truth = np.array([camera_center(pose[:, :3], pose[:, 3]) for pose in poses.values()])
    aligned = umeyama(ours, truth)
    assert aligned.scale == pytest.approx(1.0, abs=0.02)
    assert np.linalg.norm(aligned.apply(ours) - truth, axis=1).max() < 0.02
