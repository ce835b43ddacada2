"""A modal link against Lagrange's equations of the energy of its points, and its frames."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.errors import InputError
from rbjax.flexible.modal import ModalLayout, ModalLink, from_points
from rbjax.joints.flexible import LinkInertia
from rbjax.lanes import Vec3, is_zero
from rbjax.rotations import so3
from tests.flexible.modal.points import energy, lagrange, random_points

EXACT = 1e-12  # of the largest force: sums over 40 points and a hundred products


def force(found: LinkInertia, w, v, q, qd, dw, a, qdd):
    """The wrench and the generalized forces of the link's equations of motion."""
    J, h, m = np.asarray(found.rigid.J.dense.rows), np.array([*found.rigid.h]), found.rigid.m
    c = np.array([[*x.ang] for x in found.coupling]).T
    l = np.array([[*x.lin] for x in found.coupling]).T
    M = np.array([[float(x) for x in row] for row in found.mass])
    J = np.array([[float(x) for x in row] for row in J])
    ang = J @ dw + np.cross(h, a) + c @ qdd + np.cross(w, J @ w) + np.array([*found.force.ang])
    lin = (
        m * a
        - np.cross(h, dw)
        + l @ qdd
        + np.cross(w, np.cross(w, h))
        + np.array([*found.force.lin])
    )
    return ang, lin, c.T @ dw + l.T @ a + M @ qdd + np.array([*found.forces])


def random_body(seed=0, second=True):
    rng = np.random.default_rng(seed)
    points = random_points(rng)
    A = 0.1 * rng.normal(size=(40, 3, 3, 3))
    body = from_points(
        **points,
        second_modes=A + A.transpose(0, 1, 3, 2) if second else None,
        frames=[3, 8],
    )
    R = np.stack([np.asarray(so3.exp(rng.normal(size=3))), np.eye(3)])
    return points, body.replace(orientations=R)


@pytest.mark.parametrize("second", [False, True])
def test_equations_of_lagrange(second):
    points, body = random_body(1, second)
    link = ModalLink.of(body, second_order=second)
    rng = np.random.default_rng(5)
    state = [rng.normal(size=3) for _ in range(7)]
    w, _, q, qd = state[:4]
    found = link.inertia(list(q), list(qd), Vec3(*w), link.defaults)
    got = force(found, *state)
    T = lambda *x: body.kinetic_energy(*x, True) if second else energy(points, *x)  # noqa: E731
    want = lagrange(T, *map(jnp.asarray, state))
    scale = max(np.abs(np.asarray(x)).max() for x in want)
    for a, b in zip(got, want, strict=True):
        assert np.abs(a - np.asarray(b)).max() < EXACT * scale


def test_terms_of_velocity_are_point_sums():
    """J, c, f_v, f_w and f_q against sums over points."""
    points, body = random_body(2, second=False)
    m, f, U, V, Ji = points.values()
    link = ModalLink.of(body)
    rng = np.random.default_rng(6)
    w, q, qd = (rng.normal(size=3) for _ in range(3))
    found = link.inertia(list(q), list(qd), Vec3(*w), link.defaults)
    p, u = f + U @ q, U @ qd
    spin = np.einsum("nab,nb->na", Ji, V @ qd).sum(0)
    coriolis = 2 * m[:, None] * np.cross(w, u)
    pull = m[:, None] * np.cross(w, np.cross(w, p))
    want = {
        "f_v": coriolis.sum(0),
        "f_w": np.cross(p, coriolis).sum(0) + np.cross(w, spin),
        # the inertias keep their axes: w x J (w + V q') has no part along V
        "f_q": np.einsum("na,naj->j", coriolis + pull, U),
    }
    J = sum(Ji[i] + m[i] * (p[i] @ p[i] * np.eye(3) - np.outer(p[i], p[i])) for i in range(40))
    got = {"f_v": [*found.force.lin], "f_w": [*found.force.ang], "f_q": found.forces}
    for name, value in want.items():
        assert np.abs(np.array(got[name]) - value).max() < 2e-14 * 40, name
    assert np.abs(np.array([float(x) for x in found.rigid.J.dense]).reshape(3, 3) - J).max() < 1e-12
    c = np.cross(p[:, :, None], m[:, None, None] * U, axis=1).sum(0) + np.einsum(
        "nab,nbj->aj", Ji, V
    )
    assert np.abs(np.array([[*x.ang] for x in found.coupling]).T - c).max() < 1e-12


def test_frames_move_as_their_pose():
    _, body = random_body(3)
    link = ModalLink.of(body)
    rng = np.random.default_rng(7)
    q, v = jnp.asarray(rng.normal(size=3)), jnp.asarray(rng.normal(size=3))
    found = link.frames(list(q), list(v), link.defaults)
    for k, motion in enumerate(found):

        def pose(q, k=k):
            R = so3.exp(body.rotation_modes[k] @ q) @ body.orientations[k]
            p = body.positions[k] + body.modes[k] @ q
            return R, p + jnp.einsum("ajk,j,k->a", body.second_modes[k], q, q) / 2

        def velocity(q, v, pose=pose):
            (R, _), (dR, dp) = jax.jvp(pose, (q,), (v,))
            W = R.T @ dR
            return jnp.stack([W[2, 1], W[0, 2], W[1, 0]]), dp

        R, p = pose(q)
        (w, dp), (dw, ddp) = jax.jvp(velocity, (q, v), (v, jnp.zeros(3)))
        for got, want in (
            ([*motion.J], R.ravel()),
            ([*motion.at], p),
            ([*motion.twist.ang], w),
            ([*motion.twist.lin], R.T @ dp),
            ([*motion.bias.ang], dw),
            ([*motion.bias.lin], R.T @ ddp),
        ):
            assert np.abs(np.array(got) - np.asarray(want)).max() < 1e-14 * 20
        for j, axis in enumerate(motion.axes):
            want = velocity(q, jnp.eye(3)[j])
            assert np.abs(np.array([*axis.ang]) - np.asarray(want[0])).max() < 1e-14 * 20
            assert np.abs(np.array([*axis.lin]) - np.asarray(R.T @ want[1])).max() < 1e-14 * 20


def test_zeros_stay_structural():
    """A planar body has planar frames; a body without rotation modes has constant axes."""
    modes = np.zeros((3, 3, 2))
    modes[1:, 1, 0], modes[2, 1, 1] = [0.4, 1.0], -1.0
    turn = np.zeros((3, 3, 2))
    turn[2, 2] = [1.5, -3.0]
    points = dict(masses=np.ones(3), places=[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    link = ModalLink.of(from_points(**points, modes=modes, rotation_modes=turn, frames=[2]))
    x = jnp.asarray(0.3)
    motion = link.frames([x, x], [x, x], link.defaults)[0]
    assert [is_zero(a) for a in motion.J] == [False, False, True] * 2 + [True, True, False]
    assert all(map(is_zero, motion.bias))
    assert is_zero(motion.at[2])
    plain = ModalLink.of(from_points(**points, modes=modes, frames=[2]))
    assert [*plain.frames([x, x], [x, x], plain.defaults)[0].J] == [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
    still = link.frames([x, x], [0.0, 0.0], link.defaults)[0]
    assert all(map(is_zero, [*still.twist, *still.bias]))


def test_layout_is_static_and_numbers_have_derivatives():
    _, body = random_body(4)
    link = ModalLink.of(body)
    again = ModalLink.of(body.replace(mass=2.0 * body.mass))
    assert link == again and hash(link) == hash(again) and link.defaults != again.defaults
    assert len(set(link.layout.entries)) == len(link.layout.entries)
    q = qd = [0.1, -0.2, 0.3]
    w = Vec3(0.3, -0.5, 0.7)

    def power(body):
        found = link.inertia(q, qd, w, list(link.layout.values(body)))
        frame = link.frames(q, qd, list(link.layout.values(body)))[0]
        return sum(found.forces) + found.force.ang.dot(w) + frame.twist.lin.dot(frame.bias.lin)

    power = jax.jit(power)
    slope = jax.jit(jax.grad(power))(body)
    step = 1e-6
    for name in ("inertia1", "coupling1", "second_modes", "rotation_modes"):
        x = getattr(body, name)
        by = np.random.default_rng(8).normal(size=x.shape)
        if name == "inertia1":
            by = by + by.transpose(0, 2, 1)
        if name == "second_modes":
            by = by + by.transpose(0, 1, 3, 2)
        up, down = (float(power(body.replace(**{name: x + s * step * by}))) for s in (1, -1))
        got = float((getattr(slope, name) * by).sum())
        assert abs(got - (up - down) / (2 * step)) < 1e-7 * max(1.0, abs(got)), name


@pytest.mark.parametrize("second", [False, True])
def test_gradients_by_every_number_are_those_of_complex_steps(second):
    """All outputs of `inertia` by every parameter: 1e-12 of the largest."""
    points = random_points(np.random.default_rng(9), n=6, m=2)
    A = np.random.default_rng(10).normal(size=(6, 3, 2, 2))
    body = from_points(**points, second_modes=A + A.transpose(0, 1, 3, 2), frames=[1])
    link = ModalLink.of(body, second_order=second)
    q, v, w = [0.3, -0.2], [0.5, 0.4], Vec3(0.3, -0.5, 0.7)

    def outputs(params):
        found = link.inertia(q, v, w, params)
        rigid = [found.rigid.m, *found.rigid.h, *found.rigid.J]
        coupled = [x for f in (*found.coupling, found.force) for x in f]
        return [*rigid, *coupled, *(x for row in found.mass for x in row), *found.forces]

    values = np.array(link.defaults)
    stacked = jax.jit(lambda p: jnp.stack([jnp.asarray(x) for x in outputs(list(p))]))
    got = np.asarray(jax.jit(jax.jacfwd(stacked))(values))
    for k in range(len(values)):
        step = [complex(x) for x in values]
        step[k] += 1e-30j
        want = np.array([np.imag(x) / 1e-30 for x in outputs(step)])
        assert np.abs(got[:, k] - want).max() <= 1e-12 * max(1.0, np.abs(want).max())


def test_small_entries_can_be_dropped():
    _, body = random_body(4)
    small = np.diag([1.0, 2.0, 3.0])
    small[0, 1] = small[1, 0] = 1e-15
    dirty = body.replace(modal_mass=small)
    assert ("modal_mass", (0, 1)) in ModalLayout.of(dirty).entries
    assert ("modal_mass", (0, 1)) not in ModalLayout.of(dirty, 1e-14).entries


def test_wrong_number_of_parameters():
    _, body = random_body(4)
    link = ModalLink.of(body)
    with pytest.raises(InputError, match="expected"):
        link.frames([0.0] * 3, [0.0] * 3, [1.0])
    with pytest.raises(InputError, match="expected 3 and 2"):
        link.layout.values(from_points([1.0], [[0, 0, 0]], np.ones((1, 3, 1))))
