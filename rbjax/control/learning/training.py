"""Training of policies: compiled iterations, updates, and training on whole episodes.

    x_0 = begin(...),    x_{k+1}, c_k = turn(x_k)

All iterations are compiled as one loop, or in chunks that report progress. For a short training on
a GPU, which would be shorter than its compilation, some optimisations of XLA are disabled.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from rbjax.arguments import instance, integer, real_number
from rbjax.compiler import fast_compile
from rbjax.control.learning.environment import Environment
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_key
from rbjax.lanes.arrays import select
from rbjax.model.record import Record
from rbjax.progress import progress_line

CHUNKS = 10  # number of progress reports

#: On a GPU, XLA autotunes matrix products for 5 s and optimises kernels for 3 s. That is longer
#: than a short training of a small policy.
UNMEASURED = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
OPTIMISED_FROM = 2000


def run_iterations(
    where: str, turn: Callable, begin: Callable, given: tuple, iterations: int, progress: bool
) -> tuple[Any, jax.Array]:
    """Run all iterations x_{k+1}, c_k = turn(x_k) from x_0 = begin(*given).

    They are one program, or chunks that report progress.
    """
    quick = jax.default_backend() == "gpu" and iterations < OPTIMISED_FROM
    jit: Any = functools.partial(jax.jit, compiler_options=UNMEASURED if quick else None)
    first = jit(lambda n, *given: jax.lax.scan(turn, begin(*given), None, n), static_argnums=0)
    more = jit(lambda now, n: jax.lax.scan(turn, now, None, n), static_argnums=1)
    with fast_compile(quick):
        if not progress:
            return first(iterations, *given)
        chunk = max(1, iterations // CHUNKS)
        with progress_line(where) as say:
            say("compiling")
            now, some = first(min(chunk, iterations), *given)
            costs, done = [some], len(some)
            while done < iterations:
                say(f"iteration {done} of {iterations}, cost of a step {float(some[-1]):.4g}")
                now, some = more(now, min(chunk, iterations - done))
                costs.append(some)
                done += len(some)
    return now, jnp.concatenate(costs)


class Trained(Record):
    """The result of a training.

    policy: the trained policy.
    value: the value function, a `Network`; None for `through_time`.
    costs: mean cost of a step over batch and horizon, (iterations,).
    skipped: number of updates skipped because their gradients were not finite, ().
    """

    policy: Any
    value: Any
    costs: jax.Array
    skipped: jax.Array


def through_time(
    env: Environment,
    policy: Any,
    key: jax.Array,
    *,
    iterations: int = 200,
    batch: int = 64,
    rate: float = 1e-2,
    optimiser: Any = None,
    progress: bool = False,
) -> Trained:
    """Train a policy by back-propagation through whole episodes.

    Use it for a few gains, or for short episodes. For long ones use `actor_critic`.

    It minimises over theta the mean of c(x_k, pi(o(x_k))) over env.episode steps and a batch of
    initial states, which are drawn again in each iteration.

    Args:
        env: `Environment`; `episode` is the number of steps.
        policy: a callable pytree (o,) -> (nu,); its floating-point arrays are trained.
        key: of `jax.random`.
        iterations: number of updates.
        batch: number of samples in each update.
        rate: the initial learning rate of Adam, with cosine decay to a tenth.
        optimiser: an optax transformation; Adam with gradients clipped to norm 1 if None.
        progress: if true, print the progress on a terminal.

    Returns:
        `Trained`; its value is None.

    Raises:
        InputError: a policy of other sizes or without floating-point arrays; values out of range.

    Source: Werbos, *Backpropagation through time: what it does and how to do it*, 1990.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> env = rb.control.Environment(
        ...     model, lambda state, ctrl: (state.q**2).sum() + 0.1 * (state.v**2).sum(),
        ...     lambda key: rb.State(0.1 * jax.random.normal(key, (2,)), jnp.zeros(2)),
        ...     dt=0.02, episode=20)
        >>> gains = jax.tree_util.Partial(jnp.matmul, jnp.array([[0.1, 2.0, 0.2, 0.5]]))
        >>> found = rb.control.through_time(env, gains, jax.random.key(0), iterations=2, batch=4)
        >>> found.costs.shape
        (2,)
    """
    check_training("through_time", env, policy, key, iterations, batch, optimiser)
    real_number("through_time", "rate", rate, above=0.0, traced=True)
    numbers, rest = eqx.partition(policy, eqx.is_inexact_array)
    if optimiser is None:
        optimiser = optax.chain(
            optax.clip_by_global_norm(1.0), optax.adam(falling_rate(rate, iterations))
        )

    def turn(now: tuple, _: None) -> tuple[tuple, jax.Array]:
        numbers, memory, key, skipped = now
        key, other = jax.random.split(key)
        models, states = jax.vmap(env.reset)(jax.random.split(other, batch))

        def loss(numbers: Any) -> jax.Array:
            policy = eqx.combine(numbers, rest)
            return env.unroll(policy, models, states, env.episode).costs.mean()

        cost, slope = jax.value_and_grad(loss)(numbers)
        numbers, memory, fine = apply_update(optimiser, slope, memory, numbers)
        return (numbers, memory, key, skipped + (1 - fine.astype(int))), cost

    def begin(numbers: Any, key: jax.Array) -> tuple:
        return numbers, optimiser.init(numbers), key, jnp.asarray(0)

    last, costs = run_iterations("through_time", turn, begin, (numbers, key), iterations, progress)
    return Trained(eqx.combine(last[0], rest), None, costs, last[3])


def apply_update(
    optimiser: Any, slope: Any, memory: Any, numbers: Any
) -> tuple[Any, Any, jax.Array]:
    """Update the parameters `numbers` by the gradient `slope`, unless the gradient is not finite.
    Return the parameters, the optimiser's state, and whether the gradient was finite."""
    leaves = [jnp.isfinite(x).all() for x in jax.tree.leaves(slope)]
    fine = jnp.stack(leaves).all()
    slope = jax.tree.map(lambda x: jnp.where(fine, x, 0.0), slope)
    update, after = optimiser.update(slope, memory, numbers)
    moved = optax.apply_updates(numbers, update)
    numbers, memory = select(fine, (moved, after), (numbers, memory))
    return numbers, memory, fine


def falling_rate(rate: float, steps: int) -> Any:
    return optax.cosine_decay_schedule(rate, steps, 0.1)


def check_training(
    where: str, env: Any, policy: Any, key: Any, iterations: int, batch: int, optimiser: Any
) -> None:
    instance(where, "env", env, Environment, "an rb.control.Environment")
    env.check_policy(where, policy)
    check_key(where, key)
    if optimiser is not None and not (hasattr(optimiser, "init") and hasattr(optimiser, "update")):
        raise InputError(
            f"{where}: optimiser is {optimiser!r}, expected a transformation of optax, such as "
            "optax.adam(1e-3)"
        )
    if not jax.tree.leaves(eqx.filter(policy, eqx.is_inexact_array)):
        raise InputError(
            f"{where}: the policy has no floating arrays to train; give one that is a pytree of "
            "them, such as rb.control.network(...) or jax.tree_util.Partial(function, gains)"
        )
    integer(where, "iterations", iterations, least=1)
    integer(where, "batch", batch, least=1)
