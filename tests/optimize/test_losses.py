"""Tests of robust losses: values, weights, and equality of arrays and kernels."""

import numpy as np
import pyceres
import pytest

from mpsfm_core.optimize.losses import LOSSES, Loss, evaluate_loss

S = np.array([0.0, 1e-8, 0.3, 2.0, 2.2499, 2.2501, 40.0, 1e12])
SCALE = 1.5


@pytest.mark.parametrize("loss", Loss)
def test_losses_of_kernels_equal_those_of_arrays(loss: Loss) -> None:
    values, weights = LOSSES[loss](S, SCALE)
    scalar = np.array([evaluate_loss(int(loss), s, SCALE) for s in S])
    np.testing.assert_allclose(scalar, np.column_stack([values, weights]), rtol=1e-14)


@pytest.mark.parametrize("loss", Loss)
def test_weight_equals_derivative_of_loss(loss: Loss) -> None:
    s = S[S > 0]
    step = 1e-6 * s
    slope = (LOSSES[loss](s + step, SCALE)[0] - LOSSES[loss](s - step, SCALE)[0]) / (2 * step)
    np.testing.assert_allclose(LOSSES[loss](s, SCALE)[1], slope, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("loss", Loss)
def test_loss_is_bounded_by_least_squares(loss: Loss) -> None:
    values, weights = LOSSES[loss](S, SCALE)
    assert (values[0], weights[0]) == (0, 1)
    assert (values <= S * (1 + 1e-12)).all()
    assert (np.diff(values) >= 0).all()


@pytest.mark.parametrize(
    ("loss", "name"), [(Loss.SOFT_L1, "soft_l1"), (Loss.CAUCHY, "cauchy"), (Loss.TRIVIAL, None)]
)
def test_loss_equals_ceres(loss: Loss, name: str | None) -> None:
    """The loss is the cost of a problem with one residual, because Ceres exposes no loss values."""

    class Constant(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(1)
            self.set_parameter_block_sizes([1])

        def Evaluate(self, parameters, residuals, jacobians):  # type: ignore[no-untyped-def]
            residuals[0] = parameters[0][0]
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][0] = 0.0
            return True

    ceres_loss = pyceres.LossFunction({"name": name, "params": [SCALE]}) if name else None
    for s in S[:-1]:
        problem, cost, x = pyceres.Problem(), Constant(), np.array([np.sqrt(s)])
        problem.add_residual_block(cost, ceres_loss, [x])
        options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
        options.minimizer_progress_to_stdout = False
        pyceres.solve(options, problem, summary)
        expected = 0.5 * LOSSES[loss](np.array(s), SCALE)[0]
        assert summary.initial_cost == pytest.approx(expected, rel=1e-9, abs=1e-15)
