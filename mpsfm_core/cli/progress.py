"""Progress bars: a plugin that listens to the events of the run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from mpsfm_core.cli.time_left import TimeLeft, in_words
from mpsfm_core.providers import hookimpl
from mpsfm_core.providers.registry import Registry


@contextmanager
def showing_progress(registry: Registry, quiet: bool) -> Iterator[None]:
    """Show progress on stderr while the block runs: bars on a terminal, else a line a stage."""
    if quiet:
        yield
        return
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        registry.register(Lines(console), name="progress lines")
        yield
        return
    left = TimeLeft()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bars = Bars(progress, left)
        registry.register(bars, name="progress bars")
        yield
        bars.end()
        left.keep()


class Bars:
    """One bar a stage, and one for the whole run, for people who watch."""

    def __init__(self, progress: Progress, left: TimeLeft) -> None:
        self._progress = progress
        self._left = left
        self._registered = ""
        self._run = progress.add_task("run", total=None)
        self._tasks: dict[str, TaskID] = {}

    @hookimpl
    def mpsfm_notice(self, text: str) -> None:
        """Print it above the bars."""
        self._progress.console.print(text, markup=False)

    @hookimpl
    def mpsfm_stage_started(self, stage: str, total: int | None) -> None:
        """Add a bar."""
        self._tasks[stage] = self._progress.add_task(stage, total=total)
        self._left.started(stage, total)
        self._tell()

    @hookimpl
    def mpsfm_stage_progress(self, stage: str, done: int, total: int) -> None:
        """Advance it."""
        if stage in self._tasks:
            self._progress.update(self._tasks[stage], completed=done, total=total)
        self._left.progress(stage, done, total)
        self._tell()

    @hookimpl
    def mpsfm_stage_finished(self, stage: str, seconds: float) -> None:
        """Fill it."""
        self._left.finished(stage)
        self._tell()
        task = self._tasks.pop(stage, None)
        if task is not None:
            total = self._progress.tasks[task].total or 1
            self._progress.update(task, completed=total, total=total)

    @hookimpl
    def mpsfm_image_registered(self, name: str, registered: int, total: int) -> None:
        """Registered images are the mapper's progress."""
        self._registered = f"{registered} of {total} images registered"
        self.mpsfm_stage_progress("mapping", registered, total)

    def end(self) -> None:
        """The whole run is done."""
        done = " - ".join(("run", *filter(None, (self._registered,))))
        self._progress.update(self._run, description=done, completed=1, total=1)

    def _tell(self) -> None:
        """The line of the whole run."""
        known = (in_words(self._left.seconds()), self._registered)
        self._progress.update(self._run, description=" - ".join(("run", *filter(None, known))))


class Lines:
    """One line a finished stage, for logs."""

    def __init__(self, console: Console) -> None:
        self._console = console

    @hookimpl
    def mpsfm_notice(self, text: str) -> None:
        """Print it."""
        self._console.print(text, markup=False, soft_wrap=True)

    @hookimpl
    def mpsfm_stage_finished(self, stage: str, seconds: float) -> None:
        """Say how long it took."""
        self._console.print(f"{stage}: {seconds:.1f} s", markup=False)
