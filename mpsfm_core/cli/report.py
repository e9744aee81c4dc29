"""``mpsfm report``: write the report page of a result folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Result folder of 'mpsfm reconstruct'.")
    ],
) -> None:
    """Write DIR/report.html again; every run writes the page once.

    The command reads DIR only. The page opens in any browser without a network.
    """
    from mpsfm_core.report.page import write_report

    typer.echo(write_report(folder))
