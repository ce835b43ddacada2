"""Geometric stiffening: rotating beams, gravity columns and tip forces against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.errors import InputError
from rbjax.flexible import rectangle
from rbjax.flexible.modal import (
    BeamSection,
    Interface,
    ModalLink,
    beam_mesh,
    box_mesh,
    craig_bampton,
    elastic_force,
    fast_rotation,
    stiffness_in_motion,
    tetrahedral_mesh,
)
from rbjax.lanes import Vec3

# the spin-up beam of Simo & Vu-Quoc 1986; Euler-Bernoulli, twice as stiff across the plane
L, EI, RHO = 10.0, 1.4e4, 1.2
SECTION = BeamSection(EA=2.8e7, EIy=2 * EI, EIz=EI, GJ=EI, mass=RHO, rotary=(1e-3, 0.0, 0.0))
SHEARED = BeamSection(
    EA=2.8e7, EIy=2 * EI, EIz=EI, GJ=EI, mass=RHO, GAy=1e7, GAz=1e7, rotary=(1e-3, 6e-4, 6e-4)
)
#: first flap frequency of a rotating cantilever at Omega = 6, hub radius 0, in units of
#: sqrt(EI / (rho A L^4)): Wright et al., J. Appl. Mech. 49, 1982, with more digits by series
FLAP = {0: 3.5160152685562953, 6: 7.360373019280209, 12: 13.17015048750555}


def beam(n=40, modes=12, **options):
    mesh = beam_mesh(np.linspace([0.0, 0, 0], [L, 0, 0], n + 1), SECTION)
    return craig_bampton(mesh, [Interface("root", [0])], modes, frame="root", **options)


def in_plane(body):
    """The modes along y."""
    return np.flatnonzero(np.abs(np.asarray(body.first_moment1)).argmax(0) == 1)


def test_an_unstiffened_body_in_fast_rotation_is_detected():
    """omega_1^2 - Omega^2 = 3.7977^2 - 6^2 = -21.58 of the spin-up beam, with one mode."""
    body = beam(stiffening=False)
    body = body.with_modes(in_plane(body)[:1])
    assert abs(body.frequencies[0] - 3.7977) < 5e-5
    found = fast_rotation(body, [0.0, 0.0, 6.0])
    assert not found.success and not found.stiffened
    assert abs(found.squares[0] - -21.58) < 5e-3
    assert "no geometric stiffening" in found.status and "diverges" in found.status
    slow = fast_rotation(body, [0.0, 0.0, 1.0])
    assert slow.success and slow.summary().startswith("stable")
    assert "fall with the speed" in fast_rotation(body, [0.0, 0.0, 3.0]).status


def test_with_stiffening_the_beam_is_stable():
    body = beam()
    found = fast_rotation(body, [0.0, 0.0, 6.0])
    assert found.success and found.stiffened and found.squares[0] > found.at_rest[0] * 0.99
    assert found.status.startswith("stable")


@pytest.mark.parametrize("speed", [6, 12])
def test_frequencies_of_a_rotating_cantilever(speed):
    """In the plane the square is the flap square minus Omega^2. The axial force of an element is
    constant, which has the error h^2: two meshes are extrapolated.
    """
    unit = np.sqrt(EI / (RHO * L**4))
    found = []
    for n in (20, 40):
        body = beam(n, 16)
        body = body.with_modes(in_plane(body))
        found.append(fast_rotation(body, [0.0, 0.0, speed * unit]).squares[0] / unit**2 + speed**2)
    square = (4 * found[1] - found[0]) / 3
    assert abs(np.sqrt(square) / FLAP[speed] - 1) < {6: 1e-5, 12: 1e-4}[speed]  # six modes
    # the flap frequency itself, about y, with an axis of rotation along y
    body = beam(40, 16)
    flap = body.with_modes(in_plane(body))
    got = fast_rotation(flap, [0.0, speed * unit, 0.0]).squares[0] / unit**2
    assert abs(np.sqrt(got) / FLAP[speed] - 1) < 1e-3


def test_a_standing_column_buckles_under_its_weight():
    """Greenhill: q L^3 / EI = 7.8373 for a clamped column, q = rho A g."""
    body = beam()
    body = body.with_modes(in_plane(body))
    critical = 7.837347 * EI / (RHO * L**3)
    for factor, success in ((0.99, True), (1.01, False)):
        # gravity along -x is an acceleration of the frame along +x
        found = fast_rotation(body, np.zeros(3), [factor * critical, 0.0, 0.0])
        assert found.success is success
    assert "buckles" in found.status
    hanging = fast_rotation(body, np.zeros(3), [-critical, 0.0, 0.0])
    assert hanging.squares[0] > hanging.at_rest[0]


def test_a_tip_force_buckles_as_euler_has_it():
    """pi^2 EI / (4 L^2) through the second-order displacement of the tip frame, and on lanes."""
    mesh = beam_mesh(np.linspace([0.0, 0, 0], [L, 0, 0], 21), SECTION)
    body = craig_bampton(mesh, [Interface("root", [0]), Interface("tip", [20])], 10, frame="root")
    A = np.asarray(body.second_modes)[1, 0]
    critical = np.pi**2 * EI / (4 * L**2)
    least = [
        np.linalg.eigvalsh(np.asarray(body.stiffness) + factor * critical * A)[0]
        for factor in (0.999, 1.001)
    ]
    assert least[0] > 0 > least[1]
    # the frame moves by it: the axial displacement of a deflected tip is -int y'^2 / 2
    link = ModalLink.of(body, 1e-9)
    k = int(np.abs(np.asarray(body.modes)[1, 1]).argmax())
    q = 0.01 * np.eye(body.mode_count)[k]
    zero = [0.0] * body.mode_count
    tip = link.frames([float(x) for x in q], zero, link.defaults)[1]
    want = np.asarray(body.modes)[1, 0, k] * 0.01 + A[k, k] * 0.01**2 / 2
    assert abs(tip.at[0] - L - want) < 1e-14 and A[k, k] < 0


def test_solids_and_beams_stiffen_alike():
    """A slender box of quadratic tetrahedra against a Timoshenko beam, in rotation."""
    size, div = (2.0, 0.1, 0.06), (10, 1, 1)
    nodes, cells = box_mesh(size, div, quadratic=True, corner=(0.0, -0.05, -0.03))
    solid = tetrahedral_mesh(nodes, cells, E=1e8, poisson=0.0, density=1000.0)
    root = Interface("root", np.flatnonzero(nodes[:, 0] == 0.0))
    one = craig_bampton(solid, [root], 8, frame="root")
    section = rectangle(0.1, 0.06, E=1e8, density=1000.0, nu=0.0, shear=5 / 6)
    mesh = beam_mesh(np.linspace([0.0, 0, 0], [2.0, 0, 0], 41), section)
    two = craig_bampton(mesh, [Interface("root", [0])], 8, frame="root")
    for w in (0.0, 10.0, 20.0):
        a, b = (fast_rotation(x, [0.0, 0.0, w]).squares[:2] for x in (one, two))
        assert np.abs(a / b - 1).max() < 0.03  # ten elements along the beam, averaged root
    # angular acceleration has no effect on a beam whose load is across it
    K = stiffness_in_motion(two, np.zeros(3), np.zeros(3), [0.0, 0.0, 5.0])
    c1 = np.asarray(two.coupling1)[2]
    assert np.allclose(K - np.asarray(two.stiffness), 5.0 * c1)


def test_energy_is_constant_and_the_beam_lags():
    """A stiffened body on a driven root: power of the drive is the rate of the energy, by the
    equations of a `ModalLink`.
    """
    body = beam(10, 6).with_damping(0.01)
    link = ModalLink.of(body, 1e-10, second_order=True)
    rng = np.random.default_rng(0)
    q, qd, qdd = (jnp.asarray(0.1 * rng.normal(size=6)) for _ in range(3))
    w, dw = jnp.asarray(rng.normal(size=3)), jnp.asarray(rng.normal(size=3))
    found = link.inertia(list(q), list(qd), Vec3(*w), link.defaults)
    J = jnp.stack([jnp.stack([jnp.asarray(x) for x in row]) for row in found.rigid.J.dense.rows])
    c = jnp.stack([x.ang.array for x in found.coupling], 1)
    M = jnp.array([[float(x) for x in row] for row in found.mass])
    torque = J @ dw + c @ qdd + jnp.cross(w, J @ w) + found.force.ang.array
    tau = c.T @ dw + M @ qdd + jnp.stack([jnp.asarray(x) for x in found.forces])
    zero = jnp.zeros(3)

    def kinetic(w, q, qd):
        return body.kinetic_energy(w, zero, q, qd, True)

    rate = jax.jvp(kinetic, (w, q, qd), (dw, qd, qdd))[1]
    # the origin is at rest: w x h etc. do no work there
    assert abs(float(torque @ w + tau @ qd - rate)) < 1e-11 * abs(float(rate))
    force = elastic_force(body, q, qd)
    assert np.allclose(force, body.stiffness @ q + body.damping @ qd)
    assert float(force @ qd) > float(jax.jvp(lambda q: q @ body.stiffness @ q / 2, (q,), (qd,))[1])


#: t: (axial, lag) displacement of the tip in the rotating frame, m. Spin-up manoeuvre of Kane, Ryan
#: & Banerjee 1987 with the beam of Simo & Vu-Quoc 1986: geometrically exact, spectral elements,
#: implicit midpoint extrapolated in the step
SPIN_UP = {
    2.5: (-0.00132267, -0.1512836), 5.0: (-0.01265463, -0.4684762), 7.5: (-0.0177419, -0.5590835),
    10.0: (-0.0070723, -0.3628145), 12.5: (-0.0002218, -0.1126962), 15.0: (0.00051399, 0.001304),
}  # fmt: skip
PEAK = (6.76, -0.573835)


def test_spin_up_manoeuvre():
    """A stiffened body follows the geometrically exact beam to 1.5e-3 of the peak.

    The difference is of third order in the deflection, 0.057 of the length: 0.3 %. Axial modes are
    left out, so the extension of 5e-4 m at full speed is missing.
    """
    mesh = beam_mesh(np.linspace([0.0, 0, 0], [L, 0, 0], 41), SHEARED)
    body = craig_bampton(mesh, [Interface("root", [0]), Interface("tip", [40])], 12, frame="root")
    body = body.with_modes(in_plane(body)[:3])
    link = ModalLink.of(body, 1e-11)
    params, K, m, h = link.defaults, jnp.asarray(body.stiffness), 3, 0.01

    def rate(t, s):
        q, qd, turn = s[:m], s[m:], 2 * jnp.pi * t / 15
        w = 6 / 15 * (t - 15 / (2 * jnp.pi) * jnp.sin(turn))
        found = link.inertia(list(q), list(qd), Vec3(0.0, 0.0, w), params)
        drive = jnp.stack([x.ang[2] * jnp.ones(()) for x in found.coupling])
        force = jnp.stack(found.forces) + drive * 6 / 15 * (1 - jnp.cos(turn)) + K @ q
        return jnp.concatenate([qd, -force])  # the modal mass is 1

    @jax.jit
    def run():
        def step(s, n):
            t = n * h
            a = rate(t, s)
            b = rate(t + h / 2, s + h / 2 * a)
            c = rate(t + h / 2, s + h / 2 * b)
            d = rate(t + h, s + h * c)
            s = s + h / 6 * (a + 2 * b + 2 * c + d)
            tip = link.frames(list(s[:m]), [0.0] * m, params)[1].at
            return s, jnp.stack([tip[0] - L, tip[1]])

        return jax.lax.scan(step, jnp.zeros(2 * m), jnp.arange(1500))[1]

    path = np.asarray(run())
    peak = path[:, 1].argmin()
    assert abs((peak + 1) * h - PEAK[0]) < 0.015
    assert abs(path[peak, 1] - PEAK[1]) < 1.5e-3 * 0.574
    for t, (axial, lag) in SPIN_UP.items():
        got = path[round(t / h) - 1]
        assert abs(got[1] - lag) < 1.5e-3 * 0.574
        assert abs(got[0] - axial) < 6e-4


def test_wrong_vectors():
    body = beam(4, 2)
    with pytest.raises(InputError, match="omega"):
        fast_rotation(body, 6.0)
    with pytest.raises(InputError, match="acceleration"):
        stiffness_in_motion(body, np.zeros(3), [1.0])
