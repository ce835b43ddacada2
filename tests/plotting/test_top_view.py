"""Wheeled robots from above: where their parts are, and what the files and axes hold."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from rbjax import wheeled
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.planning import Footprint, OccupancyGrid
from rbjax.plotting import animate_top_view, top_view
from rbjax.plotting.from_above import centers, places, vectors, wheel_forces

KINDS = wheeled.kinds()


@pytest.fixture(scope="module")
def car():
    return wheeled.at(KINDS["car"].make(), "slipping")


@pytest.fixture(scope="module")
def motion(car):
    start = wheeled.start(car, pose=[0.3, -0.2, 0.4], twist=[3.0, 0.0, 0.2])
    return wheeled.rollout(car, start, jnp.array([[20.0, 0.3]] * 20), 0.005, save_every=5)


def test_trailers_hang_on_their_hitches():
    robot = KINDS["tractor_trailers"].make()
    vehicle = wheeled.at(robot, "reduced")
    q = np.random.default_rng(0).normal(size=(3, vehicle.nq))
    every = places(vehicle, q)
    for k in range(3):
        at = every.at(k)
        for i, body in enumerate(robot.bodies[1:], start=1):
            hitch = at.points(body.ahead, body.hitch)
            np.testing.assert_allclose(at.points(i, [body.drawbar, 0.0]), hitch, atol=1e-12)
            turned = vectors([np.cos(q[k, 2 + i]), np.sin(q[k, 2 + i])], at.bodies[body.ahead])
            np.testing.assert_allclose(at.bodies[i], turned, atol=1e-12)


@pytest.mark.parametrize("name", ["differential_drive", "car"])
def test_wheels_that_roll_move_along_themselves(name):
    vehicle = wheeled.at(KINDS[name].make(), "reduced")
    state = wheeled.start(vehicle, pose=[0.1, 0.2, 0.7], twist=[0.5, 0.0, 0.3])
    rate, h = wheeled.rates(vehicle, state, jnp.zeros(vehicle.nu)), 1e-6
    at, before, after = (places(vehicle, state.q + s * h * rate.q) for s in (0, -1, 1))
    robot = vehicle.robot
    moved = (centers(robot, after) - centers(robot, before)) / (2 * h)
    sideways = moved[:, 0] * at.wheels[:, 1] - moved[:, 1] * at.wheels[:, 0]
    assert np.hypot(*moved.T).min() > 0.1
    np.testing.assert_allclose(sideways, 0, atol=1e-8)


def test_forces_accelerate_the_car(car, motion):
    state, u = motion.state(-1), jnp.array([20.0, 0.3])
    forces, _ = wheel_forces(car, state, u, places(car, state.q))
    n = car.context(state).n
    h = 1e-5

    def velocity_of_the_center(s):
        rate = wheeled.rates(car, state, u)
        q, v = state.q + s * rate.q, state.v + s * rate.v
        context = car.context(State(q, v))
        n = context.n
        x, y = (float(a) / float(n.bodies[0].mass) for a in n.bodies[0].moment)
        body = np.array([v[0] - v[2] * y, v[1] + v[2] * x])
        return vectors(body, np.array([float(a) for a in context.pose]))

    found = (velocity_of_the_center(h) - velocity_of_the_center(-h)) / (2 * h)
    np.testing.assert_allclose(forces.sum(0) / float(n.bodies[0].mass), found, rtol=1e-6)


def test_a_picture_shows_all_of_the_robot(car, motion):
    ax = Figure().subplots()
    grid = OccupancyGrid(np.eye(4, dtype=bool), 1.0, [-2.0, -2.0])
    top_view(car, motion, ax=ax, robots=2, ctrl=jnp.array([20.0, 0.3]), grid=grid)
    low, high = np.array(ax.get_xlim()), np.array(ax.get_ylim())
    for k in (0, -1):
        found = centers(car.robot, places(car, motion.q[k]))
        assert (found[:, 0] > low[0]).all() and (found[:, 0] < low[1]).all()
        assert (found[:, 1] > high[0]).all() and (found[:, 1] < high[1]).all()


def test_a_film(car, motion, tmp_path):
    done = []
    file = animate_top_view(
        car, motion, tmp_path / "car.gif", ctrl=lambda t, s: jnp.array([20.0, 0.3]), speed=0.5,
        footprint=Footprint.disc(0.5), size=(200, 160), progress=lambda *x: done.append(x),
    )  # fmt: skip
    with Image.open(file) as picture:
        assert picture.size == (200, 160)
        assert picture.n_frames == len(done) == round(0.1 * 25 / 0.5) + 1


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"file": "car.html"}, "ends in .gif, .mp4"),
        ({"ctrl": np.zeros(3)}, "ctrl has shape"),
        ({"fps": 0.0}, "fps is 0.0"),
    ],
)
def test_bad_arguments(car, motion, tmp_path, how, says):
    file = tmp_path / how.pop("file", "car.gif")
    with pytest.raises(InputError, match=says):
        animate_top_view(car, motion, file, **how)


def test_a_motion_that_blows_up_is_shown_until_then(car, motion, tmp_path):
    bad = replace(motion, q=motion.q.at[3:].set(jnp.nan))
    with pytest.warns(UserWarning, match="not finite after t = 0.05 s"):
        file = animate_top_view(car, bad, tmp_path / "car.gif", size=(200, 160), speed=0.5)
    with Image.open(file) as picture:
        assert picture.n_frames == 3
    with pytest.raises(InputError, match="the first state is not finite"):
        animate_top_view(car, replace(motion, q=motion.q * jnp.nan), tmp_path / "car.gif")
