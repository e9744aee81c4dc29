"""Tiny models of the supported architectures with random weights, for tests."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
import transformers as hf

from mpsfm_transformers.hub import quiet

_MEAN, _STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
_SEED = 7
_ANGLE_DEG = 60.0


def dinov2(side: int = 56, **settings: Any) -> hf.Dinov2Config:
    """Create the configuration of a DINOv2 backbone with four layers."""
    return hf.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=side,
        patch_size=14,
        **settings,
    )


def _taps() -> hf.Dinov2Config:
    return dinov2(out_indices=[1, 2, 3, 4], apply_layernorm=True, reshape_hidden_states=False)


_DPT_HEAD = {"neck_hidden_sizes": [8, 8, 16, 16], "fusion_hidden_size": 8}
_ANYTHING = {"reassemble_hidden_size": 16, "head_hidden_size": 8, **_DPT_HEAD}
_STRETCHED = {
    "image_processor_type": "DPTImageProcessor",
    "size": {"height": 56, "width": 56},
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 14,
    "image_mean": _MEAN,
    "image_std": _STD,
}


def depth_anything(folder: Path, **settings: Any) -> Path:
    """Save a tiny Depth Anything V2, which is metric up to 20 m by default."""
    settings = {"depth_estimation_type": "metric", "max_depth": 20, **settings}
    config = hf.DepthAnythingConfig(backbone_config=_taps(), **_ANYTHING, **settings)
    return _save(hf.DepthAnythingForDepthEstimation, config, folder, _STRETCHED)


def prompt_depth_anything(folder: Path) -> Path:
    """Save a tiny Prompt Depth Anything."""
    config = hf.PromptDepthAnythingConfig(
        backbone_config=_taps(), depth_estimation_type="metric", max_depth=1, **_ANYTHING
    )
    processor = {**_STRETCHED, "image_processor_type": "PromptDepthAnythingImageProcessor"}
    return _save(hf.PromptDepthAnythingForDepthEstimation, config, folder, processor)


def dpt(folder: Path) -> Path:
    """Save a tiny DPT with a plain vision transformer."""
    config = hf.DPTConfig(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=64,
        backbone_out_indices=[0, 1, 2, 3],
        **_DPT_HEAD,
    )
    processor = {**_STRETCHED, "size": {"height": 64, "width": 64}, "keep_aspect_ratio": False}
    return _save(hf.DPTForDepthEstimation, config, folder, {**processor, "ensure_multiple_of": 1})


def dpt_dinov2(folder: Path) -> Path:
    """Save a tiny DPT with DINOv2, whose images are padded to multiples of 14 pixels."""
    backbone = dinov2(out_indices=[1, 2, 3, 4], reshape_hidden_states=False)
    config = hf.DPTConfig(backbone_config=backbone, use_bias_in_fusion_residual=False, **_DPT_HEAD)
    processor = {
        "image_processor_type": "DPTImageProcessor",
        "do_resize": False,
        "do_pad": True,
        "size_divisor": 14,
        "image_mean": _MEAN,
        "image_std": _STD,
    }
    return _save(hf.DPTForDepthEstimation, config, folder, processor)


def zoedepth(folder: Path) -> Path:
    """Save a tiny ZoeDepth with a BEiT backbone."""
    backbone = hf.BeitConfig(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=64,
        use_relative_position_bias=True,
        reshape_hidden_states=False,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )
    config = hf.ZoeDepthConfig(
        backbone_config=backbone,
        bottleneck_features=8,
        bin_embedding_dim=16,
        num_relative_features=4,
        **_DPT_HEAD,
    )
    processor = {
        "image_processor_type": "ZoeDepthImageProcessor",
        "size": {"height": 64, "width": 96},
        "ensure_multiple_of": 32,
        "keep_aspect_ratio": True,
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
    }
    return _save(hf.ZoeDepthForDepthEstimation, config, folder, processor)


def depth_pro(folder: Path) -> Path:
    """Save a tiny Depth Pro with its angle-of-view head, for images of 112 x 112 pixels."""
    encoder = dinov2(28)
    config = hf.DepthProConfig(
        fusion_hidden_size=16,
        patch_size=28,
        intermediate_hook_ids=[2, 0],
        intermediate_feature_dims=[8, 8],
        scaled_images_ratios=[0.25, 0.5, 1],
        scaled_images_overlap_ratios=[0.0, 0.5, 0.25],
        scaled_images_feature_dims=[8, 8, 8],
        merge_padding_value=0,
        use_fov_model=True,
        image_model_config=encoder,
        patch_model_config=encoder,
        fov_model_config=encoder,
    )
    processor = {
        "image_processor_type": "DepthProImageProcessor",
        "size": {"height": 112, "width": 112},
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
    }
    return _save(hf.DepthProForDepthEstimation, config, folder, processor)


def glpn(folder: Path) -> Path:
    """Save a tiny GLPN, whose maximum depth is 10 m."""
    config = hf.GLPNConfig(
        depths=[1, 1, 1, 1],
        hidden_sizes=[8, 8, 16, 16],
        num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=8,
    )
    processor = {"image_processor_type": "GLPNImageProcessor", "size_divisor": 32}
    return _save(hf.GLPNForDepthEstimation, config, folder, processor)


def superpoint_config(**settings: Any) -> hf.SuperPointConfig:
    """Create the configuration of a small SuperPoint with 32-dimensional descriptors."""
    settings = {"keypoint_threshold": 0.0, **settings}
    return hf.SuperPointConfig(
        encoder_hidden_sizes=[8, 8, 8, 8],
        decoder_hidden_size=16,
        descriptor_decoder_dim=32,
        **settings,
    )


def superpoint(folder: Path, **settings: Any) -> Path:
    """Save SuperPoint."""
    config = superpoint_config(**settings)
    return _save(hf.SuperPointForKeypointDetection, config, folder, {"do_resize": True})


def lightglue(folder: Path, dimension: int = 32) -> Path:
    """Save a tiny LightGlue for descriptors of the given dimension."""
    config = hf.LightGlueConfig(
        keypoint_detector_config=hf.SuperPointConfig(
            encoder_hidden_sizes=[8, 8, 8, 8],
            decoder_hidden_size=16,
            descriptor_decoder_dim=dimension,
        ),
        descriptor_dim=32,
        num_hidden_layers=2,
        num_attention_heads=2,
        filter_threshold=0.0,
        depth_confidence=-1.0,
        width_confidence=-1.0,
    )
    return _save(hf.LightGlueForKeypointMatching, config, folder, {"do_resize": True})


def superglue(folder: Path, dimension: int = 32) -> Path:
    """Save a tiny SuperGlue for descriptors of the given dimension."""
    config = hf.SuperGlueConfig(
        keypoint_detector_config=hf.SuperPointConfig(
            encoder_hidden_sizes=[8, 8, 8, 8],
            decoder_hidden_size=16,
            descriptor_decoder_dim=dimension,
        ),
        hidden_size=dimension,
        keypoint_encoder_sizes=[8, 16],
        gnn_layers_types=["self", "cross"],
        sinkhorn_iterations=5,
        matching_threshold=0.0,
    )
    return _save(hf.SuperGlueForKeypointMatching, config, folder, {"do_resize": True})


def efficient_loftr(folder: Path) -> Path:
    """Save a tiny Efficient LoFTR whose threshold accepts all matches."""
    config = hf.EfficientLoFTRConfig(
        stage_num_blocks=[1, 1, 1, 1],
        out_features=[16, 16, 32, 64],
        hidden_size=64,
        num_attention_layers=1,
        num_attention_heads=8,
        coarse_matching_threshold=0.0,
        fine_matching_slice_dim=4,
    )
    processor = {"do_resize": True}
    noise = (1, 2, 3, 128, 128)
    return _save(hf.EfficientLoFTRForKeypointMatching, config, folder, processor, noise)


def dino(folder: Path) -> Path:
    """Save DINOv2."""
    processor = {"image_mean": _MEAN, "image_std": _STD}
    return _save(hf.Dinov2Model, dinov2(), folder, processor)


def dinov3(folder: Path) -> Path:
    """Save DINOv3."""
    config = hf.DINOv3ViTConfig(
        hidden_size=16,
        num_hidden_layers=2,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=64,
        num_register_tokens=2,
    )
    return _save(hf.DINOv3ViTModel, config, folder, {"image_mean": _MEAN, "image_std": _STD})


DEPTH: Mapping[str, Callable[[Path], Path]] = {
    "depth-anything": depth_anything,
    "dpt": dpt,
    "dpt-dinov2": dpt_dinov2,
    "zoedepth": zoedepth,
    "depth-pro": depth_pro,
    "glpn": glpn,
}
"""Functions that save a tiny depth model, by architecture."""


def _save(
    family: Any,
    config: Any,
    folder: Path,
    processor: dict[str, Any],
    noise: tuple[int, ...] | None = None,
) -> Path:
    """Save random weights of an architecture in the published file format.

    ``noise`` is the shape of a random input that initializes the batch normalization statistics.
    Without initialized statistics, deep random layers have a constant output.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with torch.random.fork_rng(), quiet():
        torch.manual_seed(_SEED)
        model = family(config).eval()
        for name, parameter in model.named_parameters():
            if parameter.ndim > 1:
                torch.nn.init.xavier_uniform_(parameter, 0.1 if len(parameter) == 1 else 1.0)
            elif parameter.numel() > 1:
                torch.nn.init.uniform_(parameter, 0.0, 0.4)
            else:  # last layer's bias (depth or angle of view in degrees)
                torch.nn.init.constant_(parameter, _ANGLE_DEG if "fov" in name else 1.0)
        _see(model, noise)
        model.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(processor), encoding="utf-8")
    return folder


def _see(model: torch.nn.Module, noise: tuple[int, ...] | None) -> None:
    if noise is None:
        return
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.momentum = None
            module.train()
    with torch.inference_mode():
        model(torch.rand(noise))
    model.eval()
