"""Progress bars and progress lines, implemented as hooks for the events of a run."""

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

from mpsfm_core.cli.remaining_time import RemainingTimeEstimator, format_remaining_time
from mpsfm_core.providers import hookimpl
from mpsfm_core.providers.registry import Registry


@contextmanager
def show_progress(registry: Registry, quiet: bool) -> Iterator[None]:
    """Show progress on stderr inside a block: bars on a terminal, else a line per stage."""
    if quiet:
        yield
        return
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        registry.register(ProgressLines(console), name="progress lines")
        yield
        return
    remaining = RemainingTimeEstimator()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bars = ProgressBars(progress, remaining)
        registry.register(bars, name="progress bars")
        yield
        bars.finish()
        remaining.save()


class ProgressBars:
    """Progress bars of the stages and of the whole run, for terminals."""

    def __init__(self, progress: Progress, remaining: RemainingTimeEstimator) -> None:
        self._progress = progress
        self._remaining = remaining
        self._registered = ""
        self._run = progress.add_task("run", total=None)
        self._tasks: dict[str, TaskID] = {}

    @hookimpl
    def mpsfm_notice(self, text: str) -> None:
        """Print a message above the progress bars."""
        self._progress.console.print(text, markup=False)

    @hookimpl
    def mpsfm_stage_started(self, stage: str, total: int | None) -> None:
        """Add the progress bar of a pipeline stage."""
        self._tasks[stage] = self._progress.add_task(stage, total=total)
        self._remaining.start_stage(stage, total)
        self._update_run()

    @hookimpl
    def mpsfm_stage_progress(self, stage: str, done: int, total: int) -> None:
        """Advance the progress bar of a pipeline stage."""
        if stage in self._tasks:
            self._progress.update(self._tasks[stage], completed=done, total=total)
        self._remaining.update_stage(stage, done, total)
        self._update_run()

    @hookimpl
    def mpsfm_stage_finished(self, stage: str, seconds: float) -> None:
        """Complete the progress bar of a pipeline stage."""
        self._remaining.finish_stage(stage)
        self._update_run()
        task = self._tasks.pop(stage, None)
        if task is not None:
            total = self._progress.tasks[task].total or 1
            self._progress.update(task, completed=total, total=total)

    @hookimpl
    def mpsfm_image_registered(self, name: str, registered: int, total: int) -> None:
        """Show the number of registered images as progress of mapping."""
        self._registered = f"{registered} of {total} images registered"
        self.mpsfm_stage_progress("mapping", registered, total)

    def finish(self) -> None:
        """Complete the progress bar of the whole run."""
        description = " - ".join(("run", *filter(None, (self._registered,))))
        self._progress.update(self._run, description=description, completed=1, total=1)

    def _update_run(self) -> None:
        """Update remaining time and number of registered images at the progress bar of the run."""
        parts = (format_remaining_time(self._remaining.seconds()), self._registered)
        self._progress.update(self._run, description=" - ".join(("run", *filter(None, parts))))


class ProgressLines:
    """Progress output for log files with one line per finished stage."""

    def __init__(self, console: Console) -> None:
        self._console = console

    @hookimpl
    def mpsfm_notice(self, text: str) -> None:
        """Print a message of the reconstruction run."""
        self._console.print(text, markup=False, soft_wrap=True)

    @hookimpl
    def mpsfm_stage_finished(self, stage: str, seconds: float) -> None:
        """Print the duration of a finished stage."""
        self._console.print(f"{stage}: {seconds:.1f} s", markup=False)
