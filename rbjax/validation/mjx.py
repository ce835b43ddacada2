"""MJX in the comparison: one compiled step and one compiled vjp of a step.

The data of a step contains the quantities at its start (poses, M, bias, acceleration) and the state
at its end, so one program computes every quantity. The gradient of a trajectory applies the vjp of
the step backwards in time. Loops over time are in Python, because MJX compiles slowly in loops.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.compiling import WITHOUT_EMITTERS, xla_accepts
from rbjax.validation.ours import quick
from rbjax.validation.reference import Array, StateSamples

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    from mujoco import mjx  # prints at every import that warp is missing

#: XLA's CPU fusion makes MJX up to a thousand times slower; options that disable it, newest last
UNFUSED = (WITHOUT_EMITTERS, ("xla_disable_hlo_passes", "fusion"))


def fast() -> dict[str, Any] | None:
    """Return the first option of `UNFUSED` that this jaxlib accepts; None off the CPU."""
    if jax.default_backend() != "cpu":
        return None
    return dict([next(option for option in UNFUSED if xla_accepts(*option))])


class Mjx:
    """MJX on a model, in the precision that is active at its construction (`jax.enable_x64`)."""

    def __init__(self, m: mujoco.MjModel):
        if m.jnt_stiffnesspoly.any() or m.dof_dampingpoly.any() or m.tendon_stiffnesspoly.any():
            raise NotImplementedError("it has only linear joint springs and dampers")
        if m.actuator_damping.any() or m.actuator_dampingpoly.any() or m.actuator_armature.any():
            raise NotImplementedError("it has no damping and no armature of actuators")
        self.reference, self.model = m, mjx.put_model(m)
        self.blank = mjx.make_data(m)
        options = fast()
        options = options if options is None else options | quick()
        step = jax.vmap(self._step, (None, 0, 0, 0))
        self.step = jax.jit(step, compiler_options=options)
        self.vjp = jax.jit(jax.vmap(self._vjp, (None, 0, 0, 0, 0)), compiler_options=options)

    def _step(self, model: Any, q: jax.Array, v: jax.Array, ctrl: jax.Array) -> dict[str, Any]:
        d = mjx.step(model, self.blank.replace(qpos=q, qvel=v, ctrl=ctrl))
        pose = jnp.concatenate([d.xmat[1:].reshape(-1, 9), d.xpos[1:]], -1)
        return {
            "state": (d.qpos, d.qvel),
            "poses": pose,
            "velocities": self._velocities(d),
            "mass matrix": mjx.full_m(model, d),
            "bias forces": d.qfrc_bias,
            "forward dynamics": d.qacc,
        }

    def _velocities(self, d: Any) -> jax.Array:
        """Compute the twists at body origins. `cvel` is [angular; linear] at the centre of mass of
        the subtree."""
        m = self.reference
        arm = d.xpos[1:] - d.subtree_com[m.body_rootid[1:]]
        angular, linear = d.cvel[1:, :3], d.cvel[1:, 3:]
        return jnp.concatenate([angular, linear + jnp.cross(angular, arm)], -1)

    def _vjp(self, model: Any, q: Any, v: Any, ctrl: Any, cotangent: Any) -> Any:
        """Compute the cotangents of (q, v, ctrl) from the cotangents of the next state."""

        def step(q, v, ctrl):
            d = mjx.step(model, self.blank.replace(qpos=q, qvel=v, ctrl=ctrl))
            return d.qpos, d.qvel

        return jax.vjp(step, q, v, ctrl)[1](cotangent)

    def arrays(self, samples: StateSamples) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Convert the samples to arrays in the current precision."""
        dtype = jnp.result_type(float)
        q, v, ctrl = (jnp.asarray(x, dtype) for x in (samples.q, samples.v, samples.ctrl))
        return q, v, ctrl

    def quantities(self, samples: StateSamples) -> dict[str, Array]:
        """Compute the quantities of MJX at each state."""
        out = self.step(self.model, *self.arrays(samples))
        out["one step"] = jnp.concatenate(out.pop("state"), -1)
        return {name: np.asarray(x, np.float64) for name, x in out.items()}

    def motion(self, samples: StateSamples, steps: int, weights: Array | None) -> dict[str, Array]:
        """Compute final states (N, nq + nv) and gradients (N, nv + nu) of weights . final state."""
        q, v, ctrl = self.arrays(samples)
        path = []
        for _ in range(steps):
            path.append((q, v))
            q, v = self.step(self.model, q, v, ctrl)["state"]
        last = np.concatenate([q, v], -1)
        if weights is None:
            return {"trajectory": last.astype(np.float64)}
        nq = self.reference.nq
        row = jnp.broadcast_to(jnp.asarray(weights, q.dtype), last.shape)
        cotangent, pulled = (row[:, :nq], row[:, nq:]), jnp.zeros_like(ctrl)
        for q, v in reversed(path):
            dq, dv, du = self.vjp(self.model, q, v, ctrl, cotangent)
            cotangent, pulled = (dq, dv), pulled + du
        gradient = np.concatenate([cotangent[1], pulled], -1)
        out = {"trajectory": last, "gradient": gradient}
        return {name: np.asarray(x, np.float64) for name, x in out.items()}


def integrator(m: mujoco.MjModel, name: str, q: Any, v: Any, ctrl: Any, seconds: float) -> Any:
    """Make the integrator "Euler" or "RK4" of MJX for a batch q (N, nq), v (N, nv) and constant
    ctrl (nu,).

    The result maps a number of steps to the final (q, v), by one compiled program for all numbers.
    """
    m.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{name.upper()}")
    model = mjx.put_model(m)
    blank = mjx.make_data(m).replace(ctrl=jnp.asarray(ctrl))

    def run(model: Any, q: jax.Array, v: jax.Array, steps: jax.Array) -> Any:
        model = model.tree_replace({"opt.timestep": seconds / steps})
        data = jax.vmap(lambda q, v: blank.replace(qpos=q, qvel=v))(q, v)
        step = jax.vmap(mjx.step, (None, 0))
        data = jax.lax.fori_loop(0, steps, lambda _, d: step(model, d), data)
        return data.qpos, data.qvel

    compiled = jax.jit(run, compiler_options=fast())
    return lambda steps: compiled(model, q, v, steps)
