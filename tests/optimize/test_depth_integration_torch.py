"""The torch backend takes the same steps as the compiled kernels."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mpsfm_core.data import PinholeCamera
from mpsfm_core.optimize.depth_integration import NO_ANCHORS, DepthIntegrator
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
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
        tolerance = 1e-6 * np.abs(step.x).max() + 1e-12
        np.testing.assert_allclose(other.x, step.x, atol=tolerance)


def noisy_room(size, *, masked=False, unseen=False, points=60):
    """A room with noise; masked: a hole in both priors; unseen: one in the depth alone."""
    width, height = size
    camera = PinholeCamera(width, height, width / 1.1, width / 1.1, width / 2, height / 2)
    depth, normals = rendered(room_scene(), arc_poses(1, 0)[0], camera)
    rng = np.random.default_rng(0)
    known, seen = np.ones((2, *depth.shape), bool)
    rows, columns = slice(height // 3, height // 2), slice(width // 4, width // 2)
    if masked:
        known[rows, columns] = seen[rows, columns] = False
        known[:, :2] = seen[:, :2] = False
    if unseen:
        known[rows, columns] = False
    noise = gaussian_filter(rng.normal(size=depth.shape), 5)
    prior = depth_prior(depth * np.exp(0.06 * noise / noise.std()), 0.06, known)
    field = normal_prior(normals + rng.normal(0, 0.05, normals.shape), 0.08, seen)
    return prior, field, camera, exact_anchors(depth, points) if points else NO_ANCHORS


def random_case(shape):
    depth, normals, anchors = random_problem(shape, 5, masked=0.2)
    return depth, normals, camera_of(shape), anchors


CASES = {
    "even": lambda: noisy_room((128, 86)),
    "odd": lambda: noisy_room((133, 97), points=200),
    "no points": lambda: noisy_room((97, 64), points=0),
    "masked": lambda: noisy_room((121, 83), masked=True),
    "depth missing": lambda: noisy_room((122, 81), unseen=True),
    "one row": lambda: random_case((1, 61)),
    "one column": lambda: random_case((60, 1)),
    "one pixel": lambda: random_case((1, 1)),
    "rough": lambda: random_case((41, 38)),
}


@pytest.mark.parametrize("case", CASES)
def test_refined_maps_agree(case):
    prior, field, camera, anchors = CASES[case]()
    kernels = DepthIntegrator(prior, field, camera)
    tensors = DepthIntegrator(prior, field, camera, torch_device="cpu")
    ours, theirs = kernels.refine(anchors), tensors.refine(anchors)
    assert_agree(ours, theirs)
    assert tensors.refine(anchors, start=theirs).skipped
    moved = anchors._replace(depth=1.05 * anchors.depth)
    assert_agree(kernels.refine(moved, start=ours), tensors.refine(moved, start=theirs))


def assert_agree(ours, theirs):
    assert theirs.initial_energy == pytest.approx(ours.initial_energy, rel=1e-6, abs=1e-9)
    assert theirs.energy == pytest.approx(ours.energy, rel=1e-4, abs=1e-9)
    assert (theirs.iterations, theirs.cg_iterations) == (ours.iterations, ours.cg_iterations)
    assert (theirs.converged, theirs.skipped) == (ours.converged, ours.skipped)
    assert np.sqrt(np.mean((theirs.log_depth - ours.log_depth) ** 2)) < 1e-5
