"""XFeat, ALIKED, DISK, DeDoDe and SIFT as feature providers.

Keypoints from kornia are in pixels of the resized image, with the center of the first pixel at (0,
0). Providers convert them to COLMAP pixels of the view by adding half a pixel and then scaling.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import nullcontext

import numpy as np
import torch
from kornia.color import rgb_to_grayscale
from kornia.feature import ALIKED, DISK, DeDoDe, SIFTFeature, XFeat, get_laf_center, scale_laf

from mpsfm_core import Features, ProviderContext, View
from mpsfm_core.providers.torch_runtime import (
    SkipRandomWeights,
    deterministic_algorithms,
    inference,
    use_threads,
)
from mpsfm_kornia.options import (
    AlikedOptions,
    DedodeOptions,
    DiskOptions,
    FeatureOptions,
    SiftOptions,
    XFeatOptions,
)
from mpsfm_kornia.runtime import Grid, is_inside_mask, load_state, load_weights

_SIFT_DIMENSION = 128
_Detections = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


class KorniaFeatures(ABC):
    """Base class of the feature providers that run a detector of kornia."""

    multiple = 1
    """The sides of the detector's network input are rounded to multiples of ``multiple`` pixels."""

    def __init__(self, options: FeatureOptions, context: ProviderContext) -> None:
        use_threads(context)
        self._options = options
        self._device = context.device

    @abstractmethod
    def _detect(self, image: torch.Tensor) -> _Detections:
        """Detect features in an image (1, 3, h, w), RGB in [0, 1].

        Returns:
            Keypoints (n, 2) in pixels of the resized image (center of the first pixel at (0, 0)),
            scores (n,) in [0, 1], and descriptors (n, d).
        """

    def extract(self, view: View) -> Features:
        """Extract the strongest keypoints inside the mask, sorted by decreasing score.

        The keypoint noise ``std_px`` is 1 pixel of the view, or one pixel of the resized image if
        that is larger.
        """
        grid = Grid.fit(view, self._options.resize, self.multiple)
        with inference():
            detections = self._detect(grid.image(view, self._device))
        xy, scores, descriptors = (tensor.float().cpu().numpy() for tensor in detections)
        keypoints = grid.to_view(xy.astype(np.float64) + 0.5)
        order = np.argsort(-scores, kind="stable")
        order = order[is_inside_mask(view, keypoints[order])][: self._options.max_keypoints]
        return Features(
            keypoints=keypoints[order],
            descriptors=descriptors[order],
            scores=np.clip(scores[order], 0, 1),
            std_px=max(1.0, grid.pixel_size),
        )


class XFeatFeatures(KorniaFeatures):
    """XFeat features, with image sides in multiples of 32 so that XFeat does not resize again."""

    multiple = 32

    def __init__(self, options: XFeatOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._network = XFeat(options.max_keypoints, options.detection_threshold)
        load_state(
            self._network.net,
            load_weights(context, options.weights, options.sha256),
            options.weights,
        )
        self._network.eval().to(self._device)

    def _detect(self, image: torch.Tensor) -> _Detections:
        output = self._network.detectAndCompute(image)[0]
        return output["keypoints"], output["scores"], output["descriptors"]


class AlikedFeatures(KorniaFeatures):
    """ALIKED features."""

    def __init__(self, options: AlikedOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._network = ALIKED(
            options.variant,
            max_num_keypoints=options.max_keypoints,
            detection_threshold=options.detection_threshold,
            nms_radius=options.nms_radius,
        )
        uri = options.weights_uri
        load_state(self._network, load_weights(context, uri, options.sha256), uri)
        self._network.to(self._device)

    def _detect(self, image: torch.Tensor) -> _Detections:
        output = self._network(image)[0]
        return output.keypoints, output.keypoint_scores, output.descriptors


class DiskFeatures(KorniaFeatures):
    """DISK features.

    DISK's keypoint heatmap h > 0 has no upper bound. The keypoint score is ``h / (1 + h)``, because
    the logistic function would saturate in float32.
    """

    def __init__(self, options: DiskOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._window = options.nms_window
        self._threshold = options.detection_threshold
        self._network = DISK()
        state = load_weights(context, options.weights, options.sha256)
        load_state(self._network, state.get("extractor", state), options.weights)
        self._network.to(self._device)

    def _detect(self, image: torch.Tensor) -> _Detections:
        output = self._network(
            image,
            n=self._options.max_keypoints,
            window_size=self._window,
            score_threshold=self._threshold,
            pad_if_not_divisible=True,
        )[0]
        heat = output.detection_scores
        return output.keypoints, heat / (1 + heat), output.descriptors


class DedodeFeatures(KorniaFeatures):
    """DeDoDe features, whose scores are keypoint probabilities that sum to 1 over the image."""

    def __init__(self, options: DedodeOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        with SkipRandomWeights():
            self._network = DeDoDe("L", "B", amp_dtype=torch.float32)
        for module, uri, sha256 in (
            (self._network.detector, options.detector_weights, options.detector_sha256),
            (self._network.descriptor, options.weights, options.sha256),
        ):
            load_state(module, load_weights(context, uri, sha256), uri)
        self._network.to(self._device)

    def _detect(self, image: torch.Tensor) -> _Detections:
        keypoints, scores, descriptors = self._network(image, n=self._options.max_keypoints)
        return keypoints[0] - 0.5, scores[0], descriptors[0]


class SiftFeatures(KorniaFeatures):
    """RootSIFT features, whose score is the contrast of the difference-of-Gaussians extremum."""

    def __init__(self, options: SiftOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._threshold = options.contrast_threshold
        self._network = SIFTFeature(
            options.max_keypoints,
            upright=options.upright,
            rootsift=True,
            device=torch.device(self._device),
        ).eval()

    def _detect(self, image: torch.Tensor) -> _Detections:
        gray, network = rgb_to_grayscale(image), self._network
        # The histograms of gradient orientations are sums in any order on a GPU.
        with deterministic_algorithms() if self._device != "cpu" else nullcontext():
            frames, contrast = network.detector(gray)
            # The detector fills up the keypoints with zeros, whose descriptors take time.
            clear = contrast[0] > self._threshold
            frames, contrast = frames[:, clear], contrast[0, clear]
            if not len(contrast):
                return get_laf_center(frames)[0], contrast, gray.new_zeros(0, _SIFT_DIMENSION)
            descriptors = network.descriptor(gray, scale_laf(frames, network.scaling_coef))
        return get_laf_center(frames)[0], contrast, descriptors[0]
