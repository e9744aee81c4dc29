"""For the scripts of plugins that export a network, in the process of the authors' code.

A script is run as a program with the checkouts on its search path::

    from mpsfm_core.providers.model_export.author_script import ExportJob

    if __name__ == "__main__":
        job = ExportJob.from_arguments()
        model = TheirNetwork()
        if job.weights:
            job.load(model, job.checkpoint()["model"])
        job.export(model, [{"image": torch.rand(1, 3, 96, 128)}], ["normal"])

Imports torch: for such scripts only.
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

Given: TypeAlias = Mapping[str, torch.Tensor]
"""Inputs of a network by name, in its order."""


@dataclass(frozen=True)
class ExportJob:
    """What a script is asked for. ``weights``: the checkpoint, None for seeded random weights.
    ``output``: where the file goes. ``size``: of the network, where it comes in several."""

    weights: Path | None
    output: Path
    size: str = ""

    @classmethod
    def from_arguments(cls) -> ExportJob:
        """From the program's argument; random weights are seeded from here on."""
        warnings.simplefilter("ignore")
        torch.manual_seed(0)
        said = json.loads(sys.argv[1])
        weights = said["weights"]
        return cls(Path(weights) if weights else None, Path(said["output"]), said["size"])

    def checkpoint(self, *allowed: type) -> Any:
        """The content of the checkpoint, on the CPU: tensors and plain values, no code.

        ``allowed``: classes without code of their own that it may hold too.
        """
        assert self.weights is not None
        if self.weights.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(self.weights)
        with torch.serialization.safe_globals(list(allowed)):
            return torch.load(self.weights, map_location="cpu", weights_only=True)

    def load(self, model: torch.nn.Module, state: Mapping[str, torch.Tensor]) -> None:
        """Weights into the network, which has to find all of its own among them."""
        missing = model.load_state_dict(state, strict=False).missing_keys
        if missing:
            raise SystemExit(f"the checkpoint lacks {missing[0]} and {len(missing) - 1} more")

    def export(
        self,
        model: torch.nn.Module,
        given: Sequence[Given],
        outputs: Sequence[str],
        dynamic: Mapping[str, Mapping[int, str]] | None = None,
        said: Sequence[Sequence[torch.Tensor]] = (),
    ) -> None:
        """Write the network, traced on the first of the ``given`` inputs, and its run_network to all.

        ``dynamic``: of each tensor the axes that may have other lengths, with a name; then the
        given ones should have such. ``said``: the run_network of the authors' own network, where
        ``model`` is another form of it.
        """
        said = said or run_network(model, given)
        register_custom_op_symbolic("aten::expm1", _expm1, OPSET)
        before = set(self.output.parent.iterdir())
        with MaskedWriteRewriter():
            torch.onnx.export(
                model,
                tuple(tensor.clone() for tensor in given[0].values()),
                str(self.output),
                input_names=list(given[0]),
                output_names=list(outputs),
                dynamic_axes=dynamic,
                opset_version=OPSET,
                dynamo=False,
            )
        if beside := set(self.output.parent.iterdir()) - before - {self.output}:
            gather_weights(self.output, beside)
        arrays: dict[str, Any] = {}
        for number, (tensors, found) in enumerate(zip(given, said, strict=True)):
            arrays |= {f"{number}/in/{name}": tensor.numpy() for name, tensor in tensors.items()}
            named = zip(outputs, found, strict=True)
            arrays |= {f"{number}/out/{name}": tensor.numpy() for name, tensor in named}
        np.savez(self.output.with_suffix(".npz"), **arrays)


def gather_weights(output: Path, beside: Collection[Path]) -> None:
    """Of a network beyond 2 GB, whose weights the exporter lays ``beside`` it one by one: into one
    file of the network's name with ``.data``."""
    import onnx

    onnx.save(onnx.load(output), output, save_as_external_data=True, location=f"{output.name}.data")
    for path in beside:
        path.unlink()


def run_network(model: torch.nn.Module, given: Sequence[Given]) -> list[tuple[torch.Tensor, ...]]:
    """What a network says of several inputs."""
    model = model.eval()
    with torch.inference_mode():
        return [_answer(model, tensors) for tensors in given]


class MaskedWriteRewriter(TorchFunctionMode):
    """Writes ``tensor[index][mask] = x`` as ``tensor[index] = where(mask, x, ...)``, which
    is the same.

    The exporter of torch 2.13 (``dynamo=False``) loses what was written to a tensor before a masked
    write to a view of it: ``axes[:, 0] = x; axes[:, 0][invalid] = 0.0`` is 0 everywhere in the
    file. That made the normals of DSINE wrong by 100 degrees.
    """

    def __init__(self) -> None:
        super().__init__()
        self._last: tuple[torch.Tensor, torch.Tensor, Any] | None = None
        """The last view that was taken, its tensor and the index."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """As of torch; see the class."""
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
    """``exp(x) - 1``, which ONNX lacks, as ``2 sinh(x / 2) exp(x / 2)``: as exact near 0."""
    half = graph.op("Mul", x, graph.op("Constant", value_t=torch.tensor(0.5)))
    return graph.op("Add", *2 * (graph.op("Mul", graph.op("Sinh", half), graph.op("Exp", half)),))


def _answer(model: torch.nn.Module, given: Given) -> tuple[torch.Tensor, ...]:
    found = model(*(tensor.clone() for tensor in given.values()))
    if isinstance(found, Mapping):  # the exporter takes the values, in their order
        found = tuple(found.values())
    return tuple(found) if isinstance(found, (list, tuple)) else (found,)
