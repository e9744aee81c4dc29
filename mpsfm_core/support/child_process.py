"""Environment variables for Python processes that this process starts."""

from __future__ import annotations

import os
import sys


def subprocess_environment() -> dict[str, str]:
    """Return environment variables that make this process's modules importable in a child."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
