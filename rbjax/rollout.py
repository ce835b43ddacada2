"""`rollout`: fixed steps for throughput.

On a GPU all steps of a sample are one thread (`march`). Elsewhere the batch is the last axis of
everything inside, so that a lane is contiguous, and on the CPU time runs inside a chunk of the
batch (`dynamics.batching`).

Memory of the reverse gradient of the latter: the scan over saved states keeps one state each;
between two saved states only the first is kept and the steps are run again. So (T / save_every +
save_every) states and one step's intermediate values, per sample.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiled, staged
from rbjax.dynamics.arguments import (
    check_array,
    check_arrays,
    check_control,
    check_moves,
    check_step,
)
from rbjax.dynamics.batching import chunks
from rbjax.dynamics.devices import memory_share
from rbjax.dynamics.tracing import opened
from rbjax.errors import InputError
from rbjax.integrators import INTEGRATORS
from rbjax.march import on_threads
from rbjax.meshes import on_auto_axes
from rbjax.model import Model, State
from rbjax.solvers.arguments import check_whole
from rbjax.threads import wanted
from rbjax.trajectory import Trajectory, all_finite

Policy = Callable[[jax.Array, State], jax.Array]


def rollout(
    model: Model,
    state: State,
    ctrls: jax.Array | Policy | None = None,
    dt: float | None = None,
    *,
    integrator: str = "semi_implicit_euler",
    save_every: int = 1,
    steps: int | None = None,
    kernel: bool | None = None,
    memory: float | None = None,
) -> Trajectory:
    """Fixed steps of one state or of a batch of states: the throughput path.

    v+ = v + dt a(q, v, u), q+ = q (+) dt v+ (`semi_implicit_euler`), or an explicit Runge-Kutta
    method on the manifold: `rk4`, `tsit5`, `dopri8`, `dop853`, of order 4, 5, 8, 8 with 4, 6, 13,
    12 evaluations. In f64 `dop853` needs 10 to 15 % fewer than `dopri8` for an error of 1e-6 (on
    an arm and a humanoid); in f32 it comes down to 1.1e-6, `dopri8` to 2.4e-7.

    Args:
        model: the robot.
        state: q (nq,) or (B, nq), v likewise; a leading axis is a batch.
        ctrls: (steps, nu), or (B, steps, nu) for a batch; or a policy (t, state) -> (nu,),
            evaluated once a step; or None for no actuation. The last two need `steps`.
        dt: step in seconds; the model's timestep if None.
        integrator: one of "semi_implicit_euler", "rk4", "tsit5", "dopri8", "dop853".
        save_every: keep every so many states; it must divide the number of steps.
        steps: how many steps, where ctrls does not tell.
        kernel: whether a sample is a thread (False: a scan under XLA). None: where there is a GPU.
        memory: bytes that a reverse gradient of threads may keep states in, for the whole batch;
            the fewer, the more steps run twice. None: an eighth of the memory of the devices that
            a batch can be spread over.

    Returns:
        `Trajectory` of 1 + steps / save_every states, the first the initial one; q (T, nq), or
        (B, T, nq) for a batch; `ok` says whether all is finite.

    Raises:
        InputError: shapes, dtypes, values that are not finite, unknown integrator, a step that is
            not positive, no steps, a policy that returns anything but nu numbers.

    Differentiable in state, ctrls, model and what a policy closes over, forward and in reverse. The
    reverse gradient keeps steps / save_every + save_every states a sample; on a GPU every k-th
    state, with the smallest divisor k of save_every for which they fit into `memory`.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, I.1, IV.8; Tsitouras (2011);
    Prince & Dormand (1981); Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*,
    II.5 (`dop853`).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> rb.rollout(model, model.default_state(), jnp.zeros((10, 1)), 0.01).q.shape
        (11, 2)
    """
    if integrator not in INTEGRATORS:
        raise InputError(f"rollout: integrator {integrator!r}, expected one of {list(INTEGRATORS)}")
    state, ctrls, steps, batched = _checked(model, state, ctrls, steps)
    check_whole("rollout", "save_every", save_every, 1, why=f", a divisor of the {steps} steps")
    if steps % save_every:
        raise InputError(
            f"rollout: save_every is {save_every}, expected a divisor of the {steps} steps"
        )
    step = check_step("rollout", "dt", model.timestep if dt is None else dt, state.q.dtype)
    # the arrays of a policy that is a pytree are arguments, as the values of controls are
    given, policy = eqx.partition(ctrls, eqx.is_array)
    traced = opened((model, state, given, step))[0]
    run = _run if traced and (callable(ctrls) or staged()) else _compiled
    threads = wanted() if kernel is None else kernel
    memory = memory_share() if memory is None else memory
    return run(
        model, state, given, step, policy, integrator, int(save_every), steps, batched, threads,
        memory,
    )  # fmt: skip


def _run(
    model, state, given, dt, policy, integrator, save_every, steps, batched, threads, memory
) -> Trajectory:
    march = functools.partial(on_threads, memory=memory) if threads else _on_lanes

    def states(model, state, given, dt):
        ctrls = eqx.combine(given, policy)
        act = _acting(model, ctrls, state.q.dtype) if callable(ctrls) else None
        ctrls = None if callable(ctrls) else ctrls
        return march(model, state, ctrls, dt, act, integrator, save_every, steps, batched)

    each = () if callable(policy) or given is None or given.ndim < 3 else (given,)
    along = (state.q, state.v, *each) if batched else ()
    qs, vs = on_auto_axes(states, model, state, given, dt, along=along)
    ts = dt * jnp.arange(0, steps + 1, save_every, dtype=qs.dtype)
    return Trajectory(ts, qs, vs, all_finite(qs, vs), stats={"steps": steps})


_compiled = compiled(
    _run,
    static_argnames=(
        "policy", "integrator", "save_every", "steps", "batched", "threads", "memory"
    ),
)  # fmt: skip


def _on_lanes(model, state, ctrls, dt, policy, integrator, save_every, steps, batched):
    """The states (..., T, nq) and (..., T, nv), under XLA."""
    q, v = (x.T if batched else x for x in (state.q, state.v))
    if ctrls is not None:
        ctrls = jnp.moveaxis(ctrls, 0, -1) if ctrls.ndim == 3 else ctrls

    def march(q, v, ctrls):
        return _march(model, q, v, ctrls, dt, policy, integrator, save_every, steps)

    if batched and jax.default_backend() == "cpu":
        axes = [-1, -1, -1 if ctrls is not None and ctrls.ndim == 3 else None]
        qs, vs = chunks(lambda x: march(*x), [q, v, ctrls], axes, q.shape[-1], -1)
    else:
        qs, vs = march(q, v, ctrls)
    return [jnp.moveaxis(x, -1, 0) for x in (qs, vs)] if batched else (qs, vs)


def _march(model, q, v, ctrls, dt, policy, integrator, save_every, steps):
    """States (T, nq, ...) and (T, nv, ...) from the first one on. Batch last."""
    step = INTEGRATORS[integrator]

    def once(carry, i):
        q, v = carry
        if policy is not None:
            ctrl = _act(policy, i * dt, q, v)
        elif ctrls is None:
            ctrl = None
        else:
            ctrl = ctrls[i]
            if ctrl.ndim < q.ndim:
                ctrl = jnp.broadcast_to(ctrl[:, None], (*ctrl.shape, q.shape[-1]))
        return step(model, q, v, ctrl, dt), None

    def segment(carry, start):
        if save_every == 1:
            carry, _ = once(carry, start)
        else:
            carry, _ = jax.lax.scan(jax.checkpoint(once), carry, start + jnp.arange(save_every))
        return carry, carry

    starts = jnp.arange(0, steps, save_every)
    _, (qs, vs) = jax.lax.scan(jax.checkpoint(segment), (q, v), starts)
    return jnp.concatenate([q[None], qs]), jnp.concatenate([v[None], vs])


def _acting(model: Model, policy: Policy, dtype) -> Policy:
    """The policy, what it returns looked at."""
    return lambda t, state: check_control("rollout", model, policy(t, state), dtype)


def _act(policy: Policy, t, q, v):
    if q.ndim == 1:
        return policy(t, State(q, v))
    act = jax.vmap(lambda q, v: policy(t, State(q, v)), in_axes=-1, out_axes=-1)
    return act(q, v)


def _checked(model, state, ctrls, steps):
    """State and controls in one dtype, the number of steps, and whether there is a batch."""
    shape = np.shape(state.q) if isinstance(state, State) else ()
    batched = len(shape) == 2
    batch = shape[:1] if batched else ()
    if batch == (0,):
        raise InputError(
            f"rollout: q has shape {shape}, a batch of no states, expected one or more"
        )
    state = check_arrays("rollout", model, {"state": state}, batch)["state"]
    check_moves("rollout", model)
    if steps is not None:
        check_whole("rollout", "steps", steps, 1)
    if callable(ctrls) or ctrls is None:
        if steps is None:
            raise InputError(
                "rollout: steps is None, expected a number with a policy or no controls"
            )
        return state, ctrls, int(steps), batched
    if steps is None:
        steps = max(1, np.shape(ctrls)[-2]) if np.ndim(ctrls) > 1 else 1
    shapes = [(*lead, int(steps), model.nu) for lead in dict.fromkeys([(), batch])]
    fix = ": a row of nu numbers a step; or a policy (t, state) -> (nu,), or None"
    ctrls = check_array("rollout", "ctrls", ctrls, *shapes, fix=fix)
    return state, ctrls.astype(state.q.dtype), int(steps), batched
