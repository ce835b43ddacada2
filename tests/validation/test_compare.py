"""`compare` finds agreement and disagreement, and lists the disabled features."""

import jax
import numpy as np
import pytest

import rbjax as rb
from rbjax.validation import compare
from rbjax.validation.reference import smooth
from rbjax.validation.report import COLUMNS, Error, Report, Row, relative

QUANTITIES = (
    "poses", "velocities", "mass matrix", "bias forces", "forward dynamics", "one step",
    "trajectory", "gradient",
)  # fmt: skip

LIMITED = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body>
      <joint name="j" type="hinge" axis="0 1 0" limited="true" range="-1 1" frictionloss="0.1"/>
      <geom type="sphere" size="0.1" pos="0.3 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.slow  # MJX takes long to compile
def test_pendulum_beside_mujoco_and_mjx() -> None:
    report = compare("pendulum", states=4, mjx=("f64",), seconds=0.2)
    assert report.ok
    assert tuple(row.quantity for row in report.rows) == QUANTITIES
    assert report.columns == COLUMNS[:3]
    for row in report.rows:
        assert row.errors["MJX f64"].worst < 1e-9, row.quantity
    as_dict = report.to_dict()
    assert as_dict["ok"] and len(as_dict["rows"]) == len(QUANTITIES)


def test_arm_without_mjx_and_gradient() -> None:
    report = compare("arm7", states=4, mjx=False, seconds=0.1, gradient=False, driver="rolled")
    assert report.ok
    assert report.row("trajectory").errors["rbjax f64"].worst < 1e-12
    assert report.columns == COLUMNS[:2]


def test_the_callers_precision_stays() -> None:
    with jax.enable_x64(False):
        compare("pendulum", states=1, mjx=False, seconds=0.01, gradient=False)
        assert jax.numpy.ones(1).dtype == np.float32


def test_what_is_switched_off_is_said() -> None:
    reference, off = smooth(LIMITED)
    assert {"joint limits (j)", "joint friction loss (j)"} <= set(off)
    assert any("contacts" in word for word in off)
    assert not reference.dof_frictionloss.any()


def test_a_wrong_answer_is_out_of_tolerance() -> None:
    def report(worst: float) -> Report:
        row = Row("bias", {"rbjax f64": Error(worst, worst)}, {"rbjax f64": 1e-10})
        return Report("robot", 1, 1.0, (row,), ())

    assert report(1e-12).ok
    assert not report(1e-8).ok
    assert not report(float("nan")).ok
    assert relative(np.array([[2.0]]), np.array([[1.0]])).worst == 1.0


def test_bad_input() -> None:
    with pytest.raises(rb.InputError, match="states is 0"):
        compare("pendulum", states=0)
    with pytest.raises(rb.InputError, match="no joints"):
        compare("<mujoco><worldbody/></mujoco>")
