"""SHAC: a policy trained by gradients through a short horizon of an environment, with a value
function.

    theta <- theta + a dJ/dtheta,   J = E[(1 - g) sum_{k<h} g^k r_k + g^h V'(o_h)]

The gradient passes through policy, physics, contacts and rewards by reverse-mode differentiation
and is exact. It stops at the end of an episode. The value function V approximates all rewards
after h steps. V' is a slowly updated copy of it.
Source: Xu et al., *Accelerated policy learning with parallel differentiable simulation*, 2022.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from rbjax.arguments import integer, real_number
from rbjax.envs.learning.checks import check_discount, check_training, warn_of_skipped
from rbjax.envs.learning.critic import check_critic, fit_critic, follow, new_critic, weights_of
from rbjax.envs.learning.iterations import EACH, SAME, devices_of, over_devices, run_iterations
from rbjax.envs.learning.policy import as_policy, new_policy, split_policy
from rbjax.envs.learning.samples import (
    Samples,
    at_progress,
    draw_samples,
    figures_of,
    move_samples,
)
from rbjax.envs.learning.targets import objective, value_targets
from rbjax.envs.learning.trained import Report, Trained, no_report, summary_of
from rbjax.envs.learning.updates import apply_update, falling_rate, policy_optimiser
from rbjax.errors import InputError


class Training(NamedTuple):
    """The state of the training between two iterations."""

    policy: Any
    critic: Any
    target_critic: Any
    policy_optimiser_state: Any
    critic_optimiser_state: Any
    key: jax.Array
    skipped: jax.Array
    samples: Samples


LAYOUT = Training._make([*[SAME] * 7, EACH])


def shac(
    env: Any,
    key: jax.Array,
    policy: Any = None,
    *,
    critic: Any = None,
    iterations: int = 300,
    batch: int = 256,
    horizon: int = 32,
    discount: float = 0.99,
    td_lambda: float = 0.95,
    rate: float = 3e-3,
    critic_rate: float = 2e-3,
    critic_steps: int = 8,
    target_rate: float = 0.2,
    warm_up: int = 0,
    reward_scale: float = 1.0,
    max_grad_norm: float = 1.0,
    gradient_limit: float | None = None,
    hidden: tuple[int, ...] = (64, 64),
    std: float | None = 0.4,
    optimiser: Any = None,
    params: Any = None,
    devices: Any = None,
    reports: int = 1,
    report: Report = no_report,
    seconds: float | None = None,
) -> Trained:
    """Train a policy by short-horizon actor-critic (SHAC), with gradients through the environment.

    Use it for tasks with smooth rewards: it needs fewer steps of the robot than PPO.

    Args:
        env: `rb.envs.Environment`.
        key: of `jax.random`, for the samples, the noise and untrained networks.
        policy: a `Policy`, or a callable pytree (o,) -> (na,), whose arrays are trained; None for a
            `new_policy`.
        critic: a `Critic`, the value function at the beginning; None for an untrained one.
        iterations: number of updates of the policy.
        batch: number of parallel samples.
        horizon: h, the number of steps of a sample in an iteration.
        discount: g of a step, below 1.
        td_lambda: l of the targets of the value function, TD(l).
        rate, critic_rate: initial learning rates of Adam, with cosine decay to a tenth.
        critic_steps: updates of the value function in an iteration, each on the whole batch.
        target_rate: the update of V' in an iteration is V' + target_rate (V - V').
        warm_up: iterations at the beginning that update the value function only, fewer than all.
            Use it if the policy is already trained.
        reward_scale: factor of the rewards in J and V. Choose it so that the reward of a good
            step is about 1: the first steps of the optimiser of V are then small against V.
        max_grad_norm: limit of the norm of the gradient of J, for the default optimiser. J is in
            units of the reward of a step: the sum of the rewards times 1 - g.
        gradient_limit: limit of the norm of the gradient of a sample with respect to its state and
            action, in each step of the horizon, relative to an equal share of the objective; None
            for none. A low limit changes the direction of the gradient.
        hidden: sizes of the hidden layers of a new policy and a new critic.
        std: noise of a new policy, the standard deviation before tanh; None for no noise.
        optimiser: an optax transformation for the policy; if None, Adam (0.7, 0.95) with gradients
            clipped to `max_grad_norm`.
        params: parameters of the environment, which `Task.curriculum` changes over the training;
            None for `env.default_params`.
        devices: number of devices, or a list of them, that share the batch; None for one.
        reports: number of reports.
        report: function (steps so far, figures, policy), called for each report.
        seconds: limit of time, after which the training ends with the next report; None for none.

    Returns:
        `Trained`.

    Raises:
        InputError: a policy of other sizes or without floating-point arrays; values out of range.

    Source: Xu et al., *Accelerated policy learning with parallel differentiable simulation*, ICLR
    2022, algorithm 1.

    Example:
        >>> import jax
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> found = rb.envs.learning.shac(
        ...     env, jax.random.key(0), iterations=1, batch=2, horizon=2, hidden=(4,))
        >>> found.rewards.shape
        (1,)
    """
    where = "shac"
    check_training(where, env, key, iterations, batch, optimiser, report, seconds)
    integer(where, "horizon", horizon, least=1)
    integer(where, "critic_steps", critic_steps, least=0)
    integer(where, "warm_up", warm_up, least=0)
    integer(where, "reports", reports, least=1)
    if warm_up >= iterations:
        raise InputError(
            f"shac: warm_up is {warm_up}, expected less than iterations, {iterations}; else the "
            "policy is never updated"
        )
    check_discount(where, "discount", discount)
    for name, x in (("td_lambda", td_lambda), ("target_rate", target_rate)):
        real_number(where, name, x, least=0.0, most=1.0)
    for name, x in (
        ("rate", rate), ("critic_rate", critic_rate), ("reward_scale", reward_scale),
        ("max_grad_norm", max_grad_norm),
    ):  # fmt: skip
        real_number(where, name, x, above=0.0)
    if gradient_limit is not None:
        real_number(where, "gradient_limit", gradient_limit, above=0.0)
    if critic is not None:
        check_critic(where, env, critic)
    where_to_run = devices_of(where, devices, batch)
    mean, own_key = over_devices(where_to_run)
    parts = len(where_to_run)
    params = env.default_params if params is None else params
    policy = None if policy is None else as_policy(where, env, policy)

    def networks(given: tuple, key: jax.Array) -> tuple:
        key, one, two = jax.random.split(key, 3)
        policy, critic = given
        policy = new_policy(env, one, hidden, std=std) if policy is None else policy
        return (policy, new_critic(env, two, hidden) if critic is None else critic), key

    made, _ = eqx.filter_eval_shape(networks, (policy, critic), key)
    static = eqx.filter(made, lambda x: not isinstance(x, jax.ShapeDtypeStruct))
    arrays, rest_of_given = eqx.partition((policy, critic), eqx.is_array)
    if optimiser is None:
        optimiser = policy_optimiser(rate, iterations, max_grad_norm)
    fitter = optax.flatten(optax.adam(falling_rate(critic_rate, iterations * max(1, critic_steps))))

    def params_at(k: jax.Array) -> Any:
        return at_progress(env, params, k / iterations)

    def turn(now: Training, k: jax.Array) -> tuple[Training, dict[str, jax.Array]]:
        key, other = jax.random.split(now.key)
        acting, critic = eqx.combine((now.policy, now.critic), static)
        target_critic = eqx.combine(now.target_critic, static[1])
        weights, rest = split_policy(acting)

        def loss(weights: Any) -> tuple:
            acting = eqx.combine(weights, rest)
            samples, path = move_samples(
                env, acting, now.samples, own_key(other), horizon, params_at(k), gradient_limit
            )
            values = jax.vmap(jax.vmap(target_critic))(path.seen)
            rewards = reward_scale * path.rewards
            J = objective(rewards, values, path.done, path.ended, discount)
            return -J.mean(), (samples, path, rewards, values)

        gradient, (samples, path, rewards, values) = jax.grad(loss, has_aux=True)(weights)
        weights, optimiser_state, fine = apply_update(
            optimiser, mean(gradient), now.policy_optimiser_state, weights, k >= warm_up
        )
        targets = value_targets(rewards, values, path.done, path.ended, discount, td_lambda)
        critic, critic_optimiser_state = fit_critic(
            critic, now.critic_optimiser_state, fitter, path.obs, targets, critic_steps, mean
        )
        target_critic = follow(target_critic, critic, target_rate)
        acting = eqx.combine(weights, rest)
        learned = [part.include(path.obs, mean, parts) for part in (acting, critic, target_critic)]
        skipped = now.skipped + (1 - fine.astype(int))
        arrays = eqx.filter(learned, eqx.is_array)
        after = Training._make(
            (*arrays, optimiser_state, critic_optimiser_state, key, skipped, samples)
        )
        return after, {name: parts * mean(x) for name, x in figures_of(path, parts).items()}

    def begin(arrays: Any, key: jax.Array) -> Training:
        learned, key = networks(eqx.combine(arrays, rest_of_given), key)
        one, two = jax.random.split(key)
        samples = draw_samples(env, own_key(one), batch // parts, params_at(jnp.asarray(0)))
        policy, critic = (part.include(samples.obs, mean, parts) for part in learned)
        optimiser_state = optimiser.init(split_policy(policy)[0])
        arrays = eqx.filter((policy, critic, critic), eqx.is_array)
        skipped = jnp.zeros((), int)
        critic_optimiser_state = fitter.init(weights_of(critic))
        return Training._make(
            (*arrays, optimiser_state, critic_optimiser_state, two, skipped, samples)
        )

    def report_chunk(done: int, now: Training, figures: dict) -> None:
        policy = eqx.combine(now.policy, static[0])
        report(done * batch * horizon, summary_of(figures), policy)

    last, figures = run_iterations(
        turn, begin, (arrays, key), iterations, layout=LAYOUT, devices=where_to_run,
        chunks=reports, report=report_chunk, seconds=seconds,
    )  # fmt: skip
    policy, critic = eqx.combine((last.policy, last.critic), static)
    warn_of_skipped(where, last.skipped, len(figures["reward"]))
    return Trained(policy, critic, figures["reward"], last.skipped)
