"""Results are replaced as a whole or not at all."""

from __future__ import annotations

import errno
import os
import resource
from pathlib import Path

import pytest

from mpsfm_core.errors import InputError, OutputError
from mpsfm_core.results.folder import check_writable, replacing

ENTRIES = ("sparse", "points.ply", "summary.json")


@pytest.fixture
def output(tmp_path: Path) -> Path:
    """A folder with earlier results and a file of the user's own."""
    folder = tmp_path / "out"
    (folder / "sparse").mkdir(parents=True)
    (folder / "sparse" / "images.bin").write_text("old model")
    (folder / "summary.json").write_text("old summary")
    (folder / "notes.txt").write_text("the user's own")
    return folder


def content(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): path.read_text()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_success_replaces_ours_and_leaves_the_rest(output: Path) -> None:
    with replacing(output, ENTRIES) as fresh:
        (fresh / "points.ply").write_text("new points")
        (fresh / "summary.json").write_text("new summary")
        assert content(output)["summary.json"] == "old summary"
    assert content(output) == {
        "points.ply": "new points",
        "summary.json": "new summary",
        "notes.txt": "the user's own",
    }


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_failure_and_interruption_change_nothing(output: Path, error: type) -> None:
    before = content(output)
    with pytest.raises(error), replacing(output, ENTRIES) as fresh:
        (fresh / "points.ply").write_text("half of the points")
        raise error
    assert content(output) == before


def test_a_failure_while_swapping_is_undone(output: Path, monkeypatch) -> None:
    before = content(output)
    rename = Path.rename

    def fails_on_points(self: Path, target: Path) -> Path:
        if Path(target) == output / "points.ply":
            raise OSError(errno.EIO, "broken disk")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails_on_points)
    with pytest.raises(OSError, match="broken disk"), replacing(output, ENTRIES) as fresh:
        (fresh / "a_first.txt").write_text("renamed before it fails")
        (fresh / "points.ply").write_text("new points")
    assert content(output) == before


def test_a_full_disk_is_one_clear_error(output: Path) -> None:
    before = content(output)
    _, limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, limit))
    try:
        with (
            pytest.raises(OutputError, match=r"out: the disk is full .*earlier results"),
            replacing(output, ENTRIES) as fresh,
        ):
            (fresh / "points.ply").write_bytes(bytes(1 << 20))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    assert content(output) == before


def test_a_new_folder_that_fails_is_gone_again(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), replacing(tmp_path / "a" / "b", ENTRIES) as fresh:
        (fresh / "points.ply").write_text("x")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_checking_leaves_nothing_behind(tmp_path: Path, output: Path) -> None:
    before = content(output)
    check_writable(output)
    assert content(output) == before
    check_writable(tmp_path / "new" / "below")
    assert not (tmp_path / "new").exists()


def test_a_file_in_the_way_is_wrong_input(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="cannot be the output folder"):
            check_writable(folder)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_wrong_input(output: Path) -> None:
    output.chmod(0o500)
    with pytest.raises(InputError, match="cannot be written"):
        check_writable(output)
