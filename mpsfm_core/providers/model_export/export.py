"""This side of an export: the process is started, its file checked, and a manifest written."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data.errors import InputError, ProviderError
from mpsfm_core.providers import ModelExport
from mpsfm_core.providers.weights import WeightStore, exports_folder, file_sha256
from mpsfm_core.support.files import write_file

RANDOM = "random"
"""As the checkpoint: seeded random weights, to try an export; nothing takes that file by name."""

TOLERANCE = 1e-3
"""Relative, of 99.9 % of the values: both sides compute in float32 by other kernels, and a network
that refines step by step lets single values go another way."""
_QUANTILE = 0.999


def export_model(
    name: str,
    recipe: ModelExport,
    code: Sequence[Path],
    checkpoint: str,
    output: Path | None = None,
    *,
    sha256: str | None = None,
    size: str = "",
    python: Path | None = None,
    store: WeightStore | None = None,
) -> dict[str, Any]:
    """Make a network's ONNX file from its authors' code and weights; its manifest.

    ``code``: checkouts, the network's own first, then libraries that it needs. ``checkpoint``: path
    or URI, or ``random``. ``output``: by default in the folder of exports. ``python``: the
    interpreter for the authors' code, by default this one. The manifest lies beside the folder's
    other ones, and ``export:NAME`` means the file from then on.

    Raises:
        InputError: a checkout is not there. WeightsError: the checkpoint is not.
        ProviderError: the authors' code fails, or the file says something else than it.
    """
    for folder in code:
        if not folder.is_dir():
            raise InputError(
                f"{folder} is no folder: git clone https://github.com/{recipe.repository}"
            )
    weights = None
    if checkpoint != RANDOM:
        weights = (store or WeightStore()).resolve(checkpoint, sha256)
    target = (output or exports_folder() / f"{name}.onnx").expanduser().resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".export-", dir=target.parent) as scratch:
        made = Path(scratch) / target.name  # a file of large weights is known by its name in it
        script = importlib.util.find_spec(recipe.script)
        if script is None or script.origin is None:
            raise ProviderError(f"the plugin of {name} has no script {recipe.script!r}")
        try:
            run_script(Path(script.origin), code, made, weights=weights, size=size, python=python)
        except ProviderError as error:
            needs = ", ".join(("torch", "onnx", *recipe.packages))
            raise ProviderError(
                f"the authors' code of {name} fails: {error} (it needs {needs})"
            ) from None
        differences = compare_with_original(made)
        worst = max(differences.values())
        if worst > TOLERANCE:
            told = ", ".join(f"{key} {value:.1e}" for key, value in differences.items())
            raise ProviderError(
                f"the exported {name} says something else than its authors' network (relative "
                f"differences: {told}): nothing was written"
            )
        manifest = {
            "name": name,
            "file": str(target),
            "sha256": file_sha256(made),
            "repository": recipe.repository,
            **_commit(code[0]),
            "tested_commit": recipe.commit,
            "checkpoint": checkpoint,
            "checkpoint_sha256": weights and file_sha256(weights),
            "license": recipe.license,
            "largest_differences": differences,
            "made": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }
        for part in sorted(Path(scratch).glob(f"{target.name}*")):  # large weights lie beside
            shutil.move(part, target.with_name(part.name))
    text = json.dumps(manifest, indent=1) + "\n"
    write_file(target.with_suffix(".json"), text)
    if checkpoint != RANDOM and target.parent != exports_folder().resolve():
        exports_folder().mkdir(parents=True, exist_ok=True)
        write_file(exports_folder() / f"{name}.json", text)
    return manifest


def compare_with_original(made: Path) -> dict[str, float]:
    """Of each output the relative difference that 99.9 % of its values stay below, in the worst of
    the inputs that the script left beside the file."""
    runtime = importlib.import_module("onnxruntime")
    session = runtime.InferenceSession(str(made), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    wanted = {tensor.name for tensor in session.get_inputs()}
    worst = dict.fromkeys(names, 0.0)
    with np.load(made.with_suffix(".npz")) as stored:
        arrays = dict(stored)
    for number in sorted({name.split("/")[0] for name in arrays}):
        given = {n: arrays[f"{number}/in/{n}"] for n in wanted}
        for name, found in zip(names, session.run(names, given), strict=True):
            difference = measure_relative_difference(found, arrays[f"{number}/out/{name}"])
            worst[name] = max(worst[name], difference)
    return worst


def measure_relative_difference(found: Any, expected: Any) -> float:
    """What 99.9 % of the values of an array are off by from another of its shape, in terms of their
    size, or of the typical one where they are smaller; infinite where the shapes differ or a value
    is no number."""
    if found.shape != expected.shape or not np.isfinite([found, expected]).all():
        return float("inf")
    if not found.size:
        return 0.0
    size = np.abs(expected.astype(np.float64))
    size = np.maximum(size, max(float(np.median(size)), 1e-12))
    return float(np.quantile(np.abs(found.astype(np.float64) - expected) / size, _QUANTILE))


def run_script(
    script: Path,
    code: Sequence[Path],
    output: Path,
    *,
    weights: Path | None = None,
    size: str = "",
    python: Path | None = None,
) -> None:
    """Run a script that makes ``output`` with the checkouts on its search path, see
    :class:`mpsfm_core.providers.model_export.author_script.ExportJob`.

    Raises:
        ProviderError: it fails; the message is its last line.
    """
    job = {"weights": weights and str(weights.resolve()), "output": str(output), "size": size}
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([*(str(folder.resolve()) for folder in code), *_ours()]),
        "PYTHONDONTWRITEBYTECODE": "1",
        "XFORMERS_DISABLED": "1",
    }
    command = [str(python or sys.executable), str(script.resolve()), json.dumps(job)]
    done = subprocess.run(
        command, cwd=code[0], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode or not output.is_file():
        raise ProviderError((done.stderr.strip().splitlines() or ["no message"])[-1])


def _ours() -> list[str]:
    """Where this core is, for an interpreter that may not have it installed."""
    return [str(Path(__file__).parents[3])]


def _commit(folder: Path) -> Mapping[str, Any]:
    """Commit of a checkout, and whether it was changed since; None where it is none."""

    def ask(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=False
            )
        except OSError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    return {
        "commit": ask("rev-parse", "HEAD"),
        "changed": bool(ask("status", "--porcelain", "-uno")),
    }
