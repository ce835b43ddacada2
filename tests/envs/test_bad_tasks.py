"""Wrong tasks: every field and every function of a task, one sentence each.

A task is checked when its `Environment` is made, before any program is compiled.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import envs
from rbjax.errors import InputError, RbjaxError

MODEL = rb.load("cart_pole")
SPEED = envs.Observation("speed", lambda transition: transition.after.v)
HEIGHT = envs.Reward("height", lambda transition: -jnp.cos(transition.after.q[1]))
AIR = envs.Variable("air", lambda key, params: 0.0)
PUSH = envs.Event("push", lambda key, state, params: state)
MASS = envs.random_scale("mass", lambda model: model.bodies.mass, 0.9, 1.1)
TASK = envs.Task(
    "small", MODEL, start=lambda key, params: MODEL.random_state(key),
    observations={"policy": (SPEED,)}, rewards=(HEIGHT,), episode=5,
)  # fmt: skip


def environment(**changes: Any) -> envs.Environment:
    return envs.Environment(dataclasses.replace(TASK, **changes), kernel=False)


def observed(**changes: Any) -> dict[str, Any]:
    return {"policy": (dataclasses.replace(SPEED, **changes),)}


def randomised(draw: Any = lambda key, params: 0.0, apply: Any = lambda model, value: model) -> Any:
    return (envs.Randomisation("mass", draw, apply),)


def varying(**functions: Any) -> Any:
    return (dataclasses.replace(AIR, **functions),)


NUMBERS = {None: "expected numbers", "a": "expected numbers", 1j: "complex numbers"}
#: field of a task -> pairs of a wrong value and a part of the sentence
FIELDS: dict[str, list[tuple[Any, str]]] = {
    "name": [(None, "expected a word"), ("", "expected a word"), (3, "expected a word")],
    "model": [(None, "expected a Model"), ("cart_pole", "expected a Model")],
    "decimation": [(x, "decimation is") for x in (0, -1, 2.5, "a", True)],
    "episode": [(x, "episode is") for x in (0, -1, 2.5, None, True)],
    "dt": [(x, "dt is") for x in (0.0, -0.01, np.nan, np.inf, "a", 1j, True)],
    "action_delay": [
        *((x, "expected (smallest, largest)") for x in ((0,), (1, 0), (-1, 0), (0, 0.5), 3, None)),
        ((0, 6), "at most the episode of 5"),
    ],
    "start": [
        (None, "start is NoneType"), (MODEL.default_state(), "start is State"),
        (lambda key: None, "start takes (key)"), (lambda k, p: None, "start returned NoneType"),
        (lambda k, p: rb.State(jnp.zeros(3), jnp.zeros(2)), "start returned rb.State(q (3,)"),
        (lambda k, p: rb.State("a", jnp.zeros(2)), "start returned 'a'"),
    ],
    "observations": [
        (None, "expected a dict"), ((SPEED,), "expected a dict"), ({}, '"policy" among'),
        ({3: (SPEED,)}, "expected a dict by name"), ({"policy": ()}, "is empty"),
        ({"policy": SPEED}, "a list of rb.envs.Observation"), ({"policy": ("q",)}, "a list of"),
        ({"policy": (SPEED, SPEED)}, "twice"), (observed(name=""), "the name '', expected a word"),
        *((observed(noise=x), "noise of 'speed'") for x in (np.nan, np.inf, None, "a", 1j)),
        (observed(noise=-1.0), "at least 0"), (observed(noise=[1, 2, 3]), "noise of shape (3,)"),
        (observed(delay=(0, 6)), "at most the episode"), (observed(delay=(1, 0)), "delay of"),
        (observed(read=3), "reads 3"), (observed(read=rb.sensors.Positions), "reads <class"),
        (observed(read="gyr:imu"), "unknown sensor kind"), (observed(read=lambda: 0), "takes ()"),
        *((observed(read=lambda t, x=x: x), part) for x, part in NUMBERS.items()),
        (observed(read=lambda t: t.after.q[None]), "shape (1, 2), expected a number or (n,)"),
    ],
    "rewards": [
        (None, "a list of rb.envs.Reward"), ((), "is empty"), (HEIGHT, "a list of rb.envs.Reward"),
        ((3,), "a list of"), ((HEIGHT, HEIGHT), "twice"),
        *(((dataclasses.replace(HEIGHT, weight=x),), "the weight of 'height'")
          for x in (np.nan, np.inf, "a", None, 1j)),
        *(((envs.Reward("r", x),), "read of the reward 'r'") for x in (3, None, "q", lambda: 0)),
        *(((envs.Reward("r", lambda t, x=x: x),), part) for x, part in NUMBERS.items()),
        ((envs.Reward("r", lambda t: t.after.v),), "shape (2,), expected a number"),
    ],
    "terminations": [
        (None, "expected a dict"), ({"end": 3}, "termination 'end' is int"),
        ({"end": lambda t: 1.0}, "expected a bool"), ({"end": lambda t: t.after.v > 0}, "(2,)"),
        ({"end": lambda t: None}, "expected numbers"),
    ],
    "action": [
        *((x, "expected a map of actions") for x in (None, 3, envs.Direct)),
        *((f(x), part) for f in (envs.Offset, envs.Increment)
          for x, part in ((np.nan, "is nan"), ("a", "is 'a'"), (None, "None"), ((0, 0), "(2,)"))),
    ],
    "variables": [
        (AIR, "a list of rb.envs.Variable"), ((3,), "a list of"),
        (varying(start=3), "start of the variable 'air' is int"),
        (varying(start=lambda key: 0.0), "takes (key)"),
        (varying(start=lambda k, p: "a"), "start of 'air' returned 'a'"),
        (varying(measure=lambda t: jnp.zeros(2)), "shape (2,), expected ()"),
        (varying(update=lambda k, t: None), "expected numbers"),
        (varying(start=lambda k, p: 0, measure=lambda t: t.dt), "start it with floats"),
        (varying(start=lambda k, p: False, update=lambda k, t: t.dt), "start it with floats"),
    ],
    "events": [
        (PUSH, "a list of rb.envs.Event"), ((envs.Event("e", 3),), "apply of the event 'e' is int"),
        ((envs.Event("e", lambda state: state),), "takes (state)"),
        ((envs.Event("e", lambda k, state, p: state.state),), "returned State"),
    ],
    "randomise": [
        (MASS, "a list of rb.envs.Randomisation"), (randomised(draw=3), "is int"),
        (randomised(draw=lambda k, p: "a"), "draw of 'mass' returned 'a'"),
        (randomised(apply=lambda m, v: None), "expected the Model"),
        ((envs.random_scale("m", lambda m: m.bodies.mass, [1.0] * 3, 2.0),), "has shape (3,)"),
    ],
    "values": [(None, "expected a dict"), ({"a": "x"}, "is 'x'"), ({"a": None}, "is None")],
    "total_reward": [
        (3, "total_reward is int"), (lambda rewards: 0.0, "takes (rewards)"),
        (lambda rewards, dt: None, "expected numbers"),
        (lambda rewards, dt: jnp.zeros(2), "shape (2,)"),
    ],
    "curriculum": [(3, "curriculum is int"), (lambda params: params, "takes (params)")],
    "integrator": [("rk5", "expected one of"), (3, "expected one of")],
    "contact": [("mujco", "expected one of"), (3, "expected one of")],
    "tracked": [("nose", "known names"), (3, "known names")],
}  # fmt: skip


@pytest.mark.parametrize("field", FIELDS)
def test_sentence(field: str) -> None:
    for value, part in FIELDS[field]:
        with pytest.raises(RbjaxError, match=re.escape(part)):
            environment(**{field: value})


def test_every_field_has_wrong_values() -> None:
    assert FIELDS.keys() == {f.name for f in dataclasses.fields(envs.Task)}


@pytest.mark.parametrize("make", [envs.random_scale, envs.random_offset])
def test_wrong_ranges_of_a_randomisation(make: Any) -> None:
    for low, high in ((2.0, 1.0), (np.nan, 1.0), (0.0, np.inf), ("a", 1.0), ([0, 0], [1, 1, 1])):
        with pytest.raises(InputError, match=r"low|high"):
            make("mass", lambda model: model.bodies.mass, low, high)
    with pytest.raises(InputError, match="where is NoneType"):
        make("mass", None, 0.0, 1.0)


def test_wrong_calls() -> None:
    env, key = environment(), jax.random.key(0)
    obs, state = env.reset(key)
    with pytest.raises(InputError, match=r"state is .*, expected the rb.envs.EnvState"):
        env.step(key, state.state, jnp.zeros(1))
    for action in ("a", None, jnp.zeros(2), 1j):
        with pytest.raises(InputError, match="step: action"):
            env.step(key, state, action)
    for policy, part in ((None, "is NoneType"), (lambda obs: obs, r"takes \(obs\)")):
        with pytest.raises(InputError, match=f"policy {part}"):
            env.unroll(key, obs, state, policy, 1)


def test_a_start_of_lists() -> None:
    env = environment(start=lambda key, params: rb.State([0, 0], [0.0, 0.0]))
    assert env.reset(jax.random.key(0))[1].state.q.dtype == env.dtype
