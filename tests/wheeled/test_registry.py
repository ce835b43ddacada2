"""Every public function of wheeled robots under jit, vmap, jvp and vjp: by states, controls, and
numbers of robots, tyres and motors. A public function that is missing here fails a test."""

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import wheeled
from rbjax.model import State
from rbjax.wheeled import DCMotor, Fiala, Relaxing, RollingResistance, SpeedServo
from tests.composing import cast, check_axes, check_composes
from tests.wheeled.laws import LAWS, numbers

# those that take no arrays, or only known ones (an arrangement of wheels depends on them), and the
# adaptive solution, whose steps are no smooth function
ELSEWHERE = {"at", "controlled", "fidelities", "from_file", "kinds", "simulate",
             "with_trailers", "write_mjcf"}  # fmt: skip

CART = wheeled.kinds()["differential_drive"].make(caster=None)
TRICYCLE = wheeled.kinds()["tricycle"].make(motor=SpeedServo(5.0, 20.0), lag=0.2)
TYRE = Fiala([12.0, 10.0], [0.8, 0.7], 0.5)
OMNI = wheeled.kinds()["omni_3"].make()
DT, TIMES = 0.05, np.arange(4) * 0.1


def changed(robot, mass, radius):
    """A robot with another mass of its chassis and another radius of a wheel."""
    robot = cast(robot, mass)
    bodies = (robot.bodies[0].replace(mass=mass), *robot.bodies[1:])
    wheels = (robot.wheels[0].replace(radius=radius), *robot.wheels[1:])
    return robot.replace(bodies=bodies, wheels=wheels)


def floats(tree: Any) -> Any:
    return eqx.filter(tree, eqx.is_inexact_array)


def rates(fidelity: str, robot: Any, **options: Any) -> Callable:
    def found(q, v, u, mass, radius):
        made = changed(robot, mass, radius)
        vehicle = wheeled.at(made, fidelity, **cast(options, mass))
        return wheeled.rates(vehicle, State(q, v), u)

    return found


def terms(of: Callable, robot: Any) -> Callable:
    def found(q, v, u, mass, radius):
        return of(wheeled.at(changed(robot, mass, radius), "reduced"), State(q, v), u)

    return found


def start(pose, twist, mass, radius):
    return wheeled.start(wheeled.at(changed(TRICYCLE, mass, radius), "reduced"), pose, twist)


def rollout(q, v, controls, mass, radius):
    vehicle = wheeled.at(changed(CART, mass, radius), "reduced")
    return floats(wheeled.rollout(vehicle, State(q, v), controls, DT))


def contacts(q, v, u, tyre):
    law = Fiala(tyre[:2], tyre[2:4], tyre[4])
    return wheeled.contacts(wheeled.at(cast(CART, q), "slipping", tyre=law), State(q, v), u)


def full_model(mass, radius):
    model = wheeled.full_model(changed(CART, mass, radius))
    return floats((model.bodies, model.constraints))


def full_model_state(q, v, u):
    vehicle = wheeled.at(cast(TRICYCLE, q), "reduced")
    return wheeled.full_model_state(vehicle, State(q, v), u, "free")


def commands(twist, mass, radius):
    return wheeled.commands(changed(TRICYCLE, mass, radius), twist)


def rolled_twists(rates, mass, radius):
    return wheeled.rolled_twists(changed(OMNI, mass, radius), rates)


def odometry(angles, coefficients, pose, mass, radius):
    slip = cast(wheeled.HeadingSlip(coefficients, 0.2, 0.1, 1, -1), angles)
    times = cast(TIMES, angles)
    return wheeled.odometry(changed(OMNI, mass, radius), times, angles, slip, pose)


def mean_twists(poses):
    return wheeled.mean_twists(cast(TIMES, poses), poses)


def tracking_gains(q, v, controls, Q, R):
    vehicle = wheeled.at(cast(CART, q), "reduced")
    return wheeled.tracking_gains(vehicle, State(q, v), controls, DT, Q, R)


def law(record: Any) -> Callable:
    """The traction and the rates of a law, by its numbers too."""

    def found(u, z, factors):
        row, back = numbers(cast(record, factors))
        own = back(row * factors)
        return own.response(*u, [z[0], z[1]])

    return found


def motor(record: Any) -> Callable:

    def found(u, speed, factors):
        row, back = numbers(cast(record, factors))
        own = back(row * factors)
        return own.torque(u, speed), own.free_speed(u), own.heat(u, speed), own.power_in(u, speed)

    return found


def resisting(coefficient, load, radius, speed):
    return cast(RollingResistance(coefficient, 0.05), load).torque(load, radius, speed)


MOTORS = {
    "SpeedServo": SpeedServo(0.5, 2.0),
    "DCMotor": DCMotor(2.0, 0.05, 20.0, 24.0, 0.01, 1e-4),
}
RELAXING = Relaxing(LAWS["fiala, two"], [0.3, 0.4], 0.01)
TYRES = {name: LAWS[f"{name}, two"] for name in ("saturated", "coulomb", "pacejka", "tmeasy")}
TYRES["relaxing"] = RELAXING


def drawn(**shapes: Any) -> list[np.ndarray]:
    """Three of each array: numbers around a value, or normal ones of a shape."""
    rng = np.random.default_rng(0)
    out = []
    for given in shapes.values():
        if isinstance(given, (int, tuple)):
            out.append(0.5 * rng.normal(size=(3, *np.atleast_1d(given))))
        else:
            centre = np.asarray(given)
            out.append(centre * rng.uniform(0.8, 1.25, (3, *centre.shape)))
    return out


def robot(of: Any) -> dict[str, np.ndarray]:
    return {"mass": np.asarray(of.bodies[0].mass), "radius": np.asarray(of.wheels[0].radius)}


def factors(record: Any) -> np.ndarray:
    return np.ones(numbers(record)[0].size)


PATH = np.stack([np.linspace(1, 4, 6), np.linspace(1, 2, 6) ** 2, np.linspace(0.4, 0.9, 6)], -1)
ONE = np.asarray(1.0)
ROLLS = np.array([2.1, 0.2, 2.0])  # the velocity of a wheel, and that of its rim
REGISTRY: dict[str, tuple[Callable, list[np.ndarray]]] = {
    "rates": (rates("reduced", TRICYCLE), drawn(q=7, v=1, u=2, **robot(TRICYCLE))),
    "reduced": (terms(wheeled.reduced, CART), drawn(q=5, v=2, u=2, **robot(CART))),
    "undetermined": (terms(wheeled.undetermined, CART), drawn(q=5, v=2, u=2, **robot(CART))),
    "rates, kinematic": (rates("kinematic", TRICYCLE), drawn(q=7, v=0, u=2, **robot(TRICYCLE))),
    "rates, slipping": (
        rates("slipping", CART, tyre=TYRE), drawn(q=5, v=5, u=2, **robot(CART)),
    ),
    "start": (start, drawn(pose=3, twist=3, **robot(TRICYCLE))),
    "rollout": (rollout, drawn(q=5, v=2, controls=(3, 2), **robot(CART))),
    "contacts": (
        contacts, drawn(q=5, v=5, u=2, tyre=np.array([12.0, 10.0, 0.8, 0.7, 0.5])),
    ),
    "full_model": (full_model, drawn(**robot(CART))),
    "full_model_state": (full_model_state, drawn(q=7, v=1, u=2)),
    "commands": (commands, drawn(twist=3, **robot(TRICYCLE))),
    "rolled_twists": (rolled_twists, drawn(rates=3, **robot(OMNI))),
    "odometry": (
        odometry, drawn(angles=(4, 3), coefficients=(3, 4), pose=3, **robot(OMNI)),
    ),
    "mean_twists": (mean_twists, drawn(poses=(4, 3))),
    "pure_pursuit": (
        wheeled.pure_pursuit, drawn(path=PATH, pose=3, speed=ONE, lookahead=ONE),
    ),
    "stanley": (
        wheeled.stanley,
        drawn(path=PATH, pose=3, speed=ONE, wheelbase=ONE, gain=ONE, soft=ONE),
    ),
    "tracking_gains": (
        tracking_gains, drawn(q=(3, 5), v=(3, 2), controls=(2, 2), Q=np.ones(7), R=np.ones(2)),
    ),
    "RollingResistance": (
        resisting, drawn(coefficient=0.02 * ONE, load=10 * ONE, radius=ONE, speed=0.1 * ONE),
    ),
}  # fmt: skip
REGISTRY |= {name: (law(x), drawn(u=ROLLS, z=2, factors=factors(x))) for name, x in TYRES.items()}
REGISTRY |= {
    name: (motor(x), drawn(u=5 * ONE, speed=4 * ONE, factors=factors(x)))
    for name, x in MOTORS.items()
}
every = pytest.mark.parametrize("name", REGISTRY)


@every
def test_composes(name: str) -> None:
    check_composes(*REGISTRY[name])


@every
def test_a_compiled_function_mapped_and_differentiated(name: str) -> None:
    check_axes(*REGISTRY[name])


def test_a_batch_of_robots() -> None:
    """A vehicle with a leading axis on every number, mapped over with its state."""
    robots = [changed(CART, mass, 0.08) for mass in (5.0, 10.0, 20.0)]
    many = jax.tree.map(lambda *x: jnp.stack(x), *robots)
    q, v, u = (x[0] for x in drawn(q=5, v=2, u=2))

    def rate(robot):
        return wheeled.rates(wheeled.at(robot, "reduced"), State(q, v), u).v

    want = np.stack([rate(robot) for robot in robots])
    np.testing.assert_allclose(jax.vmap(rate)(many), want, rtol=1e-12)


def is_function(value: object) -> bool:
    return inspect.isroutine(value)


def test_no_public_function_is_missing() -> None:
    public = {name for name in wheeled.__all__ if is_function(getattr(wheeled, name))}
    known = {name for name in REGISTRY if hasattr(wheeled, name)} | ELSEWHERE
    missing = public - known
    assert not missing, f"give {sorted(missing)} an entry in tests/wheeled/test_registry.py"
    assert public >= ELSEWHERE
    here = Path(__file__)
    texts = [path.read_text() for path in here.parent.glob("test_*.py") if path != here]
    untested = {n for n in ELSEWHERE if not any(re.search(rf"\b{n}\(", text) for text in texts)}
    assert not untested, f"no test calls {sorted(untested)}"
