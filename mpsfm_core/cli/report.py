"""``mpsfm report``: the page of a finished result folder, made anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="What 'mpsfm reconstruct' has written.")
    ],
) -> None:
    """Write DIR/report.html, which every run writes by itself, anew.

    It reads DIR and nothing else, and opens in any browser without a network.
    """
    from mpsfm_core.report.page import write_report

    typer.echo(write_report(folder))
