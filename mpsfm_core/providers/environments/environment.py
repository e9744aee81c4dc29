"""Environments by name: where they are, how one is made, what it brings."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import platformdirs

from mpsfm_core.data.errors import InputError, ProviderError, did_you_mean
from mpsfm_core.providers.environments.worker_process import Worker
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version

_log = logging.getLogger(__name__)

FORMAT = 1
"""Of the description of an environment."""
FOLDER_VARIABLE = "MPSFM_ENVIRONMENTS"
"""Environment variable that names the folder with all environments."""

_NAME = re.compile(r"[a-z0-9]+([._-][a-z0-9]+)*")
_CORE = "mpsfm-core"
_DESCRIPTION = "providers.json"
_UNFINISHED = ".unfinished-"
_ASKING_S = 120.0
"""For a question that no network is needed for."""


class Environment:
    """A Python environment with providers, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._worker: Worker | None = None
        self._lock = threading.Lock()

    def __reduce__(self) -> Any:
        return Environment, (self.folder,)

    @property
    def name(self) -> str:
        """As configurations call it."""
        return self.folder.name

    @property
    def label(self) -> str:
        """As messages call it."""
        return f"environment {self.name!r}"

    @property
    def python(self) -> Path:
        """Its interpreter."""
        inside = ("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")
        return self.folder.joinpath("venv", *inside)

    def start(self) -> Worker:
        """A worker process in it."""
        return Worker(self.python, self.label)

    def ask(self, **request: Any) -> Any:
        """The answer to a question about its providers, of a worker that stays for the next one."""
        with self._lock:
            if self._worker is None or not self._worker.alive:
                self._worker = self.start()
            worker = self._worker
        return worker.ask(request, _ASKING_S)

    def close(self) -> None:
        """End the worker that answers questions."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def describe(self) -> list[dict[str, Any]]:
        """What its providers are, without starting it: as of when it was made."""
        path = self.folder / _DESCRIPTION
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if isinstance(content, list):  # as it was before it had a version
                content = {"providers": content}
            check_version(content, FORMAT, path)
            found: list[dict[str, Any]] = content["providers"]
        except InputError as error:
            _log.warning("%s is left out: %s", self.label, error)
            return []
        except (OSError, ValueError, KeyError, AttributeError, RecursionError):
            return []
        return found

    def refresh(self) -> list[dict[str, Any]]:
        """Ask it what it brings, and keep the answer."""
        found: list[dict[str, Any]] = self.ask(do="describe")
        content = {VERSION: FORMAT, "providers": found}
        text = json.dumps(content, indent=1, sort_keys=True)
        write_file(self.folder / _DESCRIPTION, text)
        return found


def environments_folder() -> Path:
    """``$MPSFM_ENVIRONMENTS``, or ``environments`` in the user's data folder."""
    said = os.environ.get(FOLDER_VARIABLE)
    return Path(said) if said else Path(platformdirs.user_data_dir("mpsfm")) / "environments"


def all_environments() -> list[Environment]:
    """Those that are there, by name."""
    root = environments_folder()
    if not root.is_dir():
        return []
    folders = (f for f in sorted(root.iterdir()) if not f.name.startswith(_UNFINISHED))
    found = (Environment(folder) for folder in folders)
    return [environment for environment in found if environment.python.exists()]


def find_environment(name: str) -> Environment:
    """The environment of a name; raises :class:`~mpsfm_core.data.errors.InputError` if there is
    none."""
    known = {environment.name: environment for environment in all_environments()}
    if name not in known:
        hint = did_you_mean(name, known)
        raise InputError(
            f"no environment {name!r}{hint}; 'mpsfm env create {name} PACKAGE' makes it"
        )
    return known[name]


def create_environment(
    name: str, packages: Sequence[str], python: str | None = None
) -> tuple[Environment, list[dict[str, Any]]]:
    """Make an environment with the core and these packages, and see what it brings.

    ``packages``: requirements or folders, as for pip. ``python``: interpreter or version, by
    default this one's. It is made by uv where that is installed, else by venv and pip.

    Raises:
        InputError: the name is taken or not one. ProviderError: it cannot be made; nothing of it
            stays behind.
    """
    if not _NAME.fullmatch(name):
        raise InputError(f"{name!r} is not made of lower-case letters, digits and - . _")
    environment = Environment(environments_folder() / name)
    if environment.folder.exists():
        raise InputError(f"{environment.label} exists; 'mpsfm env remove {name}' removes it")
    environments_folder().mkdir(parents=True, exist_ok=True)
    # made beside its place, so that one that was killed half-way is not there at all
    with tempfile.TemporaryDirectory(prefix=_UNFINISHED, dir=environments_folder()) as scratch:
        made = Environment(Path(scratch) / name)
        for command in _commands(made, [*_core(), *packages], python):
            _run(command, environment.label)
        made.refresh()
        made.close()
        _name_place(made.python.parent, made.folder, environment.folder)
        made.folder.rename(environment.folder)
    return environment, environment.describe()


def remove_environment(name: str) -> None:
    """Remove it with all that is in it."""
    shutil.rmtree(find_environment(name).folder)


def _commands(
    environment: Environment, packages: Sequence[str], python: str | None
) -> list[list[str]]:
    venv, inside = str(environment.folder / "venv"), str(environment.python)
    uv = shutil.which("uv")
    if uv:
        return [
            [uv, "venv", "--python", python or sys.executable, venv],
            [uv, "pip", "install", "--python", inside, *packages],
        ]
    return [
        [python or sys.executable, "-m", "venv", venv],
        [inside, "-m", "pip", "install", "--disable-pip-version-check", *packages],
    ]


def _name_place(scripts: Path, before: Path, after: Path) -> None:
    """Scripts of an environment name its interpreter: at the place where it is going to be."""
    old, new = os.fsencode(before), os.fsencode(after)
    for path in scripts.iterdir():
        if path.is_file() and not path.is_symlink():
            content = path.read_bytes()
            if old in content and b"\0" not in content:  # launchers on Windows are programs
                path.write_bytes(content.replace(old, new))


def _core() -> list[str]:
    """This core for pip: the same folder where it was installed from one, else its version."""
    distribution = metadata.distribution(_CORE)
    origin = json.loads(distribution.read_text("direct_url.json") or "{}")
    url = str(origin.get("url", ""))
    if url.startswith("file:"):
        editable = origin.get("dir_info", {}).get("editable", False)
        return ["-e", url.removeprefix("file://")] if editable else [f"{_CORE} @ {url}"]
    return [f"{_CORE}=={distribution.version}"]


def _run(command: list[str], label: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise ProviderError(f"{label} cannot be made: {error}") from error
    if done.returncode:
        lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        reason = next((line for line in lines if "rror" in line), lines[-1] if lines else "")
        raise ProviderError(
            f"{label} cannot be made: {' '.join(command[:4])} ...: {reason.strip()}"
        )
