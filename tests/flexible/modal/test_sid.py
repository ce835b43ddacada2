"""Standard input data: published digits of the NREL 5 MW tower and blade, and files."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from rbjax.errors import InputError
from rbjax.flexible.modal import (
    BeamSection,
    Interface,
    beam_mesh,
    craig_bampton,
    from_points,
    from_sid,
    read_sid,
    write_sid,
)
from rbjax.flexible.modal.body import shapes
from tests.flexible.modal.points import random_points
from tests.oracles import load

ORACLE = load("nrel5mw")


def sid_of(body, tmp_path):
    """The blocks of the file that `write_sid` writes."""
    from rbjax.flexible.modal.sid import _parse

    write_sid(body, tmp_path / "body.SID_FEM")
    return _parse((tmp_path / "body.SID_FEM").read_text(), "body")


def tower_body(stiffening):
    """Two bending modes of the tower, clamped at its foot, with a displacement of 1 at the top."""
    tower = ORACLE["tower"]
    x, mass, EI = np.array(tower["table"]).T
    E, A = 214e9, 100.0
    section = BeamSection(
        EA=E * A, EIy=EI, EIz=EI, GJ=E / 2.6 * 100.0, mass=mass, rotary=(mass, 0.0, 0.0)
    )
    mesh = beam_mesh(np.outer(x * tower["height"], [0.0, 0, 1]), section)
    ends = [Interface("foot", [0]), Interface("top", [len(x) - 1])]
    # with all 54 inner modes the reduction is exact
    body = craig_bampton(mesh, ends, 54, frame="foot", stiffening=stiffening)
    first = np.asarray(body.modes)[1, :2, :2]  # x and y of both modes
    order = np.argmax(np.abs(first), axis=1)
    basis = np.zeros((60, 2))
    basis[order, [0, 1]] = 1 / first[[0, 1], order]
    return body.transformed(basis, ["fore-aft", "side"])


def test_tower_digits():
    """Finite elements of the tower: all digits of the published data (8 to 12)."""
    digits = ORACLE["tower"]["digits"]
    body = tower_body(False)

    def close(got, name, tolerance=1e-10, sign=1.0):
        assert abs(float(got) / (sign * digits[name]) - 1) < tolerance, name

    close(body.mass, "mass")
    close(body.inertia[0, 0], "inertia_xx")
    close(body.inertia[1, 1], "inertia_xx")
    close(body.inertia[2, 2], "inertia_zz")
    close(body.first_moment[2], "first_moment_z")
    for k, (axis, sign) in enumerate(((1, 1.0), (0, -1.0))):
        close(body.modal_mass[k, k], "modal_mass", 3e-10)  # ten digits are given
        close(body.first_moment1[k, k], "Ct")
        close(body.coupling[axis, k], "Cr", sign=sign)
        # inertia1 = D + D^T, whose only entry of D is -sum m x z
        close(body.inertia1[k, k, 2], "C4", sign=-1.0)
        close(body.inertia2[k, k, axis, axis], "centrifugal")
    geometric = np.asarray(tower_body(True).centrifugal_stiffness)
    for k in range(2):
        for axis in range(2):
            close(geometric[k, k, axis, axis], "stiffening_omega_xx")
        assert abs(geometric[k, k, 2, 2]) < 1e-6


def blade_points():
    """The points of the blade: elements with their mass in the middle, and twisted modes.

    The curvature of a mode is turned by the structural twist and integrated twice by the midpoint
    rule, from the root (Jonkman, *FAST user's guide*; OpenFAST, ElastoDyn).
    """
    blade = ORACLE["blade"]
    x, twist, mass = np.array(blade["table"]).T
    n, length = blade["elements"], blade["tip_radius"] - blade["hub_radius"]
    dr = length / n
    r = (np.arange(n) + 0.5) / n
    angle = np.deg2rad(np.interp(r, x, twist))
    powers = np.arange(2, 7)
    bend = {
        k: (np.array(c) * powers * (powers - 1) * r[:, None] ** (powers - 2)).sum(1) / length**2
        for k, c in blade["modes"].items()
        if k != "_"
    }
    c, s = np.cos(angle), np.sin(angle)
    curvature = np.array(
        [
            [c * bend["flap1"], -s * bend["flap1"]],
            [c * bend["flap2"], -s * bend["flap2"]],
            [s * bend["edge1"], c * bend["edge1"]],
        ]
    )  # mode, x or y, element

    def integrated(f):
        return (np.cumsum(f, -1) - f / 2) * dr

    slope = integrated(curvature)
    # first moment of the mass beyond the middle of each element, with half elements at their ends
    half, z = np.interp(r, x, mass) * dr / 2, r * length + blade["hub_radius"]
    inner, outer = half * (z + dr / 2), half * (z - dr / 2)
    beyond = np.cumsum((inner + np.append(outer[1:], 0.0))[::-1])[::-1]
    pull = float((beyond * (slope[0] ** 2).sum(0)).sum() * dr)
    modes = np.zeros((n, 3, 3))
    modes[:, :2] = integrated(slope).transpose(2, 1, 0)
    shortened = integrated(np.einsum("jar,kar->jkr", slope, slope))
    second = np.zeros((n, 3, 3, 3))
    second[:, 2] = -shortened.transpose(2, 0, 1)
    places = np.outer(r * length + blade["hub_radius"], [0.0, 0, 1])
    masses = np.interp(r, x, mass) * dr
    return dict(masses=masses, places=places, modes=modes, second_modes=second), pull


def test_blade_digits(tmp_path):
    """Points with twisted modes: 13 digits, through the blocks of the file."""
    digits = ORACLE["blade"]["digits"]
    points, pull = blade_points()
    sid = sid_of(from_points(**points), tmp_path)
    del points["second_modes"]
    linear = sid_of(from_points(**points), tmp_path)
    got = {
        "J_xx": sid.J.M0[0, 0],
        "Oe_0_yz": sid.Oe.M0[0, 4],
        "Ct_0_x": sid.Ct.M0[0, 0],
        "Gr_0_xz": sid.Gr.M0[0, 2],
        "Ge_1_0_z": sid.Ge.M0[0, 5],
        "J1_0_xz": sid.J.M1[0, 2, 0],
        # the source has the opposite sign of the axial stiffening: there it is that of gravity
        "Ct1_0_z_0": -sid.Ct.M1[0, 2, 0],
        # the source integrates the centrifugal force over half elements
        "Oe1_0_xx_0": linear.Oe.M1[0, 0, 0] + pull,
        # Gr1 of the source is of the modes alone
        "Gr1_0_xx_0": linear.Gr.M1[0, 0, 0],
    }
    # with the mass in the middle of the elements: 17 elements differ by 1 %
    assert abs(sid.Oe.M1[0, 0, 0] / got["Oe1_0_xx_0"] - 1) < 0.01

    for name, value in got.items():
        assert abs(value / digits[name] - 1) < 1e-12, name


def random_body(second=True):
    rng = np.random.default_rng(3)
    A = 0.1 * rng.normal(size=(40, 3, 4, 4))
    return from_points(
        **random_points(rng, m=4),
        stiffness=np.diag([1.0, 2.0, 3.0, 4.0]),
        damping=0.1 * np.eye(4),
        second_modes=A + A.transpose(0, 1, 3, 2) if second else None,
        frames=[0, 5],
    )


def same(a, b):
    spun = [x.centrifugal_stiffness - x.inertia2 for x in (a, b)]  # a file has the sum only
    assert np.abs(spun[0] - spun[1]).max() <= 2e-15 * np.abs(spun[1]).max(initial=0.0)
    for name in shapes(1, 1):
        if name in ("centrifugal_stiffness", "inertia2") and np.any(b.centrifugal_stiffness):
            continue
        x, y = np.asarray(getattr(a, name)), np.asarray(getattr(b, name))
        assert np.abs(x - y).max(initial=0.0) <= 1e-15 * np.abs(y).max(initial=0.0), name
    assert (a.mode_names, a.frame_names) == (b.mode_names, b.frame_names)


@pytest.mark.parametrize("second", [False, True])
def test_a_file_is_read_as_it_was_written(tmp_path, second):
    body = random_body(second)
    write_sid(body, tmp_path / "a.sid")
    same(read_sid(tmp_path / "a.sid"), body)


def test_both_orders_of_indices(tmp_path):
    """FEMBS has m1(row, q, column), FEMBeam m1(row, column, q); numbers may be Fortran's."""
    body = random_body()
    write_sid(body, tmp_path / "a.sid")
    text = (tmp_path / "a.sid").read_text()
    swapped = re.sub(r"m1\((\d+), (\d+), (\d+)\)", r"   m1(\1, \3, \2)  ", text)
    swapped = re.sub(r"= (-?\d+\.\d+)e([-+]\d+)", r"= \1D\2", swapped)
    swapped = swapped.replace("\npart\n", "\n part \n").replace(
        "frame\nnew node", "frame \n new node"
    )
    assert swapped != text
    (tmp_path / "b.sid").write_text(swapped)
    same(read_sid(tmp_path / "b.sid"), body)
    mixed = text.replace("end mdCM", "m1(1, 4, 1) = 1.0\nend mdCM")
    (tmp_path / "c.sid").write_text(mixed)
    with pytest.raises(InputError, match="expected one order"):
        read_sid(tmp_path / "c.sid")


def test_structures_of_blocks(tmp_path):
    """A zero, diagonal, symmetric and unit block, and an inertia of six rows."""
    body = from_points([2.0, 1.0], [[1.0, 0.2, 0], [0, 1, 0.5]], np.ones((2, 3, 1)), frames=[1])
    write_sid(body, tmp_path / "a.sid")
    text = (tmp_path / "a.sid").read_text()
    start, end = text.index("\nAP\n"), text.index("end AP")
    unit = "\nAP\norder = 0\nnrow = 3\nncol = 3\nnq = 1\nnqn = 0\nstructure = 4\n"
    text = text[:start] + unit + text[end:]
    J, J1 = np.asarray(body.inertia), np.asarray(body.inertia1)[0]
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    six = ["J", "order = 1", "nrow = 6", "ncol = 1", "nq = 1", "nqn = 0", "structure = 3"]
    six += [f"m0({n + 1},1) = {float(J[p])!r}" for n, p in enumerate(pairs)]
    six += [f"m1({n + 1},1,1) = {float(J1[p])!r}" for n, p in enumerate(pairs)]
    start, end = text.index("\nJ\n"), text.index("end J\n")
    text = text[:start] + "\n" + "\n".join(six) + "\n" + text[end:]
    (tmp_path / "b.sid").write_text(text)
    same(read_sid(tmp_path / "b.sid"), body)
    # a lower triangle is enough for a symmetric block
    two = random_body()
    write_sid(two, tmp_path / "c.sid")
    text = (tmp_path / "c.sid").read_text()
    start, end = text.index("\nMe\n"), text.index("end Me")
    block = text[start:end].replace("structure = 3", "structure = 2")
    block = "\n".join(
        line for line in block.split("\n")
        if not (at := re.match(r"m0\((\d), (\d)\)", line)) or at[1] >= at[2]
    )  # fmt: skip
    (tmp_path / "c.sid").write_text(text[:start] + block + text[end:])
    same(read_sid(tmp_path / "c.sid"), two)


def test_order_of_an_inertia_of_six_rows():
    """The first mode of the example five_node_model of PyMbs, a file of FEMBS: J and Oe have
    different orders of xz and yz, and Gr = 2 D with J1 = D + D^T decides.
    """
    from rbjax.flexible.modal.sid import PAIRS, _from_six

    J1 = np.array([-0.27551647, 9.09886852, -0.80611251, -0.89455293, 22.44320274, -12.69207434])
    Oe = [0.13775823, -4.54943426, 0.40305626, 0.89455293, 12.69207434, -22.44320274]
    Gr = np.array(
        [
            [-0.275516466, -2.12835033, 1.43874258],
            [0.339244460, 9.09886852, -23.8975310],
            [43.4476629, -1.48661763, -0.806112514],
        ]
    )
    got = _from_six(J1)
    assert np.abs(got - (Gr + Gr.T) / 2).max() < 1e-7  # 9 digits
    for value, (a, b) in zip(Oe, PAIRS, strict=True):
        assert abs(value + got[a, b] / (2 if a == b else 1)) < 1e-7


def test_a_structure_of_another_program():
    """The attributes of a structure: APmod for AP, no De, M1 only if there is a first order."""
    m = 2
    rng = np.random.default_rng(0)

    def block(*shape, first=False):
        M1 = {"M1": rng.normal(size=(*shape, m))} if first else {}
        return SimpleNamespace(M0=rng.normal(size=shape), **M1)

    node = SimpleNamespace(
        origin=block(3, 1), phi=block(3, m, first=True), psi=block(3, m),
        APmod=SimpleNamespace(M0=np.eye(3)), name=7,
    )  # fmt: skip
    blocks = dict(mdCM=(3, 1), J=(3, 3), Ct=(m, 3), Cr=(m, 3), Me=(m, m), Oe=(m, 6), Ke=(m, m))
    sid = SimpleNamespace(
        refmod=SimpleNamespace(mass=3.0, nelastq=m, ielastq=["a", "b"]),
        frame=[node],
        **{k: block(*shape, first=k in ("J", "Oe", "Cr", "Ct")) for k, shape in blocks.items()},
    )
    body = from_sid(sid)
    w = rng.normal(size=3)
    # -w.J2 w is the first-order term of Oe
    products = np.array([w[0] ** 2, w[1] ** 2, w[2] ** 2, w[0] * w[1], w[1] * w[2], w[0] * w[2]])
    want = np.einsum("jnk,n->jk", sid.Oe.M1, products)
    got = np.einsum("a,jkab,b->jk", w, body.centrifugal_stiffness - body.inertia2, w)
    assert np.allclose(got, (want + want.T) / 2)
    assert np.allclose(body.coupling1[1, 0, 1], sid.Cr.M1[0, 1, 1])
    assert body.frame_names == ("7",) and body.mode_names == ("a", "b")
    assert not np.any(body.damping)
    del sid.Me
    with pytest.raises(InputError, match="Me is missing"):
        from_sid(sid)
    sid.Me = SimpleNamespace(M0=np.eye(3))
    with pytest.raises(InputError, match=r"Me has M0 \(3, 3\)"):
        from_sid(sid)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: "", "no mass or nelastq"),
        (lambda t: t.replace("end Ke", ""), "Ke"),
        (lambda t: t.replace("m0(1, 1) = ", "m0(1, 1) = x", 1), "expected a number"),
        (lambda t: t.replace("m0(1, 1)", "m0(1)", 1), "2 indices"),
        (lambda t: t.replace("m0(1, 1)", "m0(9, 1)", 1), "index"),
        (lambda t: t.replace("new node = 0\n", ""), "outside of a node"),
        (lambda t: t[: t.index("\nKe\n")], "Ke is missing"),
        (lambda t: t.replace("mass = ", "mass = -", 1), "the mass is -"),
        (lambda t: t.replace("nelastq = ", "nelastq = 0.", 1), "expected an integer"),
    ],
)
def test_wrong_files_are_sentences(tmp_path, change, message):
    write_sid(random_body(), tmp_path / "a.sid")
    text = (tmp_path / "a.sid").read_text()
    (tmp_path / "b.sid").write_text(change(text))
    with pytest.raises(InputError, match=message):
        read_sid(tmp_path / "b.sid")
