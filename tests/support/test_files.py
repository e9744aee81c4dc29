"""Tests that results are replaced completely or not at all."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import resource
import signal
from pathlib import Path
from typing import BinaryIO

import pytest

import mpsfm_core
from mpsfm_core.data.errors import InputError, OutputError
from mpsfm_core.support.files import (
    lock_output_folder,
    remove_temporary_files,
    replace_entries,
    write_file,
)

ENTRIES = ("sparse", "points.ply", "summary.json")


@pytest.fixture
def output(tmp_path: Path) -> Path:
    """Return a folder with earlier results and a file of the user."""
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
    with replace_entries(output, ENTRIES) as fresh:
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
    with pytest.raises(error), replace_entries(output, ENTRIES) as fresh:
        (fresh / "points.ply").write_text("half of the points")
        raise error
    assert content(output) == before


def test_failure_while_replacing_restores_old_entries(output: Path, monkeypatch) -> None:
    before = content(output)
    rename = Path.rename

    def fails_on_points(self: Path, target: Path) -> Path:
        if Path(target) == output / "points.ply":
            raise OSError(errno.EIO, "broken disk")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails_on_points)
    with pytest.raises(OutputError, match="broken disk"), replace_entries(output, ENTRIES) as fresh:
        (fresh / "a_first.txt").write_text("renamed before it fails")
        (fresh / "points.ply").write_text("new points")
    assert content(output) == before


def test_full_disk_raises_one_error(output: Path) -> None:
    before = content(output)
    _, limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, limit))
    try:
        with (
            pytest.raises(OutputError, match=r"the disk is full, but earlier results"),
            replace_entries(output, ENTRIES) as fresh,
        ):
            (fresh / "points.ply").write_bytes(bytes(1 << 20))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    assert content(output) == before


def test_failed_new_folder_is_removed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), replace_entries(tmp_path / "a" / "b", ENTRIES) as fresh:
        (fresh / "points.ply").write_text("x")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_checking_leaves_nothing_behind(tmp_path: Path, output: Path) -> None:
    before = content(output)
    with lock_output_folder(output):
        pass
    assert content(output) == before
    with lock_output_folder(tmp_path / "new" / "below"):
        assert (tmp_path / "new" / "below").is_dir()
    assert not (tmp_path / "new").exists()


def test_file_in_place_of_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        refused = pytest.raises(InputError, match="cannot be the output folder")
        with refused, lock_output_folder(folder):
            pass


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_permission_raises(output: Path) -> None:
    output.chmod(0o500)
    with pytest.raises(InputError, match="cannot be written"), lock_output_folder(output):
        pass


def killed_while(output: Path, step: int) -> bool:
    """Replace the results in a process that is killed before its ``step``-th rename."""
    child = os.fork()
    if child:
        return os.WIFSIGNALED(os.waitpid(child, 0)[1])
    count = 0
    rename = Path.rename

    def counted(self: Path, target: Path) -> Path:
        nonlocal count
        if count == step:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1
        return rename(self, target)

    Path.rename = counted  # type: ignore[method-assign]
    with replace_entries(output, ENTRIES) as fresh:
        (fresh / "sparse").mkdir()
        (fresh / "sparse" / "images.bin").write_text("new model")
        (fresh / "points.ply").write_text("new points")
        (fresh / "summary.json").write_text("new summary")
    os._exit(0)


def test_replacement_of_killed_run_is_finished(output: Path) -> None:
    for step in range(6):
        before = content(output)
        if not killed_while(output, step):
            break
        assert list(output.glob(".mpsfm-*"))
        with lock_output_folder(output):
            pass
        assert content(output) != before
        assert content(output) == {
            "sparse/images.bin": "new model",
            "points.ply": "new points",
            "summary.json": "new summary",
            "notes.txt": "the user's own",
        }
        for name in ("sparse/images.bin", "summary.json"):
            (output / name).write_text("old")
        (output / "points.ply").unlink()
    assert step == 5


def test_scratch_of_a_killed_run_is_taken_away(output: Path) -> None:
    before = content(output)
    (output / ".mpsfm-dead" / "new" / "depth").mkdir(parents=True)
    (output / ".mpsfm-dead" / "new" / "depth" / "a.npz").write_text("half")
    with lock_output_folder(output):
        assert content(output) == before
    assert not list(output.glob(".mpsfm-*"))


def test_only_one_run_has_a_folder(output: Path) -> None:
    with lock_output_folder(output):
        with (
            pytest.raises(InputError, match="another run writes to this folder"),
            lock_output_folder(output),
        ):
            pass
        assert (output / "notes.txt").exists()
    with lock_output_folder(output):
        pass


def test_file_is_written_completely_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "below" / "a.txt"
    write_file(path, "old")

    def fails(file: BinaryIO) -> None:
        file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        write_file(path, fails)
    assert path.read_text() == "old"
    assert list(path.parent.iterdir()) == [path]
    write_file(path, b"new", tmp_path / "elsewhere")
    assert path.read_text() == "new"
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_unfinished_files_of_the_dead_are_taken_away(tmp_path: Path) -> None:
    dead, young, alive = (tmp_path / f".{name}.tmp" for name in ("dead", "young", "alive"))
    for path in (dead, young, alive):
        path.write_text("half")
    for path in (dead, alive):
        os.utime(path, (0, 0))
    with alive.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        remove_temporary_files(tmp_path)
    assert {*tmp_path.iterdir()} == {young, alive}


PLAIN_WRITERS = {"files.py", "weights.py", "stages.py", "results", "testing", "builtin"}
PLAIN_WRITERS |= {"importers", "channel.py", "worker_process.py"}
"""Modules that may write without the atomic writer: partial downloads, the kernel's memory counter,
scratch folders, logs, pipes of other processes, and test data."""


def test_every_write_goes_through_one_place() -> None:
    writes = re.compile(r"\.write_(text|bytes)\(|\.open\(\"[wxa]|mkstemp|np\.savez?\w*\(\w*path")
    package = Path(mpsfm_core.__file__).parent
    found = [
        str(path.relative_to(package))
        for path in package.rglob("*.py")
        if writes.search(path.read_text(encoding="utf-8"))
        and not PLAIN_WRITERS & {*path.relative_to(package).parts}
    ]
    # These modules write to unfinished environments, to scratch folders of results and frames, and
    # to a log of checks.
    assert sorted(found) == [
        "cli/check_log.py",
        "inputs/models.py",
        "inputs/video.py",
        "providers/environments/environment.py",
    ]
