"""Laws, integrators and force elements of a user that change the model's leaves change the motion:
no constant of the links that was computed before is used."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.aba import acceleration
from rbjax.motion.field import Field, free_motion
from tests.tolerances import F64_IDENTITY, relative_error

MODEL = rb.load("double_pendulum")
FACTOR = 2.0
#: programs under XLA take longer to compile
KERNELS = [True, pytest.param(False, marks=pytest.mark.slow)]


def heavier(model):
    """All masses doubled, by each way to change a pytree that is not `Model.replace`."""
    return eqx.tree_at(lambda m: m.bodies.mass, model, FACTOR * model.bodies.mass)


def lighter_gravity(model):
    return jax.tree.map(lambda x: x if x.shape != (3,) else x / FACTOR, model)


def law(change):
    def heavy_law(model, t, state, tau, f_ext):
        return free_motion(change(model), t, state, tau, f_ext)

    return heavy_law


def heavy_step(field, t, state, inputs, dt):
    field = Field(heavier(field.model), field.dynamics, field.dt)
    a, _ = field.rates(t, state, inputs)
    v = state.v + dt * a
    return rb.State(field.retract(state.q, dt * v), v, state.x)


class Lifted(rb.forces.Element):
    """The gravity forces of a model with other masses, against the gravity of this one."""

    def loads(self, context):
        return context.generalized(rb.gravity_forces(heavier(context.model), context.q))


def start(dtype, batch):
    state = rb.State(jnp.array([0.3, 1.0], dtype), jnp.zeros(2, dtype))
    return jax.tree.map(lambda x: jnp.stack([x] * batch), state) if batch else state


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("change", [heavier, lighter_gravity])
def test_a_law_that_changes_the_model_is_heeded(change, kernel, dtype):
    tau, model = jnp.ones((4, 2), dtype), MODEL.astype(dtype)
    for batch in (0, 1):
        state = start(dtype, batch)
        found = rb.rollout(model, state, None, 0.01, tau=tau, dynamics=law(change), kernel=kernel)
        want = rb.rollout(change(model), state, None, 0.01, tau=tau, kernel=kernel)
        assert relative_error(found.v, want.v) < (F64_IDENTITY if dtype == jnp.float64 else 1e-5)


@pytest.mark.slow
def test_simulate_heeds_it_too():
    state, ts = start(jnp.float64, 0), jnp.array([0.0, 0.03])
    found = rb.simulate(MODEL, state, ts, dynamics=law(heavier), tau=jnp.ones(2), dt=0.01)
    want = rb.simulate(heavier(MODEL), state, ts, tau=jnp.ones(2), dt=0.01)
    assert relative_error(found.v, want.v) < F64_IDENTITY


@pytest.mark.parametrize("kernel", KERNELS)
def test_an_integrator_that_changes_the_model_is_heeded(kernel):
    state, tau = start(jnp.float64, 0), jnp.ones((4, 2))
    found = rb.rollout(MODEL, state, None, 0.01, tau=tau, integrator=heavy_step, kernel=kernel)
    want = rb.rollout(heavier(MODEL), state, None, 0.01, tau=tau, kernel=kernel)
    assert relative_error(found.v, want.v) < F64_IDENTITY


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_force_element_that_changes_the_model_is_heeded(kernel):
    """Gravity of twice the masses, lifted: what is left is that of the masses, upwards."""
    state = start(jnp.float64, 0)
    found = rb.rollout(MODEL.with_forces(Lifted()), state, None, 0.01, steps=3, kernel=kernel)
    want = rb.rollout(MODEL.replace(gravity=-MODEL.gravity), state, None, 0.01, steps=1)
    assert relative_error(found.v[1], want.v[1]) < F64_IDENTITY


def test_a_gradient_by_masses_reaches_a_law_that_changes_zeros():
    """A law may change entries that are zero in the file, also if only some leaves are traced."""

    def beside(model):
        com = model.bodies.com.at[:, 1].set(0.1)
        return eqx.tree_at(lambda m: m.bodies.com, model, com)

    def end(mass, change_first):
        model = eqx.tree_at(lambda m: m.bodies.mass, MODEL, mass)
        model, how = (beside(model), free_motion) if change_first else (model, law(beside))
        return (
            rb.rollout(model, start(jnp.float64, 0), None, 0.01, steps=3, dynamics=how).v[-1].sum()
        )

    found, want = (jax.grad(end)(MODEL.bodies.mass, first) for first in (False, True))
    assert relative_error(found, want) < F64_IDENTITY


class Clipped(rb.forces.Element):
    """A state that grows, with an end, and pushes."""

    speed: jax.Array
    size = 1

    def loads(self, context):
        return context.joint("shoulder").push(context.x[0])

    def rate(self, context):
        return [self.speed]

    def within(self, x):
        return [jnp.clip(x[0], -1.0, 1.0)]


def explicit_euler(field, t, state, inputs, dt):
    a, x = field.rates(t, state, inputs)
    x = None if x is None else state.x + dt * x
    return rb.State(field.retract(state.q, dt * state.v), state.v + dt * a, x)


@pytest.mark.parametrize("integrator", [
    explicit_euler, "semi_implicit_euler", pytest.param("rk4", marks=pytest.mark.slow),
    pytest.param("variational_midpoint", marks=pytest.mark.slow),
])  # fmt: skip
@pytest.mark.parametrize("kernel", KERNELS)
def test_states_of_elements_end_each_step_in_their_ranges(integrator, kernel):
    model = MODEL.with_forces(Clipped(jnp.array(40.0)))
    for batch in (0, 1):
        state = start(jnp.float64, batch)
        x = jnp.zeros((batch, 1)) if batch else jnp.zeros(1)
        path = rb.rollout(
            model, state.replace(x=x), None, 0.01, steps=5, integrator=integrator, kernel=kernel
        )
        np.testing.assert_allclose(path.x[..., 0].reshape(-1)[:3], [0.0, 0.4, 0.8], atol=1e-12)
        assert path.x.max() == 1.0
    after = rb.step(model, rb.State(jnp.zeros(2), jnp.zeros(2), jnp.ones(1)), dt=0.1)
    assert after.x[0] == 1.0


def test_a_law_under_xla_takes_forces_that_are_constants():
    """Forces on links that are Python floats, as of a force that does not depend on the state."""

    class Steady(rb.forces.Element):
        force: jax.Array

        def loads(self, context):
            return context.body("lower").push(self.force)

    model = MODEL.with_forces(Steady(jnp.array([3.0, 0.0, 0.0])))
    state = start(jnp.float64, 4)

    def plain(model, t, state, tau, f_ext):
        return acceleration(model, state.q, state.v, tau, f_ext)

    def run(state, **how):
        return rb.rollout(model, state, None, 0.01, steps=2, **how).v

    found = jax.jit(lambda s: run(s, dynamics=plain, kernel=False))(state)
    assert relative_error(found, run(state)) < F64_IDENTITY


def test_a_batch_that_is_not_finite_is_said_once():
    stiff = MODEL.replace(joints=MODEL.joints.replace(stiffness=jnp.array([1e7, 0.0])))
    still = rb.State(jnp.zeros((4, 2)), jnp.zeros((4, 2)))
    state = still.replace(q=still.q.at[2:, 0].set(0.05))
    with pytest.warns(UserWarning, match="2 of 4 samples .* sample [23]; dt is 0.02 s") as caught:
        path = rb.rollout(stiff, state, None, 0.02, steps=400)
    assert len(caught) == 1 and path.success.tolist() == [True, True, False, False]
    said = str(caught[0].message)
    bad = ~np.isfinite(np.asarray(path.v)).all(-1).all(0)
    assert f"t = {float(path.ts[bad.argmax()]):.6g} s" in said
    stable = float(said.split("Take dt below ")[1].split(" s")[0])
    one = jax.tree.map(lambda x: x[3], state)
    assert rb.rollout(stiff, one, None, 0.5 * stable, steps=2000, save_every=2000).success
    with pytest.warns(UserWarning, match="not finite"):
        assert not rb.rollout(stiff, one, None, 4 * stable, steps=2000, save_every=2000).success


def test_within_a_program_it_is_a_value_only():
    blown = rb.State(jnp.ones(2), 1e200 * jnp.ones(2))
    assert not jax.jit(lambda s: rb.rollout(MODEL, s, None, 1.0, steps=3).success)(blown)
