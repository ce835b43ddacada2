"""Every solver under jit, vmap, and both directions of differentiation."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.solvers.scenes import SOLVERS, flat, program, scene, solve
from tests.tolerances import F64_TRANSFORM, relative_error

DERIVATIVE = 1e-8  # reverse, forward, and a difference of fourth order with h = 2e-3
STEPS, H = 12, 2e-3
QUICK = "radau_iia2 pece3 rkmk3".split()  # noqa: SIM905
NAMES = [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in SOLVERS]


@pytest.mark.parametrize("name", NAMES)
def test_vmap_is_a_loop_and_derivatives_agree(name: str) -> None:
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
            s.term, solver, y0, s.args + x * dargs, s.end, STEPS, max_steps=32, adjoint=adjoint
        )
        return weight @ flat(found.ys)

    forward, reverse = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()

    @jax.jit
    def everything(xs):
        batch = jax.vmap(lambda x: end(x, forward))(xs)
        _, rate = jax.jvp(lambda x: end(x, forward), (xs[0],), (jnp.ones(()),))
        return batch, rate, jax.grad(lambda x: end(x, reverse))(xs[0])

    batch, rate, gradient = everything(np.array([0.0, H, -H, 2 * H, -2 * H]))
    loop = []
    for x in (0.0, H, -2 * H):
        y0 = jax.tree.map(lambda y, d, x=x: y + x * d, s.y0, dy)
        y, ok = program(name)(float(STEPS), s.end, y0, s.args + x * dargs)
        assert ok
        loop.append(weight @ np.asarray(y))
    assert relative_error(np.asarray(batch)[[0, 1, 4]], loop) < F64_TRANSFORM, "vmap"
    _, ahead, behind, ahead2, behind2 = (float(b) for b in batch)
    difference = (8 * (ahead - behind) - (ahead2 - behind2)) / (12 * H)
    assert abs(rate - gradient) <= DERIVATIVE * max(1, abs(rate)), "reverse is forward"
    assert abs(rate - difference) <= DERIVATIVE * max(1, abs(rate)), "forward is a difference"


@pytest.mark.parametrize("name", NAMES)
def test_a_step_compiled_is_a_step_op_by_op(name: str) -> None:
    s, solver = scene(name), SOLVERS[name].make()
    y0 = jax.tree.map(jnp.asarray, s.y0)

    def step(y0):
        t0, t1 = jnp.asarray(0.3), jnp.asarray(0.4)
        state = solver.init(s.term, t0, t1, y0, s.args)
        return flat(solver.step(s.term, t0, t1, y0, s.args, state, made_jump=False)[0])

    assert relative_error(step(y0), jax.jit(step)(y0)) < F64_TRANSFORM
