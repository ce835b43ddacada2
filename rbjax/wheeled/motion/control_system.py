"""A wheeled robot as a system of optimal control.

    x = (q, v, z),    x (+) dx = x + dx,    x+ = the steps of `rollout` over dt, the controls held
z are states of tyres. Angles are numbers without wrapping, as those of hinges: a heading of 2 pi is
a whole turn from 0, so that a motion may turn as often as it likes and no cost has a jump. A goal
up to whole turns is a cost of sines and cosines. The angles of wheels and casters are coordinates
too; a cost that leaves them out leaves them free.

A(t), B(t) are derivatives of that step by forward differentiation, so the optimum is one of what
`rollout` computes with the same method.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import choice, integer
from rbjax.control.optimal.system import System, as_system
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.wheeled.models.robot_model import RobotModel, as_state
from rbjax.wheeled.models.states import check_state, check_vehicle
from rbjax.wheeled.motion.rollout import METHODS, advance


class RobotSystem(System):
    """A wheeled robot at a fidelity, as a `System`: states `State(q, v, x)`, n = nq + nv + nx.

    Costs and constraints are given the `RobotModel` as `model`.

    Fields: vehicle; static: method, of `rollout`; parts, steps of it in one step of the problem.
    """

    vehicle: RobotModel
    method: str = eqx.field(static=True, default="rk4")
    parts: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        check_vehicle("RobotSystem", self.vehicle)
        choice("method", self.method, METHODS)
        integer("RobotSystem", "parts", self.parts, least=1)

    @property
    def model(self) -> RobotModel:
        return self.vehicle

    def with_model(self, model: Any) -> RobotSystem:
        if not isinstance(model, RobotModel):
            raise InputError(
                f"a design gave {type(model).__name__}, expected a robot at a fidelity with other "
                "numbers, as equinox.tree_at gives it"
            )
        return RobotSystem(model, self.method, self.parts)

    @property
    def n(self) -> int:
        return self.vehicle.nq + self.vehicle.nv + self.vehicle.nx

    @property
    def nu(self) -> int:
        return self.vehicle.nu

    @property
    def ctrl_range(self) -> tuple[Any, Any]:
        """The commands that motors tell apart (`Motor.command_range`); steerings have no range."""
        drives = [drive.motor.command_range for drive in self.vehicle.robot.drives]
        ends = [*drives, *[(-jnp.inf, jnp.inf)] * (self.nu - len(drives))]
        if not ends:
            return jnp.zeros(0), jnp.zeros(0)
        low, high = (jnp.stack([jnp.asarray(x, float) for x in side]) for side in zip(*ends))  # noqa: B905
        return low, high

    def spans(self) -> list[slice]:
        nq, nv, n = self.vehicle.nq, self.vehicle.nv, self.n
        return [slice(0, nq), slice(nq, nq + nv), slice(nq + nv, n)][: 2 + (n > nq + nv)]

    def checked(self, where: str, state: Any) -> State:
        return check_state(where, self.vehicle, state)

    def example(self, dtype: Any) -> State:
        return self._state(jnp.zeros(self.n, dtype))

    def step(self, t: Any, state: State, ctrl: jax.Array, dt: Any) -> State:
        vehicle, dtype = self.vehicle, state.q.dtype
        now = vehicle.context(state, ctrl)
        n = now.n
        h = jnp.asarray(dt, dtype) / self.parts

        def once(y: tuple, _: Any) -> tuple[tuple, None]:
            return advance(vehicle, n, y, now.u, h, self.method), None

        y = now.q, now.v, now.x
        if self.parts == 1:
            q, v, x = once(y, None)[0]
        else:
            q, v, x = jax.lax.scan(once, y, length=self.parts)[0]
        return as_state(q, v, x, dtype)

    def plus(self, state: State, dx: jax.Array) -> State:
        return self._state(self._flat(state) + dx)

    def minus(self, one: State, other: State) -> jax.Array:
        return self._flat(one) - self._flat(other)

    def _flat(self, state: State) -> jax.Array:
        x = state.x
        if x is None:
            x = jnp.zeros(self.vehicle.nx, state.q.dtype)
        return jnp.concatenate([state.q, state.v, x])

    def _state(self, flat: jax.Array) -> State:
        q, v, x = jnp.split(flat, [self.vehicle.nq, self.vehicle.nq + self.vehicle.nv])
        return State(q, v, x if self.vehicle.nx else None)


@as_system.register
def _(model: RobotModel) -> RobotSystem:
    """What `rb.control.Problem` makes of a robot: steps of "rk4"."""
    return RobotSystem(model)


def controlled(vehicle: RobotModel, *, method: str = "rk4", parts: int = 1) -> RobotSystem:
    """A robot at a fidelity as the system of an `rb.control.Problem`, with a method and a step.

    A vehicle itself is taken with "rk4" and one step. Wheels that slip need small steps: those of
    "rk4" are stable up to about 2.8 / lambda, where lambda is the rate at which slip decays,
    stiffness times load over (inertia times speed); "linearly_implicit_euler" takes slip at the
    end of a step, and is stable at any.

    Args:
        vehicle: `at(robot, fidelity)`.
        method: of `rollout`.
        parts: how many steps of it make one step of the problem, with the same controls.

    Returns:
        `RobotSystem`.

    Raises:
        InputError: no robot at a fidelity; parts is no positive whole number.
        UnknownName: no such method.

    Example:
        >>> import rbjax as rb
        >>> car = rb.wheeled.at(rb.wheeled.kinds()["bicycle"].make(), "slipping")
        >>> system = rb.wheeled.controlled(car, method="linearly_implicit_euler", parts=4)
        >>> problem = rb.control.Problem(system, 10, 0.04, running=[rb.control.Control()])
        >>> problem.n, problem.nu
        (11, 2)
    """
    check_vehicle("controlled", vehicle)
    return RobotSystem(vehicle, method, parts)
