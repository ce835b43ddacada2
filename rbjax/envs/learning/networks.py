"""Feed-forward networks, and running statistics of their inputs.

y = W_n f(... f(W_1 z + b_1) ...) + b_n,      z = clip((x - mean) / std, -limit, limit)
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import choice, random_key
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_several
from rbjax.model.record import Record

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "tanh": jnp.tanh,
    "elu": jax.nn.elu,
    "silu": jax.nn.silu,
}
LEAST_STD = 1e-3  # a constant observation is not magnified further
HUGE = 1e6  # entries from here on, as of episodes that fail, count as the mean in the statistics


class Network(Record):
    """A feed-forward network (n,) -> (m,).

    weights: of each layer, (out, in).
    biases: of each layer, (out,).
    activation: "tanh", "elu" or "silu", between the layers.
    """

    weights: tuple[jax.Array, ...]
    biases: tuple[jax.Array, ...]
    activation: str = eqx.field(static=True)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute the output (m,)."""
        f = ACTIVATIONS[self.activation]
        last = len(self.weights) - 1
        for k, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = jnp.matmul(W, x, precision=jax.lax.Precision.HIGHEST) + b
            x = f(x) if k < last else x
        return x

    @property
    def sizes(self) -> tuple[int, ...]:
        """The sizes of the input, each hidden layer and the output."""
        return (self.weights[0].shape[1], *(b.shape[0] for b in self.biases))


def network(
    key: jax.Array, sizes: Sequence[int], activation: str = "tanh", last: float = 0.01
) -> Network:
    """Create a `Network` with random weights: W normal with variance 2 / in, b = 0.

    Args:
        key: of `jax.random`.
        sizes: of the input (n,), each hidden layer, and the output (m,).
        activation: "tanh", "elu" or "silu".
        last: factor of the last layer's weights; small, so that the first outputs are near zero.

    Returns:
        `Network`.

    Raises:
        InputError: fewer than two sizes, or one below 1.
        UnknownName: no such activation.

    Source: He, Zhang, Ren & Sun, *Delving deep into rectifiers*, 2015.

    Example:
        >>> import jax
        >>> import rbjax as rb
        >>> [W.shape for W in rb.envs.learning.network(jax.random.key(0), (3, 8, 2)).weights]
        [(8, 3), (2, 8)]
    """
    random_key("network", key)
    sizes = check_several("network", "sizes", sizes, "integers")
    factor = check_array("network", "last", last, ())
    if len(sizes) < 2 or any(not isinstance(n, int) or n < 1 for n in sizes):
        raise InputError(f"network: sizes is {sizes}, expected two or more positive integers")
    choice("activation of network", activation, ACTIVATIONS)
    weights, biases = _random_layers(key, sizes, factor)
    return Network(weights, biases, activation)


@functools.partial(jax.jit, static_argnames="sizes")
def _random_layers(key: jax.Array, sizes: tuple[int, ...], last: jax.Array) -> tuple:
    pairs = list(itertools.pairwise(sizes))
    dtype = last.dtype
    normal = jax.random.normal(key, (sum(a * b for a, b in pairs),), dtype)
    weights, at = [], 0
    for k, (into, out) in enumerate(pairs):
        scale = (2 / into) ** 0.5 * (last if k == len(pairs) - 1 else 1.0)
        weights.append(scale * normal[at : at + into * out].reshape(out, into))
        at += into * out
    return tuple(weights), tuple(jnp.zeros(n, dtype) for n in sizes[1:])


class Normaliser(Record):
    """The running mean and standard deviation of observations: z = clip((x - mean) / std).

    mean, std: (n,).
    count: number of observations so far.
    limit: largest magnitude of z.
    """

    mean: jax.Array
    std: jax.Array
    count: jax.Array
    limit: float = eqx.field(static=True, default=10.0)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Normalise an observation (n,)."""
        return jnp.clip((x - self.mean) / self.std, -self.limit, self.limit)

    def include(self, x: jax.Array, mean: Callable = lambda x: x, parts: int = 1) -> Normaliser:
        """Return the statistics with further observations (..., n).

        Entries that are not finite, or not below 1e6 in magnitude, count as the present mean. The
        standard deviation of a single observation is left as it was.

        mean: the mean of a value over the devices that share the batch. parts: their number.

            mean' = mean + w d,  var' = (1 - w) var + w E[(x - mean)^2] - (w d)^2,  w = m / (k + m)
        """
        x = x.reshape(-1, x.shape[-1]).astype(self.mean.dtype)
        off = jnp.where(jnp.abs(x) < HUGE, x - self.mean, 0.0)
        d, square = mean((off.mean(0), (off * off).mean(0)))
        count = self.count + len(x) * parts
        w = len(x) * parts / count
        before = jnp.where(self.count > 1, self.std**2, 0.0)  # one observation has no variance
        variance = (1 - w) * before + w * square - (w * d) ** 2
        std = jnp.sqrt(jnp.maximum(variance, LEAST_STD**2))
        std = jnp.where(count > 1, std, self.std)
        return Normaliser(self.mean + w * d, std, count, self.limit)


def normaliser(size: int) -> Normaliser:
    """Return statistics without observations: mean 0, standard deviation 1."""
    return Normaliser(jnp.zeros(size), jnp.ones(size), jnp.zeros(()))
