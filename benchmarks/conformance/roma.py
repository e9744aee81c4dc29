"""RoMa through an environment against its authors' repository.

    python -m benchmarks.conformance.roma ENVIRONMENT CHECKOUT

ENVIRONMENT: as ``mpsfm env create`` made it, with mpsfm-vismatch and vismatch; CHECKOUT: of
Parskatt/RoMa. RoMa has no ONNX file to compare, so both sides run in the environment: the
collection's copy of the code by our provider, and the repository by its own ``match`` and
``to_pixel_coordinates``, both with the real architecture and the same random weights.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from benchmarks.conformance.__main__ import _AUTHORS, _photos
from mpsfm_core import ProviderContext
from mpsfm_core.environments.store import find_environment
from mpsfm_core.registry import Registry

_TOLERANCE_PX = 1e-2
"""Of positions on photos 640 pixels wide: 2e-5 of a view."""


def main() -> int:
    """Compare, print, return whether it differs."""
    environment, checkout = find_environment(sys.argv[1]), Path(sys.argv[2])
    options = {"network": "mpsfm_vismatch.seeded_roma:Matcher", "cell": 1, "min_certainty": 0.05}
    context = ProviderContext(resolve_weights=lambda uri, sha256: Path(uri))
    name = f"vismatch-roma@{environment.name}"
    provider = Registry.discover().create("matcher", name, options, context)
    worst = {"matches of one side only": 0.0, "positions, px": 0.0, "certainty": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        views = _photos(Path(folder))
        for first, second in pairwise(views):
            files = [str(Path(folder, f"{side}.png")) for side in "ab"]
            for file, view in zip(files, (first, second), strict=True):
                cv2.imwrite(file, view.image[..., ::-1])
            output = Path(folder, "theirs.npz")
            script = [str(_AUTHORS / "roma_warp.py"), str(checkout), *files, str(output)]
            subprocess.run([str(environment.python), *script], check=True)
            dense = provider.match(first, second).dense
            with np.load(output) as theirs:
                certainty = theirs["certainty"]
                half = certainty.shape[1] // 2
                # ours are those of the first view and then those of the second, row by row
                rows = np.arange(certainty.size).reshape(certainty.shape)
                order = np.concatenate([rows[:, :half].ravel(), rows[:, half:].ravel()])
                order = order[certainty.ravel()[order] > options["min_certainty"]]
                expected = theirs["a"][order], theirs["b"][order], certainty.ravel()[order]
            missing = abs(len(order) - len(dense)) / max(len(order), 1)
            worst["matches of one side only"] = max(worst["matches of one side only"], missing)
            if not missing:
                off = [np.abs(dense.points_a - expected[0]), np.abs(dense.points_b - expected[1])]
                worst["positions, px"] = max(worst["positions, px"], float(np.max(off)))
                sure = float(np.abs(dense.scores - expected[2]).max())
                worst["certainty"] = max(worst["certainty"], sure)
            print(f"{len(order)} matches of {first.name} and {second.name}", flush=True)
    print(", ".join(f"{key} {value:.1e}" for key, value in worst.items()))
    return int(worst["matches of one side only"] > 0 or worst["positions, px"] > _TOLERANCE_PX)


if __name__ == "__main__":
    sys.exit(main())
