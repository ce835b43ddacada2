"""Problems of optimal control with reference answers (optimal_control.json), as rbjax says them."""

import json
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.control import Control, Cost, Pose, Problem, StateError, Velocity


class Case(NamedTuple):
    """problem, start; costs: those listed, the lowest first; iterations of the peer that reached
    one of them."""

    problem: Problem
    start: rb.State
    costs: tuple[float, ...]
    iterations: int


@cache
def given(name: str) -> dict[str, Any]:
    """A problem of the file."""
    path = Path(__file__).with_name("optimal_control.json")
    return json.loads(path.read_text())[name]


def state(x: Any) -> rb.State:
    """A state of hinges and slides, (q, v)."""
    x = jnp.asarray(x, float)
    return rb.State(x[: len(x) // 2], x[len(x) // 2 :])


def kinova_reach(variant: str, bounds: Any = None) -> Case:
    """An arm's hand to a pose: Crocoddyl's arm_manipulation_fwddyn.py."""
    case = given("kinova_reach")
    answer = case["variants"][variant]
    start = state(case["x0"])
    pose = Pose(jnp.eye(3), jnp.asarray(case["target"]["p"]), site=case["frame"].split()[1])
    rest: Any = StateError(start)
    if variant == "as_in_crocoddyl":  # joints 1, 4 and 6 have no ends: their errors wrap
        wraps = np.array([True, False, False, True, False, True])

        def rest(t, s, u):
            e = s.q - start.q
            e = jnp.where(wraps, jnp.arctan2(jnp.sin(e), jnp.cos(e)), e)
            return jnp.concatenate([e, s.v])

    terminal = [Cost(pose, 1e3)]
    if variant == "plain_with_terminal_velocity":
        terminal.append(Cost(Velocity(), 10.0))
    problem = Problem(
        rb.load(case["model_mjcf"]), case["N"], case["dt"], bounds=bounds, terminal=terminal,
        running=[pose, Cost(rest, 0.1), Cost(Control(), 0.1)],
    )  # fmt: skip
    better = [answer[k] for k in ("better_local_optimum", "better_local_optimum_2") if k in answer]
    return Case(problem, start, (*better, answer["cost"]), answer["fddp_iterations"])


def double_pendulum() -> Case:
    """A double pendulum swung up by its first joint."""
    case = given("double_pendulum_swing_up")
    w = jnp.array([1, 1, 1, 1, 0.1, 0.1])

    def upright(t, s, u):
        return jnp.concatenate([jnp.sin(s.q), 1 - jnp.cos(s.q), s.v])

    problem = Problem(
        rb.load(case["model_mjcf"]), case["N"], case["dt"], bounds=None,
        running=[Cost(upright, 1e-3 * w), Cost(Control(), 1e-2)], terminal=[Cost(upright, 100 * w)],
    )  # fmt: skip
    costs = (case["best_known_cost"], 0.0036819661, 0.0130241099, 0.0196754828, case["cost"])
    return Case(problem, state(case["x0"]), costs, case["fddp_iterations"])


def quadrotor(bounded: bool) -> Case:
    """A quadrotor to a pose, its thrusts free or bounded."""
    case = given("quadrotor_pose")
    model = rb.load(case["model_mjcf"])
    goal = Pose(jnp.eye(3), jnp.array([1.0, 0, 1]), site="base_link")
    home = Pose(jnp.eye(3), jnp.zeros(3), site="base_link")
    near = 1e-6 * jnp.array([1e3, 1e3, 1e3, 0.1, 0.1, 0.1])
    problem = Problem(
        model, case["N"], case["dt"], terminal=[Cost(goal, 3.0)],
        running=[Cost(goal, 1e-2), Cost(home, near), Cost(Velocity(), 1e-3), Cost(Control(), 1e-6)],
        bounds=given("quadrotor_pose_bounded")["bounds"] if bounded else None,
    )  # fmt: skip
    start = model.default_state()
    if bounded:
        answer = given("quadrotor_pose_bounded")
        return Case(problem, start, (answer["world"]["cost"],), answer["se3"]["boxfddp_iterations"])
    return Case(problem, start, (case["world"]["cost"],), case["se3"]["fddp_iterations"])


def cart_pole(start: str) -> Case:
    """A cart-pole, from near upright or hanging."""
    case = given("cart_pole")
    w = jnp.array([1, 1, 0.1, 0.001, 0.001]) ** 2

    def upright(t, s, u):
        angle = s.q[1]
        return jnp.stack([jnp.sin(angle), 1 - jnp.cos(angle), s.q[0], s.v[0], s.v[1]])

    problem = Problem(
        rb.load(case["model_mjcf"]), case["N"], case["dt"], bounds=None, integral=False,
        running=[Cost(upright, w), Control()], terminal=[Cost(upright, w)],
    )  # fmt: skip
    answer = case[start]
    costs = answer.get("local_optima", [answer.get("cost")])
    return Case(problem, state(answer["x0"]), tuple(costs), answer.get("fddp_iterations", 0))


def pendulum_with_limits() -> Case:
    """A pendulum whose torque cannot lift it at once."""
    case = given("pendulum_torque_limit_discrete")

    def running(t, s, u):
        return 0.5 * (0.1 * u[0] ** 2 + 0.01 * s.v[0] ** 2) + 1 + jnp.cos(s.q[0])

    def end(t, s, u):
        return jnp.concatenate([s.q - jnp.pi, s.v])

    problem = Problem(
        rb.load(case["model_mjcf"]), 250, 0.02, bounds=(-3.0, 3.0), running=[running],
        terminal=[Cost(end, 100.0)],
    )  # fmt: skip
    return Case(problem, state([0.0, 0.0]), tuple(case["local_optima"]), 0)


def indy7(N: int, i: int) -> Case:
    """Problem i of a batch: an arm's hand to a point."""
    case = given("indy7_batch_reach")
    model = rb.load(case["model_mjcf"])
    j = np.arange(1, 7)
    q = np.array(case["ready"]) + 0.1 * np.sin(j * (i + 1))
    start = state(np.concatenate([q, 0.2 * np.cos(j * (i + 1))]))
    problem = reach(model, N, target_of(i))
    answers = [c for c in case["cases"] if c["N"] == N and c["i"] == i]
    cost, count = (answers[0]["cost"], answers[0]["fddp_iterations"]) if answers else (np.nan, 0)
    return Case(problem, start, (cost,), count)


def target_of(i: Any) -> Any:
    """The point of problem i, on a figure of eight."""
    t = 0.75 * jnp.asarray(i, float)
    x, z = 0.4 * jnp.sin(2 * np.pi * t / 6), 0.2 * jnp.sin(4 * np.pi * t / 6)
    return jnp.stack([np.sqrt(0.5) * x, 0.5 + np.sqrt(0.5) * x, 0.6 + z])


def reach(model: rb.Model, N: int, target: Any, bounds: Any = None, site: str = "tcp") -> Problem:
    """The hand of an arm to a point."""
    point = rb.control.Point(target, site=site)
    return Problem(
        model, N, 0.01, bounds=bounds, integral=False,
        running=[Cost(point, 2.0), Cost(Velocity(), 1e-2), Cost(Control(), 2e-6)],
        terminal=[Cost(point, 50.0), Cost(Velocity(), 1e-2)],
    )  # fmt: skip
