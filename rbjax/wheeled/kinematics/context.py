"""The state of a wheeled robot as lanes, and the rates of its coordinates."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rbjax.lanes import Lane, add, fusion_barrier, sub
from rbjax.wheeled.kinematics.parameters import Parameters
from rbjax.wheeled.kinematics.planar import Dual, Pair, direction, rotate, with_rate
from rbjax.wheeled.kinematics.velocities import Directions, caster_rates, shape_along, twists_of


@dataclass(frozen=True)
class RobotContext:
    """Parameters, coordinates, velocities, tyre states and controls of a robot as lanes. Functions
    of the angles are cached."""

    n: Parameters
    q: list[Lane]
    v: list[Lane]
    x: list[Lane]
    u: list[Lane]

    def with_velocities(self, v: list[Lane], x: list[Lane]) -> RobotContext:
        """Return a copy with other velocities and tyre states."""
        out = replace(self, v=v, x=x)
        known = ("pose", "directions", "shape")
        vars(out).update({name: found for name, found in vars(self).items() if name in known})
        return out

    @functools.cached_property
    def pose(self) -> Pair:
        """The heading of the chassis, as its cosine and sine."""
        return fusion_barrier(direction(self.q[2]))

    @functools.cached_property
    def directions(self) -> list[Pair]:
        """Cosine and sine of the angles of trailers, steerings and casters."""
        return fusion_barrier([direction(a) for a in angles_of(self)])

    @functools.cached_property
    def shape(self) -> Directions:
        """The `Directions`: directions of trailers and wheels at the current angles."""
        return shape_along(self.n, self.directions)

    def bodies(self) -> list[tuple[Pair, Pair]]:
        """Compute the origin and the heading (cosine and sine) of each body on the ground."""
        n = self.n
        out = [((self.q[0], self.q[1]), self.pose)]
        for k, body in enumerate(n.bodies[1:], start=1):
            at, ahead = out[n.ahead(k)]
            e = rotate(self.shape.trailers[k - 1], ahead)
            hitch, bar = rotate(body.hitch, ahead), rotate((body.drawbar, 0.0), e)
            x, y = (sub(add(a, b), c) for a, b, c in zip(at, hitch, bar, strict=True))
            out.append(((x, y), e))
        return out

    def shape_with_rate(self, w: Sequence[Lane]) -> Directions:
        """Compute the `Directions` and their rates, as `Dual` lanes, at full velocities w."""
        rates = angle_rates(self, w)
        return shape_along(
            self.n, [with_rate(e, rate) for e, rate in zip(self.directions, rates, strict=True)]
        )

    def shape_with_two_rates(self, w: Sequence[Lane]) -> Directions:
        """Compute the `Directions` with first and second time derivatives, at constant rates of
        the angles."""
        rates = angle_rates(self, w)
        return shape_along(
            self.n,
            [with_rate(with_rate(e, r), Dual(r, 0.0))
             for e, r in zip(self.directions, rates, strict=True)],
        )  # fmt: skip


def angles_of(context: RobotContext) -> list[Lane]:
    """Return the angles of trailers, steerings and casters, on which the `Directions` depends."""
    n = context.n
    return context.q[3 : n.layout.casters.stop]


def steering_rates(context: RobotContext) -> list[Lane]:
    """Compute the rate of each steering angle, rad/s."""
    n = context.n
    out = []
    first = len(n.robot.drives)
    for j, steering in enumerate(n.robot.steerings):
        u = context.u[first + j]
        if steering.lag is None:
            out.append(u)
        else:
            out.append((u - context.q[n.layout.steerings.start + j]) / n.lane(steering.lag))
    return out


def coordinate_rates(context: RobotContext, w: Sequence[Lane]) -> list[Lane]:
    """Compute q' from the full velocities."""
    n = context.n
    x, y = rotate((w[0], w[1]), context.pose)
    return [x, y, w[2], *angle_rates(context, w), *w[2 + len(n.bodies) :]]


def angle_rates(context: RobotContext, w: Sequence[Lane]) -> list[Lane]:
    """Compute the rates of the angles of trailers, steerings and casters."""
    n = context.n
    trailers = list(w[3 : 2 + len(n.bodies)])
    casters = []
    if n.layout.caster_wheels:
        casters = caster_rates(n, context.shape, twists_of(n, context.shape, w))
    return [*trailers, *steering_rates(context), *casters]
