"""What rows are made of, by closed forms of a few numbers."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.formulation import formulation_of
from rbjax.constraints.methods.recursive import reached_links
from rbjax.constraints.rows.functions import evaluate
from rbjax.constraints.rows.geometry import coordinate, distance, turn_z_to
from rbjax.constraints.rows.rolling import slip
from rbjax.forces import Loads
from rbjax.lanes import Vec3
from tests.constraints.rows import rows_at

RNG = np.random.default_rng(0)


def frame(first, **motion):
    """A frame that moves as given; a force on it is three generalized forces from `first` on."""
    names = ("position", "velocity", "acceleration", "angular_velocity", "angular_acceleration")
    moves = {name: Vec3(*motion.get(name, (0.0, 0.0, 0.0))) for name in names}

    def push(force, torque=None, at=None):
        return Loads({first + k: force[k] for k in range(3)})

    return SimpleNamespace(push=push, **moves)


@pytest.mark.parametrize("least", [0.0, 0.4])
def test_a_distance_and_its_derivatives(least):
    """sqrt(d.d + least^2) by differentiation along a path."""
    d, u, b = RNG.normal(size=(3, 3))
    row = distance(frame(0), frame(3, position=d, velocity=u, acceleration=b), least)
    length = np.sqrt(d @ d + least**2)
    np.testing.assert_allclose(row.value, length, rtol=1e-14)
    np.testing.assert_allclose(row.rate, d @ u / length, rtol=1e-13)
    second = (u @ u + d @ b) / length - (d @ u) ** 2 / length**3
    np.testing.assert_allclose(row.acceleration, second, rtol=1e-12)
    found = [float(row.gradient.tau[k]) for k in range(6)]
    np.testing.assert_allclose(found, np.concatenate([-d, d]) / length, rtol=1e-13)


def test_a_distance_of_zero():
    row = distance(frame(0), frame(3, velocity=(1.0, 2.0, 0.5)))
    assert (float(row.value), float(row.rate), float(row.acceleration)) == (0.0, 0.0, 0.0)
    assert all(float(row.gradient.tau[k]) == 0 for k in range(6))


def test_a_slip_is_opposed():
    """The force of a row on B, and the opposite one on A."""
    s = RNG.normal(size=3)
    zero, way = Vec3(0.0, 0.0, 0.0), Vec3(*s)
    u = RNG.normal(size=3)
    (row,) = slip(frame(0), frame(3, velocity=u), (zero, zero), [(way, zero)])
    np.testing.assert_allclose(row.rate, u @ s, rtol=1e-13)
    found = [float(row.gradient.tau[k]) for k in range(6)]
    np.testing.assert_allclose(found, np.concatenate([-s, s]), rtol=1e-15)


def test_a_coordinate_without_accelerations():
    joint = SimpleNamespace(start=2, q=[0.3, 0.4], v=[1.0, 2.0])
    context = SimpleNamespace(joint=lambda name: joint, a=None)
    row = coordinate(context, "elbow", 1)
    assert (row.value, row.rate, row.acceleration) == (0.4, 2.0, 0.0)
    context.a = [5.0, 6.0, 7.0, 8.0]
    assert coordinate(context, "elbow", 1).acceleration == 8.0


def test_z_is_turned_to_an_axis():
    """Also to one that points down, and to -z itself."""
    axes = np.array([[0.3, 0.5, 0.8], [0.3, -0.5, -2.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    q = jax.jit(jax.vmap(turn_z_to))(axes)
    found = Rotation.from_quat(q, scalar_first=True).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        found, axes / np.linalg.norm(axes, axis=1, keepdims=True), rtol=0, atol=1e-15
    )


def test_a_function_of_a_user_returns_its_numbers():
    found = evaluate("f", lambda t, k: [t, 2 * k], np.float64(3.0), (0.5,), (2,), jnp.float64)
    np.testing.assert_array_equal(found, [0.5, 6.0])


def test_a_torque_on_a_joint_reaches_what_it_carries():
    """In a chain of two links: below the upper one; a force from the world reaches both."""
    topology = rb.load("double_pendulum").topology
    assert reached_links(topology, Loads({1: 1.0})) == (0, frozenset({1}))
    assert reached_links(topology, Loads({0: 1.0, 1: 0.0})) == (-1, frozenset({0}))


def turned(t, q):
    """A(t, q) of a constraint on the rate of a pendulum."""
    return (t + jnp.sin(q))[None] * jnp.ones((1, 1))


def test_a_constraint_on_the_rate_by_differentiation():
    """y = A v and y' = (A_t + A_q v) v + A a; G at t = 0 where no time is given."""
    model = rb.load("pendulum").with_constraints(rc.Pfaffian(turned))
    q, v, a, t = 0.4, 0.7, -0.3, 0.3

    @jax.jit
    def found(q, v, a):
        (row,) = rows_at(model, q, v, t, a)[1]
        return row.rate, row.acceleration, rc.jacobian(model, q)

    rate, bent, G = found(*(jnp.array([x]) for x in (q, v, a)))
    np.testing.assert_allclose(rate, (t + np.sin(q)) * v, rtol=1e-14)
    np.testing.assert_allclose(bent, (1 + np.cos(q) * v) * v + (t + np.sin(q)) * a, rtol=1e-13)
    np.testing.assert_allclose(G, [[np.sin(q)]], rtol=1e-14)


def test_the_default_formulation_of_hard_and_of_soft_constraints():
    hard = rc.Pfaffian(turned)
    soft = rc.Soft(hard, [0.02, 1.0], [0.9, 0.95, 0.001, 0.5, 2.0], [1.0])
    kept, left, none = (
        formulation_of("f", SimpleNamespace(constraints=x), None) for x in ((hard,), (soft,), ())
    )
    assert left.name.startswith("compliant") and not kept.name.startswith("compliant")
    assert none is None


def test_the_index_of_formulations():
    """How often the constraints stand to be differentiated, for one of ordinary equations."""
    due = {"kkt": 1, "baumgarte": 1, "ggl": 2, "index_2": 2, "index_3": 3}
    found = {name: x.index for name, x in rc.formulations().items() if name in due}
    assert found == due


class Held(rc.Constraint):
    length: jax.Array = eqx.field(default=None)
    size = 1


def test_fields_of_constraints_are_numbers():
    with pytest.raises(rb.InputError, match=r"Held\(length=...\): got str"):
        Held("long")
    with pytest.raises(rb.InputError, match=r"Pfaffian\(A=...\): got int"):
        rc.Pfaffian(3)
