"""Tests of the choice between CPU and GPU for an ONNX model."""

from __future__ import annotations

from dataclasses import replace

import onnxruntime
import pytest
from mpsfm_onnx.model import Model

CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
IDENTITY = "one (float[n] x) => (float[n] y) { y = Identity (x) }"


@pytest.mark.parametrize(
    ("device", "here", "asked"),
    [
        ("cuda", [CUDA, CPU], [CUDA, CPU]),
        ("cuda", [CPU], [CPU]),
        ("cpu", [CUDA, CPU], [CPU]),
    ],
)
def test_gpu_is_used_if_requested_and_available(
    monkeypatch, caplog, write_onnx, context, device, here, asked
):
    """Check that the model runs on the CPU if the libraries of the GPU cannot be loaded."""
    found = []
    session = onnxruntime.InferenceSession

    def on_the_cpu(path, settings, providers):
        found.extend(providers)
        return session(path, settings, providers=[CPU])

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: here)
    monkeypatch.setattr(onnxruntime, "InferenceSession", on_the_cpu)
    model = Model(write_onnx(IDENTITY), replace(context, device=device))
    assert found == asked
    assert ("runs on the CPU" in caplog.text) == (device == "cuda")
    assert model.run({"x": [1, 2]}, ["y"])[0].tolist() == [1, 2]
