"""NetVLAD against hloc's, which the reference uses.

    python -m benchmarks.conformance.netvlad PYTHON CHECKOUT

PYTHON: an interpreter with torch, torchvision, onnx and OpenCV; CHECKOUT: of
cvg/Hierarchical-Localization. Their code exports itself with random weights, and ``global-onnx``
runs the file.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.conformance.__main__ import _AUTHORS, _SAMPLES, _TOLERANCE
from mpsfm_core import PinholeCamera, ProviderContext, View
from mpsfm_core.registry import Registry

_SIZES = ((640, 480), (333, 500), (1601, 1203), (900, 1300))


def main() -> int:
    """Compare, print, return whether it differs."""
    python, checkout = sys.argv[1:]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        views = []
        for index, (path, size) in enumerate(
            zip(sorted(_SAMPLES.glob("*.jpg")), _SIZES, strict=False)
        ):
            image = cv2.resize(cv2.imread(str(path)), size, interpolation=cv2.INTER_CUBIC)
            cv2.imwrite(str(folder / f"{index}.png"), image)
            camera = PinholeCamera(*size, 500.0, 500.0, size[0] / 2, size[1] / 2)
            views.append(View(f"{index}.png", image[..., ::-1].copy(), camera))
        model = folder / "netvlad.onnx"
        files = [str(folder / view.name) for view in views]
        script = [str(_AUTHORS / "netvlad.py"), checkout, str(model), *files]
        subprocess.run([python, *script], check=True)
        options = {"model": str(model), "network": "netvlad"}
        context = ProviderContext(resolve_weights=lambda uri, sha256: Path(uri))
        provider = Registry.discover().create("retrieval", "global-onnx", options, context)
        with np.load(model.with_suffix(".npz")) as theirs:
            ours = {view.name[:-4]: provider.describe(view) for view in views}
            off = {key: float(np.linalg.norm(ours[key] - theirs[key])) for key in ours}
            apart = float(np.linalg.norm(theirs["0"] - theirs["1"]))
    for view in views:
        print(f"{view.camera.size}: unit descriptors are {off[view.name[:-4]]:.1e} apart")
    print(f"those of two photos: {apart:.1e}")
    return int(max(off.values()) > _TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
