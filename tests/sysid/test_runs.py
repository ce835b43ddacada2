"""Recordings as arrays."""

import numpy as np

import rbjax as rb
from rbjax.sysid import Channel, Grid, Recording, Setup
from rbjax.sysid.simulation.runs import make_run

SETUP = Setup.of(rb.load("pendulum"))
T = 0.01


def test_the_last_command_holds_for_one_more_step():
    t = np.arange(6) * T
    q, ctrl = Channel(t, np.zeros(6)), Channel(t[:4], np.arange(4.0))
    run = make_run(SETUP, Recording("a", {"q": q, "ctrl": ctrl}), Grid(T))
    np.testing.assert_array_equal(run.commands[:, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(run.times["q"], t[:5])  # the sixth has no command before it


def test_positions_that_end_with_the_commands_end_the_run():
    t = np.arange(4) * T
    both = {"q": Channel(t, np.zeros(4)), "ctrl": Channel(t, np.arange(4.0))}
    run = make_run(SETUP, Recording("a", both), Grid(T))
    np.testing.assert_array_equal(run.commands[:, 0], [0, 1, 2])
    assert len(run.times["q"]) == 4


def test_columns_are_taken_by_name():
    """Joints in another order than the model's."""
    model = rb.load("cart_pole")
    t = np.arange(4) * T
    q = np.arange(8.0).reshape(4, 2)
    names = tuple(model.joint_names)
    runs = [Recording("a", {"q": Channel(t, x, n), "v": Channel(t, x, n)})
            for x, n in ((q, names), (q[:, ::-1], names[::-1]))]  # fmt: skip
    one, other = (make_run(Setup.of(model), run, Grid(T)) for run in runs)
    np.testing.assert_array_equal(one.values["q"], other.values["q"])
    np.testing.assert_array_equal(one.start.v, other.start.v)
