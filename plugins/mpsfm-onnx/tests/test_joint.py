"""Tests of one network for depth and normals, from the configuration to the priors."""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np
import pytest
import yaml
from mpsfm_onnx import contract
from mpsfm_onnx.network import Network

from mpsfm_core.config import load_config
from mpsfm_core.extraction.runner import extract
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.examples import outdoor_example

EXAMPLE = outdoor_example("painted")


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, example in (("a.png", EXAMPLE), ("b.png", EXAMPLE.partner)):
        cv2.imwrite(str(folder / name), example.view.image[..., ::-1])
    camera = EXAMPLE.camera
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    shared = {1: {"params": params, "images": "all"}}
    (tmp_path / "intrinsics.yaml").write_text(yaml.safe_dump(shared))
    return load_images(folder, tmp_path / "intrinsics.yaml")


@pytest.fixture
def runs(monkeypatch):
    """Count the forward passes of the network per image."""
    counts = Counter()
    run = Network.run

    def counted(network, view):
        counts[view.name] += 1
        return run(network, view)

    monkeypatch.setattr(Network, "run", counted)
    return counts


def priors(photos, folder, normals):
    """Compute the priors of the first image, with the provider of normals ``normals``."""
    options = dict(contract.setup(folder).options)
    chosen = {
        "extends": "demo",
        "depth": {"use": "onnx-joint", "options": options},
        "normals": {"use": normals, "options": options},
        "runtime": {"cache_dir": str(folder / normals), "workers": 1},
    }
    path = folder / f"{normals}.yaml"
    path.write_text(yaml.safe_dump(chosen))
    registry = Registry.discover()
    problem = extract(photos, load_config(path, (), registry), registry).problem
    return problem.images[0].depth, problem.images[0].normals


def test_network_runs_once_per_image(photos, runs, tmp_path):
    once = priors(photos, tmp_path, "onnx-joint")
    assert runs == {"a.png": 1, "b.png": 1}
    twice = priors(photos, tmp_path, "onnx")
    assert runs == {"a.png": 3, "b.png": 3}
    for one, other in zip(once, twice, strict=True):
        np.testing.assert_array_equal(one.variance, other.variance)
    np.testing.assert_array_equal(once[0].depth, twice[0].depth)
    np.testing.assert_array_equal(once[1].normals, twice[1].normals)
    assert once[0].valid.any() and once[1].valid.any()
