"""A feed-forward network as a pytree: policies and value functions.

    y_0 = x,    y_{k+1} = f(W_k y_k + b_k),    the last layer without f

Weights begin normal with variance 2 / in (He et al. 2015), biases at zero.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError, UnknownName
from rbjax.kinematics.arguments import check_key, check_several
from rbjax.model.record import Record

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "tanh": jnp.tanh,
    "elu": jax.nn.elu,
    "silu": jax.nn.silu,
}


class Network(Record):
    """A feed-forward network (n,) -> (m,).

    Fields: weights, each (out, in); biases, each (out,); activation, "tanh", "elu" or "silu".

    Example:
        >>> import jax, jax.numpy as jnp
        >>> import rbjax as rb
        >>> policy = rb.control.network(jax.random.key(0), (4, 16, 1))
        >>> policy(jnp.zeros(4)).shape
        (1,)
    """

    weights: tuple[jax.Array, ...]
    biases: tuple[jax.Array, ...]
    activation: str = eqx.field(static=True)

    def __call__(self, x: jax.Array) -> jax.Array:
        f = ACTIVATIONS[self.activation]
        last = len(self.weights) - 1
        for k, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = jnp.matmul(W, x, precision=jax.lax.Precision.HIGHEST) + b
            x = f(x) if k < last else x
        return x


def network(
    key: jax.Array, sizes: Sequence[int], activation: str = "tanh", last: float = 0.01
) -> Network:
    """A `Network` with random weights.

    W normal with variance 2 / in, b = 0.

    Args:
        key: of `jax.random`.
        sizes: of the input, each hidden layer, and the output.
        activation: "tanh", "elu" or "silu".
        last: a factor of the last layer's weights; small, so that a policy begins near zero.

    Returns:
        `Network`.

    Raises:
        InputError: fewer than two sizes, or one below 1. UnknownName: no such activation.

    Source: He, Zhang, Ren & Sun, *Delving deep into rectifiers*, 2015.

    Example:
        >>> import jax
        >>> import rbjax as rb
        >>> [W.shape for W in rb.control.network(jax.random.key(0), (3, 8, 2)).weights]
        [(8, 3), (2, 8)]
    """
    check_key("network", key)
    sizes = check_several("network", "sizes", sizes, "integers")
    factor = check_array("network", "last", last, ())
    if len(sizes) < 2 or any(not isinstance(n, int) or n < 1 for n in sizes):
        raise InputError(f"network: sizes is {sizes}, expected two or more positive integers")
    if activation not in ACTIVATIONS:
        raise UnknownName("activation of network", activation, ACTIVATIONS)
    weights, biases = _drawn(key, sizes, factor)
    return Network(weights, biases, activation)


@functools.partial(jax.jit, static_argnames="sizes")
def _drawn(key: jax.Array, sizes: tuple[int, ...], last: jax.Array) -> tuple:
    pairs = list(itertools.pairwise(sizes))
    dtype = last.dtype
    normal = jax.random.normal(key, (sum(a * b for a, b in pairs),), dtype)
    weights, at = [], 0
    for k, (into, out) in enumerate(pairs):
        scale = (2 / into) ** 0.5 * (last if k == len(pairs) - 1 else 1.0)
        weights.append(scale * normal[at : at + into * out].reshape(out, into))
        at += into * out
    return tuple(weights), tuple(jnp.zeros(n, dtype) for n in sizes[1:])
