"""Tests of the download of MoGe-2, with a tiny ONNX file that has MoGe-2's tensors."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from mpsfm_onnx import plugin, providers
from mpsfm_onnx.contract import moge_stand_in
from mpsfm_onnx.description import Weights, load_description

from mpsfm_core import DepthPrior, ProviderSpec
from mpsfm_core.config import load_config
from mpsfm_core.data import PinholeCamera
from mpsfm_core.extraction.runner import extract
from mpsfm_core.inputs.images import load_images
from mpsfm_core.pipeline.provider_resolution import resolve_providers
from mpsfm_core.pipeline.run import reconstruct
from mpsfm_core.providers import weights
from mpsfm_core.providers.registry import Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration
from mpsfm_core.providers.weights import file_sha256
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from tests.support.file_server import serving

CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
PATH = "/moge-2/model.onnx"


class Constant:
    """Replacement of mpsfm-compact for tests where mpsfm-compact is not installed."""

    def __init__(self, options, context):
        pass

    def predict(self, view):
        return DepthPrior.from_arrays(np.ones((24, 32)), metric=False)


@pytest.fixture
def server(tmp_path, monkeypatch):
    """Serve the weights file of the description from a local HTTP server."""
    monkeypatch.setattr(weights, "_RETRY_WAIT_S", 0.001)
    for name in weights.OFFLINE_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    file = moge_stand_in(tmp_path / "moge.onnx")
    with serving() as server:
        server.files[PATH] = file.read_bytes()
        published = Weights(
            uri=server.url + PATH, sha256=file_sha256(file), size=file.stat().st_size
        )

        def load(name):
            return load_description(name).model_copy(update={"weights": published})

        monkeypatch.setattr(plugin, "load_description", load)
        monkeypatch.setattr(providers, "load_description", load)
        yield server


@pytest.fixture
def registry():
    registry = Registry.discover()
    if "compact" not in registry.names("depth"):
        coarse = DepthCalibration(relative_std=0.5)
        registry.add(ProviderSpec("depth", "compact", Constant, calibration=coarse))
    return registry


@pytest.fixture
def config(tmp_path, registry):
    settings = (
        f"runtime.cache_dir={tmp_path / 'cache'}",
        "runtime.workers=1",
        "features.use=sift",  # fast and deterministic
    )
    return load_config("default", settings, registry)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("moge") / "photos"
    folder.mkdir()
    for number, pose in enumerate(arc_poses(3, 12.0)):
        rendering = room_scene().render(CAMERA, pose)
        cv2.imwrite(str(folder / f"{number}.png"), rendering.rgb[..., ::-1])
    intrinsics = folder.with_suffix(".yaml")
    intrinsics.write_text("1: {params: [280, 280, 160, 120], images: all}\n")
    return folder, intrinsics


def test_first_use_fetches_and_the_next_one_does_not(server, registry, config, photos):
    provision = resolve_providers(config, registry)
    assert provision.config.depth.use == provision.config.normals.use == "moge-2-small"
    assert [path for path, _ in server.requests] == [PATH]
    report = extract(load_images(*photos), provision.config, registry).report["providers"]
    (depth,) = [line for line in report if line["kind"] == "depth"]
    assert (depth["name"], depth["computed"]) == ("moge-2-small", 3)
    assert not [line for line in report if line["kind"] == "normals"]  # computed with depth
    assert resolve_providers(config, registry).config == provision.config
    assert len(server.requests) == 1


@pytest.mark.parametrize("fault", ["cut connection", "wrong hash", "offline"])
def test_failed_download_uses_the_fallback(server, registry, config, photos, tmp_path, fault):
    if fault == "cut connection":
        server.cut_after = 0
    elif fault == "wrong hash":
        server.files[PATH] = server.files[PATH][:-1] + b"x"
    else:
        runtime = config.runtime.model_copy(update={"offline": True})
        config = config.model_copy(update={"runtime": runtime})
    folder, intrinsics = photos
    summary = reconstruct(folder, None, config, intrinsics=intrinsics, registry=registry).summary
    assert summary["status"] == "success"
    (depth,) = [line for line in summary["providers"] if line["block"] == "depth"]
    assert depth["name"] == "compact" and list(depth["passed_over"]) == ["moge-2-small"]
    assert PATH in depth["passed_over"]["moge-2-small"]["detail"]
