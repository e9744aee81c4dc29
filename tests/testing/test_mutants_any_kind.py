"""Faults that a provider of any kind can have, shown with a depth provider."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mpsfm_core import DepthPrior, Options, ProviderContext, ProviderSpec, View
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import ContractSetup, run_checks
from mpsfm_core.testing.painted_views import read_depth
from tests.support.reference_providers import PaintedDepth, depth_prior

PAINTED = ContractSetup(truth_source="painted")


class Changed(PaintedDepth):
    """Depth of a correct provider, modified by :meth:`change`."""

    def predict(self, view: View) -> DepthPrior:
        return depth_prior(self.change(read_depth(view.image), view))

    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        raise NotImplementedError


class NotANumber(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        values = np.ones((4, 4), np.float32)
        prior = DepthPrior(values, None, np.ones((4, 4), bool))
        values[2, 2] = np.nan
        return prior


class Double(PaintedDepth):
    def predict(self, view: View) -> DepthPrior:
        return DepthPrior(np.ones((4, 4)), None, np.ones((4, 4), bool))


class BareArray(PaintedDepth):
    def predict(self, view: View) -> Any:
        return read_depth(view.image)


class Random(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        return depth * np.random.default_rng().uniform(0.999, 1.001)


class RandomWeights(Changed):
    """Fault: each instance has other random weights, because the weights are never loaded."""

    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        self.factor = np.random.default_rng().uniform(0.9, 1.1)

    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        return self.factor * depth


class Smoothed(Changed):
    """Fault: depth is filtered over time, as for a video."""

    scale = 1.0

    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        self.scale = 0.5 * self.scale + 0.5 * float(np.median(depth))
        return depth * self.scale / max(float(np.median(depth)), 1e-6)


class WritesToTheImage(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        image = view.image.view()
        image.flags.writeable = True
        image //= 2
        return depth


class GoesByName(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        return depth * len(view.name)


class SecretlyCanonical(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        return depth * view.camera.fx / 144.0


class SharedBuffer(Changed):
    """Fault: all instances write to one array of the class."""

    buffer = np.zeros((0, 0))

    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        SharedBuffer.buffer = depth
        time.sleep(0.05)
        return SharedBuffer.buffer


class LocalPrior(PaintedDepth):
    """Fault: the output has a local type that cannot be imported."""

    def predict(self, view: View) -> DepthPrior:
        class Mine(DepthPrior):
            pass

        prior = super().predict(view)
        return Mine(prior.depth, prior.variance, prior.valid)


class TriesTheNetwork(Changed):
    """Fault: works offline, but reports every view to a server."""

    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        with contextlib.suppress(OSError):
            socket.getaddrinfo("localhost", 443)
        return depth


class KeepsViews(Changed):
    def __init__(self, options: Any, context: ProviderContext) -> None:
        super().__init__(options, context)
        self.seen: list[np.ndarray] = []

    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        self.seen.append(view.image.astype(np.float32))
        return depth


class DriftsSlowly(PaintedDepth):
    """Fault: a running mean changes the output after several calls."""

    calls = 0

    def predict(self, view: View) -> DepthPrior:
        self.calls += 1
        prior = super().predict(view)
        if self.calls <= 8:
            return prior
        return replace(prior, depth=np.float32(1.001) * prior.depth)


class CropsToMask(PaintedDepth):
    """Fault: the map of the unmasked part of a view is returned as the map of the view."""

    def predict(self, view: View) -> DepthPrior:
        depth = read_depth(view.image)
        if view.mask is not None and view.mask.any():
            depth = depth[:, view.mask.any(axis=0)]
        return depth_prior(depth)


class LandscapeOnly(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        if view.camera.height > view.camera.width:
            raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")
        return depth


class LeavesPadding(PaintedDepth):
    """Fault: pads the image to multiples of 16 and does not crop the depth map."""

    def predict(self, view: View) -> DepthPrior:
        height, width = view.image.shape[:2]
        padded = np.pad(view.image, ((0, -height % 16), (0, -width % 16), (0, 0)), mode="edge")
        return depth_prior(read_depth(padded))


class DividesBySpread(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        if not np.ptp(view.image):
            raise ZeroDivisionError("division by zero")
        return depth


class NeedsColour(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        if (view.image == view.image[..., :1]).all():
            raise ValueError("no saturation")
        return depth


class NeedsTwoRows(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        return depth + 0 * np.gradient(depth)[0]


class NeedsWidth(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        if view.camera.width in range(2, 8):
            raise RuntimeError("kernel size can't be greater than actual input size")
        return depth


class TripsOverMasks(Changed):
    def change(self, depth: np.ndarray, view: View) -> np.ndarray:
        return depth if view.mask is None else depth * view.mask[::2]


@pytest.mark.parametrize(
    ("factory", "check", "message"),
    [
        (NotANumber, "output-rules", "depth: must be finite"),
        (Double, "output-rules", "depth: array must have dtype float32"),
        (BareArray, "output-rules", "must be a DepthPrior, got ndarray"),
        (Random, "deterministic", "the output in a second call differs"),
        (RandomWeights, "deterministic", "of a second instance"),
        (Smoothed, "no-state", "after other views"),
        (WritesToTheImage, "inputs-unchanged", "modifies its input image"),
        (GoesByName, "name-does-not-matter", "renamed view"),
        (SecretlyCanonical, "intrinsics-declared", "depends on the intrinsics"),
        (SharedBuffer, "threads", "in two parallel threads"),
        (LocalPrior, "pickles", "the answer cannot be pickled"),
        (TriesTheNetwork, "offline", "opens a network connection: localhost"),
        (KeepsViews, "memory-released", "retains 3.. kB per view"),
        (DriftsSlowly, "memory-released", "the output after .* calls differs"),
        (LandscapeOnly, "portrait", "mat1 and mat2"),
        (LeavesPadding, "odd-size", "shifted by .* px at the border|relative error"),
        (DividesBySpread, "flat", "division by zero"),
        (NeedsColour, "grayscale", "no saturation"),
        (NeedsColour, "sixteen-bit", "no saturation"),
        (NeedsTwoRows, "one-pixel", "Shape of array too small"),
        (NeedsWidth, "thin-view", "kernel size"),
        (TripsOverMasks, "masked", "broadcast"),
        (CropsToMask, "masked", "changes the output at pixels where the mask is True"),
    ],
)
def test_caught(caught: Callable[..., None], factory: type, check: str, message: str) -> None:
    caught("depth", factory, check, message, PAINTED)


def test_construction_failure_is_reported_once(caught: Callable[..., None]) -> None:
    def broken(options: Any, context: ProviderContext) -> None:
        raise RuntimeError("CUDA is not available")

    caught("depth", broken, "construction", "CUDA is not available", PAINTED)
    registry = Registry()
    registry.add(ProviderSpec("depth", "broken", broken))
    results = run_checks(registry, "depth", "broken")
    failed = {r.id for r in results if r.status == "fail"}
    assert failed == {"construction", "output-rules"}
    skipped = {r.message for r in results if r.status == "skip" and r.id != "light-import"}
    assert skipped == {"construction fails"}


def test_options_that_nobody_can_import(caught: Callable[..., None]) -> None:
    class Local(Options):
        factor: float = 1.0

    caught(
        "depth", PaintedDepth, "pickles", "the options cannot be pickled", PAINTED, options=Local
    )


def test_a_wrapper_of_nothing(caught: Callable[..., None]) -> None:
    caught("wrapper", PaintedDepth, "specification", "has to declare 'wraps-depth'")


def test_plugin_with_heavy_import_fails_its_check(install_plugin: Callable[..., str]) -> None:
    source = """
        import scipy
        from mpsfm_core import ProviderSpec, hookimpl
        @hookimpl
        def mpsfm_providers():
            factory = "tests.support.reference_providers:PaintedDepth"
            return [ProviderSpec("depth", "heavy", factory)]
    """
    install_plugin("mpsfm-heavy", source)
    (result,) = run_checks(Registry.discover(), "depth", "heavy", PAINTED, only={"light-import"})
    assert (result.status, result.message.split()[-1]) == ("fail", "scipy")


@pytest.mark.parametrize(
    ("statement", "status", "message"),
    [
        ("time.sleep(2.5)", "fail", "takes 2."),
        ("print('torch')", "pass", "s to import"),
        ("import os; os.write(1, b'torch scipy')", "pass", "s to import"),
    ],
)
def test_light_import_measures_time_and_ignores_output(
    statement: str, status: str, message: str, install_plugin: Callable[..., str]
) -> None:
    source = f"""
        import time
        from mpsfm_core import ProviderSpec, hookimpl
        {statement}
        @hookimpl
        def mpsfm_providers():
            factory = "tests.support.reference_providers:PaintedDepth"
            return [ProviderSpec("depth", "heavy", factory)]
    """
    install_plugin("mpsfm-heavy", source)
    (result,) = run_checks(Registry.discover(), "depth", "heavy", PAINTED, only={"light-import"})
    assert result.status == status and message in result.message, result.message
