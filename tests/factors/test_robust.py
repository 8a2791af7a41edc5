from __future__ import annotations

import numpy as np
import pytest

from factors.robust import LossName, make_loss

LOSSES: list[LossName] = ["cauchy", "huber", "none"]


@pytest.mark.parametrize("name", LOSSES)
def test_weight_is_the_derivative_of_cost(name: LossName) -> None:
    loss = make_loss(name, 1.3)
    norm = np.array([1e-3, 0.2, 1.0, 1.25, 1.35, 4.0, 50.0])
    step = 1e-6
    derivative = (loss.cost((norm + step) ** 2) - loss.cost((norm - step) ** 2)) / (2.0 * step)
    np.testing.assert_allclose(loss.weight(norm**2) * norm, derivative, rtol=1e-6)


@pytest.mark.parametrize("name", LOSSES)
def test_is_least_squares_for_small_residuals(name: LossName) -> None:
    loss = make_loss(name, 2.0)
    np.testing.assert_allclose(loss.cost(np.array([1e-8])), 0.5e-8, rtol=1e-6)
    assert loss.cost(np.zeros(1)) == 0.0


@pytest.mark.parametrize("name", LOSSES)
def test_quadratic_model_stays_below_twice_the_cost(name: LossName) -> None:
    loss = make_loss(name, 0.7)
    squared = np.geomspace(1e-6, 1e6, 200)
    assert (2.0 * loss.cost(squared) >= loss.weight(squared) * squared * (1.0 - 1e-9)).all()


def test_bad_names_and_scales_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown robust loss"):
        make_loss("tukey", 1.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="positive"):
        make_loss("cauchy", 0.0)
