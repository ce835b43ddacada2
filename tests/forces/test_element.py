"""The protocol of force elements: the sum, its order, and errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces import Element, Loads
from rbjax.forces.context import Context
from rbjax.model import with_constants
from tests.forces.elements import Lag, Wind
from tests.tolerances import F64_IDENTITY, relative_error


class Torque(Element):
    """A torque on the hinge, as an actuator's or not."""

    tau: jax.Array
    driven: bool = eqx.field(static=True, default=False)

    @property
    def actuates(self) -> bool:
        return self.driven

    def loads(self, context):
        return context.joint("hinge").push(self.tau)


class Pull(Element):
    """A force and a torque at a point of a body."""

    force: jax.Array
    torque: jax.Array
    point: jax.Array

    def loads(self, context):
        pole = context.body("pole")
        return pole.push(self.force, self.torque, at=pole.at(self.point).position)


class Everywhere(Element):
    """Generalized forces on all coordinates."""

    tau: jax.Array

    def loads(self, context):
        return context.generalized(self.tau)


def test_a_push_on_the_world_is_no_load():
    """It is no link's: its number, -1, would be the last link's among columns."""
    model = rb.load("cart_pole")
    context = Context.of(model, 0.0, model.default_state(), None)
    assert rb.forces.Place.on().frame(context).push(jnp.ones(3)) == Loads()


def test_generalized_forces_act_as_they_are():
    model, tau = rb.load("cart_pole"), jnp.array([3.0, -2.0])
    found = rb.applied_forces(model.with_forces(Everywhere(tau)), model.default_state())
    np.testing.assert_array_equal(found, tau)


def test_a_push_is_the_jacobian_transposed(key):
    """tau = J^T w at the point, with every driver."""
    model = rb.load("cart_pole")
    state = model.random_state(key)
    force, torque, point = (jnp.asarray(x) for x in np.random.default_rng(0).normal(size=(3, 3)))
    J = rb.jacobian(model, state.q, "pole", point)
    want = J.T @ jnp.concatenate([torque, force])
    plain = rb.applied_forces(model, state)
    for driver in ("unrolled", "rolled", "limbs"):
        acted = model.replace(driver=driver).with_forces(Pull(force, torque, point))
        found = rb.applied_forces(acted, state) - plain
        assert relative_error(found, want) < F64_IDENTITY


def test_wrenches_of_elements_are_those_of_forward_dynamics(key):
    """An element's push, as wrenches in world axes given to ABA, on every driver."""
    model = rb.load("quadrotor")
    state, air = model.random_state(key), jnp.array([3.0, 0.0, 1.0])
    velocity = rb.body_velocities(model, state.q, state.v)[0, 3:]
    wrench = jnp.zeros((1, 6)).at[0, 3:].set(2.0 * (air - velocity))
    tau = rb.applied_forces(model, state)
    want = rb.forward_dynamics(model, state.q, state.v, tau, wrench)
    acted = model.with_forces(Wind(air, jnp.array(2.0)))
    step = rb.step(acted, state, dt=1.0)
    assert relative_error(step.v - state.v, want) < F64_IDENTITY


def test_states_stand_in_the_order_of_the_elements():
    model = rb.load("cart_pole").with_forces(Lag(jnp.array(0.1)))
    model = model.with_forces(Wind(jnp.zeros(3), jnp.array(1.0)), Lag(jnp.array(0.5)))
    assert model.nx == 2
    np.testing.assert_array_equal(model.default_state().x, [0, 0])
    state = model.default_state().replace(x=jnp.array([1.0, 10.0]))
    np.testing.assert_array_equal(rb.applied_forces(model, state), [0.0, 11.0])
    after = rb.step(model, state, dt=0.01)
    np.testing.assert_allclose(after.x, [1.0 - 0.01 / 0.1, 10 - 0.01 * 10 / 0.5])
    # a state without x begins where the elements say
    assert rb.rollout(model, rb.State(state.q, state.v), None, 0.01, steps=2).x.shape == (3, 2)


def test_actuators_are_held_in_the_joints_ranges_and_absent_without_controls():
    model = rb.load("cart_pole")
    ranges = model.joints.forcerange.at[1].set(jnp.array([-2.0, 2.0]))
    model = model.replace(joints=model.joints.replace(forcerange=ranges))
    state, u = model.default_state(), jnp.zeros(1)
    passive = model.with_forces(Torque(jnp.array(5.0)))
    driven = model.with_forces(Torque(jnp.array(5.0), driven=True))
    assert rb.applied_forces(passive, state, u)[1] == 5.0
    assert rb.applied_forces(driven, state, u)[1] == 2.0
    assert rb.applied_forces(driven, state)[1] == 0.0


def test_loads_are_a_vector_space():
    a, b = Loads({0: 1.0, 1: 2.0}), Loads({1: 3.0})
    assert sum([a, b, -b], Loads()).tau[1] == 2.0
    assert sum([a, b]).tau == {0: 1.0, 1: 5.0}
    assert (2.0 * a).tau == {0: 2.0, 1: 4.0}


def test_a_model_with_constants_follows_what_is_changed(key):
    model = with_constants(rb.load("cart_pole"), jnp.float64)
    heavy = model.replace(bodies=model.bodies.replace(mass=2 * model.bodies.mass))
    q = model.random_state(key).q
    want = rb.load("cart_pole")
    want = want.replace(bodies=want.bodies.replace(mass=2 * want.bodies.mass))
    np.testing.assert_allclose(rb.mass_matrix(heavy, q), rb.mass_matrix(want, q))


class Silent(Element):
    def loads(self, context):
        return None


class Unmoved(Element):
    size = 2

    def loads(self, context):
        return Loads()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda m: m.with_forces(3.0), "with_forces: got float, expected Elements of rbjax.forces"),
        (lambda m: m.with_forces(Silent()), "Silent.loads returned NoneType, expected Loads"),
        (lambda m: m.with_forces(Pull(jnp.zeros(2), jnp.zeros(3), jnp.zeros(3))),
         r"push: a vector has shape \(2,\), expected \(3,\)"),
        (lambda m: m.with_forces(Everywhere(jnp.zeros(3))), r"has shape \(3,\), expected \(2,\)"),
        (lambda m: m.with_forces(Torque(jnp.zeros(2))), "push: got 2 forces on a hinge joint, exp"),
    ],
)  # fmt: skip
def test_wrong_elements_are_told_so(make, message):
    model = rb.load("cart_pole")
    with pytest.raises(rb.InputError, match=message):
        rb.applied_forces(make(model), model.default_state())


def test_an_element_that_does_not_move_its_state_is_told_so():
    model = rb.load("cart_pole").with_forces(Unmoved())
    with pytest.raises(NotImplementedError, match="Unmoved has a state of size 2, and no method"):
        rb.step(model, model.default_state())
    with pytest.raises(rb.UnknownName, match="body"):
        rb.applied_forces(
            rb.load("pendulum").with_forces(Pull(*jnp.zeros((3, 3)))),
            rb.load("pendulum").default_state(),
        )
