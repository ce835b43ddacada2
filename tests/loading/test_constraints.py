"""Loaded constraints: rows beside MuJoCo's own, what is left out, URDF's mimics, Cassie's loops."""

import json
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.model_rows import gradient_matrix, rows_of
from rbjax.loading import compile_model
from tests.robots import QUICK, load_quietly

CASSIE = Path(__file__).parents[3] / "shared" / "data" / "cassie"  # beside the repository
TREE = """<mujoco><option jacobian="dense"><flag contact="disable"/></option><worldbody>
  <site name="ground" pos="0.3 0 0.2" quat="1 0 2 0"/>
  <body name="stone"><geom name="stone" size="0.1"/></body>
  <body name="a" pos="0 0 1"><freejoint/><geom size="0.1"/>
    <site name="a" pos="0.1 0 0" quat="1 2 0 0"/>
    <body name="b" pos="1 0 0"><joint name="hinge" ref="20" axis="1 2 0"/><geom size="0.1"/>
      <site name="b" pos="0 0.1 0"/>
      <body name="tip"><geom size="0.1"/></body></body></body>
  <body name="c" pos="0 2 1"><joint name="slide" type="slide" ref="0.1"/><geom size="0.1"/></body>
  </worldbody><tendon><fixed name="rope"><joint joint="slide" coef="1"/></fixed>
  <spatial name="cord"><site site="ground"/><geom geom="stone"/><site site="b"/>
    <pulley divisor="2"/><site site="a"/><site site="ground"/></spatial></tendon>
  <equality>{}</equality></mujoco>"""
EQUALITIES = {  # one of each form; its kind here
    '<connect body1="b" anchor="0.1 0.2 0.3"/>': rc.Spherical,
    '<connect body1="b" body2="c" anchor="0.1 0.2 0.3"/>': rc.Spherical,
    '<connect site1="a" site2="ground"/>': rc.Spherical,
    '<weld body1="b" body2="c"/>': rc.Weld,
    '<weld body1="b" body2="c" anchor="0.1 0.2 0.3" relpose="0 0.1 0.2 1 2 0 0" torquescale="3"/>':
        rc.Weld,
    '<weld body1="c" anchor="0.1 0.2 0.3" torquescale="0"/>': rc.Spherical,
    '<weld site1="b" site2="ground"/>': rc.Weld,
    '<joint joint1="hinge" joint2="slide" polycoef="0.1 0.2 0.3 0.4 0.5"/>': rc.JointPolynomial,
    '<joint joint1="slide" polycoef="0.3 0 0 0 0"/>': rc.JointPolynomial,
    '<tendon tendon1="rope" polycoef="0.1 0 0 0 0"/>': rc.TendonPolynomial,
    '<tendon tendon1="cord" tendon2="rope" polycoef="0.1 -2 0.3 0.1 0.05"/>': rc.TendonPolynomial,
}  # fmt: skip


def rows_and_gradients(model: rb.Model):
    def found(q):
        context = rb.forces.Context.of(model, 0.0, rb.State(q, np.zeros(model.nv)), None)
        rows = rows_of(model, context)
        return jax.numpy.stack([row.value for row in rows]), gradient_matrix(context, rows)

    return jax.jit(found, compiler_options=QUICK)


def mujoco_rows(m: mujoco.MjModel, data: mujoco.MjData, q) -> Iterator[tuple]:
    """Residual and Jacobian of each equality in turn."""
    data.qpos = q
    mujoco.mj_forward(m, data)
    assert (data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)).all()
    J = data.efc_J.reshape(data.nefc, m.nv)
    for i in range(m.neq):
        mine = data.efc_id == i
        yield data.efc_pos[mine], J[mine]


def as_sines(r: np.ndarray, J: np.ndarray, scale: float, like: np.ndarray) -> tuple:
    """MuJoCo's rows of a turn, scale sin(x / 2) n, as those of `Weld`, -sin(x) n. cos(x / 2) has
    the sign for which they are like ours: a quaternion leaves it open."""
    r, J = -r / scale, -J / scale
    w = np.sqrt(1 - r @ r) * np.sign(like @ r)
    return 2 * w * r, 2 * (w * J - np.outer(r, r @ J) / w)


def wanted(constraint: rc.Constraint, r, J, scale: float, like: np.ndarray) -> tuple:
    """MuJoCo's rows of an equality, as ours: pairs with the other sign, for MuJoCo takes the first
    body's frame less the second's."""
    if isinstance(constraint, rc.JointPolynomial | rc.TendonPolynomial):
        return r, J
    turn = as_sines(r[3:], J[3:], scale, like[3:]) if constraint.size == 6 else (r[:0], J[:0])
    return np.concatenate([-r[:3], turn[0]]), np.concatenate([-J[:3], turn[1]])


def test_each_equality_has_the_rows_of_mujoco() -> None:
    text = TREE.format("".join(EQUALITIES))
    model, m = load_quietly(text), compile_model(text)
    assert [type(x) for x in model.constraints] == [*EQUALITIES.values()]
    assert model.dropped == ()
    ours, data, worst = rows_and_gradients(model), mujoco.MjData(m), 0.0
    for key in jax.random.split(jax.random.key(0), 4):
        q = np.array(model.random_state(key).q)
        values, gradients = map(np.asarray, ours(q))
        at = 0
        for i, (r, J) in enumerate(mujoco_rows(m, data, q)):
            constraint, scale = model.constraints[i], m.eq_data[i, 10]
            if len(r) > constraint.size:  # a weld without torque
                assert scale == 0 and not J[3:].any()
            g, G = (x[at : at + constraint.size] for x in (values, gradients))
            want, want_G = wanted(constraint, r, J, scale, g)
            worst = max(worst, np.abs(g - want).max(), np.abs(G - want_G).max())
            at += constraint.size
        assert at == len(values)
    assert worst <= 1e-12


def test_cassie_has_twelve_rows_of_rank_ten() -> None:
    if not CASSIE.exists():
        pytest.skip(f"{CASSIE} is not there")
    model = load_quietly(CASSIE / "cassie.xml", contacts=False)
    assert [type(x) for x in model.constraints] == [rc.Spherical] * 4
    q = np.array(json.loads((CASSIE / "consistent.json").read_text())["qpos"])
    values, G = map(np.asarray, rows_and_gradients(model)(q))
    singular = np.linalg.svd(G, compute_uv=False)
    assert len(values) == 12 and np.linalg.norm(values) <= 5e-16
    assert (singular > 1e-9).sum() == 10 and singular[10:].max() <= 1e-15


LEFT_OUT = {  # an equality: what is said of it
    '<joint name="x" joint1="hinge" active="false"/>': "constraints that are not active (x)",
}


@pytest.mark.parametrize("equality", LEFT_OUT)
def test_what_does_not_load_is_named(equality: str) -> None:
    with pytest.warns(UserWarning, match="left out of the model"):
        model = rb.load(TREE.format(equality + '<connect body1="c" anchor="0 0 0"/>'))
    assert model.dropped == (f"equality {LEFT_OUT[equality]}",)
    assert [type(x) for x in model.constraints] == [rc.Spherical]


def test_they_are_left_out_if_asked_for() -> None:
    text = TREE.format('<connect name="loop" body1="c" anchor="0 0 0"/>')
    with pytest.warns(UserWarning, match="left out"):
        model = rb.load(text, constraints=False)
    assert model.constraints == () and model.dropped == ("equality constraints (loop)",)


@pytest.mark.parametrize("flag", ["constraint", "equality"])
def test_what_is_switched_off_in_the_file_holds_nothing(flag: str) -> None:
    text = TREE.format('<connect body1="c" anchor="0 0 0"/>')
    off = text.replace('contact="disable"', f'contact="disable" {flag}="disable"')
    model = rb.load(off, strict=True)
    assert off != text and model.constraints == () and model.dropped == ()


def test_bodies_that_are_fixed_to_each_other_have_no_rows() -> None:
    text = TREE.format('<weld body1="stone"/><connect body1="b" body2="tip" anchor="0 0 0"/>')
    m = compile_model(text)
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    assert data.nefc == 0 and rb.load(text, strict=True).constraints == ()


def test_numbers_that_are_none_are_refused() -> None:
    text = TREE.format('<connect body1="c" anchor="0 nan 0"/>')
    with pytest.raises(rb.ModelError, match="equality 0 has the value nan"):
        load_quietly(text)


def test_written_and_read_back_they_have_the_same_rows() -> None:
    """In the form of sites, which gives both ends as they are, closed or not."""
    model = load_quietly(TREE.format("".join(EQUALITIES)))
    end = rc.Place(*map(np.asarray, ([0.1, 0.2, 0.3], [0.6, 0.0, 0.8, 0.0])), site="b")
    model = model.with_constraints(rc.Weld(end, rc.Place.on(body="c", point=[1.0, 2, 3])))
    model = model.with_constraints(rc.Rack("slide", "hinge", 0.3))
    again = rb.load(rb.write_mjcf(model, strict=True), strict=True)
    q = np.array(model.random_state(jax.random.key(0)).q)
    for a, b in zip(rows_and_gradients(model)(q), rows_and_gradients(again)(q), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)


def test_what_cannot_be_written_is_named() -> None:
    model = rb.load("double_pendulum")
    high = rc.JointPolynomial("elbow", "shoulder", np.ones(6))
    gear = rc.Gear("elbow", "shoulder", -3.0)
    driven = model.with_constraints(rc.Prescribed("elbow", np.sin), high, gear)
    with pytest.warns(UserWarning, match="left out: constraint Prescribed; .*JointPolynomial"):
        text = rb.write_mjcf(driven)
    (read,) = rb.load(text).constraints
    assert read.coefficients.tolist() == [0, -3, 0, 0, 0] and (read.joint, read.driver) == (1, 0)


def test_what_mujoco_refuses_is_left_out_by_name() -> None:
    """What couples a joint with itself, or a frame with itself."""
    model = rb.load("double_pendulum")
    end = rc.Place.on(body=0)
    odd = model.with_constraints(rc.JointPolynomial(0, 0, [0.1, 2.0]), rc.Weld(end, end))
    with pytest.warns(UserWarning, match="constraint JointPolynomial; .*constraint Weld"):
        assert rb.load(rb.write_mjcf(odd), strict=True).constraints == ()


# ---------------------------------------------------------------------------- URDF


def urdf(mimic: str, driver: str = "continuous") -> str:
    link = '<link name="{}"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" '
    link += 'ixy="0" ixz="0" iyz="0"/></inertial></link>'
    joint = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><axis xyz="0 1 0"/>'
    joint += '<origin xyz="0 0 1"/>{}</joint>'
    parts = [link.format(name) for name in "abc"]
    parts += [joint.format("turn", driver, "a", "b", "")]
    parts += [joint.format("bend", "continuous", "b", "c", mimic)]
    return f'<robot name="r">{"".join(parts)}</robot>'


@pytest.mark.parametrize(
    ("mimic", "driver", "value"),
    [
        ('<mimic joint="turn" multiplier="-2" offset="0.1"/>', "continuous", 0.7 - 0.1 + 2 * 0.5),
        ('<mimic joint="turn"/>', "continuous", 0.7 - 0.5),
        ('<mimic joint="turn" multiplier="3" offset="0.1"/>', "fixed", 0.7 - 0.1),
    ],
)
def test_a_mimic_is_a_coupling(mimic: str, driver: str, value: float) -> None:
    model = rb.load(urdf(mimic, driver), strict=True, floating_base=False)
    state = rb.State(np.array([0.5, 0.7])[-model.nq :], np.zeros(model.nv))
    (row,) = rows_of(model, rb.forces.Context.of(model, 0.0, state, None))
    assert float(row.value) == pytest.approx(value, abs=1e-15)


def test_a_mimic_that_is_not_wanted_or_cannot_be_is_named() -> None:
    mimic = '<mimic joint="turn"/>'
    for text, constraints in [(urdf(mimic), False), (urdf(mimic, "planar"), True)]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = rb.load(text, constraints=constraints, floating_base=False)
        assert model.constraints == ()
        assert model.dropped == ("mimic joints, which move on their own (bend of turn)",)


@pytest.mark.parametrize(
    ("mimic", "words"),
    [
        ('<mimic joint="gone"/>', "'bend' mimics 'gone', expected another one of the joints bend"),
        ('<mimic joint="bend"/>', "'bend' mimics 'bend'"),
        ('<mimic joint="turn" offset="x"/>', "<mimic offset='x'>, expected one finite number"),
        ('<mimic joint="turn" multiplier="nan"/>', "<mimic multiplier='nan'>"),
    ],
)
def test_a_mimic_of_nothing_is_refused(mimic: str, words: str) -> None:
    with pytest.raises(rb.ModelError, match=words):
        rb.load(urdf(mimic))
