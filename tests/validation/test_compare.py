"""`compare` finds agreement and disagreement, and lists the disabled features."""

import jax
import numpy as np
import pytest

import rbjax as rb
from rbjax.validation import compare
from rbjax.validation.contacts import with_contacts
from rbjax.validation.reference import smooth
from rbjax.validation.report import COLUMNS, Error, Report, ReportRow, relative

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
    assert report.success
    assert tuple(row.quantity for row in report.rows) == QUANTITIES
    assert report.columns == COLUMNS[:3]
    for row in report.rows:
        assert row.errors["MJX f64"].worst < 1e-9, row.quantity
    as_dict = report.to_dict()
    assert as_dict["success"] and len(as_dict["rows"]) == len(QUANTITIES)


def test_arm_without_mjx_and_gradient() -> None:
    report = compare("arm7", states=4, mjx=False, seconds=0.1, gradient=False, driver="rolled")
    assert report.success
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
        row = ReportRow("bias", {"rbjax f64": Error(worst, worst)}, {"rbjax f64": 1e-10})
        return Report("robot", 1, 1.0, (row,), ())

    assert report(1e-12).success
    assert not report(1e-8).success
    assert not report(float("nan")).success
    assert relative(np.array([[2.0]]), np.array([[1.0]])).worst == 1.0


DROP = """<mujoco><option timestep="0.002" cone="elliptic" integrator="implicitfast"/>
<worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body name="box" pos="0 0 .22"><freejoint/><geom name="box" type="box" size=".1 .1 .1"/>
    <body pos="0 0 .2"><joint name="j" axis="0 1 0" range="-5 5" limited="true" frictionloss=".1"/>
      <geom name="egg" type="ellipsoid" size=".03 .04 .1" pos="0 0 .05"/></body></body>
  <body pos="0 .5 .21"><freejoint/><geom name="cube" type="box" size=".1 .1 .2"/></body>
</worldbody></mujoco>"""


def test_contacts_beside_mujoco() -> None:
    """A robot drops and rests; the table has the forces, and the solver's steps are reported."""
    report = compare(DROP, states=6, seconds=0.6, contacts=True)
    names = "contacts", "forward dynamics", "constraint forces", "contact forces", "one step"
    assert tuple(row.quantity for row in report.rows) == names
    assert report.success and report.columns == COLUMNS[:2]
    assert all(row.errors["rbjax f64"].worst < 1e-11 for row in report.rows)
    assert report.row("contacts").errors["rbjax f64"].worst == 0
    assert "Newton steps or fewer in f64" in report.notes[0]
    assert "0 of 6 have contacts" not in report.notes[0]


def test_pairs_without_a_closed_form_are_off_in_both_engines() -> None:
    m, model, off = with_contacts(DROP)
    assert any("contact pairs of" in word and "ellipsoid" in word for word in off)
    egg = m.geom("egg").id
    assert not m.geom_contype[egg] and not any(egg in pair for pair in model.geoms.pairs)
    assert m.opt.tolerance == 0 and model.contact == "mujoco"


def test_bad_input() -> None:
    with pytest.raises(rb.InputError, match="states is 0"):
        compare("pendulum", states=0)
    for contacts in (False, True):
        with pytest.raises(rb.InputError, match="no joints"):
            compare("<mujoco><worldbody/></mujoco>", contacts=contacts)
    with pytest.raises(rb.InputError, match="contacts is 1, expected True or False"):
        compare("pendulum", contacts=1)


def test_no_contact_to_compare():
    with pytest.warns(UserWarning, match="none of the 3 states .* has a contact"):
        compare(DROP, states=3, seconds=0.02, contacts=True)
