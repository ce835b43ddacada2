"""`Environment`: `reset` and `step` of a task, pure functions of one sample.

    reset: state ~ start,  o = observations(state)
    step:  u = action map(a),  events,  physics (decimation steps),  variables, rewards,
           terminations,  reset by select if the episode ends,  observations
A batch under `vmap` is one kernel. If the robot has contacts, it is three kernels: before the
physics, the physics, after it. One kernel would be slower, because values that later terms need
occupy registers while the contact problems are solved.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import flag, instance, integer, random_key, shown
from rbjax.compiling import compiled, inside_jit
from rbjax.control.optimal.problem import Problem
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_takes
from rbjax.dynamics.drivers.choice import on_threads
from rbjax.dynamics.tracing.algorithm import with_compiled_constants
from rbjax.dynamics.tracing.one_sample import run_sample
from rbjax.envs.checks import check_params, check_shape, check_task, number_of
from rbjax.envs.control_step import ControlStep, key_of, with_model
from rbjax.envs.episode import EnvState, Params
from rbjax.envs.optimal_control import deterministic_step, parts_read, task_problem
from rbjax.envs.task import Task
from rbjax.envs.task_table import environment_display
from rbjax.errors import InputError
from rbjax.meshes import automatic, on_auto_axes, on_explicit_axes
from rbjax.model import Model


@displayed
class Environment:
    """A task as a functional environment: `reset(key, params)`, `step(key, state, action, params)`.

    Use it to train policies, with the adapters for learning libraries or directly: the functions
    are pure, for one sample, and compose with `jit`, `vmap`, `grad`.

    Args:
        task: an `rb.envs.Task`.
        kernel: True or None: a batch is one kernel if the platform supports it. False: XLA.

    Attributes:
        action_size: number of entries of an action.
        action_range: lower and upper limits of an action, each (na,).
        observation_size: number of entries of an observation; with several groups a dict.
        dt: control step in s.
        episode: control steps in an episode.
        control_step: the functions of one control step of one sample.
        default_params: the `Params` of the task.
        name: name of the task in the registry, as given to `rb.envs.make`; None for a task of one's
            own.
        options: options of the named task, as given to `rb.envs.make`.

    Raises:
        InputError: a term of the task returns a wrong shape, or a name occurs twice.

    Source: the interface of gymnax (Lange, 2022), with parameters as an argument.

    Example:
        >>> import jax, jax.numpy as jnp, rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> obs, state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4))
        >>> obs, state, reward, done, info = jax.vmap(env.step)(
        ...     jax.random.split(jax.random.key(1), 4), state, jnp.zeros((4, 1)))
        >>> obs.shape, reward.shape
        ((4, 5), (4,))
    """

    _display_ = environment_display

    def __init__(self, task: Task, *, kernel: bool | None = None):
        check_task(task)
        self.task = task
        self.kernel = kernel is None or flag("Environment", "kernel", kernel)
        self.control_step = ControlStep(task)
        self.dtype = self.control_step.dtype
        self.dt = self.control_step.step * task.decimation
        self.episode = task.episode
        self.action_size: int = self.control_step.action_size
        self.action_range = task.action.range(task.model)
        # set by `rb.envs.make`
        self.name: str | None = None
        self.options: dict[str, Any] = {}
        self._programs: dict[tuple[str, bool], Callable] = {}
        self._traced: dict[str, dict] = {}
        self._check_terms()

    @functools.cached_property
    def default_params(self) -> Params:
        """The parameters of the task."""
        values = self.task.values.items()
        with jax.ensure_compile_time_eval():
            return Params(
                model=self.task.model,
                weights={r.name: jnp.asarray(r.weight, self.dtype) for r in self.task.rewards},
                noise=jnp.ones((), self.dtype),
                values={name: number_of(self.task, name, x, self.dtype) for name, x in values},
            )

    @functools.cached_property
    def _default_model(self) -> Model:
        """The model of the task with the driver of kernels. Its leaves stay the same objects, by
        which traced programs are found again."""
        with jax.ensure_compile_time_eval():
            return on_threads(self.default_params.model, self.dtype)

    def reset(self, key: jax.Array, params: Params | None = None) -> tuple[Any, EnvState]:
        """Begin an episode.

        Args:
            key: of `jax.random`.
            params: parameters; None for `default_params`.

        Returns:
            The observation: (n,), or a dict group -> (n,) if the task has several groups.
            The state of the episode.

        Raises:
            InputError: params of wrong shapes.
        """
        return self._call("reset", (_data("reset", key),), params)

    def step(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params | None = None
    ) -> tuple[Any, EnvState, jax.Array, jax.Array, dict[str, Any]]:
        """Advance an episode by a control step. If it ends, begin the next one.

        Args:
            key: of `jax.random`.
            state: state of the episode.
            action: (na,), in `action_range`.
            params: parameters; None for `default_params`.

        Returns:
            The observation and the state, of the next episode if this one ended.
            The reward of the step.
            done: True if the episode ended.
            info: "terminated": a termination of the task was true, or the step failed;
                "truncated": the last step of the episode, not terminated; "failed": the state, the
                action or the reward was not finite, and the reward is then 0; "rewards": name ->
                weighted reward term, not multiplied by dt; "return" and "length" of the episode up
                to this step.

        Raises:
            InputError: an action or params of wrong shapes.
        """
        return self._call("step", self._given("step", key, state, action), params)

    def step_once(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params | None = None
    ) -> tuple[Any, EnvState, jax.Array, jax.Array, dict[str, Any]]:
        """Advance an episode by a control step, like `step` but without the reset at its end.

        Use it for gradients through an episode, and if a learning library resets by itself.
        """
        return self._call("step_once", self._given("step_once", key, state, action), params)

    def unroll(
        self, key: jax.Array, obs: Any, state: EnvState, policy: Callable, steps: int,
        params: Params | None = None,
    ) -> tuple[Any, EnvState, dict[str, Any]]:  # fmt: skip
        """Run a policy for a number of steps, with the policy inside the kernel.

        Use it for small policies, such as gains or a network of some thousand weights. Under `vmap`
        all steps are one kernel. Call it inside `jax.jit`: outside, each call compiles again.

        Args:
            key: of `jax.random`.
            obs, state: observation and state of the episode.
            policy: function (obs, key) that returns an action (na,).
            steps: number of control steps.
            params: parameters; None for `default_params`.

        Returns:
            The observation and the state after the last step.
            "obs", "action", "reward", "done", "terminated", "truncated", each with a leading axis
            of steps. "obs" are the observations before each action.

        Example:
            >>> import jax, jax.numpy as jnp, rbjax as rb
            >>> env = rb.envs.make("cart_pole_balance")
            >>> obs, state = env.reset(jax.random.key(0))
            >>> policy = lambda obs, key: jnp.zeros(1, obs.dtype)
            >>> obs, state, path = env.unroll(jax.random.key(1), obs, state, policy, 10)
            >>> path["reward"].shape
            (10,)
        """
        integer("unroll", "steps", steps, least=1)
        check_takes("unroll", "policy", policy, "obs", "key")
        instance("unroll", "state", state, EnvState, "the rb.envs.EnvState that reset returned")
        sizes = self.observation_size
        structures: list[Any] = [jax.tree.structure(x) for x in (obs, sizes)]
        if structures[0] != structures[1]:
            expected = sorted(sizes) if isinstance(sizes, dict) else "an array"
            raise InputError(
                f"unroll: obs is {shown(obs)}, expected the observation that reset returned, "
                f"{expected}"
            )
        obs = jax.tree.map(
            lambda x, n: check_shape("unroll", "obs", x, (n,), jnp.result_type(x)), obs, sizes
        )

        def all_steps(own: tuple, params: Params) -> tuple:
            data, obs, state = own

            def one(carry: tuple, i: jax.Array) -> tuple:
                obs, state = carry
                act, step = jax.random.split(jax.random.fold_in(key_of(data), i))
                action = check_shape(
                    "unroll", "the action of the policy", policy(obs, act), (self.action_size,),
                    self.dtype,
                )  # fmt: skip
                after, state, reward, done, info = self._step(
                    (jax.random.key_data(step), state, action), params, _plain
                )
                kept = {"obs": obs, "action": action, "reward": reward, "done": done}
                kept |= {name: info[name] for name in ("terminated", "truncated")}
                return (after, state), kept

            end: tuple
            found: dict[str, Any]
            end, found = jax.lax.scan(one, (obs, state), jnp.arange(steps))
            return *end, found

        own, params = (_data("unroll", key), obs, state), self._params(params)
        if not self.kernel:
            return all_steps(own, params)
        saves = self.task.model.contact is not None
        run = automatic(functools.partial(run_sample, all_steps, saves=saves))
        return run(own, self._placed(params))

    def problem(
        self, horizon: int, params: Params | None = None, *, running: Sequence[Any] = (),
        terminal: Sequence[Any] = (), constraints: Sequence[Any] = (), design: Any = None,
    ) -> Problem:  # fmt: skip
        """Return the optimal control problem of the task: its cost is minus the return.

        Use it for trajectory optimisation (`rb.control.solve`) and model predictive control
        (`rb.control.mpc`) with the rewards of the task. Controls of the problem are actions, its
        states are pairs (now, last) of states of an episode: start it with the state of `reset`.

        The problem is deterministic. Left out are events, noise, delays and randomisation.
        Variables whose `update` draws random numbers keep their values. The motion goes on after a
        termination, whose reward is paid in each step in which it is true. A state that is not
        finite costs infinity.

        Args:
            horizon: number of control steps.
            params: parameters; None for `default_params`.
            running, terminal, constraints, design: further terms, as in `rb.control.Problem`. Their
                state is a pair: `state.now.state.q`. Running costs are summed, not multiplied by
                dt.

        Returns:
            `rb.control.Problem`.

        Raises:
            InputError: fewer than one step, or params of wrong shapes.

        Example:
            >>> import jax, rbjax as rb
            >>> env = rb.envs.make("cart_pole_balance")
            >>> problem = env.problem(20)
            >>> _, state = env.reset(jax.random.key(0))
            >>> plan = rb.control.solve(problem, state, iterations=5)
            >>> plan.ctrl.shape
            (20, 1)
        """
        integer("problem", "horizon", horizon, least=1)
        given = self._params(params)
        sample, parts = self._planned
        return task_problem(
            sample, parts, horizon, self.dt, given, self.action_range, running=running,
            terminal=terminal, constraints=constraints, design=design,
        )  # fmt: skip

    @functools.cached_property
    def _planned(self) -> tuple[ControlStep, tuple]:
        """The control step of `problem`, and the parts of its states with coordinates."""
        with jax.ensure_compile_time_eval():
            sample = deterministic_step(self.task, self.default_params, self.dtype)
            return sample, parts_read(sample, self.default_params)

    def _given(self, where: str, key: Any, state: Any, action: Any) -> tuple:
        data = _data(where, key)
        instance(where, "state", state, EnvState, "the rb.envs.EnvState that reset returned")
        return data, state, check_shape(where, "action", action, (self.action_size,), self.dtype)

    def _params(self, params: Params | None) -> Params:
        if params is None:
            return self.default_params
        check_params(self.task.name, params, self.default_params)
        return params

    def _call(self, name: str, own: tuple, params: Params | None) -> Any:
        """Run a function of one sample, compiled if the call is not inside `jit`. Default
        parameters are constants of the program."""
        f, given = getattr(self, f"_{name}"), self._params(params)
        if inside_jit():
            return self._run(f, own, given)
        default = params is None
        if (name, default) not in self._programs:
            program = functools.partial(self._run, f)
            if default:
                program = functools.partial(_with_last, program, given)
            self._programs[name, default] = compiled(program)
        return self._programs[name, default](own, *(() if default else (given,)))

    def _run(self, f: Callable, own: tuple, params: Params) -> Any:
        """Run a function (own, params, part) of one sample, whose parts are kernels."""
        if on_explicit_axes(own, params):
            return on_auto_axes(functools.partial(self._run, f), own, params)
        if not self.kernel:
            return f(own, params, _plain)
        params = self._placed(params)
        if self.task.model.contact is None:
            whole = functools.partial(f, part=_plain)
            return run_sample(whole, own, params, cache=self._traced.setdefault(f.__name__, {}))
        return f(own, params, self._kernel)

    def _placed(self, params: Params) -> Params:
        """Return the parameters with the driver and the link constants of kernels."""
        default = params is self.default_params
        model = self._default_model if default else on_threads(params.model, self.dtype)
        if not self.task.randomise:
            model = with_compiled_constants(model, self.dtype)
        return with_model(params, model)

    def _kernel(self, f: Callable, own: tuple, params: Params) -> Any:
        """Run a part of a step as a kernel, which is traced once for all programs that call it."""
        return run_sample(f, own, params, saves=True, cache=self._traced.setdefault(f.__name__, {}))

    def _reset(self, own: tuple, params: Params, part: Callable) -> tuple[Any, EnvState]:
        return part(self._first, own, params)

    def _first(self, own: tuple, params: Params) -> tuple[Any, EnvState]:
        begin, noise = jax.random.split(key_of(own[0]))
        state = self.control_step.begin(begin, params)
        return self.control_step.observe(noise, state, state, params, None)

    def _step(self, own: tuple, params: Params, part: Callable) -> tuple:
        return part(self._next, self._advance(own, params, part), params)

    def _step_once(self, own: tuple, params: Params, part: Callable) -> tuple:
        return part(self._last, self._advance(own, params, part), params)

    def _advance(self, own: tuple, params: Params, part: Callable) -> tuple:
        """Integrate a control step. Return the arguments of `ControlStep.after_physics`."""

        def physics(own: tuple, params: Params) -> tuple:
            state, step, drawn, ctrl = own
            return self.control_step.physics(state, step, drawn, ctrl, params)

        state, ctrl, rest = part(self.control_step.before_physics, own, params)
        moved = part(physics, (state.state, state.step, state.drawn, ctrl), params)
        return rest, state, own[2], ctrl, moved

    def _next(self, own: tuple, params: Params) -> tuple:
        return self.control_step.after_physics(own, params, resets=True)

    def _last(self, own: tuple, params: Params) -> tuple:
        return self.control_step.after_physics(own, params, resets=False)

    def _check_terms(self) -> None:
        """Trace a reset and a step, so that wrong terms raise an error, and count observations."""
        key = jax.ShapeDtypeStruct((2,), jnp.uint32)
        params = self.default_params
        obs, state = jax.eval_shape(lambda data: self._first((data,), params), key)
        action = jax.ShapeDtypeStruct((self.action_size,), self.dtype)

        def step(data: jax.Array, state: EnvState, action: jax.Array) -> tuple:
            last, ctrl = self.control_step.prepare(key_of(data), state, action, params)
            motion = last.state, last.acceleration  # without the physics, whose trace takes longer
            return self._next((data, last, action, ctrl, motion), params)

        jax.eval_shape(step, key, state, action)
        self.observation_size = jax.tree.map(lambda x: x.shape[0], obs)


def _plain(f: Callable, own: tuple, params: Params) -> Any:
    return f(own, params)


def _with_last(f: Callable, params: Params, own: tuple) -> Any:
    return f(own, params)


def _data(where: str, key: Any) -> jax.Array:
    """Return the two integers of a key: threads do not take typed keys."""
    random_key(where, key)
    data = jax.random.key_data(key)
    return data if data.shape == (2,) else jax.random.bits(key, (2,), jnp.uint32)
