"""Feet of a walking robot: variables of contact and air time, and the terms that read them.

`Feet` has the sites of the feet and the pairs of geoms whose touch is a contact. Its variables are

    last_contact (n,)   whether each foot touched after the last step
    air_time (n,)       s, since the last contact, this step included
    swing_peak (n,)     m, the greatest height of the site since the last contact
A foot lands in a step if it touches now and did not touch after the step before. The terms are sums
over feet. h is the height of a site, v its velocity in world axes.

Source of the terms: Zakka et al., *MuJoCo Playground*, 2025, locomotion tasks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.display import displayed
from rbjax.envs.task import Variable
from rbjax.envs.terms.frames import Term, frame_at, length, norm, scalar
from rbjax.envs.terms.joints import STILL
from rbjax.envs.terms.touch import touching_at
from rbjax.lanes import safe_sqrt
from rbjax.sensors.fixed import reading


@displayed
@dataclass(frozen=True)
class Feet:
    """The feet of a robot.

    sites: a site or body of each foot. pairs: the geoms whose touch is the contact of each foot.
    command: variable of the task; rewards that need motion are zero while it is.

    Example:
        >>> import rbjax as rb
        >>> feet = rb.envs.terms.Feet(("FR", "FL"), (("FR", "floor"), ("FL", "floor")))
        >>> [variable.name for variable in feet.variables()]
        ['last_contact', 'air_time', 'swing_peak']
    """

    sites: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    command: str = "command"

    def variables(self) -> tuple[Variable, ...]:
        """Return the variables of the task that the terms read."""

        def none(key: Any, params: Any) -> jax.Array:
            return jnp.zeros(len(self.sites))

        def contact_after(key: Any, transition: Any) -> jax.Array:
            return self.contact(transition).astype(transition.after.q.dtype)

        def flown(transition: Any) -> jax.Array:
            return transition.variables["air_time"] + jnp.asarray(
                transition.dt, transition.after.q.dtype
            )

        def peak(transition: Any) -> jax.Array:
            return jnp.maximum(transition.variables["swing_peak"], self.heights(transition))

        def without_contact(name: str) -> Any:
            return lambda key, transition: jnp.where(
                self.contact(transition), 0.0, transition.variables[name]
            )

        return (
            Variable("last_contact", none, update=contact_after),
            Variable("air_time", none, measure=flown, update=without_contact("air_time")),
            Variable("swing_peak", none, measure=peak, update=without_contact("swing_peak")),
        )

    def contact(self, transition: Any) -> jax.Array:
        """Observe whether each foot (n,) touches."""
        return touching_at(transition.after, self.pairs)

    def heights(self, transition: Any) -> jax.Array:
        """Observe the heights (n,) of the sites in the world, m."""
        return reading(
            transition.after, [frame_at(transition.after, s).position[2] for s in self.sites]
        )

    def velocities(self, transition: Any) -> jax.Array:
        """Observe the velocities (3 n,) of the sites in world axes, foot by foot, m/s."""
        return reading(
            transition.after,
            [x for s in self.sites for x in frame_at(transition.after, s).velocity],
        )

    def speeds(self, transition: Any) -> jax.Array:
        """Return the horizontal speeds (n,) of the sites, m/s."""
        each = (frame_at(transition.after, s).velocity for s in self.sites)
        return reading(transition.after, [length((v[0], v[1])) for v in each])

    def landing(self, transition: Any) -> jax.Array:
        """Return whether each foot (n,) lands in this step."""
        flew = (
            transition.variables["air_time"] > 1.5 * transition.dt
        )  # before this step more than zero
        return flew & self.contact(transition)

    def slip(self, t: Any) -> jax.Array:
        """Return the sum of |v_xy|^2 of the feet in contact, zero without a command."""
        speed = self.speeds(t)
        return self._moving(t, jnp.where(self.contact(t), speed * speed, 0.0).sum())

    def clearance(self, height: float) -> Term:
        """Return the term: sum of |h - height| sqrt(|v_xy|), small if feet swing at a height."""

        def read(t: Any) -> jax.Array:
            speeds = self.speeds(t)
            roots = jnp.stack([safe_sqrt(speeds[i]) for i in range(len(self.sites))])
            return (jnp.abs(self.heights(t) - height) * roots).sum()

        return read

    def swing_height(self, height: float, *, always: bool = False) -> Term:
        """Return the term: sum of (swing_peak / height - 1)^2 of the feet that land.

        always: whether it also counts without a command."""

        def read(transition: Any) -> jax.Array:
            error = transition.variables["swing_peak"] / height - 1.0
            found = jnp.where(self.landing(transition), error * error, 0.0).sum()
            return found if always else self._moving(transition, found)

        return read

    def air_time_reward(
        self, least: float, most: float | None = None, *, always: bool = False
    ) -> Term:
        """Return the term: sum of min(air_time, most) - least, s, of the feet that land.

        always: whether it also counts without a command."""

        def read(transition: Any) -> jax.Array:
            time = transition.variables["air_time"]
            time = time if most is None else jnp.minimum(time, most)
            found = jnp.where(self.landing(transition), time - least, 0.0).sum()
            return found if always else self._moving(transition, found)

        return read

    def base_slip(self, frame: Any) -> Term:
        """Return the term: horizontal speed of a frame, m/s, times the number of touching feet."""

        def read(transition: Any) -> jax.Array:
            v = frame_at(transition.after, frame).velocity
            count = self.contact(transition).astype(transition.after.q.dtype).sum()
            return scalar(transition.after, length((v[0], v[1]))) * count

        return read

    def _moving(self, transition: Any, value: jax.Array) -> jax.Array:
        return jnp.where(norm(transition.variables[self.command]) > STILL, value, 0.0)
