"""A wheeled robot as a system of optimal control.

    x = (q, v, z),    x (+) dx = x + dx,    x+ = the steps of `rollout` over dt, controls constant
z are the states of tyres. Angles are not wrapped: a heading of 2 pi is one full turn from 0. For a
goal up to full turns, use a cost of sines and cosines. The angles of wheels and casters are
coordinates too; a cost that does not depend on them leaves them free.
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
from rbjax.wheeled.models.robot_model import (
    RobotModel,
    as_state,
    check_robot_model,
    check_state,
)
from rbjax.wheeled.motion.rollout import INTEGRATORS, advance


class RobotSystem(System):
    """A wheeled robot at a fidelity, as a `System`: states `State(q, v, x)`, n = nq + nv + nx.

    Fields:
        robot_model: the `RobotModel`.
        integrator: static, of `rollout`.
        parts: static, the number of integrator steps in one step of the problem.
    """

    robot_model: RobotModel
    integrator: str = eqx.field(static=True, default="rk4")
    parts: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        check_robot_model("RobotSystem", self.model)
        choice("integrator", self.integrator, INTEGRATORS)
        integer("RobotSystem", "parts", self.parts, least=1)

    @property
    def model(self) -> RobotModel:
        return self.robot_model

    def with_model(self, model: Any) -> RobotSystem:
        if not isinstance(model, RobotModel):
            raise InputError(
                f"a design gave {type(model).__name__}, expected a robot at a fidelity with other "
                "parameters, as equinox.tree_at returns it"
            )
        return RobotSystem(model, self.integrator, self.parts)

    @property
    def n(self) -> int:
        return self.model.nq + self.model.nv + self.model.nx

    @property
    def nu(self) -> int:
        return self.model.nu

    @property
    def ctrl_range(self) -> tuple[Any, Any]:
        """The ranges of motors' commands (`Motor.command_range`); steerings have no range."""
        drives = [drive.motor.command_range for drive in self.model.robot.drives]
        ends = [*drives, *[(-jnp.inf, jnp.inf)] * (self.nu - len(drives))]
        if not ends:
            return jnp.zeros(0), jnp.zeros(0)
        low, high = (jnp.stack([jnp.asarray(x, float) for x in side]) for side in zip(*ends))  # noqa: B905
        return low, high

    def spans(self) -> list[slice]:
        nq, nv, n = self.model.nq, self.model.nv, self.n
        return [slice(0, nq), slice(nq, nq + nv), slice(nq + nv, n)][: 2 + (n > nq + nv)]

    def checked(self, where: str, state: Any) -> State:
        return check_state(where, self.model, state)

    def example(self, dtype: Any) -> State:
        return self._state(jnp.zeros(self.n, dtype))

    def step(self, t: Any, state: State, ctrl: jax.Array, dt: Any) -> State:
        model, dtype = self.model, state.q.dtype
        context = model.context(state, ctrl)
        h = jnp.asarray(dt, dtype) / self.parts

        def once(y: tuple, _: Any) -> tuple[tuple, None]:
            return advance(model, context.n, y, context.u, h, self.integrator), None

        y = context.q, context.v, context.x
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
            x = jnp.zeros(self.model.nx, state.q.dtype)
        return jnp.concatenate([state.q, state.v, x])

    def _state(self, flat: jax.Array) -> State:
        q, v, x = jnp.split(flat, [self.model.nq, self.model.nq + self.model.nv])
        return State(q, v, x if self.model.nx else None)


@as_system.register
def _(model: RobotModel) -> RobotSystem:
    """Make the system of a robot in a problem, with steps of "rk4"."""
    return RobotSystem(model)


def controlled(model: RobotModel, *, integrator: str = "rk4", parts: int = 1) -> RobotSystem:
    """Make the system of a robot for an `rb.control.Problem`, with a choice of integrator and step.

    If a problem gets the robot itself, it uses "rk4" and one step. Wheels that slip need small
    steps: "rk4" is stable up to about 2.8 / lambda, with lambda the rate at which slip decays,
    stiffness times load / (inertia times speed). "linearly_implicit_euler" is stable for any step.

    Args:
        model: `at(robot, fidelity)`.
        integrator: of `rollout`.
        parts: the number of integrator steps in one step of the problem, with the same controls.

    Returns:
        `RobotSystem`.

    Raises:
        InputError: not a robot at a fidelity; parts is not a positive integer.
        UnknownName: no such integrator.

    Example:
        >>> import rbjax as rb
        >>> car = rb.wheeled.at(rb.wheeled.kinds()["bicycle"].make(), "slipping")
        >>> system = rb.wheeled.controlled(car, integrator="linearly_implicit_euler", parts=4)
        >>> problem = rb.control.Problem(system, 10, 0.04, running=[rb.control.Control()])
        >>> problem.n, problem.nu
        (11, 2)
    """
    check_robot_model("controlled", model)
    return RobotSystem(model, integrator, parts)
