"""Tests of the export of networks to ONNX by their authors' code in another process."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.data.errors import InputError, ProviderError, WeightsError
from mpsfm_core.providers import ModelExport
from mpsfm_core.providers.model_export import export
from mpsfm_core.providers.model_export.export import export_model, measure_relative_difference
from mpsfm_core.providers.weights import WeightStore, file_sha256

torch = pytest.importorskip("torch")
pytest.importorskip("onnxruntime")

THEIRS = """
import torch
class Net(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor([2.0]))
    def forward(self, image):
        axes = torch.zeros(1, 2, *image.shape[1:])
        axes[:, 0, ...] = image * self.gain
        axes[:, 1, ...] = image - self.gain
        invalid = torch.isnan(axes[:, 0])
        axes[:, 0, ...][invalid] = 0.0
        return axes
"""
SCRIPT = """
import torch
from their_net import Net
from mpsfm_core.providers.model_export.author_script import ExportJob

job = ExportJob.from_arguments()
net = Net()
if job.weights:
    net.load_state_dict(job.checkpoint())
{change}
axes = {{1: "height", 2: "width"}}
found = {{2: "height", 3: "width"}}
one, other = ({{"image": torch.rand(1, rows, 4)}} for rows in (3, 5))
job.export(net, [one, other], ["axes"], {{"image": axes, "axes": found}})
"""


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a source checkout with one git commit."""
    monkeypatch.setenv("MPSFM_EXPORTS", str(tmp_path / "exports"))
    folder = tmp_path / "checkout"
    folder.mkdir()
    (folder / "their_net.py").write_text(THEIRS)
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    for command in (["init", "-q"], ["add", "."], [*who, "commit", "-q", "-m", "net"]):
        subprocess.run(["git", "-C", str(folder), *command], check=True)
    return folder


def recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str = "") -> ModelExport:
    (tmp_path / "plugin_of_net.py").write_text(SCRIPT.format(change=change))
    monkeypatch.syspath_prepend(str(tmp_path))
    return ModelExport("plugin_of_net", "someone/net", "0" * 40, "MIT", ("a_package",))


@pytest.mark.slow
def test_from_a_checkpoint_to_a_file_that_is_taken_by_name(
    code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import onnxruntime

    weights = tmp_path / "net.pt"
    torch.save({"gain": torch.tensor([3.0])}, weights)
    found = export_model("net", recipe(tmp_path, monkeypatch), [code], str(weights))
    path = WeightStore(tmp_path).resolve("export:net")
    assert str(path) == found["file"]
    manifest = json.loads(path.with_suffix(".json").read_text())
    assert manifest["sha256"] == file_sha256(path)
    assert manifest["checkpoint_sha256"] == file_sha256(weights)
    assert (manifest["license"], manifest["changed"]) == ("MIT", False)
    head = subprocess.run(
        ["git", "-C", str(code), "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    )
    assert manifest["commit"] == head.stdout.strip()
    assert manifest["largest_differences"]["axes"] < 1e-6
    session = onnxruntime.InferenceSession(str(path))
    image = np.array([[[1, np.nan, 2]]], np.float32)
    (axes,) = session.run(None, {"image": image})
    np.testing.assert_allclose(axes[0, 0], [[3, 0, 6]])  # lost without MaskedWrites
    assert sorted(p.name for p in path.parent.iterdir()) == ["net.json", "net.onnx"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("net.forward = None", "code of net fails: TypeError.*needs torch, onnx, a_package"),
        (
            "torch.onnx.export = lambda *a, **k: real(shifted(), *a[1:], **k)",
            "computes other outputs than its authors' network",
        ),
    ],
)
def test_nothing_wrong_is_written(
    change: str, message: str, code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    helpers = """
real = torch.onnx.export
class shifted(torch.nn.Module):
    def forward(self, image):
        return Net()(image) + 0.5
"""
    made = recipe(tmp_path, monkeypatch, helpers + change)
    with pytest.raises(ProviderError, match=message):
        export_model("net", made, [code], export.RANDOM)
    assert not list((tmp_path / "exports").iterdir())


def test_weights_that_lie_beside_a_network_become_one_file_that_moves_with_it(
    tmp_path: Path,
) -> None:
    onnx = pytest.importorskip("onnx")
    import onnxruntime

    from mpsfm_core.providers.model_export.author_script import gather_weights

    text = """<ir_version: 8, opset_import: ["" : 17]> net (float[1000] x) => (float[1000] y) {
        z = Add (x, one)
        y = Mul (z, two)
    }"""
    model = onnx.parser.parse_model(text)
    for name, value in (("one", 1.0), ("two", 2.0)):
        weights = np.full(1000, value, np.float32)
        model.graph.initializer.append(onnx.numpy_helper.from_array(weights, name))
    made = tmp_path / "net.onnx"
    onnx.save(model, made, save_as_external_data=True, all_tensors_to_one_file=False)
    gather_weights(made, set(tmp_path.iterdir()) - {made})
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for path in (made, tmp_path / "net.onnx.data"):
        path.rename(moved / path.name)
    assert [path.name for path in tmp_path.iterdir()] == ["elsewhere"]
    session = onnxruntime.InferenceSession(str(moved / "net.onnx"))
    (found,) = session.run(None, {"x": np.zeros(1000, np.float32)})
    np.testing.assert_array_equal(found, 2.0)


@pytest.mark.slow
def test_operation_without_onnx_equivalent_raises(
    code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = code / "their_net.py"
    net.write_text(net.read_text().replace("image * self.gain", "torch.expm1(image * 1e-5)"))
    found = export_model("net", recipe(tmp_path, monkeypatch), [code], export.RANDOM)
    assert found["largest_differences"]["axes"] < 1e-6


@pytest.mark.slow
def test_checkpoint_with_code_is_refused(
    code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.save({"gain": print}, tmp_path / "net.pt")
    with pytest.raises(ProviderError, match="fails"):
        export_model("net", recipe(tmp_path, monkeypatch), [code], str(tmp_path / "net.pt"))


def test_missing_checkout_or_checkpoint_raises(
    code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = recipe(tmp_path, monkeypatch)
    with pytest.raises(InputError, match="git clone https://github"):
        export_model("net", made, [tmp_path / "nowhere"], export.RANDOM)
    with pytest.raises(WeightsError, match="does not exist"):
        export_model("net", made, [code], str(tmp_path / "none.pt"))


@pytest.mark.parametrize(
    ("found", "expected", "difference"),
    [
        (np.ones((2, 2)), np.ones((2, 3)), np.inf),
        (np.array([1.01, 100.0]), np.array([1.0, 100.0]), pytest.approx(0.01 / 50.5, rel=0.01)),
        (np.zeros(0), np.zeros(0), 0.0),
        (np.full(3, np.nan), np.full(3, np.nan), np.inf),
    ],
)
def test_relative_difference(found: np.ndarray, expected: np.ndarray, difference: float) -> None:
    assert measure_relative_difference(found, expected) == difference
