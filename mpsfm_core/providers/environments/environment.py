"""Python environments that contain providers: creation, lookup, description and removal."""

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

from mpsfm_core.data.errors import InputError, ProviderError, did_you_mean
from mpsfm_core.providers.environments.worker_process import Worker
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version
from mpsfm_core.support.user_folders import user_data_folder

_log = logging.getLogger(__name__)

FORMAT = 1
"""Format version of the file that describes the providers of an environment."""
FOLDER_VARIABLE = "MPSFM_ENVIRONMENTS"
"""Environment variable with the path of the folder that contains all provider environments."""

_NAME = re.compile(r"[a-z0-9]+([._-][a-z0-9]+)*")
_CORE = "mpsfm-core"
_DESCRIPTION = "providers.json"
_UNFINISHED = ".unfinished-"
_REQUEST_TIMEOUT_S = 120.0
"""Time limit in seconds for a request to a worker process that runs no neural network."""


class Environment:
    """Python environment with installed provider plugins, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._worker: Worker | None = None
        self._lock = threading.Lock()

    def __reduce__(self) -> Any:
        return Environment, (self.folder,)

    @property
    def name(self) -> str:
        """Name of the environment in configurations."""
        return self.folder.name

    @property
    def label(self) -> str:
        """Name of the environment in messages to the user."""
        return f"environment {self.name!r}"

    @property
    def python(self) -> Path:
        """Path of the environment's Python interpreter."""
        inside = ("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")
        return self.folder.joinpath("venv", *inside)

    def start(self) -> Worker:
        """Start a worker process with the environment's Python interpreter."""
        return Worker(self.python, self.label)

    def ask(self, **request: Any) -> Any:
        """Send a request about providers to a worker process, reusing a running one."""
        with self._lock:
            if self._worker is None or not self._worker.alive:
                self._worker = self.start()
            worker = self._worker
        return worker.ask(request, _REQUEST_TIMEOUT_S)

    def close(self) -> None:
        """End the worker process that answers requests about the environment's providers."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def describe(self) -> list[dict[str, Any]]:
        """Return the stored description of the environment's providers; start no worker."""
        path = self.folder / _DESCRIPTION
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            # An early version of MP-SfM wrote the description of the providers as a list without a
            # format version.
            if isinstance(content, list):
                content = {"providers": content}
            check_version(content, FORMAT, path)
            found: list[dict[str, Any]] = content["providers"]
        except InputError as error:
            _log.warning("the providers of %s are not available: %s", self.label, error)
            return []
        except (OSError, ValueError, KeyError, AttributeError, RecursionError):
            return []
        return found

    def refresh(self) -> list[dict[str, Any]]:
        """Let a worker process describe the environment's providers, and store the description."""
        found: list[dict[str, Any]] = self.ask(do="describe")
        content = {VERSION: FORMAT, "providers": found}
        text = json.dumps(content, indent=1, sort_keys=True)
        write_file(self.folder / _DESCRIPTION, text)
        return found


def environments_folder() -> Path:
    """Return the folder of all provider environments, which ``$MPSFM_ENVIRONMENTS`` may set."""
    folder = os.environ.get(FOLDER_VARIABLE)
    return Path(folder) if folder else user_data_folder() / "environments"


def all_environments() -> list[Environment]:
    """List the existing provider environments, sorted by name."""
    root = environments_folder()
    if not root.is_dir():
        return []
    folders = (f for f in sorted(root.iterdir()) if not f.name.startswith(_UNFINISHED))
    found = (Environment(folder) for folder in folders)
    return [environment for environment in found if environment.python.exists()]


def find_environment(name: str) -> Environment:
    """Return the provider environment with the given name.

    Raises:
        InputError: No provider environment has the given name.
    """
    known = {environment.name: environment for environment in all_environments()}
    if name not in known:
        hint = did_you_mean(name, known)
        raise InputError(
            f"no provider environment {name!r} exists{hint}; 'mpsfm env create {name} PACKAGE' "
            f"creates it"
        )
    return known[name]


def create_environment(
    name: str, packages: Sequence[str], python: str | None = None
) -> tuple[Environment, list[dict[str, Any]]]:
    """Create a Python environment with mpsfm-core and other packages, by uv or by venv and pip.

    Args:
        name: Name of the provider environment.
        packages: Pip requirements or source folders of the packages to install.
        python: Path or version of the Python interpreter, by default the running interpreter.

    Returns:
        The new Python environment and the description of its providers.

    Raises:
        InputError: The environment name is invalid, or an environment with that name exists.
        ProviderError: An installation command fails; a partly created environment is then removed.
    """
    if not _NAME.fullmatch(name):
        raise InputError(
            f"environment name {name!r} may only have lower-case letters, digits and - . _"
        )
    environment = Environment(environments_folder() / name)
    if environment.folder.exists():
        raise InputError(f"{environment.label} exists; 'mpsfm env remove {name}' removes it")
    environments_folder().mkdir(parents=True, exist_ok=True)
    # The environment is created in a temporary folder next to its final folder, so that an
    # interruption leaves no incomplete environment.
    with tempfile.TemporaryDirectory(prefix=_UNFINISHED, dir=environments_folder()) as scratch:
        made = Environment(Path(scratch) / name)
        for command in _commands(made, [*_core_requirement(), *packages], python):
            _run(command, environment.label)
        made.refresh()
        made.close()
        _relocate_scripts(made.python.parent, made.folder, environment.folder)
        made.folder.rename(environment.folder)
    return environment, environment.describe()


def remove_environment(name: str) -> None:
    """Remove a provider environment together with its folder."""
    shutil.rmtree(find_environment(name).folder)


def _commands(
    environment: Environment, packages: Sequence[str], python: str | None
) -> list[list[str]]:
    """Return the uv or pip commands that create a Python environment and install packages."""
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


def _relocate_scripts(scripts: Path, before: Path, after: Path) -> None:
    """Replace the interpreter path in the scripts of a Python environment that is moved."""
    old, new = os.fsencode(before), os.fsencode(after)
    for path in scripts.iterdir():
        if path.is_file() and not path.is_symlink():
            content = path.read_bytes()
            # On Windows, the scripts of a Python environment are binary launchers.
            if old in content and b"\0" not in content:
                path.write_bytes(content.replace(old, new))


def _core_requirement() -> list[str]:
    """Return pip arguments that install the mpsfm-core of this process in another environment."""
    distribution = metadata.distribution(_CORE)
    origin = json.loads(distribution.read_text("direct_url.json") or "{}")
    url = str(origin.get("url", ""))
    if url.startswith("file:"):
        editable = origin.get("dir_info", {}).get("editable", False)
        return ["-e", url.removeprefix("file://")] if editable else [f"{_CORE} @ {url}"]
    return [f"{_CORE}=={distribution.version}"]


def _run(command: list[str], label: str) -> None:
    """Run an installation command; raise ProviderError with its error output if it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise ProviderError(f"{label} cannot be created, no such command: {error}") from error
    if done.returncode:
        lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        reason = next((line for line in lines if "rror" in line), lines[-1] if lines else "")
        raise ProviderError(
            f"{label} cannot be created: the command {' '.join(command[:4])} ... fails: "
            f"{reason.strip()}"
        )
