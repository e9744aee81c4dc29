"""The torch backend takes the same steps as the compiled kernels."""

import numpy as np
import pytest

from mpsfm_core.data import PinholeCamera
from mpsfm_core.optimize.depth_integration import DepthIntegrator, IntegrationOptions
from mpsfm_core.testing.scenes import arc_poses, room_scene
from tests.optimize.integration_problems import (
    camera_of,
    depth_prior,
    exact_anchors,
    normal_prior,
    random_problem,
    rendered,
)

torch_backend = pytest.importorskip("mpsfm_core.optimize.depth_integration_torch")


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (8, 1), (2, 2), (7, 6), (12, 17)])
def test_majoriser_and_steps_are_the_same(shape):
    depth, normals, anchors = random_problem(shape, 3, masked=0.2)
    integrator = DepthIntegrator(depth, normals, camera_of(shape))
    terms = integrator._terms(anchors, 1.0)
    kernels, tensors = integrator._solver(terms), torch_backend.TorchSolver(terms, "cpu")
    z = terms.prior.log_depth + np.random.default_rng(0).normal(0, 0.05, shape)
    ours, theirs = kernels.majorise(z), tensors.majorise(z)
    assert theirs.energy == pytest.approx(ours.energy, rel=1e-9, abs=1e-9)
    assert theirs.point_energy == pytest.approx(ours.point_energy, rel=1e-9, abs=1e-9)
    for name in ("gradient", "east", "south", "mass"):
        expected = getattr(ours, name)
        np.testing.assert_allclose(
            getattr(theirs, name).numpy(), expected, atol=1e-6 * np.abs(expected).max() + 1e-12
        )
    for iterations in (1, 2, 5):
        step, other = kernels.step(ours, iterations), tensors.step(theirs, iterations)
        assert other.iterations == step.iterations
        tolerance = 1e-4 * np.abs(step.x).max() + 1e-12
        np.testing.assert_allclose(other.x, step.x, atol=tolerance)


def test_refined_maps_agree():
    camera = PinholeCamera(97, 64, 88.0, 88.0, 48.0, 32.0)
    depth, normals = rendered(room_scene(), arc_poses(1, 0)[0], camera)
    rng = np.random.default_rng(0)
    prior = depth_prior(depth * np.exp(rng.normal(0, 0.02, depth.shape)))
    field = normal_prior(normals + rng.normal(0, 0.03, normals.shape))
    options = IntegrationOptions(max_iterations=4, tolerance=0.0)
    anchors = exact_anchors(depth, 60)
    kernels = DepthIntegrator(prior, field, camera, options)
    tensors = DepthIntegrator(prior, field, camera, options, torch_device="cpu")
    ours, theirs = kernels.refine(anchors), tensors.refine(anchors)
    assert theirs.energy == pytest.approx(ours.energy, rel=1e-3)
    assert theirs.iterations == ours.iterations
    assert np.sqrt(np.mean((theirs.log_depth - ours.log_depth) ** 2)) < 1e-3
    assert tensors.refine(anchors, start=theirs).skipped
