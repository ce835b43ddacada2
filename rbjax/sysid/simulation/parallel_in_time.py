"""Parallel-in-time simulation: time windows run in parallel until they form one motion.

    s_1 = x_0,   s_(k+1) <- f_k(s_k)   for all k in parallel, repeatedly
f_k simulates window k from its initial state s_k. After j sweeps the first j windows are exact, so
K windows need at most K sweeps, the work of a sequential simulation. Damped joints under servos
forget their initial state within a window, and need two or three sweeps. Sweeps end when no initial
state changes by more than rounding. Derivatives satisfy the linearised equation, with separate
sweeps. A GPU runs one sample per thread, so a few long motions leave most of it idle.

Source: Gander, *50 years of time parallel time integration*, 2015 (Picard iterations over windows);
Song, Meng, Liao & Ermon, *Accelerating feedforward computation via parallel nonlinear equation
solving*, ICML 2021.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from rbjax.compiler.jax.launch import has_gpu

#: number of threads that a GPU runs in parallel
THREADS = 8192
#: least number of periods of a window; largest number of windows
SHORTEST, MOST = 64, 32
#: tolerance of a converged initial state, in rounding errors of its largest entry
ROUNDINGS = 256

#: (theta, initial state of a window, its commands) -> (final state, outputs at each command)
Window = Callable[[Any, Any, Any], tuple[Any, Any]]


def count_windows(periods: int, samples: int) -> int:
    """Choose into how many time windows to divide a motion, if `samples` motions run at once.

    It is 1 on a CPU, since a few samples use all cores.
    """
    if not has_gpu():
        return 1
    return max(1, min(MOST, periods // SHORTEST, THREADS // samples))


def simulate_windows(window: Window, theta: Any, first: Any, commands: Any, count: int) -> Any:
    """Simulate `count` windows, and return the outputs at each of the commands (N, ...).

    Args:
        window: traced function of one sample. Its initial state is a pair (k, carry), with the
            index k of its first command.
        theta: parameters of all windows.
        first: carry at the start of the motion, floats.
        commands: (N, ...) commands.
        count: number of windows.
    """
    N = jax.tree.leaves(commands)[0].shape[0]
    length = -(-N // count)
    filled = length * count - N
    places = np.arange(count) * length

    def cut(x: jax.Array) -> jax.Array:
        x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (filled, *x.shape[1:]))])
        return x.reshape(count, length, *x.shape[1:])

    @jax.jit  # traced once for all uses
    def sweep(theta: Any, starts: Any, commands: Any) -> tuple[Any, Any]:
        def one(k: Any, start: Any, commands: Any) -> tuple[Any, Any]:
            return window(theta, (k, start), commands)

        return jax.vmap(one)(jnp.asarray(places), starts, commands)

    outputs = _converged(sweep, theta, first, jax.tree.map(cut, commands))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:N], outputs)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _converged(sweep: Callable, theta: Any, first: Any, commands: Any) -> Any:
    """Return the outputs of the windows after convergence to one motion."""
    return _sweep_to_convergence(lambda starts: sweep(theta, starts, commands), first, commands)[1]


def _converged_jvp(sweep: Callable, primals: Any, tangents: Any) -> tuple[Any, Any]:
    theta, first, commands = primals
    starts, outputs = _sweep_to_convergence(
        lambda starts: sweep(theta, starts, commands), first, commands
    )
    leaves, tree = jax.tree.flatten((theta, commands))
    moves = jax.tree.leaves(tangents[::2], is_leaf=lambda x: isinstance(x, SymbolicZero))
    moving = [k for k, d in enumerate(moves) if not isinstance(d, SymbolicZero)]

    def ended(some: list[Any], starts: Any) -> tuple[Any, Any]:
        every = list(leaves)
        for k, x in zip(moving, some, strict=True):
            every[k] = x
        theta, commands = jax.tree.unflatten(tree, every)
        return sweep(theta, starts, commands)

    def slope(dstarts: Any) -> tuple[Any, Any]:
        at, along = [leaves[k] for k in moving], [moves[k] for k in moving]
        return jax.jvp(ended, (at, starts), (along, dstarts))[1]

    def known(d: Any) -> Any:
        return jnp.zeros(d.shape, d.dtype) if isinstance(d, SymbolicZero) else d

    dfirst = jax.tree.map(known, tangents[1], is_leaf=lambda x: isinstance(x, SymbolicZero))
    return outputs, _sweep_to_convergence(slope, dfirst, commands)[1]


_converged.defjvp(_converged_jvp, symbolic_zeros=True)


def _sweep_to_convergence(
    f: Callable[[Any], tuple[Any, Any]], first: Any, commands: Any
) -> tuple[Any, Any]:
    """Repeat f until the initial states converge, and return them with the outputs."""
    count = jax.tree.leaves(commands)[0].shape[0]
    starts = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), first)

    def again(value: Any) -> Any:
        k, _, starts, _ = value
        ends, outputs = f(starts)
        moved = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), first, ends)
        still = [
            _is_unchanged(a, b) for a, b in zip(*map(jax.tree.leaves, (starts, moved)), strict=True)
        ]
        return k + 1, jnp.all(jnp.stack(still)), moved, outputs

    def goes_on(value: Any) -> Any:
        return (value[0] < count) & ~value[1]

    outputs = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(f, starts)[1])
    begun = (jnp.zeros((), int), jnp.zeros((), bool), starts, outputs)
    return jax.lax.while_loop(goes_on, again, begun)[2:]


def _is_unchanged(before: jax.Array, after: jax.Array) -> jax.Array:
    """Check that states (K, ...) are finite and changed by no more than rounding."""
    size = jnp.max(jnp.abs(after), initial=0.0)
    near = jnp.abs(after - before) <= ROUNDINGS * jnp.finfo(after.dtype).eps * size
    return jnp.isfinite(size) & jnp.all(near)
