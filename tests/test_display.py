"""Displays in a terminal and in a notebook: length, content, and leaves of all kinds."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import display, planning, svg, wheeled
from rbjax.display import Display, displayed


class Pair(NamedTuple):
    a: Any
    b: Any = None


Pair = displayed(Pair)


class Many(rb.model.record.Record):
    """A record of many fields."""

    x: Any
    rest: tuple = ()


def lines(x: Any) -> list[str]:
    return repr(x).splitlines()


# ---------------------------------------------------------------- values


@pytest.mark.parametrize(
    "x, expected",
    [
        (None, "Pair(a=None)"),  # a default None is left out
        (3, "Pair(a=3)"),
        (0.1234567, "Pair(a=0.1235)"),
        ("x", "Pair(a='x')"),
        (np.float32(0.5), "Pair(a=0.5)"),
        (jnp.float32(2.0), "Pair(a=2)"),
        (np.array([1, 2]), "Pair(a=i64[2] [1, 2])"),
        (jnp.array([0.5, -1.0], jnp.float32), "Pair(a=f32[2] [0.5, -1])"),
        (jnp.zeros((0,)), "Pair(a=f64[0] [])"),
        (jnp.zeros((2, 2)), "Pair(a=f64[2,2])"),
        (jnp.zeros(7, bool), "Pair(a=bool[7])"),
        (np.array(["a", "b"]), "Pair(a=<U1[2] [a, b])"),
        (jax.random.key(0), "Pair(a=key<fry>[])"),
        (jax.ShapeDtypeStruct((3,), jnp.float32), "Pair(a=f32[3])"),
        ((1.0, (2,)), "Pair(a=(1, (2,)))"),
        ({"k": [1, 2]}, "Pair(a={'k': [1, 2]})"),
        (max, "Pair(a=<max>)"),
        (int, "Pair(a=int)"),
        (Pair(1, 2), "Pair(a=Pair(a=1, b=2))"),
    ],
)
def test_a_value_is_on_the_line(x, expected):
    assert repr(Pair(x)) == expected


def test_arrays_without_values_show_dtype_and_shape():
    seen = []
    jax.jit(lambda x: seen.append(repr(Pair(x, x[0]))) or x)(jnp.ones(3, jnp.float32))
    assert seen == ["Pair(a=f32[3], b=f32[])"]
    gone = jnp.ones(3)
    gone.delete()
    assert repr(Pair(gone)) == "Pair(a=f64[3])"


def test_nothing_is_computed_or_transferred_implicitly():
    x = Pair(jnp.ones(3), jnp.ones((50, 50)))
    with jax.transfer_guard("disallow"), jax.log_compiles():
        assert repr(x) == "Pair(a=f64[3] [1, 1, 1], b=f64[50,50])"
        assert "f64[50,50]" in x._repr_html_()


def test_long_objects_are_tables_of_few_lines():
    long = Many(jnp.zeros(3), tuple(Many(np.arange(9.0), (k,)) for k in range(100)))
    found = lines(long)
    assert len(found) == 3 and found[0] == "Many"
    assert max(map(len, found)) <= display.WIDTH
    assert found[2].endswith("100 in all)")
    several = Display("Many", [(str(k), "x") for k in range(40)], ("name", "value"))

    class Shown:
        def _display_(self):
            return several

    text, page = display.text(Shown()), display.html(Shown())
    assert len(text.splitlines()) == display.LINES
    assert text.splitlines()[-1] == "  ... 28 more"  # of 41 with the head: 13 are above
    assert page.count("<tr>") == 41


def test_half_made_objects_show():
    """A debugger shows an object before all of its fields are set."""
    assert repr(object.__new__(Many)) == "Many(x='unset', rest=())"


def test_text_of_a_page_is_escaped():
    assert "<script>" not in Pair("<script>" * 20)._repr_html_()


# ---------------------------------------------------------------- pictures


def test_curves_end_at_the_borders():
    found = svg.curves(np.array([0.0, 1.0, 2.0]), np.array([[0.0], [1.0], [0.5]]), "q")
    (width, height), m = svg.SIZE, svg.MARGIN
    middle = f"{width / 2:.1f},{m:.1f}"  # the largest value is at the top
    assert f'points="0.0,{height - m:.1f} {middle} {width:.1f},{height / 2:.1f}"' in found
    gaps = svg.curves(np.arange(5.0), np.array([0, 1, np.nan, 1, 0])[:, None], "q")
    assert gaps.count("<polyline") == 2 and "nan" not in gaps


def test_cells_are_the_filled_area():
    walls = np.zeros((4, 3), bool)
    walls[1:3, 0] = walls[0, 2] = True
    assert svg.cells(walls).count("M") == 2
    assert "M1,2h2v1h-2z" in svg.cells(walls)  # row j = 0 is at the bottom
    large = svg.cells(np.eye(1000, dtype=bool))
    assert len(large) < 10_000


# ---------------------------------------------------------------- models and motions


def test_a_model_names_its_joints_and_sizes():
    model = rb.load("humanoid")
    found = lines(model)
    assert len(found) <= display.LINES and max(map(len, found)) <= display.WIDTH
    assert f"nq {model.nq}, nv {model.nv}, nu {model.nu}, f64" in found[0]
    assert model.joint_names[0] in found[3]
    page = model._repr_html_()
    assert all(name in page for name in model.joint_names)


@pytest.mark.parametrize("batch", [0, 1, 3])
def test_a_batch_of_models_shows(batch):
    many = jax.tree.map(lambda x: np.broadcast_to(x, (batch, *x.shape)), rb.load("cart_pole"))
    assert lines(many)[0].startswith(f"Model [batch ({batch},)]: 2 bodies")


def test_models_of_other_leaves_show():
    model = rb.load("cart_pole")
    seen = []
    model = jax.tree.map(lambda x: np.asarray(x, np.float32), model)
    many = jax.tree.map(lambda x: np.stack([x, x]), model)
    jax.make_jaxpr(lambda m: seen.append(repr(m)) or m.gravity)(model)
    jax.make_jaxpr(jax.vmap(lambda m: seen.append(repr(m)) or m.gravity))(many)
    assert seen == [repr(model)] * 2
    assert "f32" in seen[0]
    for leaf in (None, 0, object()):
        empty = jax.tree.map(lambda _: leaf, model)  # noqa: B023
        assert lines(empty)[0] == "Model: 2 bodies, 2 joints, nq 2, nv 2, nu 1"


def path(batch: tuple[int, ...] = (), ok: bool = True) -> rb.Trajectory:
    q = jnp.zeros((*batch, 5, 2))
    return rb.Trajectory(jnp.linspace(0, 2, 5), q, q, jnp.full(batch, ok), stats={"steps": 4})


@pytest.mark.parametrize("batch", [(), (0,), (1,), (3,)])
def test_a_trajectory_shows(batch):
    found = lines(path(batch))
    lead = f" [batch {batch}]" if batch else ""
    assert found[0] == f"Trajectory{lead}: 5 states from 0 to 2 s, finite"
    drawn = "<svg" in path(batch)._repr_html_()
    assert drawn == (batch != (0,))


def test_a_trajectory_of_other_leaves_shows():
    assert lines(path((3,), ok=False))[0].endswith("3 of 3 not finite")
    seen = []
    jax.jit(lambda p: seen.append((repr(p), p._repr_html_())) or p.q)(path())
    assert seen[0][0].startswith("Trajectory: 5 states\n") and "svg" not in seen[0][1]
    assert repr(jax.tree.map(lambda _: None, path()))


# ---------------------------------------------------------------- other rooms


def test_wheeled_robots_list_their_wheels():
    robot = wheeled.kinds()["differential_drive"].make()
    found = lines(robot)
    assert found[0].startswith(f"Robot: {len(robot.wheels)} wheels, 1 body, 2 drives")
    assert len(found) == 2 + len(robot.wheels)
    model = wheeled.at(robot, "reduced")
    assert lines(model)[0].endswith(f"nq {model.nq}, nv {model.nv}, nx 0, nu 2")
    assert robot._repr_html_().count("<polygon") == 1 + len(robot.wheels)
    seen = []
    jax.jit(lambda r: seen.append((repr(r), r._repr_html_())) or r.gravity)(robot)
    assert "f64[2]" in seen[0][0] and "<polygon" not in seen[0][1]


def test_maps_and_plans_show():
    walls = np.zeros((20, 20), bool)
    walls[:5] = True
    grid = planning.OccupancyGrid(walls, 0.2)
    assert lines(grid)[0] == "OccupancyGrid: 20 x 20 cells of 0.2 m, 25% occupied"
    assert "<path" in grid._repr_html_()
    plan = planning.Plan("no path", expanded=1)
    assert lines(plan)[0] == "Plan: no path, 1 visited cell" and "svg" not in plan._repr_html_()
    way = planning.Path([0.0, 0, 0], [[1.0, 0, 0.5]])
    assert "<polygon" in planning.Plan("found", 1.0, path=way)._repr_html_()


def test_recordings_list_their_channels():
    t = np.linspace(0.0, 1.0, 101)
    run = rb.sysid.Recording("swing", {"q": rb.sysid.Channel(t, np.sin(t), ("hinge",))})
    assert lines(run)[0] == "Recording 'swing': 1 s, 1 channel"
    assert lines(run)[2].split() == ["q", "101", "100", "('hinge',)", "0"]


def test_problems_show_their_costs():
    model = rb.load("cart_pole")
    goal = rb.control.StateError(model.default_state())
    running = [rb.control.Control()] * 30
    problem = rb.control.Problem(model, 5, 0.02, running=running, terminal=[goal])
    found = lines(problem)
    assert found[0] == "Problem: 5 steps of 0.02 s, 4 tangent coordinates, 1 control"
    assert len(found) == display.LINES and found[1].split()[:2] == ["running", "Control,"]


def test_reports_and_recommendations_show():
    error = rb.validation.Error(1e-12, 2e-12)
    row = rb.validation.ReportRow("bias", {"rbjax f64": error}, {"rbjax f64": 1e-9})
    report = rb.validation.Report("pendulum", 3, 1.0, (row,), ())
    assert lines(report)[0] == "Report: 'pendulum', 3 states, within tolerances"
    choice = rb.recommend.Recommendation("rk4", 3.0, (Pair("rk4", 3.0),), "it is the cheapest")
    assert lines(choice)[1:] == ["  it is the cheapest", "  a      b", "  'rk4'  3"]


def test_tasks_and_environments_list_their_terms():
    env = rb.envs.make("cart_pole_balance")
    task = rb.envs.tasks()["go1_joystick_flat"]()
    steps = "1000 control steps of 0.01 s, 1 physics step in each"
    assert lines(env)[0] == f"Environment 'cart_pole_balance': {steps}"
    assert lines(env)[1].split(maxsplit=1) == ["sizes", "action (1,), observation (5,)"]
    assert lines(env.task) == [f"Task 'cart_pole_balance': {steps}", *lines(env)[2:]]
    for x in (env, task):
        assert len(lines(x)) <= display.LINES
        assert max(map(len, lines(x))) <= display.WIDTH
    assert all(name in task._repr_html_() for name in [r.name for r in task.rewards])


def test_tasks_of_wrong_parts_show():
    """A task is checked only by `Environment`; an error may print it before."""
    speed = rb.envs.Observation("speed", lambda transition: transition.after.v)
    known = {"name": "a", "model": rb.load("pendulum"), "start": None}
    for groups, rewards in (((speed,), None), ({"policy": speed}, 3), (None, {"x": 1})):
        x = rb.envs.Task(**known, observations=groups, rewards=rewards, dt=jnp.ones(2))
        assert lines(x)[0] == "Task 'a': 1000 control steps, 1 physics step in each"


def test_a_controller_shows_its_problem_and_options():
    problem = rb.control.Problem(rb.load("cart_pole"), 5, 0.02, running=[rb.control.Control()])
    found = lines(rb.control.mpc(problem))
    assert found[0] == "PredictiveController" and len(found) <= display.LINES
    assert any(x.split()[:2] == ["problem", "Problem:"] for x in found)
    assert any(x.split() == ["method", "'ddp'"] for x in found)


def test_a_monitor_shows_its_last_report():
    monitor = rb.envs.learning.Monitor("balance", 200, show=False)
    assert repr(monitor) == "Monitor 'balance': 0 of 200 steps, 0 reports"
    with monitor:
        monitor(100, {"reward": 1.0}, None)
    assert lines(monitor)[0] == "Monitor 'balance': 100 of 200 steps, 1 report"
    assert lines(monitor)[-1].split() == ["reward", "1"]
