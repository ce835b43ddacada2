"""Equilibrium of a clamped beam under a dead force at its tip, and its frequencies."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb

BEAMS = json.loads((Path(__file__).parents[2] / "oracles" / "beams.json").read_text())
#: beta L of a cantilever, roots of cos x cosh x = -1
ROOTS = np.array([1.8751040687119611, 4.6940911329741746, 7.8547574382376126])
UNIFORM = {"bending": (1.0, 1.0), "mass": 1.0, "inertia": (2e-6, 1e-6, 1e-6)}


def tip_of(model, force, loads=10, iterations=8):
    """The tip (3,) at the equilibrium under a force (3,), by Newton's method along the loads."""

    def out_of_balance(q, dq, force):
        q = rb.integrate(model, q, dq)
        still = jnp.zeros(model.nv, q.dtype)

        def work(dq):
            return (rb.frame_pose(model, rb.integrate(model, q, dq), site="tip")[1] * force).sum()

        return -rb.applied_forces(model, rb.State(q, still)) - jax.grad(work)(still)

    @jax.jit
    def step(q, force):
        still = jnp.zeros(model.nv, q.dtype)
        residual = out_of_balance(q, still, force)
        tangent = jax.jacfwd(lambda dq: out_of_balance(q, dq, force))(still)
        return rb.integrate(model, q, -jnp.linalg.solve(tangent, residual)), residual

    q = model.default_state().q
    for share in np.linspace(0, 1, loads + 1)[1:]:
        for _ in range(iterations):
            q, residual = step(q, jnp.asarray(share * np.array(force), q.dtype))
    assert jnp.abs(residual).max() < 1e4 * jnp.finfo(q.dtype).eps
    return np.asarray(rb.frame_pose(model, q, site="tip")[1], float)


def elastica_error(model):
    """Error of the tip under P L^2 / EI = 10, of the worse of deflection and shortening, over L."""
    tip, want = tip_of(model, (0.0, 10.0, 0.0)), BEAMS["elastica_tip_load"]["table"]["10"]
    deflection, shortening = (float(want[k]) for k in ("v_over_L", "shortening_over_L"))
    return max(abs(tip[1] - deflection), abs(1 - tip[0] - shortening))


def frequencies(model):
    """All frequencies about the straight beam, rad/s, in rising order."""
    q, still = model.default_state().q, jnp.zeros(model.nv)

    def force(dq):
        return rb.applied_forces(model, rb.State(rb.integrate(model, q, dq), still))

    stiffness, mass = -jax.jacfwd(force)(still), rb.mass_matrix(model, q)
    return np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real))


def frequency_errors(model):
    """Relative errors of the first frequencies of bending in the plane."""
    found = frequencies(model)[:3]
    return found / ROOTS[: len(found)] ** 2 - 1
