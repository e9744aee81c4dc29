"""Run the configuration ``paper-mast3r`` with the authors' architectures and random weights.

    python -m benchmarks.paper_chain PHOTOS [--mast3r DIR --dsine DIR] [--work DIR]

Runs ``mpsfm models export ... --checkpoint random`` and ``mpsfm reconstruct`` on a folder of
photos. The networks are SuperPoint (of transformers) for features, MASt3R (ViT-L) for matches and
depth, and DSINE (EfficientNet-B5) with a mirrored pass for normals. Random weights give no matches,
so ``mpsfm reconstruct`` ends with exit code 3 and a report. Prints the time and peak memory of each
command.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import psutil

from benchmarks._scenes import MPSFM


def main() -> None:
    """Parse the command line, export the networks, and reconstruct the photos."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("--mast3r", type=Path, nargs="*", help="Checkouts for its export.")
    parser.add_argument("--dsine", type=Path, nargs="*", help="Checkouts for its export.")
    parser.add_argument("--work", type=Path, help="Keeps the files of the networks.")
    parser.add_argument("--set", dest="settings", nargs="*", default=[], help="KEY=VALUE.")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mpsfm-chain-") as scratch:
        work = arguments.work or Path(scratch)
        work.mkdir(parents=True, exist_ok=True)
        for name, code in (("mast3r", arguments.mast3r), ("dsine", arguments.dsine)):
            file = work / f"{name}.onnx"
            if code and not file.exists():
                folders = [word for folder in code for word in ("--code", str(folder))]
                export = ["models", "export", name, *folders, "--checkpoint", "random"]
                _measured([*export, "--output", str(file)], f"export of {name}")
        detector = _random_superpoint(work / "superpoint")
        output = Path(scratch, "output")
        settings = [
            "pairs.mode=exhaustive",
            "retrieval.use=appearance",
            "features.use=superpoint-hub",
            f"features.options.model={detector}",
            f"matcher.options.model={work / 'mast3r.onnx'}",
            f"normals.options.model={work / 'dsine.onnx'}",
            "masks=[]",
            *arguments.settings,
        ]
        words = [word for setting in settings for word in ("--set", setting)]
        run = ["reconstruct", str(arguments.photos), "--config", "paper-mast3r", *words]
        _measured([*run, "--output", str(output)], "reconstruction", allowed=(0, 3))
        summary = json.loads((output / "summary.json").read_text(encoding="utf-8"))
        pairs = {name: summary["pairs"][name] for name in ("matched", "verified")}
        print(f"{summary['images']['total']} photos, pairs {pairs}: {summary['status']}")


def _random_superpoint(folder: Path) -> Path:
    import torch
    from transformers import (
        SuperPointConfig,
        SuperPointForKeypointDetection,
        SuperPointImageProcessorPil,
    )

    torch.manual_seed(0)
    SuperPointForKeypointDetection(SuperPointConfig()).save_pretrained(folder)
    SuperPointImageProcessorPil().save_pretrained(folder)
    return folder


def _measured(command: list[str], what: str, allowed: tuple[int, ...] = (0,)) -> None:
    """Run a command, and measure time and peak memory of the command's processes."""
    start, peak = time.perf_counter(), 0
    running = subprocess.Popen([*MPSFM, *command])
    process = psutil.Process(running.pid)
    while running.poll() is None:
        total = 0
        for member in (process, *process.children(recursive=True)):
            try:
                total += member.memory_info().rss
            except psutil.Error:
                continue
        peak = max(peak, total)
        time.sleep(0.5)
    took = time.perf_counter() - start
    print(f"{what}: {took:.0f} s, {peak / 2**30:.1f} GiB, exit code {running.returncode}")
    if running.returncode not in allowed:
        raise SystemExit(f"{what} failed")


if __name__ == "__main__":
    main()
