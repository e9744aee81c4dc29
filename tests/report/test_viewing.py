"""Tests of the scenes that viewers get: of a run, of a result, of any COLMAP model."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.cli.view import open_viewer
from mpsfm_core.data import DepthPrior, PinholeCamera, PosedImage, SceneState
from mpsfm_core.data.errors import InputError
from mpsfm_core.mapping import mapper
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers import hookimpl
from mpsfm_core.providers.registry import Registry
from mpsfm_core.report.viewing import pictures_from_photos, read_scene, unproject_depth_map
from mpsfm_core.testing.synthetic.problems import make_mapping_problem
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene


def test_viewer_of_a_run_gets_growing_scenes() -> None:
    seen: list[SceneState] = []

    class Watcher:
        @hookimpl
        def mpsfm_scene_changed(self, scene) -> None:
            seen.append(scene())

    registry = Registry()
    registry.register(Watcher())
    camera = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
    problem = make_mapping_problem(room_scene(), camera, arc_poses(4, 12.0), map_width=80)
    one_by_one = MapperOptions(global_initialization=False)
    result = mapper.reconstruct(problem, one_by_one, Stages(registry))
    sizes = [len(scene.images) for scene in seen]
    assert sizes[0] < sizes[-1] == len(result.reconstructions[0].images)
    last = seen[-1]
    assert np.isfinite(last.points).all()
    assert len(last.points) > 0
    assert last.images[0].depth is not None


def test_depth_map_is_unprojected_to_world_points() -> None:
    camera = PinholeCamera(40, 30, 35.0, 35.0, 20.0, 15.0)
    depth = np.full((30, 40), 3.0)
    depth[:, :20] = np.nan
    prior = DepthPrior.from_arrays(depth, np.full(depth.shape, 1e-4))
    image = PosedImage("a", camera, np.eye(3), np.array([0.0, 0, 1]), prior)
    red = np.full((30, 40, 3), (255, 0, 0), np.uint8)
    cloud = unproject_depth_map(image, red)
    assert len(cloud.xyz) == 600
    np.testing.assert_allclose(cloud.xyz[:, 2], 2)
    assert (cloud.xyz[:, 0] > 0).all()
    assert (cloud.rgb == (255, 0, 0)).all()
    assert len(unproject_depth_map(PosedImage("b", camera, np.eye(3), np.zeros(3)), red).xyz) == 0


def test_colmap_model_of_other_program_is_viewed(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write_text(str(tmp_path / "sparse" / "0"))
    scene, cloud, _ = read_scene(tmp_path)
    assert len(scene.images) == 5
    assert len(scene.points) == len(cloud.xyz) == 20
    image = model.images[1]
    (own,) = [shown for shown in scene.images if shown.name == image.name]
    np.testing.assert_allclose(own.translation, image.cam_from_world().translation)


def test_folder_without_model_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no COLMAP model"):
        read_scene(tmp_path)
    (tmp_path / "images.bin").write_bytes(b"\0\1")
    with pytest.raises(InputError, match="the COLMAP model cannot be read"):
        read_scene(tmp_path)


def test_photos_are_reduced_and_may_be_damaged(tmp_path: Path) -> None:
    picture = np.zeros((600, 800, 3), np.uint8)
    picture[..., 2] = 200  # red in OpenCV's BGR order
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    (tmp_path / "b.png").write_bytes(b"nothing")
    small = pictures_from_photos(tmp_path)("a.png")
    assert small is not None
    assert small.shape == (240, 320, 3)
    assert small[0, 0].tolist() == [200, 0, 0]
    assert pictures_from_photos(tmp_path)("b.png") is None
    assert pictures_from_photos(tmp_path)("c.png") is None


def test_viewers_come_from_plugins(tmp_path: Path, install_plugin) -> None:
    module = install_plugin(
        "mpsfm-watch",
        """
        from mpsfm_core import hookimpl

        @hookimpl
        def mpsfm_viewers():
            return {"watch": f"{__name__}:Watch", "broken": f"{__name__}:Nothing"}

        class Watch:
            def __init__(self, output, pictures):
                self.output = output
        """,
    )
    registry = Registry.discover()
    watch = open_viewer(registry, "watch", tmp_path, pictures_from_photos(tmp_path))
    assert watch.output == tmp_path
    with pytest.raises(InputError, match="did you mean 'watch'"):
        open_viewer(registry, "wach", tmp_path, pictures_from_photos(tmp_path))
    with pytest.raises(InputError, match=f"'broken' cannot be opened.*{module}"):
        open_viewer(registry, "broken", tmp_path, pictures_from_photos(tmp_path))


def test_view_command_shows_a_model(
    model: pycolmap.Reconstruction, tmp_path: Path, install_plugin
) -> None:
    install_plugin(
        "mpsfm-write",
        """
        from mpsfm_core import hookimpl

        @hookimpl
        def mpsfm_viewers():
            return {"write": f"{__name__}:Write"}

        class Write:
            def __init__(self, output, pictures):
                self.file = output / "seen.txt"

            def show(self, scene, cloud=None):
                self.file.write_text(f"{len(scene.images)} {len(cloud.xyz)}")

            def finish(self):
                return f"in {self.file}"

            def wait(self):
                pass
        """,
    )
    model.write_text(str(tmp_path))
    ended = CliRunner().invoke(build_app(), ["view", str(tmp_path), "--viewer", "write"])
    assert ended.exit_code == 0, ended.output
    assert "seen.txt" in ended.output
    assert (tmp_path / "seen.txt").read_text() == "5 20"


def test_viewer_opens_before_the_run_starts(tmp_path: Path) -> None:
    arguments = ["reconstruct", str(tmp_path), "-o", str(tmp_path / "out"), "--viewer", "nothing"]
    ended = CliRunner().invoke(build_app(), arguments)
    assert ended.exit_code == 2
    assert "no viewer 'nothing'" in ended.stderr
