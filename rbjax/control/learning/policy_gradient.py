"""Training of policies through the dynamics over a short horizon, with a value function.

    J(theta) = E[(1 - g) sum_{k<h} g^k c_k + g^h V(x_h)],     theta <- theta - a dJ/dtheta
    G_k = (1 - g) c_k + g ((1 - l) V'(x_{k+1}) + l G_{k+1}),     G_h = V'(x_h)

The value function V, fitted to the targets G, approximates all costs after h steps. V' is a slowly
updated copy of V. Costs are in units of one step. The policy is deterministic; random initial
states and models provide exploration.
Source: Xu et al., *Accelerated policy learning with parallel differentiable simulation*, 2022.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from rbjax.arguments import integer, real_number
from rbjax.control.learning.environment import Environment, Segment, network
from rbjax.control.learning.training import (
    Trained,
    apply_update,
    check_training,
    falling_rate,
    run_iterations,
)
from rbjax.errors import InputError
from rbjax.model import State

GROUPS = 32  # number of groups of samples; the gradients of groups are computed in parallel


class Samples(NamedTuple):
    """The batch between two iterations: models (B, ...) or None, states, ages (B,) in steps."""

    models: Any
    states: State
    ages: jax.Array


class Training(NamedTuple):
    """The state of the training between two iterations."""

    policy: Any
    value: Any
    slow: Any
    memory: Any
    value_memory: Any
    samples: Samples
    key: jax.Array
    skipped: jax.Array


def actor_critic(
    env: Environment,
    policy: Any,
    key: jax.Array,
    *,
    value: Any = None,
    iterations: int = 300,
    batch: int = 256,
    horizon: int = 32,
    discount: float = 0.99,
    trace: float = 0.95,
    rate: float = 3e-3,
    value_rate: float = 2e-3,
    value_steps: int = 8,
    slow: float = 0.2,
    optimiser: Any = None,
    progress: bool = False,
) -> Trained:
    """Train a policy through the dynamics over a short horizon, with a value function.

    Args:
        env: `Environment`.
        policy: a callable pytree (o,) -> (nu,); its floating-point arrays are trained.
        key: of `jax.random`, for the batch and the value function.
        value: a callable pytree (o,) -> (1,); a `Network` with two hidden layers of 64 if None.
        iterations: number of updates of the policy.
        batch: number of parallel samples.
        horizon: h, the number of steps of a sample in an iteration.
        discount: g of a step.
        trace: l of the targets.
        rate, value_rate: initial learning rates of Adam, with cosine decay to a tenth.
        value_steps: updates of the value function in an iteration, each on the whole batch.
        slow: the update of V' in an iteration is V' + slow (V - V').
        optimiser: an optax transformation for the policy; if None, Adam (0.7, 0.95) with gradients
            clipped to norm 1.
        progress: if true, print the progress on a terminal.

    Returns:
        `Trained`.

    Raises:
        InputError: a policy of other sizes or without floating-point arrays; values out of range.

    Source: Xu et al., *Accelerated policy learning with parallel differentiable simulation*, ICLR
    2022.

    Example:
        >>> import jax
        >>> import rbjax as rb
        >>> model, key = rb.load("pendulum"), jax.random.key(0)
        >>> env = rb.control.Environment(
        ...     model, lambda state, ctrl: (state.q**2).sum(), model.random_state, dt=0.05)
        >>> policy = rb.control.network(key, (2, 16, 1))
        >>> trained = rb.control.actor_critic(env, policy, key)  # doctest: +SKIP
    """
    check_training("actor_critic", env, policy, key, iterations, batch, optimiser)
    real_number("actor_critic", "rate", rate, above=0.0, traced=True)
    real_number("actor_critic", "value_rate", value_rate, above=0.0, traced=True)
    if value is not None and not callable(value):
        got = type(value).__name__
        raise InputError(f"actor_critic: value is {got}, expected a callable pytree, as the policy")
    layers = (env.observation_size, 64, 64, 1)

    def fresh(key: jax.Array) -> Any:
        # small initial weights, so that random slopes of V do not mislead the policy
        return network(key, layers, "elu", last=0.01)

    integer("actor_critic", "horizon", horizon, least=1)
    integer("actor_critic", "value_steps", value_steps, least=1)
    for what, x in (("discount", discount), ("trace", trace), ("slow", slow)):
        real_number("actor_critic", what, x, least=0.0, most=1.0, traced=True)
    numbers, rest = eqx.partition(policy, eqx.is_inexact_array)
    values, value_rest = eqx.partition(
        eqx.filter_eval_shape(fresh, key) if value is None else value, _is_number
    )
    if optimiser is None:
        optimiser = optax.chain(
            optax.clip_by_global_norm(1.0),
            optax.flatten(optax.adam(falling_rate(rate, iterations), 0.7, 0.95)),
        )
    fitter = optax.flatten(optax.adam(falling_rate(value_rate, iterations * value_steps)))

    def worth(values: Any, states: State) -> jax.Array:
        V = eqx.combine(values, value_rest)
        return jax.vmap(lambda state: V(env.observe(state))[0])(states)

    def loss(numbers: Any, values: Any, samples: Samples) -> tuple[jax.Array, Segment]:
        segment = env.unroll(eqx.combine(numbers, rest), samples.models, samples.states, horizon)
        last = jax.tree.map(lambda x: x[:, -1], segment.states)
        return policy_loss(segment.costs, worth(values, last), discount), segment

    def fit(values: Any, memory: Any, states: State, targets: jax.Array) -> tuple:
        # failed samples have weight zero and finite substitutes
        good = jnp.isfinite(targets)
        for x in jax.tree.leaves(states):
            good = good & jnp.isfinite(x).all(-1)
        targets = jnp.where(good, targets, 0.0)
        states = jax.tree.map(lambda x: jnp.where(good[:, None], x, 0.0), states)
        weights = good / jnp.maximum(good.mean(), 1 / len(good))
        # in groups, since a GPU computes a single sum over all samples with little parallelism
        states, targets, weights = jax.tree.map(
            lambda x: x.reshape(math.gcd(GROUPS, len(x)), -1, *x.shape[1:]),
            (states, targets, weights),
        )

        def off(values: Any, states: State, targets: jax.Array, weights: jax.Array) -> jax.Array:
            return (weights * (worth(values, states) - targets) ** 2).mean()

        def once(carry: tuple, _: None) -> tuple[tuple, None]:
            values, memory = carry
            slopes = jax.vmap(jax.grad(off), (None, 0, 0, 0))(values, states, targets, weights)
            slope = jax.tree.map(lambda x: x.mean(0), slopes)
            update, memory = fitter.update(slope, memory, values)
            return (optax.apply_updates(values, update), memory), None

        return jax.lax.scan(once, (values, memory), None, value_steps)[0]

    def turn(now: Training, _: None) -> tuple[Training, jax.Array]:
        slope, segment = jax.grad(loss, has_aux=True)(now.policy, now.slow, now.samples)
        policy, memory, fine = apply_update(optimiser, slope, now.memory, now.policy)
        flat = jax.tree.map(lambda x: x[:, 1:].reshape(-1, *x.shape[2:]), segment.states)
        later = worth(now.slow, flat).reshape(segment.costs.shape)
        targets = returns(segment.costs, later, discount, trace)
        before = jax.tree.map(lambda x: x[:, :-1].reshape(-1, *x.shape[2:]), segment.states)
        values, value_memory = fit(now.value, now.value_memory, before, targets.reshape(-1))
        behind = jax.tree.map(lambda s, v: s + slow * (v - s), now.slow, values)
        key, other = jax.random.split(now.key)
        samples = renew_batch(env, other, now.samples, segment, horizon)
        skipped = now.skipped + (1 - fine.astype(int))
        after = Training(policy, values, behind, memory, value_memory, samples, key, skipped)
        return after, jnp.nanmean(segment.costs)

    def begin(numbers: Any, values: Any, key: jax.Array) -> Training:
        one, two, three = jax.random.split(key, 3)
        if values is None:
            values = eqx.filter(fresh(one), eqx.is_inexact_array)
        return Training(
            numbers, values, values, optimiser.init(numbers), fitter.init(values),
            draw_batch(env, two, batch), three, jnp.asarray(0),
        )  # fmt: skip

    given = (numbers, None if value is None else values, key)
    last, costs = run_iterations("actor_critic", turn, begin, given, iterations, progress)
    trained = eqx.combine(last.policy, rest)
    return Trained(trained, eqx.combine(last.value, value_rest), costs, last.skipped)


def policy_loss(costs: jax.Array, last: jax.Array, discount: float) -> jax.Array:
    """Return the batch mean of the loss: discounted costs (B, h), plus the discounted last value
    (B,)."""
    h = costs.shape[1]
    weights = discount ** jnp.arange(h, dtype=costs.dtype)
    return ((1 - discount) * (weights * costs).sum(1) + discount**h * last).mean()


def returns(costs: jax.Array, later: jax.Array, discount: float, trace: float) -> jax.Array:
    """Return the targets (B, h) of the value function, from costs (B, h) and next values (B, h)."""

    def back(G: jax.Array, x: tuple) -> tuple[jax.Array, jax.Array]:
        c, V = x
        G = (1 - discount) * c + discount * ((1 - trace) * V + trace * G)
        return G, G

    _, found = jax.lax.scan(back, later[:, -1], (costs.T, later.T), reverse=True)
    return found.T


def draw_batch(env: Environment, key: jax.Array, batch: int) -> Samples:
    """Draw the first batch, with random ages."""
    one, two = jax.random.split(key)
    models, states = jax.vmap(env.reset)(jax.random.split(one, batch))
    return Samples(models, states, jax.random.randint(two, (batch,), 0, env.episode))


def renew_batch(
    env: Environment, key: jax.Array, samples: Samples, segment: Segment, steps: int
) -> Samples:
    """Return the batch after a segment, with new initial states for samples that ended. A sample
    ends if it is old, lost or not finite."""
    last = jax.tree.map(lambda x: x[:, -1], segment.states)
    ages = samples.ages + steps
    batch = ages.shape[0]
    over = ages >= env.episode
    over = over | ~jnp.stack([jnp.isfinite(x).all(-1) for x in jax.tree.leaves(last)]).all(0)
    if env.lost is not None:
        over = over | jax.vmap(env.lost)(last)
    models, states = jax.vmap(env.reset)(jax.random.split(key, batch))

    def pick(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(over.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    models = jax.tree.map(pick, models, samples.models)
    return Samples(models, jax.tree.map(pick, states, last), jnp.where(over, 0, ages))


def _is_number(x: Any) -> bool:
    """Return whether a leaf is a floating-point array, or the shape of one."""
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jnp.inexact)
