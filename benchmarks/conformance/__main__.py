"""``python -m benchmarks.conformance [NETWORK ...] [--checkouts DIR]``.

DIR (by default ``$MPSFM_CHECKOUTS``) has a checkout of each network's repository in a folder of the
network's name, at the commit that the table names, and of the libraries that it needs beside it.
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
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.conformance.networks import NETWORKS, Network
from mpsfm_core import PinholeCamera, ProviderContext, View
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
    differing = 0
    print("| network | commit | size | largest differences |\n|---|---|---|---|", flush=True)
    for network in NETWORKS:
        if arguments.networks and network.name not in arguments.networks:
            continue
        missing = _missing(network, arguments.checkouts)
        found = missing or _compared(network, arguments.checkouts)
        differing += "DIFFERS" in found
        code = f"{network.repository}@{network.commit[:10]}"
        print(f"| {network.name} | {code} | {network.size} | {found} |", flush=True)
    return differing


def _missing(network: Network, checkouts: Path | None) -> str:
    """Why it cannot be compared here, or an empty text."""
    if checkouts is None:
        return "skipped: no --checkouts"
    wanted = {network.name: (network.repository, network.commit), **network.libraries}
    for folder, (repository, commit) in wanted.items():
        place = checkouts / folder
        if not place.is_dir():
            return f"skipped: git clone https://github.com/{repository} {place}"
        head = subprocess.run(
            ["git", "-C", str(place), "rev-parse", "HEAD"], capture_output=True, text=True
        ).stdout.strip()
        if head != commit:
            return f"skipped: git -C {place} checkout {commit}"
    return ""


def _compared(network: Network, checkouts: Path) -> str:
    with tempfile.TemporaryDirectory(prefix="mpsfm-conformance-") as name:
        folder = Path(name)
        views = _photos(folder, network.photos)
        paths = [_AUTHORS, *(checkouts / f for f in (network.name, *network.libraries, "packages"))]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(str(path.resolve()) for path in paths),
            "XFORMERS_DISABLED": "1",
        }
        command = [sys.executable, str(_AUTHORS / network.script)]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        if done.returncode:
            last = done.stderr.strip().splitlines()[-1:]
            return f"skipped: the authors' code fails: {' '.join(last)} (needs {network.packages})"
        differences = _differences(network, folder, views)
    text = ", ".join(f"{name} {value:.1e}" for name, value in differences.items())
    differs = [n for n, value in differences.items() if value > _HOLDS.get(n, _TOLERANCE)]
    return f"DIFFERS in {', '.join(differs)}: {text}" if differs else text


def _photos(folder: Path, count: int) -> list[View]:
    """Photos of the sample scene, written for the authors' script."""
    views, entries = [], []
    cameras = _CAMERAS[:count]
    for index, (path, (width, height, focal)) in enumerate(
        zip(sorted(_SAMPLES.glob("*.jpg")), cameras, strict=False)
    ):
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        camera = PinholeCamera(width, height, focal, focal, width / 2, height / 2)
        np.save(folder / f"photo_{index}.npy", resized)
        views.append(View(path.name, resized, camera))
        entries.append({"file": f"photo_{index}.npy", "camera": vars(camera)})
    (folder / "photos.json").write_text(json.dumps(entries), encoding="utf-8")
    return views


def _differences(network: Network, folder: Path, views: list[View]) -> dict[str, float]:
    """The largest over the photos."""
    kind, name, options = network.provider(folder / "network.onnx")
    store = WeightStore(folder / "cache", offline=True)
    context = ProviderContext(resolve_weights=store.resolve)
    provider: Any = Registry.discover().create(kind, name, options, context)
    largest: dict[str, float] = {}
    for index, view in enumerate(views):
        with np.load(folder / f"reference_{index}.npz") as theirs:
            found = network.compare(network.ask(provider, view), dict(theirs))
        for key, value in found.items():
            largest[key] = max(largest.get(key, 0.0), value)
    return largest


if __name__ == "__main__":
    sys.exit(main())
