"""Constrained motion: the equations it solves, its derivatives, redundant rows, all drivers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.constrained_motion import constrained_motion


@functools.cache
def scene(driver: str) -> tuple[rb.Model, rb.State, jax.Array]:
    """An arm whose hand is on a line, with a spherical joint that is said twice."""
    model = rb.load("arm7").replace(driver=driver)
    state = model.random_state(jax.random.key(0))
    hand, elbow = model.body_names[6], model.body_names[3]
    line = rc.Inline.between(model, None, hand, point=[0.1, 0.2, 0.3], axis=[1, 2, -1], q=state.q)
    ball = rc.Spherical.between(model, None, elbow, point=[0.4, 0.2, 0.3], q=state.q)
    again = rc.Spherical.between(model, elbow, None, point=[0.4, 0.2, 0.3], q=state.q)
    tau = jax.random.normal(jax.random.key(1), (model.nv,))
    return model.with_constraints(line, ball, again), state, tau


def accelerations(model: rb.Model, q, v, tau):
    return constrained_motion(model, 0.0, rb.State(q, v), tau, {})


def textbook(model: rb.Model, state: rb.State, tau) -> tuple[np.ndarray, np.ndarray]:
    """a and l by dense matrices, l of least norm in the norm of diag(G M^-1 G^T)."""
    M, b = rb.mass_matrix(model, state.q), rb.bias_forces(model, state.q, state.v)
    G = rc.jacobian(model, state.q)

    def rate(s):
        return rc.residual(model, rb.State(rb.integrate(model, state.q, s * state.v), state.v)).rate

    bias = jax.jvp(rate, (0.0,), (1.0,))[1]
    M, b, G, bias = (np.array(x) for x in (M, b, G, bias))
    free = np.linalg.solve(M, tau - b)
    A = G @ np.linalg.solve(M, G.T)
    s = 1 / np.sqrt(np.diag(A))
    l = s * np.linalg.lstsq(s[:, None] * A * s, s * (-bias - G @ free), rcond=1e-9)[0]
    return free + np.linalg.solve(M, G.T @ l), l


@pytest.mark.parametrize("driver", ["unrolled", pytest.param("rolled", marks=pytest.mark.slow)])
def test_equations_and_redundant_rows(driver: str) -> None:
    model, state, tau = scene(driver)
    a, l = jax.jit(functools.partial(accelerations, model))(state.q, state.v, tau)
    want, multipliers = textbook(model, state, tau)
    np.testing.assert_allclose(a, want, atol=1e-10)
    # rows that are said twice share their force; rounding is divided by the proximal 1e-9
    np.testing.assert_allclose(l, multipliers, atol=1e-3)


def test_constrained_dynamics_with_wrenches_on_bodies() -> None:
    """The same as generalized forces; and as what the textbook has."""
    model, state, tau = scene("unrolled")
    wrenches = jax.random.normal(jax.random.key(2), (model.nb, 6))
    held = jax.jit(functools.partial(rc.constrained_dynamics, model))
    a, l = held(state.q, state.v, tau, wrenches)
    pushed = sum(
        np.asarray(rb.jacobian(model, state.q, body=name)).T @ w
        for name, w in zip(model.body_names, wrenches, strict=True)
    )
    want, multipliers = textbook(model, state, tau + pushed)
    np.testing.assert_allclose(a, want, atol=1e-9)
    np.testing.assert_allclose(l, multipliers, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("driver", ["unrolled", pytest.param("rolled", marks=pytest.mark.slow)])
def test_derivatives(driver: str) -> None:
    """Forward against differences, reverse against forward, by state, torque and model."""
    model, state, tau = scene(driver)
    keys = jax.random.split(jax.random.key(5), 4)
    dq, dv, dtau = (jax.random.normal(k, (model.nv,)) for k in keys[:3])
    w = jax.random.normal(keys[3], (model.nv,))

    def along(s):
        mass = model.bodies.mass * (1 + 0.1 * s)
        moved = model.replace(bodies=model.bodies.replace(mass=mass))
        q = rb.integrate(model, state.q, s * dq)
        return accelerations(moved, q, state.v + s * dv, tau + s * dtau)[0]

    forward = jax.jit(lambda s: jax.jvp(along, (s,), (1.0,)))
    value, slope = forward(0.0)
    h = 1e-5
    ends = [forward(s)[0] for s in (-h, h)]
    quotient = (ends[1] - ends[0]) / (2 * h)
    np.testing.assert_allclose(slope, quotient, rtol=1e-6, atol=1e-6 * np.abs(value).max())
    back = jax.jit(jax.grad(lambda s: along(s) @ w))(0.0)
    np.testing.assert_allclose(back, slope @ w, rtol=1e-9)


def test_a_user_s_constraint_and_the_default() -> None:
    """A mirror of two joints, written as its residual; the default holds it to rounding."""

    class Mirror(rc.Constraint):
        size = 1

        def rows(self, context):
            return [rc.coordinate(context, "shoulder") + rc.coordinate(context, "elbow")]

    model = rb.load("double_pendulum").with_constraints(Mirror())
    start = model.default_state().replace(q=jnp.array([0.5, -0.5]))
    path = rb.rollout(model, start, None, 1e-3, steps=200, integrator="rk4")
    assert path.success
    assert np.abs(path.q.sum(-1)).max() < 1e-15
    energy = rb.kinetic_energy(model, path.q[-1], path.v[-1]) + rb.potential_energy(
        model, path.q[-1]
    )
    assert abs(energy - rb.potential_energy(model, start.q)) < 1e-9


def test_a_model_without_constraints_carries_nothing() -> None:
    model = rb.load("four_bar")
    free = model.replace(constraints=())
    state = free.default_state()
    plain = rb.operation_count(lambda s: rb.step(free, s, dt=0.01), state)
    tree = rb.operation_count(lambda s: rb.forward_dynamics(free, s.q, s.v, s.v), state)
    held = rb.operation_count(lambda s: rb.step(model, s, dt=0.01), state)
    assert plain.total - tree.total <= 6 * model.nv < held.total - plain.total


def test_reactions_of_a_hanging_rod() -> None:
    """A rod at rest on two balls carries half its weight on each."""
    model = rb.load("""<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="rod">
      <freejoint/><inertial pos="0.5 0 0" mass="2" diaginertia="1 1 1"/>
    </body></worldbody></mujoco>""")
    ends = [rc.Spherical.between(model, None, "rod", point=[x, 0.0, 0.0]) for x in (0.0, 1.0)]
    model = model.with_constraints(*ends)
    found = rc.joint_wrenches(model, model.default_state())
    np.testing.assert_allclose(found[:, 5], 9.81, atol=1e-6)
    np.testing.assert_allclose(found[:, 1:5], 0.0, atol=1e-6)
    # six rows, of which two say how far the ends are apart: five are independent
    assert np.linalg.matrix_rank(rc.jacobian(model, model.default_state().q)) == 5


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda m, s: rb.rollout(m, s, None, 0.1, steps=1, constraints="kkkt"), "kkkt"),
        (
            lambda m, s: rb.rollout(
                m.replace(constraints=()), s, None, 0.1, steps=1, constraints="projected"
            ),
            "the model has none",
        ),
        (lambda m, s: m.with_constraints(rc.Spherical), "the class Spherical"),
        (
            lambda m, s: rb.step(m, s, dynamics=lambda model, t, state, tau, f_ext: tau,
                                 constraints="projected"),
            "a formulation is a dynamics",
        ),
    ],
)  # fmt: skip
def test_wrong_inputs(call, message: str) -> None:
    model = rb.load("four_bar")
    start = model.default_state()
    with pytest.raises((rb.InputError, rb.UnknownName), match=message):
        call(model, start)


def test_accelerations_start_from_free_motion() -> None:
    """At rest G a = 0, although the free motion of the tip is not along the line."""
    model = rb.load("double_pendulum")
    q, zero = jnp.array([0.7, -0.4]), jnp.zeros(2)
    tip = rc.Inplane.between(model, None, "lower", point=[0.0, 0.0, 1.2], q=q)
    model = model.with_constraints(tip)
    G = rc.jacobian(model, q)
    a, _ = accelerations(model, q, zero, zero)
    free = rb.forward_dynamics(model, q, zero, zero)
    assert abs(G @ free).max() > 0.1
    assert abs(G @ a).max() < 1e-7 < abs(a).max()


@pytest.mark.parametrize("factor", [rc.Baumgarte(3.0, 4.0), rc.KKT()], ids=lambda x: x.name)
def test_every_function_accepts_a_factor_of_a_formulation(factor):
    """`rollout` did; `acceleration`, `step` and `linearise` wanted a function."""
    model = rb.load(
        """<mujoco><worldbody><body name="bob"><joint name="x" type="slide" axis="1 0 0"/>
        <joint name="z" type="slide" axis="0 0 1"/><geom size="0.1"/></body></worldbody></mujoco>"""
    )
    distance = rc.Distance(rc.Place.on(), rc.Place.on(body="bob"), jnp.array(1.0))
    model, whole = model.with_constraints(distance), rc.formulation.as_formulation(factor)
    state = rb.State(jnp.array([0.6, -0.8]), jnp.array([0.4, 0.3]))
    for f in (
        lambda c: rb.acceleration(model, state, constraints=c),
        lambda c: rb.step(model, state, dt=0.01, constraints=c).v,
        lambda c: rb.linearise(model, state, constraints=c).A,
    ):
        np.testing.assert_array_equal(f(factor), f(whole))
