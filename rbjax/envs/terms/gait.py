"""A gait clock: phases of the legs, and a reward for feet that follow the height of their phase.

The phase p in [-pi, pi) of a leg grows by 2 pi f dt a step. With x = (p + pi) / (2 pi) the height
of a foot rises to h and falls again by cubic Bezier curves b(y) = y^3 + 3 y^2 (1 - y):

    z(p) = h b(2 x)  for x <= 1/2,      z(p) = h (1 - b(2 x - 1))  for x > 1/2
(Zakka et al., *MuJoCo Playground*, 2025; Shao et al., *Learning free gait transition*, 2021.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import instance, real_array, real_number
from rbjax.envs.task import Variable
from rbjax.envs.terms.feet import Feet
from rbjax.envs.terms.frames import Term, frame_at, length, norm, variable_of
from rbjax.envs.terms.joints import STILL

#: a robot that moves faster, m/s or rad/s, has to step
SLOW = 0.1


def gait_clock(dt: float, offsets: Sequence[float]) -> tuple[Variable, ...]:
    """Return the variables `phase` (n,), rad, and `gait_rate`, Hz, of a gait clock.

    The rate is drawn at a reset, uniform in `params.values["gait_rate"]` (2,).

    Args:
        dt: control step, s.
        offsets: phase of each leg at a reset, rad.

    Raises:
        InputError: dt is not a number above zero, or offsets are not numbers.

    Example:
        >>> import rbjax as rb
        >>> phase, rate = rb.envs.terms.gait_clock(0.02, (0.0, 1.5))
        >>> phase.start(None, None).tolist()
        [0.0, 1.5]
    """
    real_number("gait_clock", "dt", dt, above=0.0)
    real_array("gait_clock", "offsets", offsets, ndim=1)

    def rate(key: Any, params: Any) -> jax.Array:
        low, high = (params.values["gait_rate"][i] for i in (0, 1))
        return low + (high - low) * jax.random.uniform(key, ())

    def start(key: Any, params: Any) -> jax.Array:
        return jnp.asarray(list(map(float, offsets)))

    def advanced(key: Any, transition: Any) -> jax.Array:
        turned = (2 * math.pi * dt) * transition.variables["gait_rate"]
        return jnp.mod(transition.variables["phase"] + turned + math.pi, 2 * math.pi) - math.pi

    return Variable("phase", start, update=advanced), Variable("gait_rate", rate)


def phase_cosines(transition: Any) -> jax.Array:
    """Observe the cosines and then the sines of the phases.

    Args:
        transition: a `Transition`; the term reads its variable "phase" (n,), rad.

    Returns:
        (2 n,), without unit.

    Example:
        >>> from types import SimpleNamespace
        >>> import jax.numpy as jnp
        >>> from rbjax.envs.terms import phase_cosines
        >>> phase_cosines(SimpleNamespace(variables={"phase": jnp.zeros(2)})).tolist()
        [1.0, 1.0, 0.0, 0.0]
    """
    p = transition.variables["phase"]
    return jnp.concatenate([jnp.cos(p), jnp.sin(p)])


def height_of_phase(phase: jax.Array, height: float) -> jax.Array:
    """Compute the heights z(p) of feet that rise to `height`.

    Args:
        phase: (n,) phases in [-pi, pi), rad.
        height: height of a swing, m.

    Returns:
        (n,), m.

    Example:
        >>> import rbjax as rb
        >>> import jax.numpy as jnp
        >>> rb.envs.terms.height_of_phase(jnp.array([-jnp.pi, 0.0]), 0.25).tolist()
        [0.0, 0.25]
    """
    x = (phase + math.pi) / (2 * math.pi)
    rises = x <= 0.5
    y = jnp.where(rises, 2 * x, 2 * x - 1)
    b = y * y * y + 3 * y * y * (1 - y)
    return height * jnp.where(rises, b, 1 - b)


def follow_phase(
    feet: Feet, height: float, frame: Any, width: float = 0.01, command: str = "command"
) -> Term:
    """Return the reward of feet at the heights of their phases: exp(-sum of (h - z(p))^2 / width).

    It is zero if the command is zero and the frame moves slower than 0.1 m/s and 0.1 rad/s.

    Args:
        feet: the feet (n,) of the robot.
        height: height of a swing, m.
        frame: name of a site or of a body of the base, or an `rb.Frame`.
        width: of the reward, m^2.
        command: name of the variable of the task with the command.

    Returns:
        Function of a `Transition` that returns (), from 0 to 1.

    Raises:
        InputError: not `Feet`, or a height or width that is not above zero.

    Example:
        >>> import rbjax as rb
        >>> feet = rb.envs.terms.Feet(("FR", "FL"), (("FR", "floor"), ("FL", "floor")))
        >>> rb.envs.Reward("phase", rb.envs.terms.follow_phase(feet, 0.15, "imu")).weight
        1.0
    """
    instance("follow_phase", "feet", feet, Feet, "rb.envs.terms.Feet")
    real_number("follow_phase", "height", height, above=0.0)
    real_number("follow_phase", "width", width, above=0.0)

    def read(transition: Any) -> jax.Array:
        error = feet.heights(transition) - height_of_phase(transition.variables["phase"], height)
        base = frame_at(transition.after, frame)
        v, w = base.velocity, base.angular_velocity
        moves = (length((v[0], v[1])) > SLOW) | (jnp.abs(w[2]) > SLOW)
        moves = moves | (norm(variable_of(transition, command)) > STILL)
        return jnp.where(moves, jnp.exp(-(error * error).sum() / width), 0.0)

    return read
