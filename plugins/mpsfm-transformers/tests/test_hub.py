"""Tests of reading model files of the Hub, and of the error messages."""

from __future__ import annotations

import shutil

import pytest
import torch
from mpsfm_transformers import stand_in
from mpsfm_transformers.depth import HubDepth
from mpsfm_transformers.options import DepthOptions, DinoOptions, look_up_model
from mpsfm_transformers.retrieval import Dino

from mpsfm_core import ProviderContext
from mpsfm_core.data.errors import WeightsError
from mpsfm_core.providers.weights import WeightStore, file_sha256

REPOSITORY = "org/depth-model"
REVISION = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return stand_in.depth_anything(tmp_path_factory.mktemp("model"))


@pytest.fixture
def hub_cache(model, tmp_path, monkeypatch):
    """Create the cache folder of the Hugging Face Hub with the model files."""
    cache = tmp_path / "hub"
    folder = cache / "models--org--depth-model"
    snapshot = folder / "snapshots" / REVISION
    shutil.copytree(model, snapshot)
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text(REVISION)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(cache))
    return snapshot


@pytest.mark.parametrize("name", [f"{REPOSITORY}@{REVISION}", REPOSITORY])
def test_offline_from_the_cache_of_the_hub(hub_cache, context, photo, model, name):
    here = HubDepth(DepthOptions(model=str(model)), context).predict(photo())
    there = HubDepth(DepthOptions(model=name), context).predict(photo())
    torch.testing.assert_close(torch.tensor(here.depth), torch.tensor(there.depth))


def test_files_of_two_caches(hub_cache, photo, tmp_path):
    """Check that weights and configuration may be in different cache folders."""
    store = WeightStore(tmp_path / "ours", offline=True)
    uri = f"hf://{REPOSITORY}@{REVISION}/model.safetensors"
    moved = store._cached_path(uri)
    moved.parent.mkdir(parents=True)
    shutil.move(hub_cache / "model.safetensors", moved)
    store._record(uri, moved, file_sha256(moved))
    context = ProviderContext(resolve_weights=store.resolve)
    provider = HubDepth(DepthOptions(model=f"{REPOSITORY}@{REVISION}"), context)
    assert provider.predict(photo()).valid.all()


def test_missing_model_raises(context):
    with pytest.raises(WeightsError, match=r"mpsfm models fetch hf://org/none@main/config\.json"):
        HubDepth(DepthOptions(model="org/none"), context)
    with pytest.raises(WeightsError, match=r"config\.json does not exist"):
        HubDepth(DepthOptions(model="./nowhere"), context)


def test_wrong_hash_raises(model, context):
    with pytest.raises(WeightsError, match="expected 0000"):
        HubDepth(DepthOptions(model=str(model), sha256="0" * 64), context)


def test_weights_of_another_model(model, context, tmp_path):
    folder = stand_in.depth_anything(tmp_path / "other")
    shutil.copy(stand_in.dpt(tmp_path / "dpt") / "model.safetensors", folder)
    with pytest.raises(WeightsError, match=r"does not fit config\.json"):
        HubDepth(DepthOptions(model=str(folder)), context)


def test_damaged_weights_raise(model, context, tmp_path):
    folder = shutil.copytree(model, tmp_path / "damaged")
    (folder / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(WeightsError, match="cannot be loaded by transformers"):
        HubDepth(DepthOptions(model=str(folder)), context)


def test_no_pickle_is_read(model, context, tmp_path):
    folder = shutil.copytree(model, tmp_path / "pickled")
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(WeightsError, match=r"model\.safetensors does not exist"):
        HubDepth(DepthOptions(model=str(folder)), context)


def test_no_code_of_a_repository_runs(model, context, tmp_path):
    folder = shutil.copytree(model, tmp_path / "code")
    (folder / "evil.py").write_text("raise SystemExit('ran')")
    text = (folder / "config.json").read_text()
    extra = '"auto_map": {"AutoModelForDepthEstimation": "evil.Evil"}, "model_type": "evil"'
    (folder / "config.json").write_text(text.replace('"model_type": "depth_anything"', extra))
    with pytest.raises(WeightsError, match="cannot be loaded by transformers"):
        HubDepth(DepthOptions(model=str(folder)), context)


def test_model_of_another_task_raises(context, tmp_path):
    with pytest.raises(WeightsError, match="cannot be loaded by transformers"):
        HubDepth(DepthOptions(model=str(stand_in.dino(tmp_path / "dino"))), context)


@pytest.mark.parametrize("make", [stand_in.dino, stand_in.dinov3])
def test_dino_descriptor_has_unit_length(context, photo, tmp_path, make):
    provider = Dino(DinoOptions(model=str(make(tmp_path / "dino")), resize=64), context)
    vector = provider.describe(photo())
    assert vector.shape == (16,)
    assert vector @ vector == pytest.approx(1, abs=1e-5)


def test_licenses_by_name():
    assert look_up_model("depth-anything/Depth-Anything-V2-Small-hf").license == "Apache-2.0"
    assert look_up_model("depth-anything/Depth-Anything-V2-Large-hf@abc").license == "CC-BY-NC-4.0"
    assert (
        look_up_model("depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf").license
        == "Apache-2.0"
    )
    assert "see its card" in look_up_model("org/name").license
