"""Wrong arguments of learners and wrong checkpoints: one sentence each, before any training."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs.learning import (
    evaluate,
    load_policy,
    network,
    new_critic,
    new_policy,
    save_policy,
    settings,
    shac,
    through_time,
    train,
)
from rbjax.errors import InputError, RbjaxError
from tests.envs.learning.pole import KEY, environment

ENV = environment()
NUMBERS = (-1.0, np.nan, "fast", None)
HIDDEN = [((0,), "hidden[0] is 0"), ((2.5,), "hidden[0] is 2.5"), (4, "hidden is 4"),
          ("ab", "hidden is 'ab'"), (None, "hidden is None")]  # fmt: skip
STD = [(x, "std is") for x in (0.0, -1.0, np.nan, "fast")]
COMMON: dict[str, list[tuple[Any, str]]] = {
    "env": [(x, "expected an rb.envs.Environment") for x in (None, "pole", ENV.task)],
    "key": [
        *((x, "key of jax.random") for x in (None, 3, jnp.zeros(3))),
        (jax.random.split(KEY), "a batch of keys of shape (2,)"),
        (jnp.zeros((2, 2), jnp.uint32), "a batch of keys of shape (2,)"),
    ],
    "policy": [
        (3.0, "policy is float"), (network(KEY, (4, 3)), "shape"),
        (network(KEY, (3, 1)), "fails for an observation"), (lambda o: o[:1], "no floating"),
    ],
    "iterations": [(x, "iterations is") for x in (0, 1.5, "two", True)],
    "batch": [(x, "batch is") for x in (0, -1, 2.5, None)],
    "rate": [(x, "rate is") for x in (0.0, *NUMBERS)],
    "optimiser": [(x, "a transformation of optax") for x in (1, "adam")],
    "devices": [
        (1000, "devices is 1000"), (0, "devices is 0"), ("cpu", "devices of JAX"),
        ([], "on 0 devices"), (["cpu"], "devices of JAX"),
    ],
    "reports": [(x, "reports is") for x in (0, 1.5, None)],
    "report": [(None, "report is NoneType"), (lambda figures: None, "takes (figures)")],
    "params": [(3, "expected rb.envs.Params"), ({}, "expected rb.envs.Params")],
}  # fmt: skip
SHAC = COMMON | {
    "critic": [(3, "critic is 3"), (lambda obs: 0.0, "expected a Critic")],
    "horizon": [(x, "horizon is") for x in (0, 2.5, None)],
    "discount": [(1.0, "factor 1 - discount"), *((x, "discount is") for x in (2.0, *NUMBERS))],
    "td_lambda": [(x, "td_lambda is") for x in (1.1, *NUMBERS)],
    "critic_rate": [(x, "critic_rate is") for x in (0.0, *NUMBERS)],
    "critic_steps": [(x, "critic_steps is") for x in (-1, 0.5, None)],
    "target_rate": [(x, "target_rate is") for x in (2.0, *NUMBERS)],
    "warm_up": [(1, "never updated"), (-1, "warm_up is"), (0.5, "warm_up is")],
    "reward_scale": [(x, "reward_scale is") for x in (0.0, *NUMBERS)],
    "max_grad_norm": [(x, "max_grad_norm is") for x in (0.0, *NUMBERS)],
    "gradient_limit": [(x, "gradient_limit is") for x in (0.0, -1.0, np.nan)],
    "hidden": HIDDEN,
    "std": STD,
    "seconds": [(x, "seconds is") for x in (0, -1.0, np.nan, "fast")],
}


def by_shac(env: Any = ENV, key: Any = KEY, policy: Any = None, **given: Any) -> Any:
    return shac(env, key, policy, **{"iterations": 1, "batch": 2, "horizon": 2} | given)


def by_time(env: Any = ENV, key: Any = KEY, policy: Any = None, **given: Any) -> Any:
    policy = network(KEY, (4, 1)) if policy is None else policy
    return through_time(env, policy, key, **{"iterations": 1, "batch": 2} | given)


@pytest.mark.parametrize("learner", [by_shac, by_time])
def test_sentence_of_a_learner(learner: Any) -> None:
    for argument, cases in (SHAC if learner is by_shac else COMMON).items():
        for value, part in cases:
            with pytest.raises(InputError, match=re.escape(part)):
                learner(**{argument: value})


CALLS = {
    "sizes is (4,)": lambda: network(KEY, (4,)),
    "unknown activation of network 'relu6'": lambda: network(KEY, (4, 1), "relu6"),
    "normalise is 3": lambda: new_policy(ENV, KEY, normalise=3),
    "new_critic: env is None": lambda: new_critic(None, KEY),
    "new_critic: normalise is None": lambda: new_critic(ENV, KEY, normalise=None),
    "policy is NoneType": lambda: evaluate(ENV, None, KEY, 1),
    "policy takes (obs)": lambda: evaluate(ENV, lambda obs: obs, KEY, 1),
    "noise is 3": lambda: evaluate(ENV, new_policy(ENV, KEY), KEY, 1, noise=3),
    "episodes is 0": lambda: evaluate(ENV, new_policy(ENV, KEY), KEY, 0),
    "unknown task 'another'": lambda: settings("another"),
    "unknown algorithm 'sac'": lambda: settings(None, "sac"),
    "unknown backend 'cuda'": lambda: settings(None, backend="cuda"),
    "unknown task 'no_task'": lambda: train("no_task"),
    "unknown algorithm 'dqn'": lambda: train("no_task", "dqn"),
    "steps is 0": lambda: train("no_task", steps=0),
    "options need the name": lambda: train(ENV, options={"a": 1}),
    "options is 3": lambda: train("cart_pole_balance", options=3),
    "out is 3": lambda: train("cart_pole_balance", out=3),
    "unknown setting of SHAC 'horizn'": lambda: train(ENV, "shac", progress=False, horizn=2),
    "batch is 0": lambda: train(ENV, "shac", progress=False, batch=0),
    "horizon is 'two'": lambda: train(ENV, "shac", progress=False, horizon="two"),
}


@pytest.mark.parametrize("part", CALLS)
def test_sentence_of_a_call(part: str) -> None:
    with pytest.raises(RbjaxError, match=re.escape(part)):
        CALLS[part]()


@pytest.mark.parametrize("make", [new_policy, new_critic])
def test_wrong_networks(make: Any) -> None:
    cases = [("hidden", *case) for case in HIDDEN]
    for argument, value, part in cases + [("std", *x) for x in STD] * (make is new_policy):
        with pytest.raises(InputError, match=re.escape(part)):
            make(ENV, KEY, **{argument: value})


# ---------------------------------------------------------------- checkpoints

TASK = "cart_pole_balance"


@pytest.fixture(scope="module")
def saved(tmp_path_factory: Any) -> Path:
    pytest.importorskip("orbax.checkpoint")
    policy = new_policy(rb.envs.make(TASK), KEY, (3,))
    return save_policy(tmp_path_factory.mktemp("policy") / "good", policy, TASK)


#: path in policy.json -> wrong values; None is an entry that is missing
HEADS: dict[str, tuple[Any, ...]] = {
    "format": (2, "1"),
    "task": (None, 3, "no_task"),
    "options": (None, 3, {"x": 1}),
    "arrays": (3, "zz", "../other", "parameters-99"),
    "policy": (None, 3, []),
    "policy.sizes": (None, "a", [5], [5, -3, 1], [5, 4, 1], [5, 2.5, 1]),
    "policy.activation": (None, "relu", 3, []),
    "policy.actions": (None, 0, 2, "one"),
    "policy.squash": (None, "no", 1),
    "policy.normalised": (None, False, "yes"),
    "policy.noise": (None, False, 1),
    "policy.limit": (None, -1, "ten"),
}


def spoilt(head: dict[str, Any], path: str, value: Any) -> str:
    """policy.json with another value at a path, or without it."""
    head = json.loads(json.dumps(head))
    *outer, name = path.split(".")
    part = head[outer[0]] if outer else head
    if value is None:
        del part[name]
    else:
        part[name] = value
    return json.dumps(head)


def test_files_that_are_no_checkpoint(saved: Path) -> None:
    file = saved / "policy.json"
    good = file.read_text()
    texts = ["", "{", "[]", "3", "null", "\0", '"text"', "{}", good[: len(good) // 2]]
    texts += [spoilt(json.loads(good), path, x) for path, xs in HEADS.items() for x in xs]
    try:
        for text in texts:
            file.write_text(text)
            with pytest.raises(RbjaxError, match=r"load_policy: .*|known names") as raised:
                load_policy(saved)
            assert len(str(raised.value)) > 30, text
    finally:
        file.write_text(good)
    assert load_policy(saved)[1].network.sizes == (5, 3, 1)


def test_wrong_paths_and_tasks(saved: Path, tmp_path: Path) -> None:
    for path in (None, 3, tmp_path, tmp_path / "nowhere", saved / "policy.json"):
        with pytest.raises(InputError, match="load_policy: "):
            load_policy(path)
    policy = new_policy(rb.envs.make(TASK), KEY, (3,))
    for given, part in (
        ((tmp_path, network(KEY, (4, 1)), TASK), "network is Network"),
        ((3, policy, TASK), "path is 3"),
        ((saved / "policy.json", policy, TASK), "is a file"),
        ((tmp_path, policy, "no_task"), "known names"),
        ((tmp_path, policy, None), "known names"),
        ((tmp_path, policy, TASK, {"sparce": True}), "did you mean 'sparse'"),
        ((tmp_path, policy, TASK, 3), "options is 3"),
        ((tmp_path, policy, TASK, {}, [1]), "settings is"),
        ((tmp_path, policy, TASK, {"sparse": environment}), "expected True or False"),
        ((tmp_path, policy, "walker_run", {"speed": environment}), "not plain data"),
    ):
        with pytest.raises(RbjaxError, match=part):
            save_policy(*given)
    assert not list(tmp_path.iterdir())


def test_policies_and_critics_of_another_task(tmp_path: Path) -> None:
    other = rb.envs.make(TASK)
    policy, critic = new_policy(other, KEY, (3,)), new_critic(other, KEY, (3,))
    with pytest.raises(InputError, match="evaluate: the policy"):
        evaluate(ENV, policy, KEY, 2)
    with pytest.raises(InputError, match=r"shac: the critic takes observations \(5,\)"):
        shac(ENV, KEY, critic=critic, iterations=1, batch=2, horizon=2)
    folder = save_policy(tmp_path / "other", policy, "hopper_run")
    with pytest.raises(InputError, match="load_policy: the policy fails for an observation"):
        load_policy(folder)


def test_names_that_train_sets() -> None:
    for changes in ({"iterations": 2}, {"report": print}, {"key": KEY}):
        with pytest.raises(RbjaxError, match="unknown setting of SHAC"):
            train(TASK, "shac", steps=16, batch=4, horizon=4, progress=False, **changes)


def test_a_curriculum_without_a_result() -> None:
    forgetful = environment(curriculum=lambda params, progress: None)
    with pytest.raises(InputError, match="the result of the curriculum is NoneType"):
        shac(forgetful, KEY, iterations=1, batch=2, horizon=2, hidden=(2,))
