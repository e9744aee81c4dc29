"""Tests of each importer on a miniature folder in the layout of its dataset.

Two or three cameras view a plane at a distance of 2 m, so that the depth of every pixel is known.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation.importers import import_scene
from mpsfm_core.evaluation.prior_quality import read_depth
from mpsfm_core.evaluation.scene_folder import SceneFolder
from mpsfm_core.inputs.images import load_images

TURNS = Rotation.from_euler("y", [[0], [10], [-20]], degrees=True).as_matrix()
SHIFTS = np.array([[0.0, 0, 0], [0.3, -0.1, 0.2], [-0.5, 0.1, 0.1]])
CAM_FROM_WORLD = [np.column_stack(pose) for pose in zip(TURNS, SHIFTS, strict=True)]
WORLD_FROM_CAM = [
    np.block([[r.T, (-r.T @ t)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    for r, t in zip(TURNS, SHIFTS, strict=True)
]
DEPTH_MM = np.full((48, 64), 2000, dtype=np.uint16)
DEPTH_MM[:, :8] = 0


def photo(path: Path, size: tuple[int, int] = (64, 48)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((size[1], size[0], 3), 100, dtype=np.uint8))


def check_poses(scene: SceneFolder, names: list[str]) -> None:
    assert list(scene.truth) == names
    for name, expected in zip(names, CAM_FROM_WORLD, strict=False):
        np.testing.assert_allclose(np.column_stack(scene.truth[name]), expected, atol=1e-6)


def cameras(scene: SceneFolder) -> list[list[float]]:
    """Return the undistorted camera parameters that the pipeline reads from a scene folder."""
    return [i.pinhole.params.tolist() for i in load_images(scene.images, scene.intrinsics)]


def model(
    folder: Path, names: list[str], camera: pycolmap.Camera, *, points: bool = True
) -> pycolmap.Reconstruction:
    """Write a COLMAP model whose images observe four points of the plane z = 2."""
    result = pycolmap.Reconstruction()
    result.add_camera_with_trivial_rig(camera)
    world = np.array([[0.1, 0.1, 2.0], [-0.2, 0.1, 2.0], [0.2, -0.1, 2.0], [0, 0, 2.2]])
    for number, (name, pose) in enumerate(zip(names, CAM_FROM_WORLD, strict=True), start=1):
        xy = camera.img_from_cam(world @ pose[:, :3].T + pose[:, 3])
        image = pycolmap.Image(name=name, keypoints=xy, camera_id=1, image_id=number)
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for row, point in enumerate(world if points else []):
        elements = [pycolmap.TrackElement(i + 1, row) for i in range(len(names))]
        result.add_point3D(point, pycolmap.Track(elements))
    folder.mkdir(parents=True, exist_ok=True)
    result.write_text(str(folder))
    return result


def eth3d(source: Path) -> None:
    names = [f"dslr_images_undistorted/DSC_{n:04d}.JPG" for n in (286, 287, 288)]
    for name in names:
        photo(source / "images" / name)
    undistorted = pycolmap.Camera(
        model="PINHOLE", width=64, height=48, params=[60, 61, 31, 25], camera_id=1
    )
    model(source / "dslr_calibration_undistorted", names, undistorted)
    # The original images are larger and distorted. Their depth is 2 m, unknown in the left fifth,
    # which the scanner does not see.
    original = pycolmap.Camera(
        model="THIN_PRISM_FISHEYE",
        width=80,
        height=60,
        params=[60, 61, 39, 31, 0.1, 0, 0, 0, 0, 0, 0, 0],
        camera_id=1,
    )
    originals = [name.replace("_undistorted", "") for name in names]
    model(source / "dslr_calibration_jpg", originals, original, points=False)
    depth = np.full((60, 80), 2.0, dtype="<f4")
    depth[:, :16] = np.inf
    folder = source / "ground_truth_depth" / "dslr_images"
    folder.mkdir(parents=True)
    for name in originals:
        depth.tofile(folder / Path(name).name)


def test_eth3d_import_has_true_cameras_poses_and_depth(tmp_path: Path) -> None:
    eth3d(tmp_path / "courtyard")
    scene = import_scene("eth3d", tmp_path / "courtyard", tmp_path / "out")
    check_poses(scene, ["DSC_0286.JPG", "DSC_0287.JPG", "DSC_0288.JPG"])
    assert cameras(scene)[0] == [60, 61, 31, 25]
    truth = pycolmap.Reconstruction(str(scene.path / "gt"))
    assert truth.num_points3D() == 4 and truth.compute_num_observations() == 12
    depth = read_depth(scene.path / "gt_depth" / "DSC_0287.png")
    assert depth.shape == (48, 64)
    assert set(np.unique(depth)) == {0.0, 2.0}
    # Column 16 of the original image is the first column with depth.
    original = pycolmap.Camera(
        model="THIN_PRISM_FISHEYE",
        width=80,
        height=60,
        params=[60, 61, 39, 31, 0.1] + 7 * [0],
    )
    row, columns = 24, np.arange(64)
    rays = np.column_stack([(columns + 0.5 - 31) / 60, np.full(64, (row + 0.5 - 25) / 61)])
    there = original.img_from_cam(np.column_stack([rays, np.ones(64)]))
    np.testing.assert_array_equal(depth[row] > 0, (there[:, 0] >= 16) & (there[:, 0] <= 80))


def test_eth3d_without_depth(tmp_path: Path) -> None:
    eth3d(tmp_path / "courtyard")
    (tmp_path / "courtyard" / "ground_truth_depth").rename(tmp_path / "elsewhere")
    assert import_scene("eth3d", tmp_path / "courtyard", tmp_path / "out").depth is None


def test_eth3d_depth_of_the_wrong_size(tmp_path: Path) -> None:
    eth3d(tmp_path / "courtyard")
    folder = tmp_path / "courtyard" / "ground_truth_depth" / "dslr_images"
    np.zeros(17, dtype="<f4").tofile(folder / "DSC_0286.JPG")
    with pytest.raises(InputError, match="17 values, not those of 80 x 60 pixels"):
        import_scene("eth3d", tmp_path / "courtyard", tmp_path / "out")


@pytest.mark.parametrize("folder", ["images", "images_2"])
def test_smerf_import_has_true_cameras_and_poses(tmp_path: Path, folder: str) -> None:
    source = tmp_path / "berlin"
    names = ["DSC00010.JPG", "DSC00011.JPG", "DSC00012.JPG"]
    fisheye = pycolmap.Camera(
        model="OPENCV_FISHEYE",
        width=64,
        height=48,
        params=[30, 30, 32, 24, 0.01, 0, 0, 0],
        camera_id=1,
    )
    model(source / "sparse" / "0", names, fisheye)
    for name in names:
        photo(source / folder / name, (64, 48) if folder == "images" else (32, 24))
    scene = import_scene("smerf", source, tmp_path / "out")
    check_poses(scene, names)
    assert scene.depth is None
    found = next(iter(pycolmap.Reconstruction(str(scene.path / "gt")).cameras.values()))
    scale = 1 if folder == "images" else 0.5
    assert found.model_name == "OPENCV_FISHEYE" and found.width == 64 * scale
    np.testing.assert_allclose(found.params[:4], np.array([30, 30, 32, 24]) * scale)


def test_tanks_and_temples_with_the_log(tmp_path: Path) -> None:
    source = tmp_path / "Ignatius"
    for number in (1, 2, 3):
        photo(source / f"{number:06d}.jpg", (96, 54))
    lines = []
    for number, pose in enumerate(WORLD_FROM_CAM):
        lines.append(f"{number} {number} 0")
        lines += [" ".join(f"{value:.10f}" for value in row) for row in pose]
    log = source / "Ignatius_COLMAP_SfM.log"
    log.write_text("\n".join(lines) + "\n")
    scene = import_scene("tanks-and-temples", source, tmp_path / "out")
    check_poses(scene, ["000001.jpg", "000002.jpg", "000003.jpg"])
    np.testing.assert_allclose(cameras(scene)[0], [58.286, 58.286, 48, 27], atol=1e-3)
    log.write_text("\n".join(lines[:10]) + "\n")
    with pytest.raises(InputError, match=r"has 2 poses, .* has 3 photos"):
        import_scene("tanks-and-temples", source, tmp_path / "other")
    log.write_text("\n".join(lines[:8]) + "\n")
    with pytest.raises(InputError, match="no 4 x 4 matrix"):
        import_scene("tanks-and-temples", source, tmp_path / "other")


def test_tanks_and_temples_with_a_model(tmp_path: Path) -> None:
    source = tmp_path / "Ignatius"
    names = ["000001.jpg", "000002.jpg", "000003.jpg"]
    for name in names:
        photo(source / "images" / name)
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=64, height=48, params=[50, 32, 24], camera_id=1
    )
    model(source / "sparse" / "0", names, camera)
    scene = import_scene("tanks-and-temples", source, tmp_path / "out")
    check_poses(scene, names)
    assert cameras(scene)[0] == [50, 50, 32, 24]


def realestate_lines() -> list[str]:
    lines = ["https://example.org/video"]
    for stamp, pose in zip((50050000, 50083000, 50116000), CAM_FROM_WORLD, strict=True):
        values = " ".join(f"{value:.9f}" for value in pose.ravel())
        lines.append(f"{stamp} 0.5 0.9 0.5 0.5 0.0 0.0 {values}")
    return lines


@pytest.mark.parametrize("inside", [True, False])
def test_realestate10k_import_has_true_cameras_and_poses(tmp_path: Path, inside: bool) -> None:
    source = tmp_path / "0a3b5fb184936a83"
    for stamp in (50050000, 50083000):  # The third frame has no image file.
        photo(source / f"{stamp}.png", (64, 36))
    file = (source if inside else tmp_path) / f"{source.name}.txt"
    file.write_text("\n".join(realestate_lines()) + "\n")
    scene = import_scene("realestate10k", source, tmp_path / "out")
    check_poses(scene, ["50050000.png", "50083000.png"])
    np.testing.assert_allclose(cameras(scene)[0], [32, 32.4, 32, 18])
    file.write_text("\n".join(realestate_lines())[:-30])
    with pytest.raises(InputError, match="values, not 19"):
        import_scene("realestate10k", source, tmp_path / "other")


def seven_scenes(source: Path) -> None:
    for sequence, number in (("seq-01", 0), ("seq-01", 1), ("seq-02", 0)):
        base = source / sequence / f"frame-{number:06d}"
        photo(Path(f"{base}.color.png"))
        depth = DEPTH_MM.copy()
        depth[:, -8:] = 65535
        cv2.imwrite(f"{base}.depth.png", depth)
        pose = WORLD_FROM_CAM[2 if sequence == "seq-02" else number]
        np.savetxt(f"{base}.pose.txt", pose)


def test_seven_scenes_import_has_true_poses_and_depth(tmp_path: Path) -> None:
    seven_scenes(tmp_path / "chess")
    scene = import_scene("7-scenes", tmp_path / "chess", tmp_path / "out")
    names = ["seq-01/frame-000000.png", "seq-01/frame-000001.png", "seq-02/frame-000000.png"]
    check_poses(scene, names)
    assert cameras(scene)[0] == [58.5, 58.5, 32, 24]
    depth = read_depth(scene.path / "gt_depth" / "seq-02" / "frame-000000.png")
    assert (depth[:, 8:-8] == 2).all() and not depth[:, :8].any() and not depth[:, -8:].any()


def scannet(source: Path) -> None:
    for number in (0, 1, 10):
        photo(source / "color" / f"{number}.jpg", (130, 97))
        (source / "depth").mkdir(exist_ok=True)
        cv2.imwrite(str(source / "depth" / f"{number}.png"), DEPTH_MM)
        (source / "pose").mkdir(exist_ok=True)
        np.savetxt(source / "pose" / f"{number}.txt", WORLD_FROM_CAM[min(number, 2)])
    (source / "intrinsic").mkdir()
    np.savetxt(source / "intrinsic" / "intrinsic_color.txt", matrix(110, 110, 64.5, 48))
    np.savetxt(source / "intrinsic" / "intrinsic_depth.txt", matrix(55, 55, 31.5, 23.5))


def matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def test_scannet_import_has_true_cameras_poses_and_depth(tmp_path: Path) -> None:
    source = tmp_path / "scene0000_00"
    scannet(source)
    np.savetxt(source / "pose" / "11.txt", np.full((4, 4), -np.inf))
    photo(source / "color" / "11.jpg", (130, 97))  # tracking was lost
    scene = import_scene("scannet", source, tmp_path / "out")
    check_poses(scene, ["000000.jpg", "000001.jpg", "000010.jpg"])
    assert cameras(scene)[0] == [110, 110, 65, 48.5]
    depth = read_depth(scene.path / "gt_depth" / "000001.png")
    assert depth.shape == (97, 130)
    # The image has twice the focal length, so column 8 of the depth camera is column 65 + 2 * (8 -
    # 32) of the image.
    known = np.flatnonzero(depth[48] > 0)
    assert known.min() in (16, 17, 18) and (depth[48, known] == 2).all()


def quaternions(order: str) -> list[list[float]]:
    """Return the unit quaternions of ``world_from_cam``, scalar last (xyzw) or first (wxyz)."""
    xyzw = Rotation.from_matrix([pose[:3, :3] for pose in WORLD_FROM_CAM]).as_quat()
    return (xyzw if order == "xyzw" else xyzw[:, [3, 0, 1, 2]]).tolist()


def tum_rgbd(source: Path, size: tuple[int, int] = (640, 480)) -> None:
    """Write images between true poses, so that a pose has to be interpolated."""
    lines = []
    for number, (pose, quaternion) in enumerate(
        zip(WORLD_FROM_CAM, quaternions("xyzw"), strict=True)
    ):
        # The true pose is constant around the time of each image.
        for time in (10 * number + 0.98, 10 * number + 1.03):
            lines.append(" ".join(map(str, [time, *pose[:3, 3], *quaternion])))
        photo(source / "rgb" / f"{10 * number + 1}.png", size)
        (source / "depth").mkdir(exist_ok=True)
        stored = DEPTH_MM.astype(np.uint32) * 5  # 5000 units per meter
        cv2.imwrite(str(source / "depth" / f"{number}.png"), stored.astype(np.uint16))
    photo(source / "rgb" / "15.png", size)  # no true pose within 0.1 s
    (source / "rgb.txt").write_text(
        "# color images\n15 rgb/15.png\n1 rgb/1.png\n11 rgb/11.png\n21 rgb/21.png\n"
    )
    (source / "depth.txt").write_text("1.01 depth/0.png\n11.5 depth/1.png\n20.99 depth/2.png\n")
    (source / "groundtruth.txt").write_text("\n".join(lines) + "\n")


def test_tum_rgbd_import_interpolates_poses_and_reads_depth(tmp_path: Path) -> None:
    source = tmp_path / "rgbd_dataset_freiburg3_desk"
    tum_rgbd(source)
    scene = import_scene("tum-rgbd", source, tmp_path / "out")
    check_poses(scene, ["rgb/1.png", "rgb/11.png", "rgb/21.png"])
    assert cameras(scene)[0] == [535.4, 539.2, 320.6, 248.1]
    depth = read_depth(scene.path / "gt_depth" / "rgb" / "21.png")
    assert (depth[:, 8:] == 2).all() and not depth[:, :8].any()
    # The depth image nearest in time to the second image is half a second late.
    assert not (scene.path / "gt_depth" / "rgb" / "11.png").exists()


def test_tum_rgbd_cameras_have_distortion(tmp_path: Path) -> None:
    source = tmp_path / "rgbd_dataset_freiburg1_desk"
    tum_rgbd(source)
    scene = import_scene("tum-rgbd", source, tmp_path / "out")
    camera = next(iter(pycolmap.Reconstruction(str(scene.path / "gt")).cameras.values()))
    matrix = np.array([[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1]])
    points = np.array([[0.2, -0.1, 1.0], [-0.3, 0.2, 1.0]])
    distortion = np.array([0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    # OpenCV's center of the first pixel is (0, 0), COLMAP's (0.5, 0.5).
    np.testing.assert_allclose(camera.img_from_cam(points), expected[:, 0] + 0.5, atol=1e-6)


def test_eth3d_slam_import_reads_the_calibration(tmp_path: Path) -> None:
    source = tmp_path / "plant_1"
    tum_rgbd(source, (64, 48))
    with pytest.raises(InputError, match=r"write fx fy cx cy to calibration\.txt"):
        import_scene("eth3d-slam", source, tmp_path / "other")
    (source / "calibration.txt").write_text("60 61 31.5 23.5\n")
    scene = import_scene("eth3d-slam", source, tmp_path / "out")
    check_poses(scene, ["rgb/1.png", "rgb/11.png", "rgb/21.png"])
    assert cameras(scene)[0] == [60, 61, 32, 24]


BODY_FROM_CAM = np.block(
    [
        [Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.array([[0.1], [0.2], [0.3]])],
        [np.zeros((1, 3)), np.ones((1, 1))],
    ]
)


@pytest.mark.parametrize("truth", ["state_groundtruth_estimate0", "mocap0"])
def test_euroc_import_converts_poses_of_the_body(tmp_path: Path, truth: str) -> None:
    root = tmp_path / "MH_01_easy" / "mav0"
    lines, images = ["#timestamp [ns],..."], ["#timestamp [ns],filename"]
    for number, pose in enumerate(WORLD_FROM_CAM):
        body = pose @ np.linalg.inv(BODY_FROM_CAM)
        x, y, z, w = Rotation.from_matrix(body[:3, :3]).as_quat()
        time = 1403636579763555584 + number * 10**9
        for shift in (-20_000_000, 20_000_000):
            values = [*body[:3, 3], w, x, y, z, 0, 0, 0]
            lines.append(",".join(map(str, [time + shift, *values])))
        images.append(f"{time},{time}.png")
        photo(root / "cam0" / "data" / f"{time}.png")
    (root / "cam0" / "data.csv").write_text("\n".join(images) + "\n")
    (root / truth).mkdir()
    (root / truth / "data.csv").write_text("\n".join(lines) + "\n")
    model = "radial-tangential" if truth.startswith("state") else "equidistant"
    (root / "cam0" / "sensor.yaml").write_text(
        "sensor_type: camera\n"
        "T_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: {BODY_FROM_CAM.ravel().tolist()}\n"
        "resolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [60, 61, 31.5, 23.5]\n"
        f"distortion_model: {model}\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    )
    scene = import_scene("euroc", root.parent, tmp_path / "out")
    check_poses(scene, [name.partition(",")[2] for name in images[1:]])
    camera = next(iter(pycolmap.Reconstruction(str(scene.path / "gt")).cameras.values()))
    assert camera.model_name == ("OPENCV" if model == "radial-tangential" else "OPENCV_FISHEYE")
    np.testing.assert_allclose(camera.params, [60, 61, 32, 24, -0.28, 0.07, 0.0002, 1.8e-05])
    (root / "cam0" / "sensor.yaml").write_text("T_BS: 1\n")
    with pytest.raises(InputError, match="calibration cannot be read"):
        import_scene("euroc", root.parent, tmp_path / "other")


def test_lamar_import_has_poses_of_devices_and_of_rigs(tmp_path: Path) -> None:
    source = tmp_path / "hl_2022-01-01"
    rig_from_cam = BODY_FROM_CAM
    rig_pose = WORLD_FROM_CAM[1] @ np.linalg.inv(rig_from_cam)

    def line(*values: object) -> str:
        return ", ".join(map(str, values))

    def pose_line(first: object, second: object, pose: np.ndarray) -> str:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return line(first, second, w, x, y, z, *pose[:3, 3])

    for time in (1, 2, 3, 4):
        photo(source / "raw_data" / "images" / f"{time}.jpg")
    (source / "raw_data" / "depths").mkdir()
    cv2.imwrite(str(source / "raw_data" / "depths" / "1.png"), DEPTH_MM)
    covariance = ["0.1"] * 36
    files = {
        "sensors.txt": [
            "# sensor_id, name, sensor_type, [sensor_params]+",
            line("a", "first", "camera", "PINHOLE", 64, 48, 60, 61, 32, 24),
            line("b", "second", "camera", "SIMPLE_PINHOLE", 64, 48, 55, 32, 24),
            line("w", "", "wifi"),
        ],
        "images.txt": [
            "# timestamp, sensor_id, image_path",
            *(line(time, sensor, f"images/{time}.jpg") for time, sensor in
              ((1, "a"), (2, "b"), (3, "a"), (4, "a"))),
        ],
        "depths.txt": [line(1, "a", "depths/1.png")],
        "rigs.txt": [pose_line("rig", "b", rig_from_cam)],
        "trajectories.txt": [
            line(pose_line(1, "a", WORLD_FROM_CAM[0]), *covariance),
            pose_line(2, "rig", rig_pose),
            pose_line(3, "a", WORLD_FROM_CAM[2]),
        ],
    }  # fmt: skip
    for name, lines in files.items():
        (source / name).write_text("\n".join(lines) + "\n")
    scene = import_scene("lamar", source, tmp_path / "out")
    # The image without a pose, 4.jpg, is left out.
    check_poses(scene, ["images/1.jpg", "images/2.jpg", "images/3.jpg"])
    truth = pycolmap.Reconstruction(str(scene.path / "gt"))
    focals = {image.name: image.camera.params[0] for image in truth.images.values()}
    assert focals["images/1.jpg"] == 60 and focals["images/2.jpg"] == 55
    depth = read_depth(scene.path / "gt_depth" / "images" / "1.png")
    assert (depth[:, 8:] == 2).all()
    # Poses relative to the scan take precedence.
    (source / "proc").mkdir()
    shifted = [WORLD_FROM_CAM[n] + [[0, 0, 0, 5], [0] * 4, [0] * 4, [0] * 4] for n in (0, 2)]
    (source / "proc" / "alignment_trajectories.txt").write_text(
        "\n".join([pose_line(1, "a", shifted[0]), pose_line(3, "a", shifted[1])]) + "\n"
    )
    aligned = import_scene("lamar", source, tmp_path / "aligned")
    rotation, translation = aligned.truth["images/1.jpg"]
    np.testing.assert_allclose(-rotation.T @ translation, shifted[0][:3, 3], atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("eth3d", "calibration is missing"),
        ("smerf", "COLMAP model and images/"),
        ("tanks-and-temples", "COLMAP_SfM.log"),
        ("realestate10k", "no text file"),
        ("7-scenes", "0 usable images"),
        ("scannet", "folder of photos is missing"),
        ("tum-rgbd", "list of color images is missing"),
        ("euroc", "folder of the first camera is missing"),
        ("lamar", "list of sensors is missing"),
        ("colmap", "no dataset 'colmap'"),
    ],
)
def test_import_scene_wrong_layout_raises(tmp_path: Path, kind: str, message: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=message):
        import_scene(kind, tmp_path / "empty", tmp_path / "out")


def test_import_command_takes_every_nth_image(tmp_path: Path) -> None:
    seven_scenes(tmp_path / "chess")
    target = tmp_path / "out"
    arguments = ["testsets", "import", "7-scenes", str(tmp_path / "chess"), str(target)]
    result = CliRunner().invoke(build_app(), [*arguments, "--every", "2"])
    assert result.exit_code == 0
    assert "2 images with true poses, with depth" in result.stdout
    again = CliRunner().invoke(build_app(), arguments)
    assert again.exit_code == 2 and "not empty" in again.stderr
