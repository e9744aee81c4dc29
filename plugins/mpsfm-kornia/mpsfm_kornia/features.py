"""XFeat, ALIKED, DISK, DeDoDe and SIFT as feature providers.

kornia reports keypoints in a frame whose pixel centres are integers, on the image it was given.
Here they become COLMAP pixels of the view: half a pixel is added, then the size is scaled.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import torch
from kornia.color import rgb_to_grayscale
from kornia.feature import ALIKED, DISK, DeDoDe, SIFTFeature, XFeat, get_laf_center

from mpsfm_core import Features, ProviderContext, View
from mpsfm_core.providers.torch_runtime import inference, use_threads
from mpsfm_kornia.options import (
    AlikedOptions,
    DedodeOptions,
    DiskOptions,
    FeatureOptions,
    SiftOptions,
    XFeatOptions,
)
from mpsfm_kornia.runtime import Grid, fill, load_weights, usable

_Detections = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


class KorniaFeatures(ABC):
    """What the detectors share."""

    multiple = 1
    """The sides of the network's image are multiples of this."""

    def __init__(self, options: FeatureOptions, context: ProviderContext) -> None:
        use_threads(context)
        self._options = options
        self._device = context.device

    @abstractmethod
    def _detect(self, image: torch.Tensor) -> _Detections:
        """Keypoints (n, 2), scores (n,) in [0, 1] and descriptors (n, d) of a (1, 3, h, w) image.

        Keypoints are kornia's: the centre of the first pixel is (0, 0).
        """

    def extract(self, view: View) -> Features:
        """The strongest keypoints inside of the view's mask, best first.

        ``std_px`` is 1, or the size of a pixel of the resized image if that is more.
        """
        grid = Grid.fit(view, self._options.resize, self.multiple)
        with inference():
            found = self._detect(grid.image(view, self._device))
        xy, scores, descriptors = (tensor.float().cpu().numpy() for tensor in found)
        keypoints = grid.to_view(xy.astype(np.float64) + 0.5)
        order = np.argsort(-scores, kind="stable")
        order = order[usable(view, keypoints[order])][: self._options.max_keypoints]
        return Features(
            keypoints=keypoints[order],
            descriptors=descriptors[order],
            scores=np.clip(scores[order], 0, 1),
            std_px=max(1.0, grid.pixel_size),
        )


class XFeatFeatures(KorniaFeatures):
    """XFeat. Sides are multiples of 32, so that kornia's own resizing has nothing to do."""

    multiple = 32

    def __init__(self, options: XFeatOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._network = XFeat(options.max_keypoints, options.detection_threshold)
        fill(
            self._network.net,
            load_weights(context, options.weights, options.sha256),
            options.weights,
        )
        self._network.eval().to(self._device)

    def _detect(self, image: torch.Tensor) -> _Detections:
        found = self._network.detectAndCompute(image)[0]
        return found["keypoints"], found["scores"], found["descriptors"]


class AlikedFeatures(KorniaFeatures):
    """ALIKED."""

    def __init__(self, options: AlikedOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._network = ALIKED(
            options.variant,
            max_num_keypoints=options.max_keypoints,
            detection_threshold=options.detection_threshold,
            nms_radius=options.nms_radius,
        )
        uri = options.weights_uri
        fill(self._network, load_weights(context, uri, options.sha256), uri)
        self._network.to(self._device)

    def _detect(self, image: torch.Tensor) -> _Detections:
        found = self._network(image)[0]
        return found.keypoints, found.keypoint_scores, found.descriptors


class DiskFeatures(KorniaFeatures):
    """DISK. Its heatmap ``h > 0`` has no upper end; ``h / (1 + h)`` is the score, since the
    logistic function is 1 in float32 for nearly all of its keypoints."""

    def __init__(self, options: DiskOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._window = options.nms_window
        self._threshold = options.detection_threshold
        self._network = DISK()
        state = load_weights(context, options.weights, options.sha256)
        fill(self._network, state.get("extractor", state), options.weights)
        self._network.to(self._device)

    def _detect(self, image: torch.Tensor) -> _Detections:
        found = self._network(
            image,
            n=self._options.max_keypoints,
            window_size=self._window,
            score_threshold=self._threshold,
            pad_if_not_divisible=True,
        )[0]
        heat = found.detection_scores
        return found.keypoints, heat / (1 + heat), found.descriptors


class DedodeFeatures(KorniaFeatures):
    """DeDoDe. Its scores are probabilities of pixels, which are 1 together."""

    def __init__(self, options: DedodeOptions, context: ProviderContext) -> None:
        super().__init__(options, context)
        self._network = DeDoDe("L", "B", amp_dtype=torch.float32)
        for module, uri, sha256 in (
            (self._network.detector, options.detector_weights, options.detector_sha256),
            (self._network.descriptor, options.weights, options.sha256),
        ):
            fill(module, load_weights(context, uri, sha256), uri)
        self._network.to(self._device)

    def _detect(self, image: torch.Tensor) -> _Detections:
        keypoints, scores, descriptors = self._network(image, n=self._options.max_keypoints)
        return keypoints[0] - 0.5, scores[0], descriptors[0]


class SiftFeatures(KorniaFeatures):
    """RootSIFT. The score is the contrast that the detector maximises."""

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
        frames, contrast, descriptors = self._network(rgb_to_grayscale(image))
        clear = contrast[0] > self._threshold
        return get_laf_center(frames)[0][clear], contrast[0][clear], descriptors[0][clear]
