"""Export of a neural network to a verified ONNX file with a manifest of its origin."""

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
"""Checkpoint name that selects seeded random weights, which tests an export without a download."""

TOLERANCE = 1e-3
"""Largest accepted relative difference between outputs of the ONNX file and of the original
network, for 99.9 % of the values. Up to 0.1 % of the output values may differ more, because
iterative networks amplify float32 rounding of single values."""
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
    """Export a neural network from its authors' code and weights to an ONNX file.

    A JSON manifest with hashes and source commit is stored next to the ONNX file. Weights options
    can then refer to the ONNX file as ``export:NAME``.

    Args:
        name: Name of the exported network in ``export:NAME``.
        recipe: Recipe for the export of the network, which a plugin declares.
        code: Folders with source checkouts, first that of the network, then those of required
            libraries.
        checkpoint: Path or URI of the authors' weights, or ``random`` for random weights.
        output: Path of the ONNX file to write, by default in the folder of exports.
        sha256: Expected SHA-256 of the authors' checkpoint in hex.
        size: Variant of the network, such as "large", if the authors published several sizes.
        python: Python interpreter that runs the authors' code, by default the interpreter of this
            process.
        store: Weight store that finds or downloads the checkpoint.

    Returns:
        Content of the JSON manifest with the hashes and source commit of the exported network.

    Raises:
        InputError: A source checkout does not exist.
        WeightsError: The checkpoint with the authors' weights is not available.
        ProviderError: The authors' code fails, or the outputs of the ONNX file differ from those of
            the original network.
    """
    for folder in code:
        if not folder.is_dir():
            raise InputError(
                f"source checkout {folder} is no folder; create it by "
                f"git clone https://github.com/{recipe.repository}"
            )
    weights = None
    if checkpoint != RANDOM:
        weights = (store or WeightStore()).resolve(checkpoint, sha256)
    target = (output or exports_folder() / f"{name}.onnx").expanduser().resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".export-", dir=target.parent) as scratch:
        # The ONNX file of a large network contains the name of its separate weights file, so the
        # temporary ONNX file already has its final name.
        made = Path(scratch) / target.name
        script = importlib.util.find_spec(recipe.script)
        if script is None or script.origin is None:
            raise ProviderError(f"the plugin that exports {name} has no module {recipe.script!r}")
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
            listed = ", ".join(f"{key} {value:.1e}" for key, value in differences.items())
            raise ProviderError(
                f"the exported {name} computes other outputs than its authors' network (relative "
                f"differences: {listed}): nothing was written"
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
        # The pattern matches the ONNX file and, for large networks, its separate weights file.
        for part in sorted(Path(scratch).glob(f"{target.name}*")):
            shutil.move(part, target.with_name(part.name))
    text = json.dumps(manifest, indent=1) + "\n"
    write_file(target.with_suffix(".json"), text)
    if checkpoint != RANDOM and target.parent != exports_folder().resolve():
        exports_folder().mkdir(parents=True, exist_ok=True)
        write_file(exports_folder() / f"{name}.json", text)
    return manifest


def compare_with_original(made: Path) -> dict[str, float]:
    """Compare the outputs of an exported ONNX file with those of the original network.

    Args:
        made: Path of the ONNX file. The export script wrote example inputs and the original outputs
            to an NPZ file next to the ONNX file.

    Returns:
        Relative difference by output name, which is the largest value of
        :func:`measure_relative_difference` over all example inputs.
    """
    runtime = importlib.import_module("onnxruntime")
    session = runtime.InferenceSession(str(made), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    inputs = {tensor.name for tensor in session.get_inputs()}
    worst = dict.fromkeys(names, 0.0)
    with np.load(made.with_suffix(".npz")) as stored:
        arrays = dict(stored)
    for number in sorted({name.split("/")[0] for name in arrays}):
        given = {n: arrays[f"{number}/in/{n}"] for n in inputs}
        for name, found in zip(names, session.run(names, given), strict=True):
            difference = measure_relative_difference(found, arrays[f"{number}/out/{name}"])
            worst[name] = max(worst[name], difference)
    return worst


def measure_relative_difference(actual: Any, expected: Any) -> float:
    """Return the 99.9 % quantile of the relative differences between two arrays.

    Each difference is divided by the absolute expected value, or by the median of all absolute
    expected values if the median is larger.

    Args:
        actual: Output array of the exported ONNX file.
        expected: Expected output array of the original network.

    Returns:
        Quantile of the relative differences, infinite if the shapes differ or a value is not
        finite.
    """
    if actual.shape != expected.shape or not np.isfinite([actual, expected]).all():
        return float("inf")
    if not actual.size:
        return 0.0
    size = np.abs(expected.astype(np.float64))
    size = np.maximum(size, max(float(np.median(size)), 1e-12))
    return float(np.quantile(np.abs(actual.astype(np.float64) - expected) / size, _QUANTILE))


def run_script(
    script: Path,
    code: Sequence[Path],
    output: Path,
    *,
    weights: Path | None = None,
    size: str = "",
    python: Path | None = None,
) -> None:
    """Run a plugin's export script with the authors' source checkouts on its search path.

    Args:
        script: Path of the export script, which uses
            :class:`~mpsfm_core.providers.model_export.author_script.ExportJob`.
        code: Folders with the authors' source checkouts.
        output: Path of the ONNX file that the script writes.
        weights: Path of the authors' checkpoint, or None for random weights.
        size: Variant of the network, such as "large", if the authors published several sizes.
        python: Python interpreter that runs the script, by default the interpreter of this process.

    Raises:
        ProviderError: The export script fails; the message is the last line of the script's error
            output.
    """
    job = {"weights": weights and str(weights.resolve()), "output": str(output), "size": size}
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(
            [*(str(folder.resolve()) for folder in code), *_core_folder()]
        ),
        "PYTHONDONTWRITEBYTECODE": "1",
        "XFORMERS_DISABLED": "1",
    }
    command = [str(python or sys.executable), str(script.resolve()), json.dumps(job)]
    done = subprocess.run(
        command, cwd=code[0], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode or not output.is_file():
        raise ProviderError((done.stderr.strip().splitlines() or ["no message"])[-1])


def _core_folder() -> list[str]:
    """Return the folder that contains mpsfm_core, for the search path of an export script."""
    return [str(Path(__file__).parents[3])]


def _commit(folder: Path) -> Mapping[str, Any]:
    """Return the git commit of a source checkout and whether its files were changed."""

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
