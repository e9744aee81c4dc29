"""``python -m benchmarks.conformance [NETWORK ...] [--checkouts DIR]``.

DIR (by default ``$MPSFM_CHECKOUTS``) has a checkout of each network's repository in a folder of the
export's name, at the commit that its plugin names, and of the libraries that it needs beside it.
What is not there is skipped, with the commands that get it. The packages that the authors' code
needs are looked for in this environment and in ``DIR/packages`` (``pip install --target``).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.conformance.networks import NETWORKS, Network
from mpsfm_core import PinholeCamera, ProviderContext, View
from mpsfm_core.errors import ProviderError
from mpsfm_core.model_export.run import compared, run_script
from mpsfm_core.providers import ModelExport
from mpsfm_core.registry import Registry
from mpsfm_core.weights import WeightStore

_SAMPLES = Path(__file__).parents[2] / "examples" / "sample_scene" / "images"
_AUTHORS = Path(__file__).parent / "authors"
_CAMERAS = ((640, 480, 620.0), (333, 500, 410.0), (517, 389, 900.0))
"""Width, height and focal length of the photos: landscape, portrait, and odd sizes."""
_HOLDS = {"normals, deg": 0.06}
_TOLERANCE = 1e-3
"""Relative; of angles the same in radians. Both sides compute in float32, by other kernels."""


def main() -> int:
    """Compare, print the table, return how many networks differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("networks", nargs="*")
    parser.add_argument("--checkouts", type=Path, default=os.environ.get("MPSFM_CHECKOUTS"))
    arguments = parser.parse_args()
    exports = {
        n: e for found in Registry.discover().call_hook("mpsfm_exports") for n, e in found.items()
    }
    differing = 0
    print("| network | commit | size | largest differences |\n|---|---|---|---|", flush=True)
    for network in NETWORKS:
        if arguments.networks and network.export not in arguments.networks:
            continue
        recipe = exports[network.export]
        missing = _missing(network, recipe, arguments.checkouts)
        found = missing or _compared(network, arguments.checkouts)
        differing += "DIFFERS" in found
        code = f"{recipe.repository}@{recipe.commit[:10]}"
        print(f"| {network.export} | {code} | {network.described} | {found} |", flush=True)
    return differing


def _missing(network: Network, recipe: ModelExport, checkouts: Path | None) -> str:
    """Why it cannot be compared here, or an empty text."""
    if checkouts is None:
        return "skipped: no --checkouts"
    wanted = {network.export: (recipe.repository, recipe.commit), **network.libraries}
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


def _compared(network: Network, checkouts: Path) -> str:
    with tempfile.TemporaryDirectory(prefix="mpsfm-conformance-") as name:
        made = Path(name) / "network.onnx"
        views = _photos(made.parent)
        code = [checkouts / f for f in (network.export, *network.libraries, "packages")]
        try:
            run_script(_AUTHORS / network.script, code, made, size=network.size)
        except ProviderError as error:
            needs = f" (needs {', '.join(network.packages)})" if network.packages else ""
            return f"skipped: the authors' code fails: {error}{needs}"
        differences = {"file": max(compared(made).values()), **_differences(network, made, views)}
    text = ", ".join(f"{name} {value:.1e}" for name, value in differences.items())
    differs = [n for n, value in differences.items() if not value <= _HOLDS.get(n, _TOLERANCE)]
    return f"DIFFERS in {', '.join(differs)}: {text}" if differs else text


def _photos(folder: Path) -> list[View]:
    """Photos of the sample scene, written for the authors' script."""
    views, entries = [], []
    for index, (path, (width, height, focal)) in enumerate(
        zip(sorted(_SAMPLES.glob("*.jpg")), _CAMERAS, strict=False)
    ):
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
        np.save(folder / f"photo_{index}.npy", resized)
        views.append(View(path.name, resized, camera))
        entries.append({"file": f"photo_{index}.npy", "camera": vars(camera)})
    (folder / "photos.json").write_text(json.dumps(entries), encoding="utf-8")
    return views


def _differences(network: Network, made: Path, views: Sequence[View]) -> dict[str, float]:
    """The largest over the photos, each with those after it where several are seen at once."""
    kind, name, options = network.provider(made)
    store = WeightStore(made.parent / "cache", offline=True)
    context = ProviderContext(resolve_weights=store.resolve)
    provider: Any = Registry.discover().create(kind, name, options, context)
    largest: dict[str, float] = {}
    for index in range(len(views)):
        shown = [views[(index + k) % len(views)] for k in range(network.views)]
        with np.load(made.with_name(f"reference_{index}.npz")) as theirs:
            found = network.compare(network.ask(provider, *shown), dict(theirs))
        for key, value in found.items():
            largest[key] = float(np.fmax(largest.get(key, np.nan), value))
    return largest


if __name__ == "__main__":
    sys.exit(main())
