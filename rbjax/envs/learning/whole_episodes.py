"""Back-propagation through time: a policy trained by gradients through whole episodes."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from rbjax.arguments import integer, real_number
from rbjax.envs.learning.checks import check_training, warn_of_skipped
from rbjax.envs.learning.iterations import SAME, devices_of, over_devices, run_iterations
from rbjax.envs.learning.policy import as_policy, split_policy
from rbjax.envs.learning.samples import Samples, at_progress, figures_of, move_samples
from rbjax.envs.learning.trained import Report, Trained, no_report, summary_of
from rbjax.envs.learning.updates import apply_update, falling_rate


def through_time(
    env: Any,
    policy: Any,
    key: jax.Array,
    *,
    iterations: int = 200,
    batch: int = 64,
    rate: float = 1e-2,
    optimiser: Any = None,
    params: Any = None,
    devices: Any = None,
    reports: int = 1,
    report: Report = no_report,
) -> Trained:
    """Train a policy by back-propagation through whole episodes.

    Use it for a few gains, or for short episodes. For long ones use `shac`.

    It maximises the mean reward of a step over env.episode steps and a batch of initial states,
    which are drawn again in each iteration. Rewards after a termination are zero.

    Args:
        env: `rb.envs.Environment`.
        policy: a `Policy`, or a callable pytree (o,) -> (na,), whose arrays are trained.
        key: of `jax.random`.
        iterations: number of updates.
        batch: number of samples in each update.
        rate: the initial learning rate of Adam, without unit, with cosine decay to a tenth.
        optimiser: an optax transformation; Adam with gradients clipped to norm 1 if None.
        params: parameters of the environment, which `Task.curriculum` changes over the training;
            None for `env.default_params`.
        devices: number of devices, or a list of them, that share the batch; None for one.
        reports: number of reports.
        report: function (steps so far, figures, policy), called for each report.

    Returns:
        `Trained`; its critic is None.

    Raises:
        InputError: a policy of other sizes or without floating-point arrays; values out of range.

    Source: Werbos, *Backpropagation through time: what it does and how to do it*, 1990.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> gains = jax.tree_util.Partial(jnp.matmul, jnp.zeros((1, env.observation_size)))
        >>> found = rb.envs.learning.through_time(env, gains, jax.random.key(0), iterations=1,
        ...     batch=2)
        >>> found.rewards.shape
        (1,)
    """
    check_training("through_time", env, key, iterations, batch, optimiser, report)
    real_number("through_time", "rate", rate, above=0.0)
    integer("through_time", "reports", reports, least=1)
    policy = as_policy("through_time", env, policy)
    where_to_run = devices_of("through_time", devices, batch)
    mean, own_key = over_devices(where_to_run)
    parts = len(where_to_run)
    params = env.default_params if params is None else params
    arrays, static = eqx.partition(policy, eqx.is_array)
    if optimiser is None:
        optimiser = optax.chain(
            optax.clip_by_global_norm(1.0), optax.adam(falling_rate(rate, iterations))
        )

    def turn(now: tuple, k: jax.Array) -> tuple[tuple, dict[str, jax.Array]]:
        arrays, optimiser_state, key, skipped = now
        present = at_progress(env, params, k / iterations)
        key, other = jax.random.split(key)
        one, two = jax.random.split(own_key(other))
        weights, rest = split_policy(eqx.combine(arrays, static))
        draw = jax.vmap(env.reset, (0, None))
        obs, state = draw(jax.random.split(one, batch // parts), present)
        samples = Samples(obs, state, jnp.ones(batch // parts, bool))

        def loss(weights: Any) -> tuple:
            acting = eqx.combine(weights, rest)
            _, path = move_samples(env, acting, samples, two, env.episode, present)
            before = jnp.cumsum(path.done, 0) - path.done  # episodes that ended earlier
            rewards = jnp.where(before == 0, path.rewards, 0.0)
            return -rewards.mean(), path._replace(rewards=rewards)

        gradient, path = jax.grad(loss, has_aux=True)(weights)
        weights, optimiser_state, fine = apply_update(
            optimiser, mean(gradient), optimiser_state, weights
        )
        acting = eqx.combine(weights, rest).include(path.obs, mean, parts)
        skipped = skipped + (1 - fine.astype(int))
        after = (eqx.filter(acting, eqx.is_array), optimiser_state, key, skipped)
        return after, {name: parts * mean(x) for name, x in figures_of(path, parts).items()}

    def begin(arrays: Any, key: jax.Array) -> tuple:
        weights, _ = split_policy(eqx.combine(arrays, static))
        return arrays, optimiser.init(weights), key, jnp.zeros((), int)

    def report_chunk(done: int, now: tuple, figures: dict) -> None:
        policy = eqx.combine(now[0], static)
        report(done * batch * env.episode, summary_of(figures), policy)

    last, figures = run_iterations(
        turn, begin, (arrays, key), iterations, layout=SAME, devices=where_to_run, chunks=reports,
        report=report_chunk,
    )  # fmt: skip
    warn_of_skipped("through_time", last[3], iterations)
    return Trained(eqx.combine(last[0], static), None, figures["reward"], last[3])
