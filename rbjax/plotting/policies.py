"""Policies in motion: episodes of an environment as a trajectory, and as an animation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax import contact as contacts_of
from rbjax.arguments import file_path, instance, integer, real_number
from rbjax.contact import ContactForces
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_takes
from rbjax.envs import Environment, EnvState, Params
from rbjax.envs.actions import action_center_and_scale
from rbjax.envs.batch_step import batch_step
from rbjax.model import Model, State
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting.animation import animate, writable
from rbjax.plotting.solid_shapes import solids

Policy = Callable[[Any, jax.Array], jax.Array]
#: the number of robots in a GIF or an MP4
FEW = 8


@displayed
class RecordedEpisodes(NamedTuple):
    """Recorded motion of an environment.

    trajectory: q (samples, T, nq), v (samples, T, nv) at control steps. An episode that ends is
        followed by the next one.
    reward: (samples, T - 1), of each step.
    done: (samples, T - 1), whether an episode ended with the step.
    contacts: contact forces of the first sample at each time; None without a contact law.
    """

    trajectory: Trajectory
    reward: np.ndarray
    done: np.ndarray
    contacts: ContactForces | None


def record_policy(
    env: Environment,
    policy: Policy | None = None,
    *,
    seconds: float | None = None,
    samples: int = 1,
    seed: int = 0,
    params: Params | None = None,
) -> RecordedEpisodes:
    """Run a policy in an environment and return the motion.

    Args:
        env: the environment.
        policy: function (observation, key) that returns an action (na,); None for random actions,
            uniform in `env.action_range`, and in -1..1 without two limits.
        seconds: duration; None for one episode, or 10 s of a longer one.
        samples: number of robots.
        seed: of the random numbers.
        params: parameters of the environment; None for its own.

    Returns:
        `RecordedEpisodes`: the trajectory, rewards, ends of episodes, contact forces of the first
        robot.

    Raises:
        InputError: not an environment, or a policy that is not a function.

    Example:
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> found = rb.plotting.record_policy(env, seconds=0.1, samples=3)
        >>> found.reward.shape[0], found.trajectory.q.shape[-1]
        (3, 2)
    """
    instance("record_policy", "env", env, Environment, "rb.envs.Environment")
    if policy is not None:
        check_takes("record_policy", "policy", policy, "observation", "key")
    samples = integer("record_policy", "samples", samples, least=1)
    integer("record_policy", "seed", seed)
    if params is not None:
        instance(
            "record_policy", "params", params, Params, "Params, as env.default_params, or None"
        )
    longest = min(env.episode * env.dt, 10.0) if seconds is None else seconds
    least = real_number("record_policy", "seconds", longest, least=0.0)
    steps = max(1, round(least / env.dt))
    act = _random_actions(env) if policy is None else policy
    first, key = jax.random.split(jax.random.key(seed))
    obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(first, samples), params)

    step = jax.vmap(lambda keys, state, action: env.step(keys, state, action, params))

    def one(carry: tuple, key: jax.Array) -> tuple:
        obs, state = carry
        _, (obs, state, reward, done, _) = batch_step(act, step, obs, state, key, samples)
        return (obs, state), (_kept(state), reward, done)

    start = _kept(state)
    run = jax.jit(lambda carry, keys: jax.lax.scan(one, carry, keys)[1])
    moved, reward, done = run((obs, state), jax.random.split(key, steps))
    states, ctrl, drawn = jax.tree.map(
        lambda a, b: np.moveaxis(np.concatenate([np.asarray(a)[None], np.asarray(b)]), 0, 1),
        start, moved,
    )  # fmt: skip
    ts = env.dt * np.arange(steps + 1)
    ok = np.isfinite(states.q).all((1, 2))
    trajectory = Trajectory(
        jnp.asarray(ts), jnp.asarray(states.q), jnp.asarray(states.v), jnp.asarray(ok)
    )
    model = env.default_params.model if params is None else params.model
    first_sample = jax.tree.map(lambda x: x[0], (states, ctrl, drawn))
    contacts = _contacts(env, model, *first_sample)
    return RecordedEpisodes(
        trajectory, np.moveaxis(np.asarray(reward), 0, 1), np.asarray(done).T, contacts
    )


def animate_policy(
    env: Environment,
    policy: Policy | None,
    path: str | Path,
    *,
    seconds: float | None = None,
    samples: int = 1,
    seed: int = 0,
    params: Params | None = None,
    source: Any = None,
    title: str | None = None,
    **options: Any,
) -> Path:
    """Write an animation of a policy in its environment, with the contact forces.

    Use it to look at a trained policy, or at a task with random actions. An HTML page shows
    thousands of robots, GIF and MP4 the first eight.

    Args:
        env: the environment.
        policy: function (observation, key) that returns an action (na,); None for random actions.
        path: the file to write: .html, .gif or .mp4.
        seconds: duration; None for one episode, or 10 s of a longer one.
        samples: number of robots; the first is drawn in full colour.
        seed: of the random numbers.
        params: parameters of the environment; None for its own.
        source: a robot file whose geoms are drawn; None for the geoms of the model.
        title: text at the top; None for the name of the task.
        options: of `rbjax.plotting.animate`, such as fps, speed, follow, tracked, trace, camera,
            size. The view follows the body `Task.tracked`.

    Returns:
        The path.

    Raises:
        InputError: another suffix, not an environment, wrong options.

    Example:
        >>> import pathlib, tempfile
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "random.html"
        >>> rb.plotting.animate_policy(env, None, file, seconds=0.2, samples=100).name
        'random.html'
    """
    path = file_path("animate_policy", path)
    writable(path)
    found = record_policy(env, policy, seconds=seconds, samples=samples, seed=seed, params=params)
    model = env.task.model
    drawn = samples if path.suffix == ".html" else min(samples, FEW)
    given = {"samples": drawn, "contacts": found.contacts, "tracked": tracked_body(env)}
    title = env.task.name.replace("_", " ") if title is None else title
    shapes = drawn_source(model) if source is None else source
    return animate(model, found.trajectory, path, source=shapes, title=title, **given | options)


def drawn_source(model: Model) -> Model | None:
    """Return the model if it has geoms to draw, else None, which draws rods and ellipsoids."""
    return model if any(s.body >= 0 for s in solids(model)) else None


def tracked_body(env: Environment) -> str:
    """Return the name of the body that a view follows: `Task.tracked`, or the first body."""
    task = env.task
    return task.model.body_names[0] if task.tracked is None else task.tracked


def _kept(state: EnvState) -> tuple:
    """Return the parts of a state that the drawing needs."""
    motion = state.state
    return State(motion.q, motion.v, motion.x), state.ctrl, state.drawn


def _random_actions(env: Environment) -> Policy:
    _, center, scale = action_center_and_scale(*map(jnp.asarray, env.action_range))
    low, high = center - scale, center + scale

    def act(obs: Any, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (env.action_size,), env.dtype, low, high)

    return act


def _contacts(env: Environment, model: Model, states: Any, ctrl: Any, drawn: Any) -> Any:
    """Solve for the contact forces of one robot at all times; None without a contact law."""
    law = env.task.model.contact if env.task.contact is None else env.task.contact
    if law is None:
        return None

    def forces(state: State, ctrl: jax.Array, drawn: Any) -> ContactForces:
        own = model
        for r in env.task.randomise:
            own = r.apply(own, drawn[r.name])
        return contacts_of.solve(own, state, ctrl, contact=law, dt=env.task.dt).contacts

    return jax.jit(jax.vmap(forces))(states, ctrl, drawn)
