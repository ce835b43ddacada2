"""Tyre laws with numbers of real tyres, and what all of them share."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.wheeled import Coulomb, Fiala, LinearTyre, Pacejka, TMeasy

# alike along and across, and not
LAWS = {
    "linear": LinearTyre(12.0),
    "linear, two": LinearTyre([12.0, 9.0]),
    "saturated": LinearTyre(12.0, 0.9),
    "saturated, two": LinearTyre([12.0, 9.0], [0.9, 0.7]),
    "coulomb": Coulomb(0.8),
    "coulomb, two": Coulomb([0.8, 0.6], [0.02, 0.03]),
    "fiala": Fiala(12.0, 0.8),
    "fiala, two": Fiala([12.0, 9.0], [0.8, 0.7]),
    "pacejka": Pacejka(10.0, 1.6, 1.0, 0.5),
    "pacejka, two": Pacejka([10.0, 8.0], [1.65, 1.3], [1.0, 0.9], [0.6, -0.5]),
    "pacejka, two heights": Pacejka([10.0, 8.0], 1.5, [1.0, 0.9], -1.0),
    "tmeasy": TMeasy(25.0, 0.1, 1.0, 0.4, 0.8),
    "tmeasy, two": TMeasy([28.0, 22.0], [0.1, 0.17], [1.05, 0.9], [0.45, 0.6], [0.9, 0.85]),
}
# two numbers of each kind are the general case; the slow tests take the others too
GENERAL = {*(name for name in LAWS if "two" in name), "linear", "pacejka"} - {"linear, two"}
EVERY = pytest.mark.parametrize(
    "law",
    [
        pytest.param(law, id=name, marks=() if name in GENERAL else pytest.mark.slow)
        for name, law in LAWS.items()
    ],
)


def limits(law) -> np.ndarray | None:
    """The half axes of its ellipse of friction."""
    found = law.peak if hasattr(law, "peak") else law.friction
    return None if found is None else np.broadcast_to(np.asarray(found), 2)


def numbers(record):
    """All numbers of a record in a row, and how to put such a row back, complex or not."""
    leaves, tree = jax.tree.flatten(record)
    sizes = [np.size(x) for x in leaves]

    def back(row):
        parts = jnp.split(row, np.cumsum(sizes)[:-1])
        shaped = [p.reshape(np.shape(x)) for p, x in zip(parts, leaves, strict=True)]
        return jax.tree.unflatten(tree, shaped)

    return jnp.concatenate([jnp.ravel(x) for x in leaves]), back


def by_complex_step(f, x, h=1e-30):
    """The Jacobian of f, one complex step for each number of x."""
    steps = jnp.eye(x.size)
    return jax.vmap(lambda e: jnp.imag(f(x + 1j * h * e)) / h, out_axes=-1)(steps)


def slopes_agree(f, x) -> float:
    """How far `jacfwd` and `jacrev` are from complex steps, of the largest entry of each row."""
    ways = jax.jit(lambda x: (by_complex_step(f, x), jax.jacfwd(f)(x), jax.jacrev(f)(x)))
    want, *found = map(np.asarray, ways(x))
    scale = np.maximum(1.0, np.abs(want).max(-1, keepdims=True))
    return max(np.abs((jac - want) / scale).max() for jac in found)


def replaced(record, **fields):
    """A copy with other fields, of whatever dtype and shape."""
    for name, value in fields.items():
        record = eqx.tree_at(lambda r, name=name: getattr(r, name), record, jnp.asarray(value))
    return record
