"""Every solver under jit, vmap, and both directions of differentiation."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.solvers.scenes import SOLVERS, flat, scene, solve
from tests.tolerances import F64_TRANSFORM, relative_error

DERIVATIVE = 1e-8  # reverse, forward, and a difference of fourth order with h = 2e-3
STEPS, H = 12, 2e-3
QUICK = ("radau_iia2",)
NAMES = [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in SOLVERS]


def transformed(name: str) -> tuple[np.ndarray, ...]:
    """A number at the end, under vmap and in a loop; its rate forward, in reverse, by differences.

    Two programs: forward mode under vmap, and reverse mode in a loop.
    """
    s, solver = scene(name), SOLVERS[name].make()
    rng = np.random.default_rng(0)
    dy = jax.tree.map(lambda x: 0.3 * rng.normal(size=x.shape), s.y0)
    if SOLVERS[name].kind == "lie":
        dy[0][0] = 0.0  # along the sphere, to first order
    dargs = 0.3 * rng.normal(size=s.args.shape)
    weight = rng.normal(size=s.exact.shape)

    def end(x, adjoint):
        y0 = jax.tree.map(lambda y, d: y + x * d, s.y0, dy)
        found = solve(
            s.term, solver, y0, s.args + x * dargs, s.end, STEPS, max_steps=16, adjoint=adjoint
        )
        return weight @ flat(found.ys), found.result == diffrax.RESULTS.successful

    forward, reverse = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()

    @jax.jit
    def everything(xs):
        ahead = lambda x: jax.jvp(  # noqa: E731
            lambda x: end(x, forward), (x,), (jnp.ones(()),), has_aux=True
        )
        back = jax.value_and_grad(lambda x: end(x, reverse), has_aux=True)
        return jax.vmap(ahead)(xs), jax.lax.map(back, xs[:3])

    xs = np.array([0.0, H, -2 * H, -H, 2 * H])
    (batch, rate, ok), ((loop, fine), gradient) = everything(xs)
    assert ok.all() and fine.all()
    _, ahead, behind2, behind, ahead2 = (float(b) for b in batch)
    difference = (8 * (ahead - behind) - (ahead2 - behind2)) / (12 * H)
    return np.asarray(batch[:3]), np.asarray(loop), rate[:3], gradient, difference


@pytest.mark.parametrize("name", NAMES)
def test_vmap_is_a_loop_and_derivatives_agree(name: str) -> None:
    batch, loop, rate, gradient, difference = transformed(name)
    assert relative_error(batch, loop) < F64_TRANSFORM, "vmap"
    assert relative_error(gradient, rate, floor=1.0) < DERIVATIVE, "reverse is forward"
    assert relative_error(difference, rate[0], floor=1.0) < DERIVATIVE, "forward is a difference"


def stepped(name: str) -> tuple[jax.Array, jax.Array]:
    """One step op by op, and compiled."""
    s, solver = scene(name), SOLVERS[name].make()
    y0 = jax.tree.map(jnp.asarray, s.y0)

    def step(y0):
        t0, t1 = jnp.asarray(0.3), jnp.asarray(0.4)
        state = solver.init(s.term, t0, t1, y0, s.args)
        return flat(solver.step(s.term, t0, t1, y0, s.args, state, made_jump=False)[0])

    return step(y0), jax.jit(step)(y0)


@pytest.mark.parametrize("name", NAMES)
def test_a_step_compiled_is_a_step_op_by_op(name: str) -> None:
    eager, compiled = stepped(name)
    assert relative_error(eager, compiled) < F64_TRANSFORM


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == "newmark" else pytest.mark.slow) for n in SOLVERS
     if n != "rigid_body_splitting"],
)  # fmt: skip
def test_a_gain_that_the_control_of_a_robot_closes_over(name: str) -> None:
    model, solver = rb.load("pendulum"), SOLVERS[name].make()
    start, ts = rb.State(jnp.array([0.5]), jnp.zeros(1)), jnp.array([0.0, 0.1])

    @functools.partial(jax.jit, static_argnums=1)
    def end(gain, adjoint=None):
        def control(t, state):
            return -gain * state.q

        found = rb.simulate(model, start, ts, control, solver=solver, dt=0.02, adjoint=adjoint)
        return found.q[-1, 0]

    back = jax.grad(end)(2.0)
    ahead = jax.jacfwd(lambda gain: end(gain, diffrax.ForwardMode()))(2.0)
    difference = (end(2.0 + H) - end(2.0 - H)) / (2 * H)
    assert abs(back) > 1e-4
    assert abs(back - ahead) < DERIVATIVE * abs(back)
    assert abs(back - difference) < 1e-5 * abs(back)  # of second order
