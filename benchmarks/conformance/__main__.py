"""Compare our providers with the original code of their networks.

Usage: ``python -m benchmarks.conformance [NETWORK ...] [--checkouts DIR]``.

DIR (default ``$MPSFM_CHECKOUTS``) contains checkouts of the networks' repositories and of required
libraries. Each checkout folder has the network's name in ``mpsfm models export``, at the commit
pinned by our plugin. A network without checkout is skipped, and the table lists the commands that
create the checkout. Packages that the authors' code imports may be in ``DIR/packages`` (``pip
install --target``). RoMa and NetVLAD run in the Python environment that --environment names
(default ``vismatch``). ``mpsfm env create`` creates this environment with mpsfm-vismatch, vismatch
and onnx.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from benchmarks.conformance.netvlad import APART
from benchmarks.conformance.networks import HOSTED, NETWORKS, Hosted, Network
from benchmarks.conformance.shared import AUTHORS, photos
from mpsfm_core import ProviderContext, View
from mpsfm_core.data.errors import MpsfmError, ProviderError
from mpsfm_core.providers.environments.environment import find_environment
from mpsfm_core.providers.model_export.export import compare_with_original, run_script
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.weights import WeightStore

Compared: TypeAlias = Callable[[Path], dict[str, float]]
"""Function that returns the largest difference of each network output, given the checkouts."""
_HOLDS = {"normals, deg": 0.06, "positions, px": 1e-2, APART: np.inf}
_TOLERANCE = 1e-3
"""Maximum relative difference of depth and std between our provider and the authors' code.

Our providers and the authors' code compute in float32.
"""


def main() -> int:
    """Compare all networks, print the table, and return the number of networks that differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("networks", nargs="*")
    parser.add_argument("--checkouts", type=Path, default=os.environ.get("MPSFM_CHECKOUTS"))
    parser.add_argument("--environment", default="vismatch")
    arguments = parser.parse_args()
    exports = {
        n: e for found in Registry.discover().call_hook("mpsfm_exports") for n, e in found.items()
    }
    rows: list[tuple[str, str, str, str, Mapping[str, tuple[str, str]], Compared]] = []
    for network in NETWORKS:
        recipe, name = exports[network.export], network.export
        compare = partial(_through_file, network)
        code = recipe.repository, recipe.commit
        rows.append((name, *code, network.described, network.libraries, compare))
    for hosted in HOSTED:
        compare = partial(_in_environment, hosted, arguments.environment)
        code = hosted.repository, hosted.commit
        rows.append((hosted.name, *code, hosted.described, {}, compare))
    differing = 0
    print("| network | commit | size | largest differences |\n|---|---|---|---|", flush=True)
    for name, repository, commit, described, libraries, compare in rows:
        if arguments.networks and name not in arguments.networks:
            continue
        wanted = {name: (repository, commit), **libraries}
        found = _missing(wanted, arguments.checkouts) or _told(compare, arguments.checkouts)
        differing += "DIFFERS" in found
        print(f"| {name} | {repository}@{commit[:10]} | {described} | {found} |", flush=True)
    return differing


def _missing(wanted: Mapping[str, tuple[str, str]], checkouts: Path | None) -> str:
    """Return the reason why a network cannot be compared, or an empty string.

    ``wanted`` contains the required repository and commit of each folder of checkouts.
    """
    if checkouts is None:
        return "skipped: no --checkouts"
    for folder, (repository, commit) in wanted.items():
        place = checkouts / folder
        if not (place / ".git").exists():
            return f"skipped: git clone https://github.com/{repository} {place}"
        head = subprocess.run(
            ["git", "-C", str(place), "rev-parse", "HEAD"], capture_output=True, text=True
        ).stdout.strip()
        if head != commit:
            return f"skipped: git -C {place} checkout {commit}"
    return ""


def _told(compare: Compared, checkouts: Path) -> str:
    try:
        differences = compare(checkouts)
    except MpsfmError as error:
        return f"skipped: {error}"
    text = ", ".join(f"{name} {value:.1e}" for name, value in differences.items())
    differs = [n for n, value in differences.items() if not value <= _HOLDS.get(n, _TOLERANCE)]
    return f"DIFFERS in {', '.join(differs)}: {text}" if differs else text


def _in_environment(hosted: Hosted, environment: str, checkouts: Path) -> dict[str, float]:
    return hosted.compare(find_environment(environment), checkouts / hosted.name)


def _through_file(network: Network, checkouts: Path) -> dict[str, float]:
    with tempfile.TemporaryDirectory(prefix="mpsfm-conformance-") as name:
        made = Path(name) / "network.onnx"
        views = photos(made.parent)
        code = [checkouts / f for f in (network.export, *network.libraries, "packages")]
        try:
            run_script(AUTHORS / network.script, code, made, size=network.size)
        except ProviderError as error:
            needs = f" (needs {', '.join(network.packages)})" if network.packages else ""
            raise ProviderError(f"original code of {network.export}: {error}{needs}") from None
        return {
            "file": max(compare_with_original(made).values()),
            **_differences(network, made, views),
        }


def _differences(network: Network, made: Path, views: Sequence[View]) -> dict[str, float]:
    """Compute the largest difference of each output over all photos (or groups of photos)."""
    kind, name, options = network.provider(made)
    store = WeightStore(made.parent / "cache", offline=True)
    context = ProviderContext(resolve_weights=store.resolve)
    provider: Any = Registry.discover().create(kind, name, options, context)
    largest: dict[str, float] = {}
    for index in range(len(views)):
        shown = [views[(index + k) % len(views)] for k in range(network.views)]
        with np.load(made.with_name(f"reference_{index}.npz")) as theirs:
            differences = network.compare(network.ask(provider, *shown), dict(theirs))
        for key, value in differences.items():
            largest[key] = float(np.fmax(largest.get(key, np.nan), value))
    return largest


if __name__ == "__main__":
    sys.exit(main())
