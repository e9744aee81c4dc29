"""Cache and data folders of the user, also for accounts without a home folder."""

from __future__ import annotations

import logging
import os
import tempfile
from functools import cache
from pathlib import Path

import platformdirs

CACHE_VARIABLE = "MPSFM_CACHE"

_log = logging.getLogger(__name__)


def user_cache_folder() -> Path:
    """Return ``$MPSFM_CACHE``, else the platform's cache folder, else a temporary folder."""
    variable = os.environ.get(CACHE_VARIABLE)
    if variable:
        try:
            return Path(variable).expanduser()
        except RuntimeError:  # Expanding "~" fails for an account without a home folder.
            return Path(variable)
    try:
        return Path(platformdirs.user_cache_dir("mpsfm"))
    except RuntimeError:
        return _temporary_folder()


def user_data_folder() -> Path:
    """Return the platform's data folder, else ``data`` in :func:`user_cache_folder`.

    Some accounts have no data folder, for instance a container's user id without a passwd entry.
    """
    try:
        return Path(platformdirs.user_data_dir("mpsfm"))
    except RuntimeError:
        return user_cache_folder() / "data"


@cache
def _temporary_folder() -> Path:
    folder = Path(tempfile.gettempdir()) / f"mpsfm-{os.getuid() if hasattr(os, 'getuid') else 0}"
    _log.warning(
        "this account has no home folder: caches are stored in %s; set %s or HOME to change it",
        folder,
        CACHE_VARIABLE,
    )
    return folder
