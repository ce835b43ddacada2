"""Numbers that control refuses before it computes."""

import numpy as np
import pytest

import rbjax as rb
from rbjax import control
from rbjax.control.optimal.system import system_of


def test_an_integrator_is_for_a_model():
    system = control.Equations(lambda t, x, u: -x, 2, 1)
    assert system_of("f", system) is system
    for given in ({"integrator": "rk4"}, {"dynamics": 3}, {"constraints": "kkt"}):
        with pytest.raises(rb.InputError, match="f: integrator, dynamics and constraints are for"):
            system_of("f", system, **given)


def test_arguments_are_named():
    model = rb.load("pendulum")
    state, states = model.default_state(), rb.State(np.zeros((3, 1)), np.zeros((3, 1)))
    one, u = np.ones(1), np.zeros((2, model.nu))
    for dt in (0.0, -0.1, "x"):
        with pytest.raises(rb.InputError, match="time_varying_lqr: dt"):
            control.time_varying_lqr(model, states, u, dt, np.ones(2), one[: model.nu])
    with pytest.raises(rb.InputError, match=r"^feedback: ctrl has shape"):
        control.feedback(model, state, np.zeros(7), np.zeros((model.nu, 2)))
