"""Functions that differ in numbers compile once, and what a function reads is never stale."""

import functools
import gc
import importlib
import itertools
import math
import os
import random
import sys
import threading
import time
import types
from collections import defaultdict
from enum import Enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.motion.closures import captured as levels
from rbjax.motion.closures.captured import Captured, captured, with_captured
from tests.compilations import compilations
from tests.tolerances import F64_IDENTITY, GRADIENT, relative_error

# Float and integer powers of two: what is computed before and in the program is the same.
GAIN, COUNT, TABLE, WEIGHTS = 2.0, 2, {"gain": 2.0}, np.array([2.0, 4.0])
T, S = 0.0, rb.State(jnp.array([0.25, 0.5]), jnp.array([0.5, -1.0]))
MODULE = types.ModuleType("of_a_user")


class Way(Enum):
    LEFT = 1
    RIGHT = 2


class Gains(NamedTuple):
    p: float
    d: int


class Controller:
    k = 2.0

    def __init__(self, d):
        self.d = d

    def __call__(self, t, s):
        return self.k * s.q + self.d * s.v

    def global_gain(self, t, s):
        return GAIN * s.v


class Linear(eqx.Module):
    k: jax.Array
    way: str = eqx.field(static=True, default="v")

    def __call__(self, t, s):
        return GAIN * self.k * (s.v if self.way == "v" else s.q)


def set_global(name, value):
    return lambda: globals().update({name: value})


@pytest.fixture(autouse=True)
def restored():
    """The globals that tests change."""
    names = "GAIN", "COUNT", "WEIGHTS"
    before = {name: globals()[name] for name in names}
    yield
    globals().update(before, TABLE={"gain": 2.0})
    sys.modules.pop("of_a_user", None)
    os.environ.pop("RBJAX_TEST", None)
    Controller.k = 2.0


@functools.partial(jax.jit, static_argnames="key")
def program(numbers, key):
    tree, *leaves = key
    return eqx.combine(numbers, jax.tree.unflatten(tree, leaves))(T, S)


def value(f):
    """f(T, S) as a program gives it, one for all functions of a key."""

    def run(f):
        numbers, rest = eqx.partition(f, eqx.is_array)
        leaves, tree = jax.tree.flatten(rest)
        return program(numbers, (tree, *leaves))

    return with_captured(run, f)


# ------------------------------------------------------------------ what is read, and changes


def of_a_global():
    return lambda t, s: GAIN * s.v, set_global("GAIN", 4.0)


def of_a_count():
    return lambda t, s: COUNT * s.v, set_global("COUNT", 4)


def of_a_helper():
    return lambda t, s: helped(s), set_global("GAIN", 4.0)


def helped(s):
    return GAIN * s.v


def of_a_global_within():
    return lambda t, s: jax.vmap(lambda x: GAIN * x)(s.v), set_global("GAIN", 4.0)


def of_a_cell():
    k = 2.0

    def change():
        nonlocal k
        k = 4.0

    return lambda t, s: k * s.v, change


def of_a_cell_of_a_helper():
    k = 2

    def change():
        nonlocal k
        k = 4

    def scaled(x):
        return k * x

    return lambda t, s: scaled(s.v), change


def of_a_list():
    gains = [2, [2.0]]
    return lambda t, s: gains[0] * gains[1][0] * s.v, lambda: gains[1].append(gains[1].pop() + 2)


def of_a_list_of_counts():
    gains = [2]
    return lambda t, s: gains[-1] * s.v, lambda: gains.append(4)


def of_a_dict():
    return lambda t, s: TABLE["gain"] * s.v, lambda: TABLE.update(gain=4.0)


def of_the_order_of_a_dict():
    gains = {"b": 2.0, "a": 4.0}

    def change():
        gains["b"] = gains.pop("b")

    return lambda t, s: jnp.array(list(gains.values())) * s.v, change


def of_a_default():
    def f(t, s, k=2.0):
        return k * s.v

    def change():
        f.__defaults__ = (4.0,)

    return f, change


def of_a_keyword():
    def f(t, s, *, k=2):
        return k * s.v

    return f, lambda: f.__kwdefaults__.update(k=4)


def of_an_attribute_of_the_function():
    def f(t, s):
        return f.gain * s.v

    f.gain = 2.0
    return f, lambda: setattr(f, "gain", 4.0)


def of_an_attribute():
    one = Controller(2.0)
    return lambda t, s: one.d * s.v, lambda: setattr(one, "d", 4.0)


def of_an_object():
    one = Controller(2.0)
    return one, lambda: setattr(one, "d", 4.0)


def of_a_method():
    one = Controller(jnp.array(2.0))
    return one.__call__, lambda: setattr(one, "d", jnp.array(4.0))


def of_a_class():
    return Controller(2.0), lambda: setattr(Controller, "k", 4.0)


def of_a_method_that_reads():
    return Controller(2.0).global_gain, set_global("GAIN", 4.0)


def of_a_module():
    MODULE.gain = 2.0
    return lambda t, s: MODULE.gain * s.v, lambda: setattr(MODULE, "gain", 4.0)


def of_a_function_of_a_module():
    MODULE.scaled = lambda x: GAIN * x
    return lambda t, s: MODULE.scaled(s.v), set_global("GAIN", 4.0)


def of_a_partial():
    return functools.partial(lambda k, t, s: k * GAIN * s.v, 2.0), set_global("GAIN", 4.0)


def of_a_partial_of_jax():
    f = jax.tree_util.Partial(lambda k, t, s: k * GAIN * s.v, jnp.array(2.0))
    return f, set_global("GAIN", 4.0)


def of_a_module_of_equinox():
    return Linear(jnp.array(2.0)), set_global("GAIN", 4.0)


def of_a_function_in_a_module():
    mlp = eqx.nn.MLP(2, 2, 4, 1, activation=lambda x: GAIN * x, key=jax.random.key(0))
    return lambda t, s: mlp(s.v), set_global("GAIN", 4.0)


def of_an_array_in_place():
    weights = np.array([2.0, 4.0])
    return lambda t, s: weights * s.v, lambda: weights.__setitem__(0, 8.0)


def of_indices_in_place():
    rows = np.array([0, 1])
    return lambda t, s: s.v[rows], lambda: rows.__setitem__(0, 1)


def of_values_of_an_array():
    """numpy takes no tracers."""
    weights = np.array([2.0, 4.0])
    return lambda t, s: np.linalg.norm(weights) * s.v, lambda: weights.__setitem__(0, 8.0)


def of_a_comparison():
    k = 2.0

    def change():
        nonlocal k
        k = -4.0

    return lambda t, s: k * s.v if k > 0 else s.q, change


def of_a_number_of_python():
    k = 2.0

    def change():
        nonlocal k
        k = 4.0

    return lambda t, s: math.sqrt(k) * s.v, change


def of_what_kind_of_number():
    k = 2.0

    def change():
        nonlocal k
        k = 4

    return lambda t, s: s.v if isinstance(k, float) else s.q, change


def of_what_is_caught():
    k = 2.0

    def change():
        nonlocal k
        k = 4.0

    def f(t, s):
        try:
            return float(k) * s.v
        except TypeError:
            return s.q

    return f, change


def of_a_condition_on_an_array():
    k = np.array(2.0)
    return lambda t, s: s.v if k > 0 else s.q, lambda: k.__setitem__((), -4.0)


def of_an_enum():
    way = Way.LEFT

    def change():
        nonlocal way
        way = Way.RIGHT

    return lambda t, s: s.v if way is Way.LEFT else s.q, change


def of_a_tuple_with_names():
    gains = Gains(2.0, 2)

    def change():
        nonlocal gains
        gains = Gains(2.0, 4)

    return lambda t, s: gains.p * gains.d * s.v, change


def of_the_sign_of_zero():
    k = 0.0

    def change():
        nonlocal k
        k = -0.0

    return lambda t, s: math.copysign(1.0, k) * s.v, change


def of_functions_that_call_each_other():
    def even(n, x):
        return x if n == 0 else GAIN * odd(n - 1, x)

    def odd(n, x):
        return even(n - 1, x)

    return lambda t, s: even(4, s.v), set_global("GAIN", 4.0)


def of_a_compiled_helper():
    k = jax.jit(lambda x: 2.0 * x)

    def change():
        nonlocal k
        k = jax.jit(lambda x: 4.0 * x)

    return lambda t, s: k(s.v), change


def of_an_attribute_whose_name_is_computed():
    return lambda t, s: getattr(Controller, "k" + "") * s.v, lambda: setattr(Controller, "k", 4.0)


def of_an_attribute_that_a_helper_takes():
    one = Controller(2.0)
    take = lambda x, name: getattr(x, name)  # noqa: E731
    return lambda t, s: take(one, "d") * s.v, lambda: setattr(one, "d", 4.0)


def of_all_attributes():
    one = Controller(2.0)
    return lambda t, s: vars(one)["d"] * s.v, lambda: setattr(one, "d", 4.0)


def of_the_dict_of_an_object():
    one = Controller(2)
    return lambda t, s: one.__dict__["d"] * s.v, lambda: setattr(one, "d", 4)


def of_a_dict_with_a_default():
    gains = defaultdict(float, k=2.0)
    return lambda t, s: gains["k"] * s.v, lambda: gains.update(k=4.0)


def of_the_order_of_a_dict_with_a_default():
    gains = defaultdict(float, b=2.0, a=4.0)

    def change():
        gains["b"] = gains.pop("b")

    return lambda t, s: jnp.array(list(gains.values())) * s.v, change


def of_the_environment():
    os.environ["RBJAX_TEST"] = "2.0"
    return (lambda t, s: float(os.environ["RBJAX_TEST"]) * s.v,
            lambda: os.environ.update(RBJAX_TEST="4.0"))  # fmt: skip


def of_a_variable_of_the_environment():
    os.environ["RBJAX_TEST"] = "2.0"
    return (lambda t, s: float(os.getenv("RBJAX_TEST")) * s.v,
            lambda: os.environ.update(RBJAX_TEST="4.0"))  # fmt: skip


def of_a_module_that_it_imports():
    MODULE.gain = 2.0
    sys.modules["of_a_user"] = MODULE

    def f(t, s):
        import of_a_user

        return of_a_user.gain * s.v

    return f, lambda: setattr(MODULE, "gain", 4.0)


def of_a_name_that_it_imports():
    MODULE.gain = 2.0
    sys.modules["of_a_user"] = MODULE

    def f(t, s):
        from of_a_user import gain

        return gain * s.v

    return f, lambda: setattr(MODULE, "gain", 4.0)


def of_which_array_it_is():
    one = two = jnp.array([2.0, 4.0])

    def change():
        nonlocal two
        two = jnp.array([2.0, 4.0])

    return lambda t, s: s.v if one is two else s.q, change


def of_which_array_of_numpy_it_is():
    one = two = np.array([2.0, 4.0])

    def change():
        nonlocal two
        two = np.array([2.0, 4.0])

    return lambda t, s: s.v if one is not two else s.q, change


def of_which_array_is_in_a_list():
    one = jnp.array(2.0)
    some = [one]
    return lambda t, s: s.v if any(one is x for x in some) else s.q, some.clear


def of_whether_it_is_an_array():
    k = 2.0

    def change():
        nonlocal k
        k = np.array(2.0)

    return lambda t, s: s.v if hasattr(k, "shape") else s.q, change


CHANGES = [f for name, f in globals().items() if name.startswith("of_")]


@pytest.mark.parametrize("make", CHANGES)
def test_what_is_read_is_not_stale(make):
    f, change = make()
    assert isinstance(captured(f), Captured)
    before = np.asarray(value(f))
    np.testing.assert_array_equal(before, f(T, S))
    np.testing.assert_array_equal(value(make()[0]), before)
    change()
    after = np.asarray(value(f))
    np.testing.assert_array_equal(after, f(T, S))
    assert (after != before).any()
    again, _ = make()  # of what stands in globals, as it is now
    np.testing.assert_array_equal(value(again), again(T, S))


# ------------------------------------------------------------------------ what compiles once

FAMILIES = {
    "a float": lambda k: lambda t, s: k * s.v,
    "a default": lambda k: lambda t, s, k=k: k * s.v,
    "a helper's": lambda k: (lambda scaled: lambda t, s: scaled(s.v))(lambda x: k * x),
    "an array": lambda k: (lambda w: lambda t, s: w * s.v)(jnp.array([k, 1.0])),
    "an array of numpy": lambda k: (lambda w: lambda t, s: w * s.v)(np.array([k, 1.0])),
    "a scalar of numpy": lambda k: (lambda w: lambda t, s: w * s.v)(np.float64(k)),
    "a dict": lambda k: (lambda w: lambda t, s: w["k"] * s.v)({"k": k}),
    "a tuple with names": lambda k: (lambda w: lambda t, s: w.p * s.v)(Gains(k, 1)),
    "a partial": lambda k: functools.partial(lambda k, t, s: k * s.v, k),
    "a module": lambda k: Linear(jnp.array(k)),
    "a network": lambda k: (lambda net: lambda t, s: net(s.v))(
        eqx.nn.MLP(2, 2, 4, 1, key=jax.random.key(int(8 * k)))
    ),
    "a lambda in a lambda": lambda k: lambda t, s: jax.vmap(lambda x: k * x)(s.v),
    "a model": lambda k: (lambda m: lambda t, s: m.gravity[2] * s.v)(
        scene().replace(gravity=jnp.array([0, 0, k]))
    ),
}


@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)
def test_other_numbers_compile_nothing_again(family):
    value(family(0.5))
    with compilations() as compiled:
        found = [np.asarray(value(family(k))) for k in np.linspace(-1.0, 1.0, 20).tolist()]
    assert len(compiled) == 0
    want = [family(k)(T, S) for k in np.linspace(-1.0, 1.0, 20).tolist()]
    np.testing.assert_allclose(found, want, rtol=F64_IDENTITY)


def test_what_branches_on_a_number_is_compiled_once_for_each():
    family = lambda k: lambda t, s: k * s.v if k > 0 else -k * s.v  # noqa: E731
    wanted = {k: abs(k) * S.v for k in (1.0, -2.0, 3.0)}
    value(family(5.0))  # and the programs that come before any
    with compilations() as compiled:
        for k in (1.0, -2.0, 3.0, 1.0, -2.0, 3.0):
            np.testing.assert_array_equal(value(family(k)), wanted[k])
    assert len(compiled) == 3


# ------------------------------------------------------------------------- what is not read


def writes():
    calls = 0

    def f(t, s):
        nonlocal calls
        calls += 1
        return s.v

    return f


UNREAD = {
    "a generator": lambda: (lambda g: lambda t, s: next(g) * s.v)(itertools.count(1)),
    "a clock": lambda: lambda t, s: time.time() * s.v,
    "chance": lambda: lambda t, s: np.random.rand() * s.v,
    "chance of Python": lambda: lambda t, s: random.random() * s.v,
    "a lock": lambda: (lambda x: lambda t, s: s.v if x else s.q)(threading.Lock()),
    "what it counts": writes,
    "what runs outside": lambda: lambda t, s: jax.pure_callback(lambda v: v, s.v, s.v),
}


HIDDEN = {
    "globals": lambda: lambda t, s: globals()["GAIN"] * s.v,
    "eval": lambda: lambda t, s: eval("GAIN") * s.v,
    "globals of a helper": lambda: (lambda f: lambda t, s: f() * s.v)(lambda: globals()["GAIN"]),
}


@pytest.mark.parametrize("make", HIDDEN.values(), ids=HIDDEN)
def test_what_it_does_not_name_is_compiled_at_each_call_and_said(make):
    f = make()
    levels._say.cache_clear()
    with pytest.warns(UserWarning, match=r"uses `(globals|eval)`.*compiled at each call.*names"):
        np.testing.assert_array_equal(value(f), f(T, S))
    globals()["GAIN"] = 4.0
    np.testing.assert_array_equal(value(f), 4 * S.v)  # the same object, and no second warning


def test_identity_of_arrays_within_a_transformation():
    """Arrays that are operands are one operand where they are one array."""

    def run(k):
        f = lambda t, s, one=k: (1.0 if one is k else 2.0) * k * s.v  # noqa: E731
        return value(f).sum()

    assert jax.grad(run)(3.0) == S.v.sum()
    np.testing.assert_array_equal(jax.vmap(run)(jnp.arange(3.0)), jnp.arange(3.0) * S.v.sum())


def test_what_names_modules_and_computes_names_is_not_read():
    MODULE.gain = 2.0
    f = lambda t, s: getattr(MODULE, "ga" + "in") * s.v  # noqa: E731
    assert captured(f) is f


@pytest.mark.parametrize("make", UNREAD.values(), ids=UNREAD)
def test_what_cannot_be_read_is_an_object_of_its_own(make):
    f = make()
    assert captured(f) is f
    assert value(f).shape == (2,)


def test_what_writes_into_what_it_reads_is_traced_once():
    for tracers in (False, True):
        calls = []

        def f(t, s, calls=calls, tracers=tracers):
            calls.append(s.v if tracers else 1)
            return len(calls) * s.v

        value(f)
        due = len(calls)
        value(f)
        assert len(calls) == due
        assert captured(f) is f


def test_a_function_that_raises_raises_its_own_and_is_read_as_before():
    wrong = True

    def f(t, s):
        if wrong:
            raise KeyError("mine")
        return GAIN * s.v

    with pytest.raises(KeyError, match="mine"):
        value(f)
    assert f.__code__ not in levels._levels
    wrong = False
    np.testing.assert_array_equal(value(f), 2 * S.v)


# ------------------------------------------------------------------------ rollout and simulate


@functools.cache
def scene():
    return rb.load("cart_pole")


rollout_file = importlib.import_module("rbjax.motion.rollout")


def rolled(policy, **how):
    return rb.rollout(scene(), S, policy, 0.01, steps=3, **how).q[-1]


def solved(policy, **how):
    return rb.simulate(scene(), S, jnp.linspace(0.0, 0.02, 3), policy, dt=0.01, **how).q[-1]


@pytest.mark.parametrize("march", [rolled, pytest.param(solved, marks=pytest.mark.slow)])
def test_twenty_lambdas_are_one_program(march):
    def end(k):
        return march(lambda t, s: -k * s.v[:1])

    end(0.5)
    gains = np.linspace(-1.0, 1.0, 20).tolist()
    with compilations() as compiled:
        ends = [end(k) for k in gains]
    assert len(compiled) == 0
    want = jax.jit(jax.vmap(end))(jnp.array(gains))
    np.testing.assert_allclose(ends, want, atol=1e-14)

    slope = jax.grad(lambda k: end(k)[1])
    here = slope(0.5)
    with compilations() as compiled:
        other = slope(0.25)
    assert len(compiled) == 0
    assert here != other
    h = 1e-4
    assert relative_error(here, (end(0.5 + h) - end(0.5 - h))[1] / (2 * h)) < GRADIENT


def test_laws_integrators_and_forces_are_read_too():
    def run(k):
        def law(model, t, state, tau, f_ext):
            return k * tau

        def euler(field, t, state, inputs, dt):
            a, _ = field.rates(t, state, inputs)
            return rb.State(field.retract(state.q, dt * state.v), state.v + k * dt * a)

        tau = lambda t, s: jnp.array([k, 1.0])  # noqa: E731
        return rb.rollout(
            scene(), S, None, 0.01, tau=tau, dynamics=law, integrator=euler, steps=2
        ).v[1]

    run(1.0)
    with compilations() as compiled:
        found = [run(k) for k in (2.0, 3.0)]
    assert len(compiled) == 0
    np.testing.assert_allclose(found, [jax.jit(run)(k) for k in (2.0, 3.0)], atol=1e-14)


@pytest.mark.slow
def test_memory_is_bounded(monkeypatch):
    """Programs leave when others come: functions that differ in more than numbers."""
    few = functools.lru_cache(2, typed=True)(rollout_file._compiled.__wrapped__)
    monkeypatch.setattr(rollout_file, "_compiled", few)
    model, live = rb.load("pendulum"), []
    gc.collect()
    gc.freeze()  # what the tests before this one left is not looked through six times
    for n in range(6):
        rb.rollout(model, model.default_state(), lambda t, s, n=n: n * s.v, 0.01, steps=1)
        gc.collect()
        live.append(len(jax.devices()[0].client.live_executables()))
    assert live[-1] == live[2]
    assert live[1] > live[0]  # that one more would be counted
