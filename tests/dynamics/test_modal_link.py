"""A flexible link with a modal inertia: a beam in one mode, against Lagrange's equations."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.energy import momentum_and_rate
from rbjax.errors import ModelError
from rbjax.lanes import Mat3, Sym3, Vec3, add, mul, sincos
from rbjax.spatial import Force, RigidInertia, Transform

#: Gauss points of the unit interval, which carry the mass of the beam
NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)
POINTS = [((1.0 + x) / 2.0, w / 2.0) for x, w in zip(NODES, WEIGHTS, strict=True)]
LENGTH, MASS = 0.7, 1.2
ANCHOR = (0.03, 0.02, 0.01)


def at_points(q, params):
    """Mass, position and derivative by q of each point, in the frame of the root.

    The beam lies along x. A point at the fraction x of the length bends in y by q x^2 (3 - x) / 2,
    and the beam shortens to second order in q.
    """
    length, mass = params
    for x, weight in POINTS:
        y, short = x * x * (3.0 - x) / 2.0, -0.6 * x**3 / length
        at = Vec3(add(mul(length, x), mul(short, mul(q, q))), mul(y, q), 0.0)
        yield mul(mass, weight), at, Vec3(mul(2.0, mul(short, q)), y, 0.0)


class Massless(rb.joints.Node):
    """The motion of the tip without the mass of the beam."""

    name, coordinates = "modal_massless", 1
    params = {"length": 1.0, "mass": MASS}  # noqa: RUF012

    def pose(self, q, params):
        c, s = sincos(1.5 * q[0] / params[0])
        tip = Vec3(params[0] - 0.6 / params[0] * q[0] * q[0], q[0], 0.0)
        return Transform(Mat3(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0), tip)


class Beam(rb.joints.Flexible):
    """A beam whose body is its tip, and whose inertia over base and mode is a sum over points."""

    name, coordinates, count = "modal_beam", 1, 1
    params = Massless.params

    def poses(self, q, params):
        return [Massless().pose(q, params)]

    def inertia(self, q, v, w, params):
        rigid, C, m, force, own = RigidInertia.zero(), Force.zero(), 0.0, Force.zero(), 0.0
        short = Vec3(1.0, 0.0, 0.0)
        for (mass, r, d), (x, _) in zip(at_points(q[0], params), POINTS, strict=True):
            rigid = rigid + RigidInertia(mass, Vec3.zero(), Sym3.zero()).shifted(r)
            C, m = C + Force(r.cross(d), d) * mass, add(m, mul(mass, d.dot(d)))
            turned = w.cross(w.cross(r))
            bias = short * mul(-1.2 * x**3 / params[0], mul(v[0], v[0])) + w.cross(d * v[0]) * 2.0
            force = force + Force(r.cross(bias), bias) * mass
            own = add(own, mul(mass, d.dot(bias + turned)))
        return rb.joints.LinkInertia(rigid, (C,), ((m,),), force, (own,))


class AtFrames(Beam):
    """The same beam, with its points as frames."""

    name, count = "modal_beam_at_frames", 1 + len(POINTS)

    def poses(self, q, params):
        points = at_points(q[0], params)
        return [*(Transform(Mat3.identity(), r) for _, r, _ in points), *super().poses(q, params)]

    def inertias(self, params):
        points = at_points(0.0, params)
        own = [RigidInertia(mass, Vec3.zero(), Sym3.zero()) for mass, _, _ in points]
        return [*own, RigidInertia.zero()]

    def inertia(self, q, v, w, params):
        return None


class Root(Massless):
    """The frame of the root."""

    name = "modal_root"

    def pose(self, q, params):
        return Transform(Mat3.identity(), Vec3.zero())


for kind in (Beam(), AtFrames(), Massless(), Root()):
    rb.joints.register(kind)

LIMB = """<body name="tip{n}" pos="0.2 0.05 0" euler="20 30 10">
    <joint name="bend{n}" pos="0.03 0.02 0.01" stiffness="4"/>
    <geom size="0.02 0.03 0.01" pos="0.02 0.01 0.0" mass="0.2"/>
    <body name="hand{n}" pos="0 0.2 0.1" euler="0 50 0">
      <joint name="last{n}" axis="0.6 0 0.8"/>
      <geom size="0.02 0.05 0.03" pos="0.02 0.05 0.01" mass="0.4"/></body></body>"""
ARM = """<mujoco><option gravity="0.3 -0.5 -9.81"/>
<default><geom contype="0" conaffinity="0" type="box"/></default>
<worldbody><body name="hub" pos="0.1 0 0.3">{base}
  <geom size="0.1 0.04 0.06" pos="0.05 0.01 0" mass="1.3"/>{limbs}</body></worldbody></mujoco>"""
BASES = {"hinge": '<joint name="first" axis="0.1 0.2 0.9" pos="0.02 0 0"/>', "free": "<freejoint/>"}


def arm(kind: str, base: str = "hinge", limbs: tuple[str, ...] = ("",)) -> rb.Model:
    model = rb.load(ARM.format(base=BASES[base], limbs="".join(LIMB.format(n=n) for n in limbs)))
    for n in limbs:
        model = model.with_joint(f"bend{n}", kind, length=LENGTH)
    return model


@functools.cache
def moving(base: str = "hinge", limbs: tuple[str, ...] = ("",)):
    model = arm("modal_beam", base, limbs)
    state = model.random_state(jax.random.key(3))
    return model, state.q, state.v, jax.random.normal(jax.random.key(4), (model.nv,))


def energies(q, v):
    """Kinetic and potential energy of the rigid bodies and of the points of the beam."""
    rigid, root = arm("modal_massless"), arm("modal_root")

    def points(h):
        moved = q + h * v
        R, p = rb.frame_pose(root, moved, rb.Frame(body="tip", point=ANCHOR))
        at = [r for _, r, _ in at_points(moved[1], (LENGTH, MASS))]
        return jnp.stack([p + (R * jnp.stack([jnp.asarray(x) for x in r])).sum(-1) for r in at])

    mass = MASS * jnp.array([w for _, w in POINTS])
    x, rate = jax.jvp(points, (0.0,), (1.0,))
    T = rb.kinetic_energy(rigid, q, v) + (mass[:, None] * rate**2).sum() / 2
    return T, rb.potential_energy(rigid, q) - (mass * (x * rigid.gravity).sum(-1)).sum(), x, rate


def everything(model, q, v, a):
    return {
        "tau": rb.inverse_dynamics(model, q, v, a),
        "a": rb.forward_dynamics(model, q, v, a),
        "M": rb.mass_matrix(model, q),
        "inverse": rb.inverse_mass_matrix(model, q),
        "C": rb.coriolis_matrix(model, q, v),
        "T": rb.kinetic_energy(model, q, v),
        "U": rb.potential_energy(model, q),
        "g": rb.gravity_forces(model, q),
        "com": rb.center_of_mass(model, q),
        "h": rb.centroidal_momentum(model, q, v),
        "p": momentum_and_rate(model, q, v, a),
    }


@functools.cache
def found(driver: str = "unrolled", base: str = "hinge", limbs: tuple[str, ...] = ("",)):
    model, q, v, a = moving(base, limbs)
    return jax.jit(functools.partial(everything, model.replace(driver=driver)))(q, v, a)


def test_a_clamped_beam_by_hand() -> None:
    """M(q) of the points and of the tip, and M' v^2 / 2 by a complex step."""
    text = """<mujoco><option gravity="0 -9.81 0"/><worldbody><body name="tip">
      <joint name="bend"/><inertial pos="0 0 0" mass="0.5" diaginertia="0.1 0.1 0.02"/>
      </body></worldbody></mujoco>"""
    model = rb.load(text).with_joint("bend", "modal_beam", length=LENGTH)

    def modal_mass(q):
        squares = sum(m * d.dot(d) for m, _, d in at_points(q, (LENGTH, MASS)))
        return squares + 0.5 * ((1.2 / LENGTH * q) ** 2 + 1.0) + 0.02 * (1.5 / LENGTH) ** 2

    q, v, a = 0.2, 0.7, -1.3
    weight = 9.81 * (0.5 + sum(m * list(d)[1] for m, _, d in at_points(q, (LENGTH, MASS))))
    slope = modal_mass(q + 1e-30j).imag / 1e-30
    tau = modal_mass(q) * a + slope * v * v / 2 + weight
    at = [np.array([x]) for x in (q, v, a)]
    np.testing.assert_allclose(rb.mass_matrix(model, at[0]), [[modal_mass(q)]], rtol=1e-13)
    np.testing.assert_allclose(rb.inverse_dynamics(model, *at), [tau], rtol=1e-13)
    again = rb.forward_dynamics(model, at[0], at[1], np.array([tau]))
    np.testing.assert_allclose(again, [a], rtol=1e-12)


@pytest.mark.slow
def test_lagrange_s_equations() -> None:
    """d/dt dT/dv - dT/dq + dU/dq = tau, with the energies of rigid bodies and points of mass."""
    (model, q, v, a), ours = moving(), found()

    @jax.jit
    def lagrange(q, v):
        def of(k):
            return lambda q, v: energies(q, v)[k]

        p = jax.grad(of(0), 1)
        M, by_q = jax.jacfwd(p, (1, 0))(q, v)
        T, U, *_ = energies(q, v)
        T_q, g = jax.grad(of(0))(q, v), jax.grad(of(1))(q, v)
        return {"T": T, "U": U, "M": M, "tau": M @ a + by_q @ v - T_q + g, "g": g}, p(q, v), T_q - g

    want, p, force = lagrange(q, v)
    for name, value in want.items():
        np.testing.assert_allclose(ours[name], value, rtol=1e-12, atol=1e-12, err_msg=name)
    again = jax.jit(functools.partial(rb.forward_dynamics, model))(q, v, want["tau"])
    np.testing.assert_allclose(again, a, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ours["p"][0], p, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ours["p"][1], force + a, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_centers_and_momenta_are_sums_over_bodies_and_points() -> None:
    (_, q, v, _), ours = moving(), found()
    rigid = arm("modal_massless")
    mass = MASS * np.array([w for _, w in POINTS])
    _, _, x, rate = jax.jit(energies)(q, v)
    total, own = float(rigid.bodies.mass.sum()), rb.center_of_mass(rigid, q)
    com = (total * own + mass @ x) / (total + MASS)
    np.testing.assert_allclose(ours["com"], com, rtol=1e-12)
    h = rb.centroidal_momentum(rigid, q, v)
    lever = np.cross(own - com, h[3:]) + (mass[:, None] * np.cross(x - com, rate)).sum(0)
    np.testing.assert_allclose(ours["h"][:3], h[:3] + lever, rtol=1e-12)
    np.testing.assert_allclose(ours["h"][3:], h[3:] + mass @ rate, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("base", ["hinge", "free"])
def test_identities(base: str) -> None:
    """ABA inverts RNEA; M, its inverse, C and gravity belong together."""
    (model, q, v, a), ours = moving(base), found(base=base)

    @jax.jit
    def more(tau):
        def mass_matrix(h):
            return rb.mass_matrix(model, rb.integrate(model, q, h * v))

        M_rate = jax.jvp(mass_matrix, (0.0,), (1.0,))[1]
        return rb.forward_dynamics(model, q, v, tau), M_rate

    again, M_rate = more(ours["tau"])
    np.testing.assert_allclose(again, a, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(ours["M"] @ ours["inverse"], np.eye(model.nv), atol=1e-12)
    np.testing.assert_allclose(ours["C"] + ours["C"].T, M_rate, atol=1e-12)
    np.testing.assert_allclose(ours["C"] @ v + ours["M"] @ a + ours["g"], ours["tau"], rtol=1e-11)
    np.testing.assert_allclose(ours["T"], v @ ours["M"] @ v / 2, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("driver", ["rolled", "limbs"])
def test_drivers_agree(driver: str) -> None:
    """The rolled driver, and two flexible limbs on a floating base in a loop."""
    given = {"base": "free", "limbs": ("", "2")} if driver == "limbs" else {}
    one, other = found("unrolled", **given), found(driver, **given)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_derivatives_and_batches() -> None:
    """The derivative rule of ABA by q, v, tau and the parameters, against the inverse of M."""
    model, q, v, tau = moving()

    def implicit(params, q, v, tau):
        own = model.replace(joints=model.joints.replace(params=params))
        b = rb.bias_forces(own, q, v)
        return jnp.linalg.solve(rb.mass_matrix(own, q), tau - b)

    def forward(params, q, v, tau):
        own = model.replace(joints=model.joints.replace(params=params))
        return rb.forward_dynamics(own, q, v, tau)

    at = model.joints.params, q, v, tau
    got, want = (jax.jit(jax.jacrev(f, (0, 1, 2, 3)))(*at) for f in (forward, implicit))
    for x, y in zip(got, want, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)
    three = [jnp.stack([x, 0.5 * x, -x]) for x in at[1:]]
    each = jax.vmap(functools.partial(rb.forward_dynamics, model))(*three)
    one = rb.forward_dynamics(model, *(x[1] for x in three))
    np.testing.assert_allclose(each[1], one, rtol=1e-12)
    single = rb.forward_dynamics(model, *(x[1].astype(np.float32) for x in three))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, one, rtol=2e-4)


@pytest.mark.slow
def test_energy_is_constant_along_a_motion() -> None:
    model, q, v, _ = moving()
    path = rb.rollout(
        model, rb.State(q, v), None, 1e-3, steps=200, integrator="rk4", save_every=200
    )

    def energy(q, v):
        spring = 2.0 * q[1] ** 2  # stiffness 4 N/m
        return rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q) + spring

    first, last = jax.vmap(energy)(path.q, path.v)
    np.testing.assert_allclose(last, first, rtol=1e-8)


@pytest.mark.slow
def test_rows_of_constraints_hold_a_flexible_link() -> None:
    """A rod from the hand to the world: by clusters and by the factors of ABA as by dense M."""
    model, q, v, tau = moving()
    rod = rb.constraints.Distance.between(model, rb.Frame("hand"), rb.Frame("world"), q=q)
    model, every = model.with_constraints(rod), rb.constraints.formulations()
    found = [
        jax.jit(functools.partial(every[name].method, model, 0.0))(rb.State(q, v), tau, None)
        for name in ("kkt", "recursive", "multipliers")
    ]
    free = rb.forward_dynamics(model, q, v, tau)
    assert np.abs(found[0] - free).max() > 1e-2
    for a in found[1:]:
        np.testing.assert_allclose(a, found[0], rtol=1e-9, atol=1e-9)


def test_the_regressor_rejects_a_flexible_link() -> None:
    model, q, v, a = moving()
    with pytest.raises(ModelError, match=r"flexible.*joints\.params"):
        rb.inertial_regressor(model, q, v, a)


@pytest.mark.slow
def test_an_inertia_over_base_and_mode_equals_points_at_frames() -> None:
    _, q, v, a = moving()
    other = arm("modal_beam_at_frames")
    got = jax.jit(functools.partial(everything, other))(q, v, a)
    for name, want in found().items():
        pairs = zip(jax.tree.leaves(got[name]), jax.tree.leaves(want), strict=True)
        for x, y in pairs:
            if name != "C":  # C is not unique
                np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-12, err_msg=name)
