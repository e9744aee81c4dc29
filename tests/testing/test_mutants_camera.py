"""Tests that the contract checks of camera providers name each fault of a camera provider."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpsfm_core.providers import ProviderSpec
from mpsfm_core.providers.kinds.camera import CameraPrior
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing import CheckResult, run_checks
from mpsfm_core.testing.scaffold import write_plugin

Change = Callable[[Any, Any, Any], Any]
"""Function that changes the correct output, given the view and the correct provider."""


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProviderSpec]:
    """Return the specification of the template plugin, which is a correct camera provider."""
    folder = tmp_path_factory.mktemp("camera")
    write_plugin("camera-template", "camera", folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder / "camera-template"))
        (spec,) = importlib.import_module("camera_template.plugin").mpsfm_providers()
        yield spec


def scaled(prior: Any, focal: float = 1.0, std: float = 1.0) -> Any:
    return replace(
        prior, focal_px=focal * prior.focal_px, focal_std_px=std * focal * prior.focal_std_px
    )


def run_check(template: ProviderSpec, change: Change, id: str) -> CheckResult:
    """Run one contract check on the correct provider with a change of its output."""

    def factory(options: Any, context: Any) -> Any:
        module = importlib.import_module("camera_template.model")
        correct = module.CameraTemplate(options, context)

        class Changed:
            def calibrate(self, view: Any) -> Any:
                prior = correct.calibrate(view)
                return None if prior is None else change(prior, view, correct)

        return Changed()

    registry = Registry()
    capabilities = template.capabilities | {"estimates-radial"}
    registry.add(replace(template, factory=factory, capabilities=capabilities))
    (result,) = (r for r in run_checks(registry, "camera", template.name, only={id}))
    return result


def with_radial(prior: Any, radial: float = 0.0) -> Any:
    return replace(prior, radial=radial, radial_std=0.01)


@pytest.mark.parametrize(
    ("change", "check", "message"),
    [
        (lambda p, v, c: scaled(p, 1.3), "camera-focal", "the truth is 144.0 px"),
        (lambda p, v, c: scaled(p, 1 / p.focal_px), "camera-size", "at twice the image size"),
        (
            lambda p, v, c: scaled(p, 0.75 * v.camera.width / p.focal_px),
            "camera-focal",
            "the truth is 144.0 px",
        ),
        (lambda p, v, c: scaled(p, v.camera.fx / p.focal_px), "camera-guess", "twice the focal"),
        (lambda p, v, c: scaled(p, std=1 / p.focal_px), "camera-std", "at twice the image size"),
        (lambda p, v, c: scaled(p, std=20.0), "camera-std", "60% of the focal length"),
        (lambda p, v, c: replace(p, gravity=-p.gravity), "camera-gravity", "vector points up"),
        (
            lambda p, v, c: replace(p, gravity=p.gravity[[0, 2, 1]]),
            "camera-gravity",
            "degrees off",
        ),
        (
            lambda p, v, c: replace(p, gravity=p.gravity * (-1, 1, 1)),
            "camera-gravity",
            "degrees off",
        ),
        (
            lambda p, v, c: replace(p, gravity_std_deg=np.deg2rad(p.gravity_std_deg)),
            "camera-gravity",
            "is no std in degrees",
        ),
        (lambda p, v, c: with_radial(p, -0.2), "camera-radial", "-0.2 for a view without"),
        (lambda p, v, c: scaled(p, 25.0), "camera-size", "an angle of view of 3 degrees"),
        (lambda p, v, c: None, "camera-focal", "cannot tell"),
        (lambda p, v, c: replace(p, gravity=None), "output-rules", "must both be given"),
        (lambda p, v, c: p.focal_px, "output-rules", "must be a CameraPrior, got float"),
        (lambda p, v, c: scaled(p, std=0.0), "output-rules", "must be positive and finite"),
        (lambda p, v, c: replace(p, gravity=2 * p.gravity), "output-rules", "a unit vector"),
    ],
)
def test_check_names_fault_of_camera_provider(
    template: ProviderSpec, change: Change, check: str, message: str, tmp_path: Path
) -> None:
    def changed(prior: Any, view: Any, correct: Any) -> Any:
        return change(with_radial(prior), view, correct)

    result = run_check(template, changed, check)
    assert (result.status, message in result.message) == ("fail", True), result


def test_default_focal_length_of_black_view_fails(template: ProviderSpec) -> None:
    def factory(options: Any, context: Any) -> Any:
        module = importlib.import_module("camera_template.model")
        correct = module.CameraTemplate(options, context)

        class WithDefault:
            def calibrate(self, view: Any) -> Any:
                down = np.array([0.0, 1.0, 0.0])
                default = CameraPrior(200.0, 6.0, gravity=down, gravity_std_deg=2.0)
                return correct.calibrate(view) or default

        return WithDefault()

    registry = Registry()
    registry.add(replace(template, factory=factory))
    (result,) = run_checks(registry, "camera", template.name, only={"camera-focal"})
    assert result.status == "fail" and "below 10 % for a black view" in result.message


def test_gravity_that_is_not_mirrored_fails(template: ProviderSpec) -> None:
    fixed: list[Any] = []

    def change(prior: Any, view: Any, correct: Any) -> Any:
        fixed.append(prior.gravity)
        return with_radial(replace(prior, gravity=fixed[0]))

    result = run_check(template, change, "camera-mirror")
    assert result.status == "fail" and "gravity" in result.message
