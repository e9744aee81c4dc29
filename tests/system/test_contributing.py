"""Tests that the plugin in CONTRIBUTING.md works as printed."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.data import PinholeCamera, View
from mpsfm_core.providers import ProviderContext
from mpsfm_core.providers.kinds.depth import run_depth
from mpsfm_core.providers.registry import Registry

GUIDE = Path(__file__).resolve().parents[2] / "CONTRIBUTING.md"

NETWORK = """
import torch


class Network(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Conv2d(3, 1, 1)

    def forward(self, rgb):
        return 1 + self.layer(rgb).abs()
"""


def blocks() -> dict[str, str]:
    """Return the code blocks of the guide by the preceding file name."""
    pattern = r"`(my_depth/\w+\.py)`(?:(?!`my_depth/).)*?```python\n(.*?)```"
    return dict(re.findall(pattern, GUIDE.read_text(encoding="utf-8"), re.DOTALL))


def test_guide_plugin_is_short() -> None:
    code = "\n".join(blocks().values())
    assert 0 < len([line for line in code.splitlines() if line.strip()]) < 50


def test_guide_plugin_predicts_valid_depth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch")
    package = tmp_path / "my_depth"
    package.mkdir()
    for name, code in {**blocks(), "my_depth/network.py": NETWORK}.items():
        (tmp_path / name).write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    network = importlib.import_module("my_depth.network").Network()
    torch.save(network.state_dict(), tmp_path / "weights.pt")

    registry = Registry()
    registry.register(importlib.import_module("my_depth.plugin"))
    context = ProviderContext(resolve_weights=lambda uri, sha256: Path(uri))
    options = {"weights": str(tmp_path / "weights.pt")}
    provider = registry.create("depth", "my-depth", options, context)

    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    view = View("a.jpg", pixels, PinholeCamera(64, 48, 60, 60, 32, 24))
    prior = run_depth(registry.spec("depth", "my-depth"), provider, view)
    assert prior.shape == (48, 64)
    assert prior.valid.all()
