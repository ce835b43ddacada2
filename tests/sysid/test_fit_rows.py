"""Rows of the residual by column: three of an attitude, whatever its reading has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.rotations import quaternion
from rbjax.sysid import Grid, Setup, Unknown
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.setup import simulate_motion
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.statistics.fit_statistics import fit_statistics

N, SIGMA = 150, 1e-3
SOUGHT = {"inertia": Unknown("bodies.inertia", (0, 0, 0), positive=True)}


def tumbling(loss="squares", missing=False):
    """A free body whose q (7 columns) was read with noise of SIGMA m and rad about each axis."""
    setup, rng, grid = Setup.of(rb.load("free_body")), np.random.default_rng(0), Grid(0.02)
    start = rb.State(setup.model.default_state().q, jnp.array([0.1, 0, 0.2, 1.0, 2.0, 3.0]))
    path = simulate_motion(lambda p: setup, jnp.zeros(1), start, jnp.zeros((N, 0)), grid)
    at, turn = np.asarray(path.q[:, :3]), path.q[:, 3:]
    noise = SIGMA * rng.normal(size=(N + 1, 6))
    off = jax.vmap(quaternion.exp)(jnp.asarray(noise[:, 3:]))
    turned = np.asarray(jax.vmap(quaternion.multiply)(turn, off))
    q = np.concatenate([at + noise[:, :3], turned], 1)[None]
    weights = np.full_like(q, 1 / SIGMA)
    if missing:  # one number of an attitude is none
        weights[:, ::2, 4] = 0.0
    times = {"q": jnp.arange(N + 1)[None] * 0.02}
    run = Run(
        jax.tree.map(lambda a: a[None], start), jnp.zeros((1, N, 0)), times,
        {"q": jnp.asarray(q)}, {"q": jnp.asarray(weights)}, jnp.ones(1), jnp.ones(1),
    )  # fmt: skip
    of = SimulationError(setup, Unknowns.of("test", SOUGHT, setup), run, grid, loss=loss)
    return of, np.asarray(of.unknowns.read(setup))


@pytest.mark.parametrize("loss", ["squares", "huber"])
@pytest.mark.parametrize("missing", [False, True])
def test_an_attitude_has_three_degrees_of_freedom(loss, missing):
    """By its four numbers the noise would be 13 % too small: the root of 3/4."""
    of, x = tumbling(loss, missing)
    columns = of.columns(x, {"q"})
    assert [c.name for c in columns] == [f"q[{k}]" for k in range(6)]
    turns = (N + 1) // 2 if missing else N + 1
    assert [len(c.runs[0].psi) for c in columns] == 3 * [N + 1] + 3 * [turns]
    assert of.samples == 3 * (N + 1) + 3 * turns
    said = fit_statistics(["inertia"], x, columns)
    assert said.rows == of.samples and said.estimates.dof == pytest.approx(said.rows - 1)
    # 4 standard deviations of a scale of 75 or 151 samples; by all three axes 7 %
    rate = 1.0 if loss == "squares" else 0.843  # the root of the mean of psi^2 of normal noise
    scale = [said.scale[f"q[{k}]"] for k in range(3, 6)]
    assert np.sqrt(np.mean(np.square(scale))) == pytest.approx(rate, rel=0.13 if missing else 0.09)
