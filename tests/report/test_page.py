"""Tests of the content of the report, and of its source files."""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest

from mpsfm_core.data.errors import InputError
from mpsfm_core.data.result_layout import REPORT
from mpsfm_core.report.page import render, write_report
from mpsfm_core.report.result_folder import ResultFolder
from mpsfm_core.results.held_out import evaluate_held_out
from mpsfm_core.results.obj import read_obj


def data_of(page: str) -> dict[str, Any]:
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    return json.loads(text)


def test_run_writes_report_and_its_source_files(finished: Path) -> None:
    assert (finished / REPORT).is_file()
    assert (finished / "views" / "1.png.webp").is_file()
    with np.load(finished / "views" / "1.png.npz") as maps:
        assert maps["normals"].shape == (*maps["depth"].shape, 3)
        assert maps["camera"].tolist() == [320, 240, 280, 280, 160, 120]
    with np.load(finished / "views" / "matches.npz") as matches:
        assert matches["starts"][-1] == len(matches["points_a"]) == len(matches["points_b"]) > 0


def test_report_is_written_again_from_the_folder(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / finished.name)
    again = write_report(tmp_path / finished.name)
    assert again.read_text(encoding="utf-8") == (finished / REPORT).read_text(encoding="utf-8")


def test_report_loads_nothing_from_servers(finished: Path) -> None:
    page = (finished / REPORT).read_text(encoding="utf-8")
    assert "default-src 'none'" in page
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", page)
    assert "url(http" not in page


def test_report_of_many_images_loads_further_pictures_from_the_folder(finished: Path) -> None:
    result = ResultFolder.open(finished)
    photos = data_of(render(result, max_embedded=2))["photos"]
    sources = [photo["pictures"]["photo"]["src"] for photo in photos]
    embedded = [source.startswith("data:") for source in sources]
    assert len(photos) > 2 and sum(embedded) == 2 and embedded[0]
    for photo, source, is_embedded in zip(photos, sources, embedded, strict=True):
        assert is_embedded == ("prior" in photo["pictures"])
        assert is_embedded or (finished / unquote(source)).is_file()


def test_points_of_report_are_those_of_the_model(finished: Path) -> None:
    result = ResultFolder.open(finished)
    points = data_of(render(result))["points"]["sparse"]
    assert points["count"] == result.model.num_points3D()
    steps = np.frombuffer(base64.b64decode(points["xyz"]), "<u2").reshape(-1, 3)
    xyz = steps * np.array(points["step"]) + points["low"]
    truth = np.array([result.model.points3D[key].xyz for key in sorted(result.model.points3D)])
    assert np.abs(xyz - truth).max() < 1e-4 * np.ptp(truth)


def test_report_lists_unregistered_photos_and_remedies(finished: Path) -> None:
    data = data_of((finished / REPORT).read_text(encoding="utf-8"))
    assert data["verdict"]["level"] == "partial"
    (missing,) = [photo for photo in data["photos"] if photo["status"] == "missing"]
    assert missing["name"] == "noise.png"
    assert missing["remedy"]
    assert any("noise.png" in finding["images"] for finding in data["findings"])


def test_report_lists_refined_lens_parameters_of_a_photo(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    details = next(iter(summary["images"]["details"].values()))
    details |= {"camera_model": "OPENCV_FISHEYE", "principal_point_x": 331.5}
    details |= {"principal_point_x_std": 0.5, "principal_point_x_reason": {}}
    details |= {"distortion_3": 0.02, "distortion_3_std": 0.001}
    (tmp_path / "out" / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    data = data_of(write_report(tmp_path / "out").read_text(encoding="utf-8"))
    first, *others = data["photos"]
    assert first["lens"] == [["k3", 0.02, 0.001, 3]]
    assert all(photo["lens"] == [] for photo in others)


def test_report_states_how_well_held_out_photos_are_predicted(held_out: Path) -> None:
    photos = data_of((held_out / REPORT).read_text(encoding="utf-8"))["photos"]
    renderings = {photo["name"]: photo["rendering"] for photo in photos if photo["rendering"]}
    expected = evaluate_held_out(held_out)["geometries"]["dense.ply"]["per_image"]
    metrics = {name: expected["1.png"][name] for name in ("covered", "psnr", "ssim")}
    assert renderings == {"1.png": {"geometry": "dense.ply", **metrics}}
    assert metrics["covered"] > 0.5 and metrics["psnr"] > 10


def test_mesh_command_adds_the_textured_mesh_to_the_report(meshed: Path) -> None:
    encoded = data_of((meshed / REPORT).read_text(encoding="utf-8"))["mesh"]
    mesh = read_obj(meshed / "mesh.obj")
    arrays = {
        key: np.frombuffer(base64.b64decode(encoded[key]), dtype).reshape(len(rows), -1)
        for key, dtype, rows in (
            ("xyz", "<u2", mesh.vertices),
            ("uv", "<u2", mesh.uv),
            ("triangles", "<u4", mesh.triangles),
        )
    }
    xyz = np.array(encoded["low"]) + np.array(encoded["step"]) * arrays["xyz"]
    np.testing.assert_allclose(xyz, mesh.vertices, atol=max(encoded["step"]))
    np.testing.assert_allclose(arrays["uv"] / 0xFFFF, mesh.uv, atol=1e-4)
    np.testing.assert_array_equal(arrays["triangles"], mesh.triangles)
    assert encoded["texture"].startswith("data:image/")


def test_report_has_the_poses_of_the_frames_of_a_video(walked: Path) -> None:
    (trajectory,) = data_of(render(ResultFolder.open(walked)))["trajectories"]
    assert trajectory["name"] == "" and trajectory["times"] == [0.0, 0.5, 1.0]
    poses = np.array(trajectory["poses"]).reshape(-1, 3, 4)
    np.testing.assert_array_equal(poses[:, :, 3], [[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0]])
    np.testing.assert_allclose(poses[2, :, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)


def test_report_without_views_is_written(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "out")
    shutil.rmtree(tmp_path / "out" / "views")
    (tmp_path / "out" / "dense.ply").unlink()
    data = data_of(write_report(tmp_path / "out").read_text(encoding="utf-8"))
    assert data["points"]["dense"]["count"] == 0
    assert all("photo" not in photo["pictures"] for photo in data["photos"])


def test_report_of_failed_run_shows_no_earlier_results(
    finished: Path, failed: Path, tmp_path: Path
) -> None:
    shutil.copytree(finished, tmp_path / "out")
    shutil.copy(failed / "summary.json", tmp_path / "out")
    data = data_of(write_report(tmp_path / "out").read_text(encoding="utf-8"))
    assert data["verdict"]["level"] == "failed"
    assert data["points"]["sparse"]["count"] == 0


@pytest.mark.parametrize(
    "name", ["summary.json", "dense.ply", "depth/1.png.npz", "views/1.png.npz", "views/1.png.webp"]
)
def test_damaged_result_file_is_named(finished: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(finished, tmp_path / "out")
    file = tmp_path / "out" / name
    file.write_bytes(file.read_bytes()[:40])
    with pytest.raises(InputError, match=re.escape(name.rpartition("/")[2])):
        write_report(tmp_path / "out")
    assert (tmp_path / "out" / REPORT).read_bytes() == (finished / REPORT).read_bytes()


def test_folder_without_results_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"summary\.json"):
        write_report(tmp_path)
