"""Smooth problems on which orders are measured, one a kind of solver, and one program a solver.

References come from SciPy's Dormand-Prince 8 in NumPy, which shares nothing with rbjax. Problems
made for a known solution would not do: it depends on no parameter, and derivatives by these are
tested too. `rb.stability.measured_order` has problems of its own: neither is taken from the other.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import rbjax as rb

SOLVERS = rb.solvers.all()


def relaxation(t, y, args):
    """Prothero and Robinson's, with a quadratic term: exact solution cos t from y = 1."""
    rate, bend, _ = args
    return rate * (y - jnp.cos(t)) * (1 + bend * y) - jnp.sin(t)


def pendulum(t, y, args):
    """Pushed and damped."""
    stiffness, push, damping = args
    q, v = y
    return v, -stiffness * jnp.sin(q) + push * jnp.cos(t) - damping * v


INERTIA = np.array([1.0, 2.0, 3.5])


def torque(t, turn, args):
    """Of gravity on a body held beside its centre, and a push."""
    weight, push, _ = args
    w, x, y, z = turn
    down = jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    arm = jnp.array([0.0, 0.2, 1.0])
    return weight * jnp.cross(down, arm) + push * jnp.sin(t) * jnp.array([1.0, 0.0, 0.5])


@dataclass(frozen=True)
class Scene:
    """A term, an initial state, parameters, and the same equations for SciPy."""

    term: Any
    y0: Any
    args: np.ndarray
    end: float
    plain: Callable[[float, np.ndarray], np.ndarray]

    @functools.cached_property
    def exact(self) -> np.ndarray:
        start = np.concatenate([np.ravel(x) for x in jax.tree.leaves(self.y0)])
        found = solve_ivp(
            self.plain, (0.0, self.end), start, method="DOP853", rtol=3e-14, atol=1e-14
        )
        assert found.success
        return found.y[:, -1]


def _plain_relaxation(t, y):
    return -1.0 * (y - np.cos(t)) * (1 + 0.5 * y) - np.sin(t)


def _plain_pendulum(t, x):
    q, v = x
    return np.array([v, -2.0 * np.sin(q) + 0.5 * np.cos(t) - 0.3 * v])


def _plain_body(t, x):
    w, a, b, c = x[:4]
    rate = x[4:]
    turned = 0.5 * np.array(
        [
            -a * rate[0] - b * rate[1] - c * rate[2],
            w * rate[0] + b * rate[2] - c * rate[1],
            w * rate[1] + c * rate[0] - a * rate[2],
            w * rate[2] + a * rate[1] - b * rate[0],
        ]
    )
    down = np.array([2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)])
    moment = 2.0 * np.cross(down, [0.0, 0.2, 1.0]) + 0.4 * np.sin(t) * np.array([1.0, 0.0, 0.5])
    return np.concatenate([turned, (np.cross(INERTIA * rate, rate) + moment) / INERTIA])


PENDULUM = Scene(
    diffrax.ODETerm(pendulum),
    (np.array([1.0]), np.array([0.3])),
    np.array([2.0, 0.5, 0.3]),
    2.0,
    _plain_pendulum,
)
SCENES = {
    "ode": Scene(
        diffrax.ODETerm(relaxation),
        np.array([1.5, 0.5]),
        np.array([-1.0, 0.5, 0.0]),
        2.0,
        _plain_relaxation,
    ),
    "second-order": PENDULUM,
    "split": PENDULUM,
    "lie": Scene(
        rb.solvers.RigidBody(INERTIA, torque),
        (np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, 1.0, -0.7])),
        np.array([2.0, 0.4, 0.0]),
        1.0,
        _plain_body,
    ),
}


def flat(y: Any) -> jax.Array:
    return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(y)])


def scene(name: str) -> Scene:
    return SCENES[SOLVERS[name].kind]


def solve(term, solver, y0, args, end, steps, **options):
    """A solution in equal steps; the last is not left to rounding."""
    return diffrax.diffeqsolve(
        term, solver, 0.0, end, end / steps * (1 + 1e-12), y0, args, throw=False, **options
    )


@functools.cache
def program(name: str) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """(steps, end, y0, args) -> the final state in a row, and whether every step succeeded."""
    term, solver = scene(name).term, SOLVERS[name].make()

    @jax.jit
    def run(steps, end, y0, args):
        found = solve(term, solver, y0, args, end, steps, max_steps=None)
        ok = found.result == diffrax.RESULTS.successful
        return flat(jax.tree.map(lambda x: x[-1], found.ys)), ok

    return run
