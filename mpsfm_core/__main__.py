"""``python -m mpsfm_core``: the command ``mpsfm`` of this environment."""

from mpsfm_core.cli import main

main()
