"""Export of the trained compact network to the ONNX file of the plugin."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from training.network import CompactNetwork

_OPSET = 18
_SMALL = 1024
"""Minimum number of values of weight arrays that are stored as float16 instead of float32."""


class Exported(nn.Module):
    """Network with the input and output tensors of the exported ONNX file.

    The input ``image`` (1, 3, h, w) is RGB from 0 to 255. The input ``intrinsics`` (1, 3, 3) is the
    calibration matrix K in pixels of ``image``. Output maps have the shape (1, c, h / 2, w / 2).
    ``depth`` and its ``std`` are in meters for the canonical focal length. ``normals`` are unit
    vectors in the camera frame. ``angle`` is the std of normals about each axis in rad.
    ``validity`` is the probability in 0..1 that a pixel shows a surface.
    """

    def __init__(self, network: CompactNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor, intrinsics: Tensor) -> tuple[Tensor, ...]:
        """Predict depth, std, normals, angle and validity."""
        height, width = image.shape[2:]
        focal, center = intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2]
        x = torch.arange(width // 32, device=image.device) * 32.0 + 16.0
        y = torch.arange(height // 32, device=image.device) * 32.0 + 16.0
        x = (x - center[:, :1]) / focal[:, :1]
        y = (y - center[:, 1:]) / focal[:, 1:]
        shape = (-1, height // 32, width // 32)
        rays = torch.stack([x[:, None].expand(shape), y[:, :, None].expand(shape)], 1)
        out = self.network(image, rays)
        depth = out["log_depth"].exp()
        return (
            depth,
            depth * out["log_std"].exp(),
            out["normals"],
            out["log_angle"].exp(),
            out["validity"].sigmoid(),
        )


class ExportedCamera(nn.Module):
    """Camera branch with the tensors of the exported ONNX file.

    The input ``image`` (1, 3, h, w) is RGB from 0 to 255. The output ``focal`` (1, 1) is the focal
    length in input pixels, the geometric mean of both axes, and ``focal_std`` the std of its
    logarithm. ``gravity`` (1, 3) is a unit vector in the camera frame with ``gravity_std`` in rad,
    and ``radial`` is the distortion k1 with ``radial_std``.
    """

    def __init__(self, network: CompactNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """Estimate focal length, gravity and distortion, each with its std."""
        height, width = image.shape[2:]
        out = self.network.calibrate(image)
        diagonal = torch.sqrt(torch.as_tensor(height * height + width * width, dtype=torch.float32))
        scale, floor = FOCAL_STD
        return (
            out["log_focal"].exp() * diagonal,
            torch.sqrt((scale * out["log_focal_std"].exp()) ** 2 + floor**2),
            out["gravity"],
            out["log_gravity_std"].exp() * GRAVITY_STD,
            out["radial"],
            out["log_radial_std"].exp() * RADIAL_STD,
        )


_OUTPUTS = ("depth", "std", "normals", "angle", "validity")
_CAMERA = ("focal", "focal_std", "gravity", "gravity_std", "radial", "radial_std")
FOCAL_STD = (2.3, 0.15)
"""Factor of the std of the log focal length that the camera branch predicts, and its floor. The
factor is measured on panoramas for validation; the floor covers photos unlike panoramas."""
GRAVITY_STD = 2.0
"""Factor of the std of gravity, measured on panoramas for validation."""
RADIAL_STD = 1.3
"""Factor of the std of the distortion, measured on panoramas for validation."""


def export(checkpoint: Path, output: Path) -> dict[str, float]:
    """Export the depth and normals of a checkpoint to ONNX as float16, and compare with torch.

    Returns:
        The largest relative difference between ONNX and torch for each output, on a random image.
    """
    intrinsics = torch.eye(3)[None] * 220
    intrinsics[0, :2, 2] = torch.tensor([128.0, 96.0])
    maps = {name: {2: "h2", 3: "w2"} for name in _OUTPUTS}
    return _export(Exported, checkpoint, output, {"intrinsics": intrinsics}, _OUTPUTS, maps)


def export_camera(checkpoint: Path, output: Path) -> dict[str, float]:
    """Export the camera branch of a checkpoint to ONNX as float16, and compare with torch.

    Returns:
        The largest relative difference between ONNX and torch for each output, on a random image.
    """
    return _export(ExportedCamera, checkpoint, output, {}, _CAMERA, {})


def _export(
    kind: Callable[[CompactNetwork], nn.Module],
    checkpoint: Path,
    output: Path,
    inputs: dict[str, Tensor],
    outputs: Sequence[str],
    axes: dict[str, dict[int, str]],
) -> dict[str, float]:
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    network = CompactNetwork()
    network.load_state_dict(averaged(state))
    module = kind(network).eval()
    with warnings.catch_warnings():
        # torch's TorchScript-based ONNX exporter needs no further package, but warns about shapes.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            (torch.rand(1, 3, 192, 256) * 255, *inputs.values()),
            str(output),
            input_names=["image", *inputs],
            output_names=list(outputs),
            dynamic_axes={"image": {2: "h", 3: "w"}} | axes,
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(output)
    _halve(model)
    model.producer_name = "mpsfm-compact"
    if "samples" in state:
        samples = {"samples": int(state["samples"])}
        model.metadata_props.add(key="training", value=json.dumps(samples))
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, output)
    return _difference(module, output, outputs, with_intrinsics="intrinsics" in inputs)


def keep(checkpoint: Path, output: Path) -> None:
    """Write the averaged weights of a checkpoint as float16, a start for another training run."""
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    weights = averaged(state)
    torch.save({k: v.half() if v.is_floating_point() else v for k, v in weights.items()}, output)


def average(checkpoints: Sequence[Path], output: Path) -> None:
    """Write the mean weights of several checkpoints, with the largest of their sample counts.

    The mean of checkpoints of one run is often more accurate than each of them (Wortsman et al.,
    Model soups, 2022). Verify the accuracy of the mean weights on validation data.
    """
    states = [torch.load(path, map_location="cpu", weights_only=True) for path in checkpoints]
    stages = [averaged(state) for state in states]
    mean = dict(stages[-1])
    for name, value in mean.items():
        if value.is_floating_point():
            mean[name] = torch.stack([stage[name] for stage in stages]).mean(dim=0)
    samples = max(int(state["samples"]) for state in states)
    torch.save({"mean": {f"module.{k}": v for k, v in mean.items()}, "samples": samples}, output)


def averaged(state: dict) -> dict[str, Tensor]:
    """Return the moving average of the weights in a checkpoint, or its plain weights."""
    mean = state.get("mean")
    if mean is None:
        return state
    return {k.removeprefix("module."): v for k, v in mean.items() if k.startswith("module.")}


def _halve(model: onnx.ModelProto) -> None:
    """Store large weight arrays as float16, each followed by a Cast node to float32."""
    graph = model.graph
    casts = []
    for array in list(graph.initializer):
        values = numpy_helper.to_array(array)
        if array.data_type != TensorProto.FLOAT or values.size < _SMALL:
            continue
        stored = numpy_helper.from_array(values.astype(np.float16), array.name + "_half")
        graph.initializer.remove(array)
        graph.initializer.append(stored)
        casts.append(helper.make_node("Cast", [stored.name], [array.name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def _difference(
    module: nn.Module, path: Path, outputs: Sequence[str], with_intrinsics: bool
) -> dict[str, float]:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    worst = dict.fromkeys(outputs, 0.0)
    for height, width in ((192, 256), (256, 160)):
        image = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(0)) * 255
        inputs = {"image": image}
        if with_intrinsics:
            matrix = [[210.0, 0, width / 2], [0, 205.0, height / 2], [0, 0, 1]]
            inputs["intrinsics"] = torch.tensor([matrix])
        with torch.inference_mode():
            wanted = module(*inputs.values())
        feed = {name: value.numpy() for name, value in inputs.items()}
        for name, a, b in zip(outputs, wanted, session.run(list(outputs), feed), strict=True):
            gap = np.abs(a.numpy() - b).max() / np.abs(a.numpy()).max()
            worst[name] = max(worst[name], float(gap))
    return worst
