"""Tests that errors print one message, set the exit code and keep earlier results."""

from __future__ import annotations

import resource
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.support.files import lock_output_folder


@pytest.fixture
def output(tmp_path: Path) -> Path:
    """Output folder with earlier results."""
    folder = tmp_path / "out"
    (folder / "sparse").mkdir(parents=True)
    (folder / "sparse" / "images.bin").write_text("an earlier model")
    (folder / "summary.json").write_text("an earlier summary")
    return folder


@pytest.fixture(autouse=True)
def earlier_results_stay(output: Path):
    before = content(output)
    yield
    assert content(output) == before


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }


def check(ended, code: int, *texts: str) -> None:
    """Check the exit code, and that stderr has one error line that contains all ``texts``."""
    lines = [line for line in ended.err.splitlines() if line.startswith("mpsfm: ")]
    lines = [line for line in lines if not line.startswith("mpsfm: WARNING: ")]
    assert "Traceback" not in ended.err
    assert ended.code == code, ended.err
    assert len(lines) == 1, ended.err
    for text in texts:
        assert text in lines[0]


def test_folder_without_images_is_an_error(
    photo_scene, mpsfm, output: Path, tmp_path: Path
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    ended = mpsfm("reconstruct", empty, "--output", output, "--config", photo_scene.config)
    check(ended, 2, str(empty), "no images")
    assert "providers" not in ended.err  # no weights are downloaded for an empty folder
    ended = mpsfm("reconstruct", tmp_path / "no", "--output", output, "--config", "demo")
    assert ended.code == 2


def test_folder_with_one_image_is_an_error(
    photo_scene, mpsfm, output: Path, tmp_path: Path
) -> None:
    shutil.copy(photo_scene.images / "0.png", tmp_path)
    ended = mpsfm("reconstruct", tmp_path, "--output", output, "--config", photo_scene.config)
    check(ended, 2, "only one image", "0.png")


def test_unreadable_image_with_strict_inputs_is_an_error(
    photo_scene, mpsfm, output: Path, tmp_path: Path
) -> None:
    images = tmp_path / "images"
    shutil.copytree(photo_scene.images, images)
    data = (images / "2.png").read_bytes()
    (images / "2.png").write_bytes(data[: len(data) // 3])
    (images / "9.jpg").write_text("this is no picture")
    arguments = ["reconstruct", images, *photo_scene.arguments[2:], "--output", output]
    arguments += ["--set", "inputs.strict=true"]
    check(mpsfm(*arguments), 2, "9.jpg")
    (images / "9.jpg").unlink()
    check(mpsfm(*arguments), 2, "2.png")


def test_output_folder_inside_photos_is_an_error(photo_scene, mpsfm) -> None:
    ended = mpsfm(*photo_scene.arguments, "--output", photo_scene.images)
    check(ended, 2, "is the folder of the photos")


def test_locked_output_folder_is_an_error(photo_scene, mpsfm, output: Path) -> None:
    with lock_output_folder(output):
        check(
            mpsfm(*photo_scene.arguments, "--output", output),
            2,
            "another run writes to this folder",
        )


def test_intrinsics_of_other_image_size_are_an_error(
    photo_scene, mpsfm, output: Path, tmp_path: Path
) -> None:
    intrinsics = tmp_path / "intrinsics.yaml"
    intrinsics.write_text("1: {params: [560, 560, 320, 240], width: 640, height: 480}\n")
    ended = mpsfm(*photo_scene.arguments, "--intrinsics", intrinsics, "--output", output)
    check(ended, 2, str(intrinsics), "640x480", "320x240")


def test_missing_weights_are_an_error(photo_scene, mpsfm, output: Path, tmp_path: Path) -> None:
    pytest.importorskip("mpsfm_onnx")
    config = tmp_path / "config.yaml"
    base = photo_scene.config.read_text().split("depth:")[0]
    config.write_text(
        f"{base}depth:\n  use: onnx\n  options: {{model: {tmp_path}/absent.onnx}}\n"
        "normals:\n  use: from-depth\nruntime: {workers: 1}\n"
    )
    ended = mpsfm(*photo_scene.arguments, "--config", config, "--output", output)
    check(ended, 2, "absent.onnx")


def test_missing_depth_files_are_an_error(photo_scene, mpsfm, output: Path, tmp_path: Path) -> None:
    ended = mpsfm(
        *photo_scene.arguments, "--output", output, "--set", f"depth.options.directory={tmp_path}"
    )
    check(ended, 2, str(tmp_path))


def test_nan_from_provider_is_an_error(photo_scene, mpsfm, install_plugin, output: Path) -> None:
    module = install_plugin(
        "mpsfm-nan",
        """
        import numpy as np
        from mpsfm_core import DepthPrior, ProviderSpec, hookimpl

        class Nan:
            def __init__(self, options, context):
                pass

            def predict(self, view):
                depth = np.ones((24, 32), np.float32)
                prior = DepthPrior(depth, None, depth > 0)
                broken = depth.copy()
                broken[3, 4] = np.nan
                object.__setattr__(prior, "depth", broken)
                return prior

        @hookimpl
        def mpsfm_providers():
            return [ProviderSpec("depth", "nan", "mpsfm_nan_plugin:Nan")]
        """,
    )
    import importlib.util
    import os

    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    paths = [str(Path(spec.origin).parent), str(Path(__file__).resolve().parents[2])]
    ended = mpsfm(
        *photo_scene.arguments,
        "--output",
        output,
        "--set",
        "depth.use=nan",
        extra={"PYTHONPATH": os.pathsep.join(paths)},
    )
    check(ended, 1, "'nan'", ".png", "depth", "finite")


def test_full_disk_keeps_earlier_results(photo_scene, mpsfm, output: Path, tmp_path: Path) -> None:
    # With a filled cache, the second run writes no large files except the results.
    assert mpsfm(*photo_scene.arguments, "--output", tmp_path / "first", "--quiet").code == 0

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    ended = mpsfm(*photo_scene.arguments, "--output", output, preexec_fn=small_files)
    check(ended, 1, str(output), "the disk is full", "earlier results are unchanged")


@pytest.mark.parametrize(
    ("stage", "by"),
    [
        ("inputs", signal.SIGINT),
        ("extraction", signal.SIGINT),
        ("mapping", signal.SIGINT),
        ("extraction", signal.SIGTERM),
    ],
)
def test_ctrl_c_keeps_earlier_results(
    photo_scene, interrupted, output: Path, stage: str, by: signal.Signals, cache: Path
) -> None:
    ended = interrupted(*photo_scene.arguments, "--output", output, after=stage, by=by)
    check(ended, 130, "interrupted")


def test_output_folder_that_cannot_be_created_is_an_error(
    photo_scene, mpsfm, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("x")
    ended = mpsfm(*photo_scene.arguments, "--output", tmp_path / "file")
    check(ended, 2, "file", "cannot be the output folder")


def test_nan_pixels_in_depth_files_are_invalid_not_fatal(
    photo_scene, mpsfm, tmp_path: Path
) -> None:
    depth = tmp_path / "depth"
    shutil.copytree(photo_scene.folder / "depth", depth)
    with np.load(depth / "1.npz") as stored:
        values = stored["depth"].copy()
    values[:20] = np.nan
    np.savez(depth / "1.npz", depth=values)
    ended = mpsfm(
        *photo_scene.arguments,
        "--output",
        tmp_path / "other",
        "--set",
        f"depth.options.directory={depth}",
    )
    assert ended.code == 0, ended.err
