"""Helpers for plugin scripts that run the authors' code of a network and export it to ONNX.

An export script runs as a program with the authors' source checkouts on its search path::

    from mpsfm_core.providers.model_export.author_script import ExportJob

    if __name__ == "__main__":
        job = ExportJob.from_arguments()
        model = TheirNetwork()
        if job.weights:
            job.load(model, job.checkpoint()["model"])
        job.export(model, [{"image": torch.rand(1, 3, 96, 128)}], ["normal"])

Only export scripts may import this module, because it imports torch.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch.onnx.utils import register_custom_op_symbolic
from torch.overrides import TorchFunctionMode

OPSET = 17

Inputs: TypeAlias = Mapping[str, torch.Tensor]
"""Input tensors of a network by name, in the order of the network's arguments."""


@dataclass(frozen=True)
class ExportJob:
    """Export request that MP-SfM sends to the export script of a plugin."""

    weights: Path | None
    """Path of the authors' checkpoint, or None for seeded random weights."""
    output: Path
    """Path of the ONNX file to write."""
    size: str = ""
    """Variant of the network, such as "large", if the authors published several sizes."""

    @classmethod
    def from_arguments(cls) -> ExportJob:
        """Read the export request from the program's argument and seed torch's random numbers."""
        warnings.simplefilter("ignore")
        torch.manual_seed(0)
        job = json.loads(sys.argv[1])
        weights = job["weights"]
        return cls(Path(weights) if weights else None, Path(job["output"]), job["size"])

    def checkpoint(self, *allowed: type) -> Any:
        """Load the tensors of the authors' checkpoint to the CPU without running code in the file.

        Args:
            allowed: Additional classes, which must be harmless, that the checkpoint file may
                contain.
        """
        assert self.weights is not None
        if self.weights.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(self.weights)
        with torch.serialization.safe_globals(list(allowed)):
            return torch.load(self.weights, map_location="cpu", weights_only=True)

    def load(self, model: torch.nn.Module, state: Mapping[str, torch.Tensor]) -> None:
        """Load a checkpoint into a network and raise an error if a parameter is missing."""
        missing = model.load_state_dict(state, strict=False).missing_keys
        if missing:
            raise SystemExit(
                f"the checkpoint lacks {len(missing)} parameters of the network, such as "
                f"{missing[0]}"
            )

    def export(
        self,
        model: torch.nn.Module,
        inputs: Sequence[Inputs],
        outputs: Sequence[str],
        dynamic: Mapping[str, Mapping[int, str]] | None = None,
        expected: Sequence[Sequence[torch.Tensor]] = (),
    ) -> None:
        """Write the ONNX file and an NPZ file with example inputs and the network's outputs.

        Args:
            model: Torch network to export.
            inputs: Example inputs of the network. The exporter traces the network on the first
                example.
            outputs: Names of the network's outputs in the ONNX file.
            dynamic: Names of the axes of variable length, by axis index and tensor name. The
                example inputs should differ in the lengths of the named axes.
            expected: Outputs of the original network for each example, if ``model`` is a modified
                form of that network.
        """
        expected = expected or run_network(model, inputs)
        register_custom_op_symbolic("aten::expm1", _expm1, OPSET)
        before = set(self.output.parent.iterdir())
        with MaskedWriteRewriter():
            torch.onnx.export(
                model,
                tuple(tensor.clone() for tensor in inputs[0].values()),
                str(self.output),
                input_names=list(inputs[0]),
                output_names=list(outputs),
                dynamic_axes=dynamic,
                opset_version=OPSET,
                dynamo=False,
            )
        if tensor_files := set(self.output.parent.iterdir()) - before - {self.output}:
            gather_weights(self.output, tensor_files)
        arrays: dict[str, Any] = {}
        for number, (tensors, result) in enumerate(zip(inputs, expected, strict=True)):
            arrays |= {f"{number}/in/{name}": tensor.numpy() for name, tensor in tensors.items()}
            named = zip(outputs, result, strict=True)
            arrays |= {f"{number}/out/{name}": tensor.numpy() for name, tensor in named}
        np.savez(self.output.with_suffix(".npz"), **arrays)


def gather_weights(output: Path, tensor_files: Collection[Path]) -> None:
    """Merge the weights files of an ONNX network above 2 GB into one file.

    Args:
        output: Path of the ONNX file. The weights are written to the path of the ONNX file with the
            suffix ``.data``.
        tensor_files: Paths of the weights files, each with one tensor, that torch's exporter wrote.
    """
    import onnx

    onnx.save(onnx.load(output), output, save_as_external_data=True, location=f"{output.name}.data")
    for path in tensor_files:
        path.unlink()


def run_network(model: torch.nn.Module, inputs: Sequence[Inputs]) -> list[tuple[torch.Tensor, ...]]:
    """Run a network on each of several inputs and return the outputs."""
    model = model.eval()
    with torch.inference_mode():
        return [_answer(model, tensors) for tensors in inputs]


class MaskedWriteRewriter(TorchFunctionMode):
    """Torch mode that replaces masked writes ``tensor[index][mask] = x`` by ``torch.where``.

    The ONNX exporter of torch 2.13 (``dynamo=False``) has a bug with masked writes to a view of a
    tensor. After ``axes[:, 0] = x`` and ``axes[:, 0][invalid] = 0.0``, the values of the exported
    network are 0 everywhere.
    """

    def __init__(self) -> None:
        super().__init__()
        self._last: tuple[torch.Tensor, torch.Tensor, Any] | None = None
        """Most recent tensor view that was created by indexing, the indexed tensor and the
        index."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """Execute a torch function, but replace a masked write by ``torch.where``."""
        if func is torch.Tensor.__getitem__:
            view = func(*args)
            self._last = view, args[0], args[1]
            return view
        if func is torch.Tensor.__setitem__ and self._last is not None:
            target, mask, value = args
            view, tensor, index = self._last
            if target is view and isinstance(mask, torch.Tensor) and mask.dtype == torch.bool:
                tensor[index] = torch.where(mask, torch.full_like(view, value), view)
                return None
        return func(*args, **(kwargs or {}))


def _expm1(graph: Any, x: Any) -> Any:
    """Export ``expm1``, which ONNX lacks, as ``2 sinh(x / 2) exp(x / 2)``, accurate near 0."""
    half = graph.op("Mul", x, graph.op("Constant", value_t=torch.tensor(0.5)))
    return graph.op("Add", *2 * (graph.op("Mul", graph.op("Sinh", half), graph.op("Exp", half)),))


def _answer(model: torch.nn.Module, inputs: Inputs) -> tuple[torch.Tensor, ...]:
    result = model(*(tensor.clone() for tensor in inputs.values()))
    # Torch's exporter writes the outputs of a network that returns a mapping in the order of the
    # mapping.
    if isinstance(result, Mapping):
        result = tuple(result.values())
    return tuple(result) if isinstance(result, (list, tuple)) else (result,)
