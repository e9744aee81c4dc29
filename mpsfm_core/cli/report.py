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
    """Write the page DIR/report.html again, which every run writes at its end.

    The command reads only the result folder DIR. The page opens in any browser without a network.
    """
    from mpsfm_core.report.page import write_report

    typer.echo(write_report(folder))
