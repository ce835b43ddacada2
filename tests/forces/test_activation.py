"""Activations: the exact step of a filter, ranges, and windings of a controlled angle."""

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.forces.activation import Filter, Integrator
from tests.forces.actuated import actuation, errors, limbs
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, F64_ROUNDING

FREE = jnp.array([-np.inf, np.inf])


def test_the_exact_filter_is_the_solution():
    lag = Filter(FREE, jnp.array(0.05), True)
    one, two = lag.advanced(2.0, jnp.array(-1.0), 0.02), jnp.array(-1.0)
    for _ in range(4):
        two = lag.advanced(2.0, two, 0.005)
    np.testing.assert_allclose(one, 2 - 3 * np.exp(-0.4), atol=F64_ROUNDING)
    np.testing.assert_allclose(one, two, atol=F64_ROUNDING)


def test_a_step_ends_within_the_range():
    winding = Integrator(jnp.array([-0.1, 0.2]))
    assert winding.advanced(9.0, jnp.array(0.0), 0.1) == 0.2
    assert winding.advanced(-9.0, jnp.array(0.0), 0.1) == -0.1


LAWS = [
    '<general joint="h" dyntype="integrator" actrange="-.2 .3" ctrlrange="-.5 .5" gainprm="3"/>',
    '<general joint="s" dyntype="filter" dynprm="0.07" actrange="-.2 .3" actearly="true"/>',
    '<general joint="k" dyntype="filterexact" dynprm="0.001" forcerange="-.2 .4"/>',
    '<position joint="k" kp="3" timeconst="0.1"/>',
    '<intvelocity joint="b" gear="1 2 3" kp="3" kv="0.1"/>',
    '<position joint="b" gear="1 -2 0.3" kp="3" kv="0.1"/>',
    '<position joint="b" gear="0.1 0.2 0" kp="3" timeconst="0.1"/>',
    '<general joint="b" gear="0.2 0.1 0.3" dyntype="filter" dynprm="0.1" gainprm="3"'
    ' biastype="affine" biasprm="0 -3" actearly="true"/>',
    '<intvelocity site="s4" refsite="s1" gear="0 0 0 0.3 0.2 1" kp="2" actrange="-6 8"/>',
    '<muscle tendon="rope" lengthrange="0.5 2.5" force="20" tausmooth="0.2"/>',
    '<cylinder joint="s" timeconst="0.2" area="2" bias="1 2 3"/>',
    '<general joint="h" dyntype="muscle" dynprm="0.01 0.04" gaintype="affine" gainprm="1 2 3"/>',
]


def test_against_mujoco():
    assert max(errors(limbs(*LAWS))) < F64_PARITY


def test_without_controls_nothing_moves_the_states():
    model = load_quietly(limbs(*LAWS[:2]))
    state = model.default_state().replace(x=jnp.array([0.1, 0.2]))
    run = jax.jit(actuation)
    tau, rate, after = run(model, state, None)
    np.testing.assert_array_equal(after, [0.1, 0.2])
    assert not np.any(tau) and not np.any(rate)
