"""Tests of the commands extract, match and map on a work folder with replaceable files."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.inputs.matches import features_from_hloc, matches_from_database, matches_from_hloc

h5py = pytest.importorskip("h5py")
SAMPLE = Path(__file__).parents[2] / "examples" / "sample_scene"


def mpsfm(*arguments: object) -> str:
    """Run a command and return its output."""
    ended = CliRunner().invoke(build_app(), [str(argument) for argument in arguments])
    assert ended.exit_code == 0, ended.output
    return ended.output


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a work folder of four photos after extract and match."""
    folder = tmp_path_factory.mktemp("work")
    names = folder / "names.txt"
    names.write_text("".join(f"view_{number}.jpg\n" for number in range(4)))
    settings: list[Any] = ["--config", "demo", "--image-list", names, "-q"]
    settings += ["--set", "extraction.integration_size=96", "--set", "depth.use=flat"]
    settings += [
        "--set",
        "normals.use=from-depth",
        "--set",
        f"runtime.cache_dir={folder / 'cache'}",
    ]
    settings += ["--intrinsics", SAMPLE / "intrinsics.yaml"]
    mpsfm("extract", SAMPLE / "images", "-o", folder / "work", *settings)
    mpsfm("match", folder / "work", "-q")
    return folder / "work"


@pytest.fixture(scope="module")
def photos() -> Any:
    from mpsfm_core import load_images

    return load_images(SAMPLE / "images", intrinsics=SAMPLE / "intrinsics.yaml")


def test_database_is_read_by_colmap(work: Path, photos: Any) -> None:
    with pycolmap.Database.open(str(work / "database.db")) as database:
        assert database.num_images() == 4 and database.num_cameras() == 1
        assert database.num_verified_image_pairs() >= 3
        images = {image.name: image.image_id for image in database.read_all_images()}
        assert sorted(images) == [f"view_{number}.jpg" for number in range(4)]
        matches = database.read_matches(images["view_0.jpg"], images["view_1.jpg"])
        keypoints = database.read_keypoints(images["view_0.jpg"])
        assert len(matches) > 15 and matches[:, 0].max() < len(keypoints)
    imported = matches_from_database(work / "database.db", photos)
    np.testing.assert_allclose(imported.keypoints[0], keypoints[:, :2], atol=1e-4)


def test_hloc_files_have_the_same_features_and_matches(work: Path, photos: Any) -> None:
    features, rows = features_from_hloc(work / "features.h5", photos)
    with h5py.File(work / "features.h5") as file:
        stored = file["view_0.jpg/keypoints"][()]
    first = features["view_0.jpg"]
    np.testing.assert_allclose(first.keypoints, stored[rows["view_0.jpg"]] + 0.5, atol=1e-4)
    assert first.descriptors.shape == (len(first), 128)
    imported = matches_from_hloc(work / "features.h5", work / "matches.h5", photos)
    assert len(imported.matches) == 6
    indices = imported.matches[0, 1].indices
    distance = np.linalg.norm(
        features["view_0.jpg"].descriptors[indices[:, 0]]
        - features["view_1.jpg"].descriptors[indices[:, 1]],
        axis=1,
    )
    assert np.median(distance) < 0.8 * np.median(
        np.linalg.norm(first.descriptors[:50, None] - first.descriptors[None, 50:100], axis=-1)
    )


def test_features_of_another_program_are_matched(work: Path, tmp_path: Path) -> None:
    """A features file with half of the keypoints gives fewer matches, without extraction."""
    copy = Path(shutil.copytree(work, tmp_path / "work"))
    with h5py.File(copy / "features.h5", "r+") as file:
        for name in list(file):
            for dataset, axis in (("keypoints", 0), ("descriptors", 1), ("scores", 0)):
                half = np.take(file[name][dataset][()], np.arange(0, 800, 2), axis)
                del file[name][dataset]
                file[name].create_dataset(dataset, data=half)
    mpsfm("match", copy, "-q")
    with pycolmap.Database.open(str(copy / "database.db")) as database:
        assert len(database.read_keypoints(1)) == 400


@pytest.mark.slow
@pytest.mark.parametrize("option", [[], ["--hloc"]], ids=["database", "hloc"])
def test_work_folder_is_mapped(work: Path, option: list[str]) -> None:
    mpsfm("map", work, "-q", *option)
    model = pycolmap.Reconstruction(str(work / "result" / "sparse"))
    assert model.num_reg_images() == 4


def test_folder_without_settings_is_explained(tmp_path: Path) -> None:
    ended = CliRunner().invoke(build_app(), ["match", str(tmp_path)])
    assert ended.exit_code == 2
    assert "run 'mpsfm extract' first" in " ".join(ended.output.split())
