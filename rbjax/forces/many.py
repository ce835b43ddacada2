"""One force on many bodies.

Where the driver writes links out, the force is written out as well, body by body. Elsewhere it is a
loop over the bodies whose program holds it once, so that a program does not grow with the bodies:
for 30 bodies in a GPU thread it has a tenth of the statements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.forces.context import Context, Frame
from rbjax.forces.element import Loads
from rbjax.lanes import Vec3, as_arrays, is_literal
from rbjax.model import WORLD
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.spatial import Force, Motion, Transform


def on_each(now: Context, bodies: Sequence[int], act: Callable[..., Loads], *numbers: Any) -> Loads:
    """The sum of act(frame, *numbers) over bodies.

    Args:
        now: the instant.
        bodies: their indices; one may come twice. Those that cannot move are left out.
        act: a function of a body's frame and its parameters that returns `Loads`, a sum of results
            of `push`. It computes with lanes and does not branch on their values. If it pushes only
            its body and reads only the body's pose and velocity, the bodies can be evaluated in a
            loop. Otherwise the code is unrolled.
        numbers: arrays (n,), of which `act` is given a lane, arrays (n, 3), of which it is given a
            `Vec3`, and pytrees of such.

    Example:
        >>> import rbjax as rb, jax
        >>> class Breeze(rb.forces.Element):
        ...     drag: jax.Array  # (nb,) N s/m
        ...     def loads(self, now):
        ...         slow = lambda body, drag: body.push(body.velocity * -drag)
        ...         return rb.forces.on_each(now, range(now.model.nb), slow, self.drag)
        >>> model = rb.load("double_pendulum")
        >>> model = model.with_forces(Breeze(jax.numpy.ones(2)))
        >>> rb.applied_forces(model, model.default_state()).tolist()
        [0.0, 0.0]
    """
    moving = [i for i, b in enumerate(bodies) if now.model.topology.body_links[b] != WORLD]
    columns = jax.tree.map(lambda x: _lanes(table(x, now.q.dtype)), numbers)

    def written_out() -> Loads:
        each = ((bodies[i], _known(lane, columns, i)) for i in moving)
        return sum((act(now.body(b), *own) for b, own in each), Loads())

    if isinstance(now.links.driver, Unrolled) or not moving:
        return written_out()
    rows, index = np.array(moving), np.array(bodies)[moving]
    own = _known(now.links.column, columns, rows)
    leaves, tree = jax.tree.flatten((*now.links.columns(index), own))

    def one(lanes: list) -> Force:
        left = iter(lanes)
        given = [x if is_literal(x) else next(left) for x in leaves]
        pose, twist, weld, own = jax.tree.unflatten(tree, given)
        links: Any = _Still(pose, twist)
        found: Any = act(Frame(links, _OWN, weld), *own)
        if found.tau or isinstance(found.wrenches, Force) or found.wrenches.keys() - {_OWN}:
            raise _NotItsOwn
        force = found.wrenches.get(_OWN, Force.zero())
        return as_arrays(force, jnp.zeros((), now.q.dtype))

    try:
        forces = jax.lax.map(one, [x for x in leaves if not is_literal(x)])
    except _NotItsOwn:
        return written_out()
    return Loads({}, now.links.scattered(index, forces))


#: the index that stands for the body's link in a loop over bodies
_OWN = -2


class _NotItsOwn(Exception):
    """A force that the loop over bodies cannot evaluate: it acts on something other than its body,
    or it reads more than the body's pose and twist."""


class _Still:
    """The motion of one link, in place of `LinkMotion`."""

    def __getattr__(self, name: str) -> Any:
        raise _NotItsOwn

    def __init__(self, pose: Transform, twist: Motion):
        self._pose, self._twist = pose, twist

    def pose(self, link: int) -> Transform:
        return self._pose

    def twist(self, link: int) -> Motion:
        return self._twist


def _lanes(x: Any) -> Any:
    return Vec3(*(x[:, k] for k in range(3))) if np.ndim(x) == 2 else x


def _known(lane: Callable, columns: Any, i: Any) -> Any:
    return jax.tree.map(lambda x: x if is_literal(x) else lane(x, i), columns)
