"""Environments for the training of policies: a robot, its cost, observations and initial states.

    u = pi(o(x)),     x+ = f(x, u; model),     J = sum gamma^k c(x_k, u_k)

A policy is any callable pytree (o,) -> (nu,): gains, a `Network`, a module of Equinox. Training
changes its floating-point arrays. Controls with bounds are u = mid + width / 2 tanh(pi). With
`randomise` each sample has its own model (domain randomisation, Tobin et al. 2017).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import flag, integer
from rbjax.dynamics.arguments import check_array, check_model, check_step, check_takes
from rbjax.errors import InputError, UnknownName
from rbjax.kinematics.arguments import check_key, check_several
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.field import dynamics_of, free_motion
from rbjax.motion.integrators import integrator_of
from rbjax.motion.rollout import rollout

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "tanh": jnp.tanh,
    "elu": jax.nn.elu,
    "silu": jax.nn.silu,
}


class Network(Record):
    """A feed-forward network (n,) -> (m,)."""

    weights: tuple[jax.Array, ...]  # each (out, in)
    biases: tuple[jax.Array, ...]  # each (out,)
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
    """Create a `Network` with random weights: W normal with variance 2 / in, b = 0.

    Args:
        key: of `jax.random`.
        sizes: of the input, each hidden layer, and the output.
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


class Segment(NamedTuple):
    """Motions of a batch: states (B, T + 1, ...), ctrl (B, T, nu), costs (B, T)."""

    states: State
    ctrl: jax.Array
    costs: jax.Array


class Environment(Record):
    """A robot with a cost, observations and initial states, for the training of a policy.

    Args (also its fields):
        model: an `rb.Model`.
        cost: (state, ctrl) -> a number, of one step.
        start: key -> `State`, the initial state of an episode.
        dt: the step in s; the model's timestep if None.
        observe: state -> (o,), the observation; q and v if None.
        randomise: (key, model) -> model, for each sample and episode; None for the model itself.
        lost: state -> bool, true to end an episode early; states that are not finite always end it.
        episode: number of steps of an episode.
        squash: if true, tanh maps controls to the model's control ranges, if those are finite.
        integrator: as in `rb.rollout`.

    Raises:
        InputError: wrong types, functions with other arguments.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> env = rb.control.Environment(
        ...     model, lambda state, ctrl: (state.q**2).sum() + 0.1 * (ctrl**2).sum(),
        ...     model.random_state, dt=0.05)
        >>> env.observation_size, env.squash
        (2, True)
    """

    model: Model
    dt: jax.Array
    cost: Callable[[State, jax.Array], jax.Array]
    start: Callable[[jax.Array], State]
    observe: Callable[[State], jax.Array]
    randomise: Callable[[jax.Array, Model], Model] | None
    lost: Callable[[State], jax.Array] | None
    integrator: Any
    episode: int = eqx.field(static=True)
    squash: bool = eqx.field(static=True)

    def __init__(
        self, model: Model, cost: Any, start: Any, *, dt: Any = None, observe: Any = None,
        randomise: Any = None, lost: Any = None, episode: int = 250, squash: bool = True,
        integrator: Any = None,
    ) -> None:  # fmt: skip
        check_model("Environment", model)
        if model.nu == 0:
            raise InputError("Environment: the model has no actuator, expected one or more")
        check_takes("Environment", "cost", cost, "state", "ctrl")
        check_takes("Environment", "start", start, "key")
        for name, f, takes in (
            ("observe", observe, ("state",)), ("randomise", randomise, ("key", "model")),
            ("lost", lost, ("state",)),
        ):  # fmt: skip
            if f is not None:
                check_takes("Environment", name, f, *takes)
        integer("Environment", "episode", episode, least=1)
        self.model, self.cost, self.start = model, cost, start
        dtype = jnp.zeros(()).dtype
        self.dt = check_step("Environment", "dt", model.timestep if dt is None else dt, dtype)
        self.observe = _all if observe is None else observe
        self.randomise, self.lost = randomise, lost
        dynamics = dynamics_of("Environment", model, free_motion, None, steps=True)
        integrator_of("Environment", integrator, dynamics, model)
        self.squash = flag("Environment", "squash", squash)
        self.episode, self.integrator = episode, integrator
        state = jax.eval_shape(start, jax.random.key(0))
        due = ((model.nq,), (model.nv,))
        if not isinstance(state, State) or (state.q.shape, state.v.shape) != due:
            got = type(state).__name__
            if isinstance(state, State):
                got = f"rb.State(q {state.q.shape}, v {state.v.shape})"
            raise InputError(
                f"Environment: start returned {got}, expected rb.State(q {due[0]}, v {due[1]})"
            )
        found = jax.eval_shape(cost, state, jnp.zeros(model.nu))
        if jnp.shape(found):
            raise InputError(
                f"Environment: cost returned shape {jnp.shape(found)}, expected a number"
            )

    @property
    def observation_size(self) -> int:
        """The length of an observation."""
        state = jax.eval_shape(self.start, jax.random.key(0))
        return jax.eval_shape(self.observe, state).shape[0]

    def act(self, policy: Any, state: State) -> jax.Array:
        """Return the controls (nu,) of a policy at a state."""
        return squash_controls(self, policy(self.observe(state)))

    def controller(self, policy: Any) -> Callable[[Any, State], jax.Array]:
        """Return the policy as a function (t, state) -> ctrl, for `rb.rollout`."""
        return lambda t, state: self.act(policy, state)

    def check_policy(self, where: str, policy: Any) -> None:
        """Raise InputError unless the policy fits this environment."""
        if not callable(policy):
            raise InputError(
                f"{where}: the policy is {type(policy).__name__}, expected a callable pytree such "
                "as rb.control.network(key, (n, 32, nu))"
            )
        size = self.observation_size
        try:
            found = eqx.filter_eval_shape(policy, jnp.zeros(size, self.dt.dtype))
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{where}: the policy fails for an observation ({size},), expected a function "
                f"of it that returns ({self.model.nu},): {error}"
            ) from error
        if jnp.shape(found) != (self.model.nu,):
            raise InputError(
                f"{where}: the policy of an observation ({size},) returned shape "
                f"{jnp.shape(found)}, expected ({self.model.nu},)"
            )

    def reset(self, key: jax.Array) -> tuple[Any, State]:
        """Draw a model (None if it is not randomised) and an initial state."""
        one, two = jax.random.split(key)
        model = None if self.randomise is None else self.randomise(one, self.model)
        state = self.start(two)
        if state.x is None and self.model.nx:
            state = State(state.q, state.v, self.model.start(state.q.dtype))
        return model, state

    def unroll(self, policy: Any, models: Any, states: State, steps: int) -> Segment:
        """Simulate a batch under a policy. models: of each sample, or None for `self.model`."""
        dt: Any = self.dt

        def moved(model: Model, state: State) -> Any:
            act, how = self.controller(policy), self.integrator
            run = rollout(model, state, act, dt, steps=steps, integrator=how)
            return State(run.q, run.v, run.x)

        path = moved(self.model, states) if models is None else jax.vmap(moved)(models, states)
        before = jax.tree.map(lambda x: x[:, :-1], path)
        ctrls = jax.vmap(jax.vmap(lambda state: self.act(policy, state)))(before)
        return Segment(path, ctrls, jax.vmap(jax.vmap(self.cost))(before, ctrls))


def squash_controls(env: Environment, y: jax.Array) -> jax.Array:
    """Map the unbounded output of a policy to controls, within their ranges by tanh if `squash`."""
    if not env.squash:
        return y
    low, high = jnp.asarray(env.model.actuators.ctrlrange, y.dtype).T
    mid, half = 0.5 * (low + high), 0.5 * (high - low)
    finite = jnp.isfinite(half)
    mid, half = jnp.where(finite, mid, 0.0), jnp.where(finite, half, 1.0)
    return jnp.where(finite, mid + half * jnp.tanh(y), y)


def _all(state: State) -> jax.Array:
    return jnp.concatenate([state.q, state.v])
