"""Parts of motion of a wheeled robot by closed forms of a few numbers."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.wheeled import RollingResistance, kinds
from rbjax.wheeled.files.reading import _mapping
from rbjax.wheeled.kinematics.parameters import parameters_of
from rbjax.wheeled.kinematics.velocities import chassis_twist
from rbjax.wheeled.models.forces import shaft_torques, wheel_loads
from rbjax.wheeled.multibody.tree import _array

UNICYCLE = kinds()["unicycle"].make(radius=0.2)


@pytest.mark.parametrize("steerability", [1, 2])
def test_two_leaders_turn_about_one_centre(steerability):
    """Neither slides sideways, and the second rolls ahead at the free speed."""
    p, q, b = np.array([0.0, 0.1]), np.array([2.0, 0.1]), 0.4
    e, f = np.array([1.0, 0.0]), np.array([np.cos(b), np.sin(b)])
    shape = SimpleNamespace(leaders=((tuple(p), tuple(e)), (tuple(q), tuple(f))))
    arrangement = SimpleNamespace(steerability=steerability)
    n = SimpleNamespace(robot=SimpleNamespace(arrangement=arrangement))
    x, y, w = map(float, chassis_twist(n, shape, [3.0]))
    for at, ahead in ((p, e), (q, f)):
        velocity = np.array([x - w * at[1], y + w * at[0]])
        np.testing.assert_allclose(velocity @ [-ahead[1], ahead[0]], 0.0, atol=1e-14)
    np.testing.assert_allclose(velocity @ f, 3.0, rtol=1e-13)


def test_rolling_resistance_of_loads_at_rest():
    """-c N r tanh(r phi' / u) on each shaft, besides the torques of the drives."""
    robot = UNICYCLE.replace(resistance=RollingResistance(0.02, 0.01))
    n = parameters_of(robot, jnp.float64)
    context, w = SimpleNamespace(n=n, u=[1.5, -0.5]), [0.0, 0.0, 0.0, 0.3, -0.2]
    found = [float(x) for x in shaft_torques(context, w)]
    loads = np.array([float(x) for x in wheel_loads(n)])
    r = np.array([float(wheel.radius) for wheel in robot.wheels])
    due = [1.5, -0.5] - 0.02 * loads * r * np.tanh(r * w[3:] / 0.01)
    np.testing.assert_allclose(found, due, rtol=1e-13)
    assert (np.abs(loads[0] * r[0]) > 1).all()


def test_a_robot_as_a_system_keeps_its_states():
    vehicle = rb.wheeled.at(UNICYCLE, "reduced")
    system = rb.wheeled.controlled(vehicle)
    state = rb.State(jnp.arange(1.0, vehicle.nq + 1), jnp.zeros(vehicle.nv), jnp.zeros(vehicle.nx))
    np.testing.assert_array_equal(system.checked("f", state).q, state.q)
    bare = rb.State(state.q, state.v, None)
    np.testing.assert_array_equal(system.minus(state, bare), np.zeros(system.n))


def test_lanes_some_of_which_are_traced_become_an_array():
    found = jax.jit(lambda x: _array([[1.0, x], [0.5]], jnp.float64))(3.0)
    np.testing.assert_array_equal(found, [1.0, 3.0, 0.5])
    assert isinstance(_array([[1.0, 2.0]], jnp.float64), np.ndarray)


def test_names_of_what_is_not_there():
    for wrong in ("nope", 3):
        with pytest.raises(rb.UnknownName, match=f"fidelity '?{wrong}"):
            rb.wheeled.at(UNICYCLE, wrong)
    with pytest.raises(rb.UnknownName, match="did you mean 'reduced'"):  # a book's word
        rb.wheeled.at(UNICYCLE, "kinematical")
    with pytest.raises(rb.InputError, match="from_file: radius is 3, expected a mapping"):
        _mapping("radius", 3)
