"""Comparison of RoMa in ``vismatch-roma`` with the repository of RoMa's authors.

Our provider runs the copy of RoMa in vismatch. The reference is the function ``match`` of the
repository of RoMa's authors, with ``to_pixel_coordinates``. Both networks have the original
architecture and the same random weights, and run in one Python environment, because RoMa cannot be
exported to ONNX.
"""

from __future__ import annotations

import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.conformance.shared import photos, run_authors
from mpsfm_core import ProviderContext
from mpsfm_core.providers.environments.environment import Environment
from mpsfm_core.providers.registry import Registry


def compare(environment: Environment, checkout: Path) -> dict[str, float]:
    """Compute the largest differences of RoMa's matches and certainties over pairs of photos."""
    options = {"network": "mpsfm_vismatch.seeded_roma:Matcher", "cell": 1, "min_certainty": 0.05}
    context = ProviderContext(resolve_weights=lambda uri, sha256: Path(uri))
    name = f"vismatch-roma@{environment.name}"
    provider = Registry.discover().create("matcher", name, options, context)
    worst = {"matches of one side only": 0.0, "positions, px": 0.0, "certainty": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        views = photos(Path(folder))
        for index, (first, second) in enumerate(pairwise(views)):
            files = [Path(folder, f"photo_{side}.png") for side in (index, index + 1)]
            output = Path(folder, "theirs.npz")
            run_authors(environment, "roma_warp.py", checkout, *files, output)
            dense = provider.match(first, second).dense
            with np.load(output) as theirs:
                certainty = theirs["certainty"]
                half = certainty.shape[1] // 2
                # Our provider returns the matches from the warp of the first view, then from the
                # warp of the second view, each in row order.
                rows = np.arange(certainty.size).reshape(certainty.shape)
                order = np.concatenate([rows[:, :half].ravel(), rows[:, half:].ravel()])
                order = order[certainty.ravel()[order] > options["min_certainty"]]
                expected = theirs["a"][order], theirs["b"][order], certainty.ravel()[order]
            missing = abs(len(order) - len(dense)) / max(len(order), 1)
            worst["matches of one side only"] = max(worst["matches of one side only"], missing)
            if missing:
                worst["positions, px"] = np.inf
            else:
                off = [np.abs(dense.points_a - expected[0]), np.abs(dense.points_b - expected[1])]
                worst["positions, px"] = max(worst["positions, px"], float(np.max(off)))
                sure = float(np.abs(dense.scores - expected[2]).max())
                worst["certainty"] = max(worst["certainty"], sure)
    return worst
