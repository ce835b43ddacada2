"""Robots as constants of `solve`'s programs: other numbers are seen, and compile little."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Control, Problem, StateError
from rbjax.control.optimal.solver import ROBOTS, ConstantRobots, StaticPytree
from tests.compilations import compilations

MODEL = rb.load("pendulum")
START = rb.State(MODEL.default_state().q + 0.3, MODEL.default_state().v)


def of_mass(scale):
    mass, inertia = (x * scale for x in (MODEL.bodies.mass, MODEL.bodies.inertia))
    return MODEL.replace(bodies=MODEL.bodies.replace(mass=mass, inertia=inertia))


def solved(model, start=START):
    still = StateError(MODEL.default_state())
    problem = Problem(model, 5, 0.05, running=[still, Control()], terminal=[still])
    return rb.control.solve(problem, start)


def test_each_robot_has_its_own_optimum_and_few_have_a_program():
    scales = [1.0, 1.3, 0.7, 1.9, 0.6]
    costs, programs = [], []
    for scale in scales:
        with compilations() as compiled:
            costs.append(float(solved(of_mass(scale)).cost))
        programs.append(len(compiled))
    asked = jax.vmap(lambda scale: solved(of_mass(scale)).cost)(jnp.asarray(scales))
    np.testing.assert_allclose(costs, asked, rtol=1e-12)
    assert len(set(costs)) == len(costs)
    assert programs[ROBOTS + 1 :] == [0] * (len(scales) - ROBOTS - 1)
    with compilations() as compiled:
        assert float(solved(of_mass(scales[0])).cost) == costs[0]
    assert not compiled


def test_derivatives_by_a_robot():
    cost = lambda scale: solved(of_mass(scale)).cost  # noqa: E731
    h = 1e-5
    slope = (cost(1.2 + h) - cost(1.2 - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(cost)(1.2), slope, rtol=1e-6)


def test_constants_are_compared_by_their_numbers():
    make = lambda x: StaticPytree(*jax.tree.flatten((jnp.asarray(x), "a name")))  # noqa: E731
    one, same, other = make([0.0, 1.0]), make([0.0, 1.0]), make([0.0, 2.0])
    assert one == same and hash(one) == hash(same)
    assert one != other and one != make([0, 1]) and one != "constants"
    assert make([np.nan]) == make([np.nan])
    assert one.unflatten()[1] == "a name"


def test_what_is_known():
    known = ConstantRobots()
    robots = [(jnp.asarray(float(k)), len) for k in range(ROBOTS + 2)]
    found = [known.constants(robot) for robot in robots]
    assert [x is not None for x in found] == [True] * ROBOTS + [False] * 2
    again = known.constants((jnp.asarray(0.0), len))
    assert again is found[0], "equal numbers are the same constants"
    assert known.constants((jnp.zeros(2), len)) is not None, "another form"
    assert known.constants((jnp.asarray(0.0), _Unhashable())) is None

    @jax.jit
    def traced(x):
        assert known.constants((x, len)) is None
        return x

    traced(1.0)


class _Unhashable:
    __hash__ = None  # type: ignore[assignment]


@pytest.mark.parametrize("wrong", ["a name", None, (1, "x")])
def test_a_start_that_is_no_state(wrong):
    with pytest.raises(rb.InputError, match="solve: the state is"):
        solved(MODEL, wrong)
