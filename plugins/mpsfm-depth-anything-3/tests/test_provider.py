"""Comparison of the provider with the authors' inference code on the same random weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mpsfm_core import PinholeCamera, ProviderContext, View
from mpsfm_core.data.errors import WeightsError

torch = pytest.importorskip("torch")
pytest.importorskip("depth_anything_3", reason="pip install --no-deps depth-anything-3")

from mpsfm_depth_anything_3.contract import write_weights  # noqa: E402
from mpsfm_depth_anything_3.options import DepthAnything3Options, weights  # noqa: E402
from mpsfm_depth_anything_3.provider import DepthAnything3, network_of  # noqa: E402
from safetensors.torch import load_model  # noqa: E402

SIDE = 84


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_weights(tmp_path_factory.mktemp("weights") / "model.safetensors")


@pytest.fixture(scope="module")
def provider(file: Path, context: ProviderContext) -> DepthAnything3:
    return DepthAnything3(DepthAnything3Options(weights=str(file), resize=SIDE), context)


@pytest.fixture(scope="module")
def photos() -> list[Any]:
    folder = Path(__file__).resolve().parents[3] / "examples" / "sample_scene" / "images"
    return [cv2.cvtColor(cv2.imread(str(p)), cv2.COLOR_BGR2RGB) for p in sorted(folder.glob("*"))]


@pytest.fixture(scope="module")
def view(photos: list[Any]) -> Callable[..., View]:
    def make(index: int, width: int, height: int) -> View:
        image = cv2.resize(photos[index], (width, height), interpolation=cv2.INTER_AREA)
        camera = PinholeCamera(width, height, 100.0, 100.0, width / 2, height / 2)
        return View(f"{index}.jpg", image, camera)

    return make


def of_the_authors(file: Path, views: list[View]) -> Any:
    """Run the authors' ``DepthAnything3.inference`` in float32 on images that need no resizing.

    The authors' image loader needs torchvision, so this function repeats its steps.
    """
    network = network_of("da3-small")
    load_model(torch.nn.ModuleDict({"model": network}), file)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    images = [torch.from_numpy(v.image.copy()).permute(2, 0, 1).float() / 255 for v in views]
    batch = torch.stack([(i - mean[:, None, None]) / std[:, None, None] for i in images])[None]
    with torch.inference_mode():
        return network(batch)


def test_provider_equals_the_authors_inference(
    provider: DepthAnything3, file: Path, view: Callable[..., View]
) -> None:
    views = [view(index, 84, 56) for index in range(3)]
    group, theirs = provider.predict_group(views), of_the_authors(file, views)
    for index, prior in enumerate(group.depth):
        np.testing.assert_allclose(prior.depth, theirs.depth[0, index], rtol=1e-5)
        assert prior.variance is not None
        std = 0.2 * float(theirs.depth.mean()) / theirs.depth_conf[0, index]
        np.testing.assert_allclose(np.sqrt(prior.variance), std, rtol=1e-4)
    assert group.poses is not None and group.intrinsics is not None
    np.testing.assert_allclose(group.poses, theirs.extrinsics[0, :, :3], atol=1e-6)
    matrix = theirs.intrinsics[0, 0]
    expected = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    np.testing.assert_allclose(group.intrinsics[0], expected, rtol=1e-5)


def test_intrinsics_are_of_the_view(provider: DepthAnything3, view: Callable[..., View]) -> None:
    """Check that the principal point at the center of a resized and padded view stays there."""
    group = provider.predict_group([view(0, 168, 112), view(1, 84, 84)])
    assert group.intrinsics is not None
    np.testing.assert_allclose(group.intrinsics[:, 2:], [[84, 56], [42, 42]], atol=1e-3)
    assert [prior.shape for prior in group.depth] == [(56, 84), (84, 84)]


def test_only_the_nested_network_is_metric(
    provider: DepthAnything3, view: Callable[..., View]
) -> None:
    (prior,) = provider.predict_group([view(0, 84, 56)]).depth
    assert not prior.metric


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no tensors", "is not a safetensors file"),
        (None, "does not fit the network da3-base: size mismatch"),
    ],
)
def test_other_files(
    content: bytes | None, message: str, file: Path, tmp_path: Path, context: ProviderContext
) -> None:
    path = file
    if content is not None:
        path = tmp_path / "model.safetensors"
        path.write_bytes(content)
    network = "da3-small" if content else "da3-base"
    with pytest.raises(WeightsError, match=message):
        DepthAnything3(DepthAnything3Options(weights=str(path), network=network), context)


def test_published_weights_have_their_license() -> None:
    (file,) = weights(DepthAnything3Options(network="da3-giant"))
    assert (file.uri, file.license) == (
        "hf://depth-anything/DA3-GIANT@main/model.safetensors",
        "CC-BY-NC-4.0",
    )
    own = replace(weights(DepthAnything3Options(weights="a.safetensors"))[0], sha256=None)
    assert (own.uri, own.license) == ("a.safetensors", "unknown")


def test_provider_prints_nothing(
    file: Path, context: ProviderContext, view: Callable[..., View], capfd: Any
) -> None:
    provider = DepthAnything3(DepthAnything3Options(weights=str(file), resize=28), context)
    provider.predict_group([view(0, 28, 28)] * 3)
    assert capfd.readouterr() == ("", "")
