"""Training loop of the camera branch, with the other layers of the network frozen."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from training.camera_views import SIZES, CameraBatch, Panoramas, Renders, augmented, concatenate
from training.network import CompactNetwork

_RENDERED = 0.4
"""Share of rendered images in the training samples."""
_AVERAGE = 0.999
"""Decay of the exponential moving average of the weights."""
_WEIGHTS = {"focal": 1.0, "gravity": 1.0, "radial": 0.5, "up": 2.0, "error": 2.0}
_VALIDATION = 2048
"""Number of validation images."""


def train_camera(
    panoramas: Path,
    renders: Path | None,
    run: Path,
    start: Path,
    held_out: Sequence[str],
    steps: int,
    batch: int = 256,
    rate: float = 1e-3,
    minutes: float | None = None,
    seed: int = 0,
) -> None:
    """Train the camera branch on images cut from panoramas and from rendered images.

    Args:
        panoramas: Folder of upright equirectangular JPEGs.
        renders: Folder of rendered images, which may grow during training.
        run: Folder of the checkpoint ``camera.pt``.
        start: Weights of the network. Weights of the camera branch may be missing.
        held_out: File names of panoramas for validation.
        steps: Number of steps. The learning rate falls to zero along a cosine.
        batch: Number of images per step.
        rate: Largest learning rate.
        minutes: Time limit. The learning rate follows the time instead of ``steps`` if given.
        seed: Seed of the random images.
    """
    torch.manual_seed(seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = CompactNetwork()
    state = torch.load(start, map_location="cpu", weights_only=True)
    fresh = not any(name.startswith("calibration") for name in state)
    network.load_state_dict({k: v for k, v in state.items() if k[:6] != "focal."}, strict=not fresh)
    if fresh:
        network.calibration.begin(network.stages)
    network.to(device, memory_format=torch.channels_last).eval()
    branch = network.calibration
    mean = torch.optim.swa_utils.AveragedModel(
        branch, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(_AVERAGE), use_buffers=True
    )
    optimizer = torch.optim.AdamW(branch.parameters(), lr=rate, weight_decay=0.05)
    random = torch.Generator(device).manual_seed(seed)
    paths = sorted(panoramas.glob("*.jpg"))
    training = Panoramas([p for p in paths if p.name not in held_out], device, seed)
    judged = Panoramas([p for p in paths if p.name in held_out], device, 1)
    chunk = min(batch, 256)
    fixed = [
        judged.batch(chunk, SIZES[k % len(SIZES)]) for k in range(min(8, _VALIDATION // chunk))
    ]
    drawn = Renders(device, seed)
    run.mkdir(parents=True, exist_ok=True)
    print(f"{len(training)} panoramas, {len(judged)} for validation", flush=True)  # noqa: T201
    started, recent, share = time.monotonic(), dict[str, float](), 0.0
    step = 0
    while share < 1:
        elapsed = time.monotonic() - started
        share = (step + 1) / steps if minutes is None else max(1e-9, elapsed / (60 * minutes))
        for group in optimizer.param_groups:
            warm = min(1.0, (step + 1) / 200)
            group["lr"] = rate * warm * (0.5 + 0.5 * math.cos(math.pi * min(share, 1.0)))
        if renders is not None and step % 100 == 0:
            drawn.load(renders)
        size = SIZES[int(torch.randint(len(SIZES), (1,)))]
        rendered = round(_RENDERED * batch) if len(drawn) > batch else 0
        parts = [training.batch(batch - rendered, size)]
        parts += [drawn.batch(rendered, size)] if rendered else []
        samples = augmented(concatenate(parts), random)
        branch.train()
        terms = _losses(_predict(network, samples.image, device), samples)
        total = torch.stack([_WEIGHTS[name] * term for name, term in terms.items()]).sum()
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_(branch.parameters(), 1.0)
        optimizer.step()
        mean.update_parameters(branch)
        step += 1
        if step % 20 == 0:
            for name, term in terms.items():
                value = float(term.detach())
                recent[name] = 0.8 * recent.get(name, value) + 0.2 * value
        if step % 500 == 0 or share >= 1:
            text = " ".join(f"{name} {value:.3f}" for name, value in recent.items())
            scores = judge(network, mean.module, fixed, device)
            print(  # noqa: T201
                f"{step} {elapsed:.0f}s {len(drawn)} renders: {text} | {scores}", flush=True
            )
            weights = {k: v for k, v in network.state_dict().items() if k[:12] != "calibration."}
            weights |= {f"calibration.{k}": v for k, v in mean.module.state_dict().items()}
            torch.save(weights, run / "camera.part")
            (run / "camera.part").rename(run / "camera.pt")


@torch.inference_mode()
def judge(
    network: CompactNetwork,
    branch: nn.Module,
    batches: Sequence[CameraBatch],
    device: torch.device,
) -> str:
    """Describe median errors of a camera branch, and the share of errors within one std."""
    own, network.calibration = network.calibration, branch.eval()
    rows: dict[str, list[Tensor]] = {}
    for batch in batches:
        out = _predict(network, batch.image, device)
        errors = {
            "focal": ((out["log_focal"][:, 0] - batch.log_focal).abs(), out["log_focal_std"]),
            "gravity": (_angle(out["gravity"], batch.gravity), out["log_gravity_std"]),
            "radial": ((out["radial"][:, 0] - batch.radial).abs(), out["log_radial_std"]),
        }
        for name, (error, log_std) in errors.items():
            rows.setdefault(name, []).append(error)
            rows.setdefault(f"{name} within", []).append((error < log_std[:, 0].exp()).float())
    network.calibration = own
    values = {name: torch.cat(row) for name, row in rows.items()}
    return ", ".join(
        f"{name} {float(row.mean() if name.endswith('within') else row.median()):.3f}"
        for name, row in values.items()
    )


def _predict(network: CompactNetwork, image: Tensor, device: torch.device) -> dict[str, Tensor]:
    with torch.autocast(device.type, torch.bfloat16):
        return network.calibrate(image.contiguous(memory_format=torch.channels_last))


def _losses(out: dict[str, Tensor], batch: CameraBatch) -> dict[str, Tensor]:
    """Compute negative Laplace log-likelihoods, and errors of the up vectors and of the camera."""
    focal = (out["log_focal"][:, 0] - batch.log_focal).abs()
    gravity = _angle(out["gravity"], batch.gravity)
    radial = (out["radial"][:, 0] - batch.radial).abs()
    known = out["log_radial_std"][:, 0]
    return {
        "focal": _likelihood(focal, out["log_focal_std"][:, 0]),
        "gravity": _likelihood(gravity, out["log_gravity_std"][:, 0]),
        "radial": _likelihood(radial, known),
        "up": (out["up"] - batch.up).abs().mean(),
        "error": (focal + gravity).mean(),
    }


def _likelihood(error: Tensor, log_std: Tensor) -> Tensor:
    return (error * torch.exp(-log_std) + log_std).mean()


def _angle(first: Tensor, second: Tensor) -> Tensor:
    """Compute the angles (n,) in rad between unit vectors (n, 3), with finite gradients."""
    chord = (first - second).square().sum(1).clamp(min=1e-8).sqrt()
    return 2 * torch.asin((chord / 2).clamp(max=0.9999))
