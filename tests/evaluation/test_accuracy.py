"""Tests of the accuracy of depth maps and point clouds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.data.errors import InputError
from mpsfm_core.evaluation import read_poses
from mpsfm_core.evaluation.cloud_accuracy import cloud_accuracy
from mpsfm_core.evaluation.depth_accuracy import depth_accuracy, mean_accuracy
from mpsfm_core.evaluation.prior_quality import write_depth
from mpsfm_core.evaluation.result_folder import read_true_surface
from mpsfm_core.results.ply import read_ply, write_ply

TRUTH = np.array([[2, 2, 4, 0]], dtype=np.float32).repeat(3, axis=0)
VALID = np.ones(TRUTH.shape, dtype=np.bool_)


def test_depth_accuracy_matches_hand_computed_errors() -> None:
    depth = np.array([[1, 3, 4, 9]], dtype=np.float32).repeat(3, axis=0)
    found = depth_accuracy(depth, VALID, TRUTH, scale=1.0)
    assert found is not None
    assert found.abs_rel == pytest.approx((0.5 + 0.5 + 0) / 3)
    assert found.rmse_log == pytest.approx(np.sqrt((np.log(2) ** 2 + np.log(1.5) ** 2) / 3))
    # The depth ratios 2, 1.5 and 1 are compared with the thresholds 1.25, 1.5625 and 1.953125.
    assert (found.delta1, found.delta2, found.delta3) == pytest.approx((1 / 3, 2 / 3, 2 / 3))
    assert (found.pixels, found.coverage, found.scale) == (9, 1.0, 1.0)


def test_depth_accuracy_median_scaling_removes_scale() -> None:
    depth = np.where(TRUTH > 0, 0.25 * TRUTH, 1).astype(np.float32)
    raw = depth_accuracy(depth, VALID, TRUTH, scale=1.0)
    scaled = depth_accuracy(depth, VALID, TRUTH, scale=None)
    assert raw is not None and scaled is not None
    assert raw.abs_rel == pytest.approx(0.75) and raw.delta3 == 0
    assert scaled.scale == pytest.approx(4) and scaled.abs_rel == pytest.approx(0, abs=1e-6)
    both = mean_accuracy([raw, scaled])
    assert both["abs_rel"] == pytest.approx(0.375) and both["pixels"] == 18


def test_depth_accuracy_uses_common_pixels() -> None:
    valid = VALID.copy()
    valid[:, 0] = False
    found = depth_accuracy(TRUTH + np.float32(0), valid, TRUTH, scale=1.0)
    assert found is not None
    assert found.coverage == pytest.approx(2 / 3) and found.abs_rel == 0
    assert depth_accuracy(TRUTH, ~VALID, TRUTH, scale=None) is None


def test_depth_accuracy_interpolates_smaller_map() -> None:
    rows, columns = np.mgrid[0:40, 0:80] + 0.5
    truth = (2 + columns / 80 + rows / 40).astype(np.float32)
    small = truth.reshape(20, 2, 40, 2).mean(axis=(1, 3))
    found = depth_accuracy(small, np.ones(small.shape, np.bool_), truth, scale=1.0)
    assert found is not None and found.abs_rel < 1e-3


def test_cloud_accuracy_of_plane() -> None:
    x, y = np.meshgrid(np.arange(0, 1, 0.01), np.arange(0, 1, 0.01))
    scan = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    half = scan[scan[:, 0] < 0.5] + [0, 0, 0.03]
    wrong = np.array([[0.5, 0.5, 5.0], [0.5, 0.5, 6.0]])
    found = cloud_accuracy(np.concatenate([half, wrong]), scan, (0.02, 0.05))
    assert found["accuracy"]["0.02"] == 0
    assert found["accuracy"]["0.05"] == pytest.approx(5000 / 5002, abs=1e-4)
    assert found["completeness"]["0.02"] == 0
    # Scan points are complete within sqrt(0.05^2 - 0.03^2) = 0.04 of the half that the cloud
    # contains.
    assert found["completeness"]["0.05"] == pytest.approx(0.53, abs=0.011)
    assert found["f1"]["0.05"] == pytest.approx(2 * 0.53 / 1.53, abs=0.01)
    assert found["median_distance_to_scan"] == pytest.approx(0.03)
    with pytest.raises(InputError, match="empty"):
        cloud_accuracy(scan[:0], scan)


def test_cloud_accuracy_distant_cloud_has_finite_median() -> None:
    rng = np.random.default_rng(0)
    scan = rng.random((5000, 3)) * [1, 1, 0]
    found = cloud_accuracy(scan + np.array([0, 0, 3]), scan, (0.01, 0.02))
    assert found["median_distance_to_scan"] == pytest.approx(3, abs=0.01)
    assert found["median_distance_to_points"] == pytest.approx(3, abs=0.01)
    assert found["f1"] == {"0.01": 0, "0.02": 0}


def test_cloud_accuracy_counts_dense_regions_once() -> None:
    scan = np.array([[0.0, 0, 0], [1, 0, 0]])
    crowded = np.concatenate([np.full((1000, 3), 0.001), [[1.0, 0, 3]]])
    assert cloud_accuracy(crowded, scan, (0.1,))["accuracy"]["0.1"] == 0.5


@pytest.mark.parametrize("kind", ["ours", "ascii", "big"])
def test_read_ply_supports_all_formats(kind: str, tmp_path: Path) -> None:
    points = np.array([[1.5, -2, 3], [0.25, 5, -6]])
    path = tmp_path / "cloud.ply"
    if kind == "ours":
        write_ply(path, points, np.zeros((2, 3), dtype=np.uint8))
    elif kind == "ascii":
        body = "\n".join(f"7 {x} {y} {z}" for x, y, z in points)
        names = "property int label\n" + "".join(f"property double {a}\n" for a in "xyz")
        faces = "element face 1\nproperty list uchar int vertex_indices\n"
        path.write_text(
            f"ply\nformat ascii 1.0\ncomment x\nelement vertex 2\n{names}{faces}end_header\n"
            f"{body}\n3 0 1 0\n"
        )
    else:
        header = "ply\nformat binary_big_endian 1.0\nelement vertex 2\n"
        header += "".join(f"property float64 {a}\n" for a in "xyz") + "end_header\n"
        path.write_bytes(header.encode() + points.astype(">f8").tobytes())
    np.testing.assert_array_equal(read_ply(path)[0], points)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat\nend_header\n",
        b"ply\nformat ascii 1.0\nelement face 1\nend_header\n",
    ],
)
def test_read_ply_invalid_file_raises(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.ply").write_bytes(content)
    with pytest.raises(
        InputError, match=r"x\.ply( is not a PLY file|: the vertices need x, y and z)"
    ):
        read_ply(tmp_path / "x.ply")


def test_evaluate_command_reports_depth_and_cloud(scene_folder: Path, tmp_path: Path) -> None:
    gt, depth = scene_folder / "gt", scene_folder / "gt_depth"
    (tmp_path / "depth").mkdir()
    (tmp_path / "sparse").symlink_to(gt)
    flat = np.full((24, 32), 2.0, dtype=np.float32)
    np.savez(tmp_path / "depth" / "0001.png.npz", depth=flat, valid=flat > 0)
    cloud = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    write_ply(tmp_path / "dense.ply", cloud, np.zeros((500, 3), dtype=np.uint8))
    arguments = ["evaluate", str(tmp_path), str(gt), "--gt-depth", str(depth)]
    arguments += ["--scan", str(tmp_path / "dense.ply")]
    result = CliRunner().invoke(build_app(), arguments)
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["depth"]["raw"]["scale"] == 1 and report["depth"]["raw"]["images"] == 1
    scaled = report["depth"]["median_scaled"]
    assert 0 < scaled["rmse_log"] < report["depth"]["raw"]["rmse_log"]
    assert report["cloud"]["f1"]["0.01"] == 1.0
    assert report["trajectory"]["rpe_rmse"] == pytest.approx(0, abs=1e-9)
    write_ply(tmp_path / "dense.ply", cloud[:0], np.zeros((0, 3), dtype=np.uint8))
    result = CliRunner().invoke(build_app(), arguments)
    assert result.exit_code == 2 and "dense.ply: the file has no points" in result.stderr
    write_depth(tmp_path / "other" / "x.png", flat)
    arguments[4] = str(tmp_path / "other")
    result = CliRunner().invoke(build_app(), arguments)
    assert (
        result.exit_code == 2
        and "no depth map of the results has a true depth map" in result.stderr
    )


def test_evaluate_command_without_scan_uses_true_depth(scene_folder: Path, tmp_path: Path) -> None:
    gt, depth = scene_folder / "gt", scene_folder / "gt_depth"
    (tmp_path / "depth").mkdir()
    (tmp_path / "sparse").symlink_to(gt)
    flat = np.full((24, 32), 2.0, dtype=np.float32)
    np.savez(tmp_path / "depth" / "0001.png.npz", depth=flat, valid=flat > 0)
    surface = read_true_surface(gt, depth, sorted(read_poses(gt)), [0.05])
    far = surface + np.array([0, 0, 50])
    cloud = np.concatenate([surface, far])
    write_ply(tmp_path / "dense.ply", cloud, np.zeros((len(cloud), 3), dtype=np.uint8))
    arguments = ["evaluate", str(tmp_path), str(gt), "--gt-depth", str(depth)]
    result = CliRunner().invoke(build_app(), [*arguments, "--distance", "0.05", "--distance", "1"])
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)["cloud"]
    assert found["completeness"] == {"0.05": 1.0, "1.0": 1.0}
    assert found["accuracy"]["0.05"] == pytest.approx(0.5, abs=0.02)
