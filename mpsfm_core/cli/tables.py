"""Tables on the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

_PIPE_WIDTH = 2000
"""Width of tables in characters if the output is no terminal, so that lines are not wrapped."""


def print_table(header: Sequence[str], rows: Iterable[Sequence[str | Text]]) -> None:
    """Print a table with header; rich does not interpret brackets in the cells as markup."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    table = Table(*header, box=None, header_style="bold", padding=(0, 2, 0, 0))
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    console.print(table)
