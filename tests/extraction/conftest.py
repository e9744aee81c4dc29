"""Photos of a synthetic room, and ground-truth providers that count their calls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mpsfm_core.config import Config, RuntimeOptions
from mpsfm_core.data import (
    DenseMatches,
    DepthPrior,
    Features,
    NormalPrior,
    PairDepth,
    PairMatches,
    PinholeCamera,
    View,
)
from mpsfm_core.data.options import Options
from mpsfm_core.extraction.options import AdjustmentOptions
from mpsfm_core.extraction.runner import Extraction, extract
from mpsfm_core.inputs.images import load_images
from mpsfm_core.providers import ProviderContext, ProviderSpec
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 80.0, 60.0)
COUNT = 4
INTRINSICS = "1: {params: [140, 140, 80, 60], images: all}"


class FakeOptions(Options):
    """Options of the test providers; ``weights`` is a file that is part of the cache key."""

    flavour: int = 0
    weights: str = ""


class Truth:
    """Ground truth of the images, rendered once for all tests."""

    def __init__(self) -> None:
        self.names = [f"view{number}.png" for number in range(COUNT)]
        self.scene = room_scene()
        self.poses = dict(zip(self.names, arc_poses(COUNT, 10.0), strict=True))
        self.renderings = {
            name: self.scene.render(CAMERA, pose) for name, pose in self.poses.items()
        }


@dataclass
class World:
    """Images and providers. ``calls`` counts provider calls by ``(kind, image or pair)``.

    ``break_on`` has functions that return (or raise) a replacement of an output. ``made`` counts
    the constructed providers by kind.
    """

    truth: Truth
    root: Path
    calls: Counter[tuple[str, str]] = field(default_factory=Counter)
    break_on: dict[tuple[str, str], Callable[[], object]] = field(default_factory=dict)
    made: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.names, self.poses = self.truth.names, self.truth.poses
        self.scene = self.truth.scene
        self.registry = Registry.discover()
        self.cache = self.root / "cache"
        rng = np.random.default_rng(0)
        self.seeds = rng.uniform(0, 1, (400, 2)) * CAMERA.size
        for name in self.names:
            self.write(name, self.truth.renderings[name].rgb)
        (self.root / "intrinsics.yaml").write_text(INTRINSICS)
        self._register()

    def write(self, name: str, rgb: np.ndarray) -> None:
        (self.root / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(self.root / "images" / name), rgb[..., ::-1])

    def config(self, **changes: Any) -> Config:
        values: dict[str, Any] = {
            "features": ProviderConfig(use="truth"),
            "matcher": ProviderConfig(use="mutual-nearest"),
            "depth": ProviderConfig(use="truth"),
            "normals": ProviderConfig(use="truth"),
            "adjustment": AdjustmentOptions(enabled=False),  # true keypoints are exact
            "runtime": RuntimeOptions(cache_dir=self.cache, workers=2),
            **changes,
        }
        return Config(**values)

    def extract(self, events: Any = None, inputs: Any = None, **changes: Any) -> Extraction:
        config = self.config(**changes)
        images = load_images(self.root / "images", self.root / "intrinsics.yaml", None, inputs)
        return extract(images, config, self.registry, events)

    def asked(self) -> Counter[str]:
        """Return the number of provider calls by kind since the last call of this method."""
        counts: Counter[str] = Counter()
        for (kind, _), number in self.calls.items():
            counts[kind] += number
        self.calls.clear()
        return counts

    def count(self, kind: str, name: str) -> Any:
        self.calls[kind, name] += 1
        return self.break_on.get((kind, name), lambda: None)()

    def positions(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels and world coordinates of the shared 3D points that a view observes."""
        first = self.poses[self.names[1]]
        found = self.scene.correspondences(CAMERA, first, CAMERA, self.poses[name], self.seeds)
        return found.xy_b[found.visible], found.points[found.visible]

    def _register(self) -> None:
        def spec(kind: Any, name: str, cls: type, *capabilities: Any) -> ProviderSpec:
            def factory(options: FakeOptions, context: ProviderContext) -> object:
                self.made[kind] += 1
                return cls(self, options)

            return ProviderSpec(
                kind=kind,
                name=name,
                factory=factory,
                options=FakeOptions,
                capabilities=frozenset(capabilities),
            )

        self.registry.add(
            spec("features", "truth", TrueFeatures),
            spec("depth", "truth", TrueDepth, "metric"),
            spec("depth", "intrinsic", TrueDepth, "intrinsics-aware"),
            spec("depth", "joint", TrueJoint, "joint-normals"),
            spec("normals", "joint", TrueNormals),
            spec("normals", "truth", TrueNormals),
            spec("matcher", "dense", TrueDense, "dense"),
            spec("matcher", "dense-depth", TrueDenseDepth, "dense", "pair-depth"),
            spec("retrieval", "truth", TrueRetrieval),
            spec("mask", "left", LeftMask),
            version="1",
        )


@dataclass
class Fake:
    world: World
    options: FakeOptions


class TrueFeatures(Fake):
    """Feature provider: keypoints are projections of 3D points, descriptors their coordinates."""

    def extract(self, view: View) -> Features:
        self.world.count("features", view.name)
        xy, points = self.world.positions(view.name)
        return Features(xy, points.astype(np.float32))


class TrueDepth(Fake):
    def predict(self, view: View) -> DepthPrior:
        answer = self.world.count("depth", view.name)
        if answer is not None:
            return answer
        depth = self.world.truth.renderings[view.name].depth
        return DepthPrior.from_arrays(depth)


class TrueNormals(Fake):
    def predict(self, view: View, depth: DepthPrior | None = None) -> NormalPrior:
        self.world.count("normals", view.name)
        return true_normals(self.world, view)


class TrueJoint(TrueDepth):
    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        self.world.count("joint", view.name)
        return TrueDepth.predict(self, view), true_normals(self.world, view)


class TrueDense(Fake):
    """Dense matcher: ground-truth matches on a grid of 10 pixels."""

    def match(self, view_a: View, view_b: View, features_a=None, features_b=None) -> PairMatches:
        assert features_a is None and features_b is None
        self.world.count("dense", f"{view_a.name} {view_b.name}")
        columns, rows = np.meshgrid(np.arange(5.0, 160, 10), np.arange(5.0, 120, 10))
        xy = np.column_stack([columns.ravel(), rows.ravel()])
        poses = self.world.poses[view_a.name], self.world.poses[view_b.name]
        found = self.world.scene.correspondences(CAMERA, poses[0], CAMERA, poses[1], xy)
        seen = found.visible
        scores = np.linspace(0.5, 1, seen.sum(), dtype=np.float32)
        return PairMatches(dense=DenseMatches(xy[seen], found.xy_b[seen], scores, std_px=2.0))


class TrueDenseDepth(TrueDense):
    """Matcher with depth: the relative std is 10 % minus 1 % per image between the two images."""

    def match(self, view_a: View, view_b: View, features_a=None, features_b=None) -> PairMatches:
        found = super().match(view_a, view_b)
        names = self.world.names
        std = 0.1 - 0.01 * abs(names.index(view_a.name) - names.index(view_b.name))
        depths = []
        for view in (view_a, view_b):
            depth = self.world.truth.renderings[view.name].depth
            depths.append(DepthPrior.from_arrays(depth, (std * depth) ** 2))
        return PairMatches(dense=found.dense, depth=PairDepth(*depths))


class TrueRetrieval(Fake):
    """Retrieval provider: the descriptor is the camera's position on the arc."""

    def describe(self, view: View) -> np.ndarray:
        self.world.count("retrieval", view.name)
        angle = 0.3 * self.world.names.index(view.name)
        return np.array([np.cos(angle), np.sin(angle)], dtype=np.float32)


class LeftMask(Fake):
    """Mask provider: the left half, plus ``flavour`` pixel columns, is usable."""

    def mask(self, view: View) -> np.ndarray:
        self.world.count("mask", view.name)
        allowed = np.zeros((view.camera.height, view.camera.width), dtype=np.bool_)
        allowed[:, : view.camera.width // 2 + self.options.flavour] = True
        return allowed


def true_normals(world: World, view: View) -> NormalPrior:
    normals = world.truth.renderings[view.name].normals
    return NormalPrior.from_arrays(normals, np.full(normals.shape[:2], 0.01))


@pytest.fixture(scope="session")
def truth() -> Truth:
    return Truth()


@pytest.fixture
def world(truth: Truth, tmp_path: Path) -> World:
    return World(truth, tmp_path)


@pytest.fixture
def context() -> ProviderContext:
    return ProviderContext(resolve_weights=lambda uri, sha256: Path(uri))
