"""Maps of the action of a policy to the controls of a robot.

A map is any object with `size(model)`, `range(model)` and `ctrl(action, state, params)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_array
from rbjax.display import displayed
from rbjax.envs.episode import EnvState, Params
from rbjax.errors import InputError
from rbjax.model import Model


def action_center_and_scale(low: Any, high: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the map of -1..1 to the range of an action: a = center + scale * x.

    Args:
        low, high: limits of an action, each (na,); infinite for none.

    Returns:
        limited: whether an entry has both limits, (na,).
        center, scale: (low + high) / 2 and (high - low) / 2, each (na,); 0 and 1 without limits.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.envs.actions import action_center_and_scale
        >>> _, center, scale = action_center_and_scale(jnp.array([2.0]), jnp.array([6.0]))
        >>> float(center[0]), float(scale[0])
        (4.0, 2.0)
    """
    low, high = jnp.asarray(low), jnp.asarray(high)
    limited = jnp.isfinite(high - low)
    center = jnp.where(limited, 0.5 * (low + high), 0.0)
    return limited, center, jnp.where(limited, 0.5 * (high - low), 1.0)


@displayed
@dataclass(frozen=True)
class Direct:
    """The action is the controls, clipped to their ranges.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Direct().size(rb.load("cart_pole"))
        1
    """

    def size(self, model: Model) -> int:
        """Return the number of entries of an action."""
        return model.nu

    def range(self, model: Model) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper limits (na,) of an action."""
        low, high = np.asarray(model.actuators.ctrlrange).T
        return low, high

    def ctrl(self, action: jax.Array, state: EnvState, params: Params) -> jax.Array:
        """Compute the controls (nu,)."""
        return _clipped(params.model, action)


@displayed
@dataclass(frozen=True)
class Scaled:
    """Actions of -1 to 1 are mapped to the ranges of the controls, and clipped to them.

    Controls without two limits are the clipped action itself, -1 to 1.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Scaled().range(rb.load("cart_pole"))
        (array([-1.]), array([1.]))
    """

    def size(self, model: Model) -> int:
        """Return the number of entries of an action."""
        return model.nu

    def range(self, model: Model) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper limits (na,) of an action."""
        return -np.ones(model.nu), np.ones(model.nu)

    def ctrl(self, action: jax.Array, state: EnvState, params: Params) -> jax.Array:
        """Compute the controls (nu,)."""
        low, high = jnp.asarray(params.model.actuators.ctrlrange, action.dtype).T
        _, center, scale = action_center_and_scale(low, high)
        return center + scale * jnp.clip(action, -1.0, 1.0)


@displayed
@dataclass(frozen=True)
class Offset:
    """The controls are rest + scale * action, clipped to their ranges: targets of servos near a
    posture.

    rest: (nu,) controls of a zero action, in the unit of the controls.
    scale: factor of the action, a number or (nu,).

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Offset((0.0,), 0.5).size(rb.load("cart_pole"))
        1
    """

    rest: Any
    scale: Any = 1.0

    def size(self, model: Model) -> int:
        """Return the number of entries of an action."""
        _check("Offset", "rest", self.rest, model)
        _check("Offset", "scale", self.scale, model)
        return model.nu

    def range(self, model: Model) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper limits (na,) of an action."""
        return -np.ones(model.nu), np.ones(model.nu)

    def initial_ctrl(self, model: Model) -> Any:
        """Return the controls (nu,) before the first step."""
        return np.broadcast_to(np.asarray(self.rest), (model.nu,))

    def ctrl(self, action: jax.Array, state: EnvState, params: Params) -> jax.Array:
        """Compute the controls (nu,)."""
        rest, scale = (jnp.asarray(x, action.dtype) for x in (self.rest, self.scale))
        return _clipped(params.model, rest + scale * action)


@displayed
@dataclass(frozen=True)
class Increment:
    """The action changes the controls: ctrl = last ctrl + scale * action, clipped to their ranges.

    scale: factor of the action, a number or (nu,).
    start: (nu,) controls before the first step; None for zero.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Increment(0.04).size(rb.load("cart_pole"))
        1
    """

    scale: Any = 1.0
    start: Any = None

    def size(self, model: Model) -> int:
        """Return the number of entries of an action."""
        _check("Increment", "scale", self.scale, model)
        _check("Increment", "start", 0.0 if self.start is None else self.start, model)
        return model.nu

    def range(self, model: Model) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper limits (na,) of an action."""
        return -np.ones(model.nu), np.ones(model.nu)

    def initial_ctrl(self, model: Model) -> Any:
        """Return the controls (nu,) before the first step."""
        start = 0.0 if self.start is None else self.start
        return np.broadcast_to(np.asarray(start), (model.nu,))

    def ctrl(self, action: jax.Array, state: EnvState, params: Params) -> jax.Array:
        """Compute the controls (nu,)."""
        return _clipped(params.model, state.ctrl + jnp.asarray(self.scale, action.dtype) * action)


def _check(where: str, name: str, x: Any, model: Model) -> None:
    """Raise InputError unless x is a finite number, or one of each control."""
    shape = real_array(where, name, x).shape
    if shape not in ((), (model.nu,)):
        raise InputError(f"{where}: {name} has shape {shape}, expected a number or ({model.nu},)")


def _clipped(model: Model, ctrl: jax.Array) -> jax.Array:
    low, high = jnp.asarray(model.actuators.ctrlrange, ctrl.dtype).T
    return jnp.clip(ctrl, low, high)
