"""Motion in segments side by side against the motion at once: numbers, slopes, sweeps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import PD, Grid, Setup, Unknown
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation import parallel_in_time
from rbjax.sysid.simulation.parallel_in_time import simulate_windows
from rbjax.sysid.simulation.setup import simulate_motion

N = 50
SOUGHT = {
    "mass": Unknown("bodies.mass", positive=True), "damping": Unknown("joints.damping"),
    "delay": Unknown("delay"),
}  # fmt: skip


def both(setup: Setup, grid: Grid, count: int) -> list:
    """Motion and slopes at once and in segments, by (p, start)."""
    of = Unknowns.of("test", SOUGHT, setup)
    commands = jnp.asarray(np.random.default_rng(0).normal(size=(N, 1)))

    def slopes(count: int) -> list:
        def path(x: jax.Array) -> list[jax.Array]:
            start = rb.State(x[-2:-1], x[-1:])
            moved = simulate_motion(
                lambda p: of.write(setup, p), x[:-2], start, commands, grid, count=count
            )
            return [moved.q, moved.v, moved.ctrl]

        x = jnp.append(of.read(setup), jnp.array([0.3, -0.2]))

        along = jax.jit(jax.vmap(lambda e: jax.jvp(path, (x,), (e,)), out_axes=(None, 0)))
        return jax.tree.leaves(along(jnp.eye(x.size)))

    return [slopes(1), slopes(count)]


@pytest.mark.parametrize("kd", [8.0, 0.0])  # it forgets its start within a segment, or never does
def test_segments_are_one_motion(kd):
    servo = PD(jnp.array([20.0]), jnp.array([kd]))
    setup = Setup.of(rb.load("pendulum"), servo, delay=0.013)
    once, found = both(setup, Grid(0.02, 1, "rk4", 2), 7)  # the last segment is shorter
    for a, b in zip(once, found, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-11 * np.abs(a).max())


def counted(f, first, count: int) -> tuple[np.ndarray, int]:
    """x <- f(x) from one x to the next, and how many sweeps of segments that takes."""
    seen = []

    def segment(theta, begins, commands):
        jax.debug.callback(lambda k: seen.append(int(k)), begins[0])
        return jax.lax.scan(lambda x, u: (f(x) + u, f(x) + u), begins[1], commands)

    shown = simulate_windows(segment, None, first, jnp.zeros(8 * count), count)
    jax.effects_barrier()
    return np.asarray(shown), seen.count(0)


def test_how_many_sweeps():
    forgets, sweeps = counted(lambda x: 0.01 * x, jnp.ones(()), 6)
    np.testing.assert_allclose(forgets, 0.01 ** np.arange(1, 49), atol=1e-13)
    assert sweeps == 2  # all starts are zero to rounding after one
    keeps, sweeps = counted(lambda x: -x, jnp.ones(()), 6)
    np.testing.assert_array_equal(keeps, (-1.0) ** np.arange(1, 49))
    assert sweeps == 1  # the guess is right
    grows, sweeps = counted(lambda x: 2 * x, jnp.ones(()), 6)
    np.testing.assert_array_equal(grows, 2.0 ** np.arange(1, 49))
    assert sweeps == 6  # never before the last
    lost, sweeps = counted(lambda x: x * jnp.inf, jnp.ones(()), 6)
    assert sweeps == 6 and not np.isfinite(lost).any()


def test_few_samples_on_a_gpu_are_cut(monkeypatch):
    assert parallel_in_time.count_windows(8000, 4) == 1  # on a CPU
    monkeypatch.setattr(parallel_in_time, "has_gpu", lambda: True)
    assert parallel_in_time.count_windows(8000, 52) == 32
    assert parallel_in_time.count_windows(8000, 1000) == 8
    assert parallel_in_time.count_windows(8000, 100_000) == 1
    assert parallel_in_time.count_windows(130, 1) == 2
    assert parallel_in_time.count_windows(10, 1) == 1
