"""Kinematics of a beam: columns and biases against nested jvps, structural zeros, errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import rbjax as rb
from rbjax.errors import InputError, UnknownName
from rbjax.flexible.strain import StrainBeam, largest_cell_angle, strain_beam
from rbjax.lanes import is_literal, is_zero

BEAMS = {
    "planar": strain_beam({"k_y": 3}),
    "planar_stretched": strain_beam({"k_z": 2, "e_x": 1, "g_y": 0}, frames=(0.4,)),
    "torsion": strain_beam({"k_x": 2, "g_z": 1}),
    "straight": strain_beam({"e_x": 1, "g_y": 2}, points=4),
    "constant": strain_beam({"k_x": 0, "k_y": 0, "k_z": 0}),
    "bending": strain_beam({"k_y": 2, "k_z": 1}),
    "spatial": strain_beam(
        {"k_x": 1, "k_y": 3, "k_z": 2, "e_x": 1, "g_y": 0, "g_z": 1},
        natural={"k_x": 0, "k_z": 1},
        frames=(0.25, 1.0),
    ),
    "reduced_planar": strain_beam(
        {"k_z": 3, "g_y": 2}, basis=np.random.default_rng(7).normal(size=(7, 3)), frames=(0.4,)
    ),
    "reduced": strain_beam(
        {"k_x": 1, "k_y": 3, "k_z": 2, "e_x": 1, "g_y": 0, "g_z": 1},
        basis=np.random.default_rng(8).normal(size=(14, 4)),
        natural={"k_z": 1},
    ),
    "reduced_by_strain": strain_beam(
        {"k_y": 3, "k_z": 2, "e_x": 1},
        basis=scipy.linalg.block_diag(
            [[1.0, 0.2], [0.0, 1.0], [0.5, 0.3], [0.0, 0.7]], [[1.0], [0.4], [0.1]], [[0.0], [1.0]]
        ),
    ),
}


def parameters(beam: StrainBeam) -> list:
    natural = {name: 0.4 for name in beam.params if name.startswith("natural")}
    return beam.values_of(length=1.3, **{k: (x,) * len(beam.params[k]) for k, x in natural.items()})


def numbers(lanes) -> np.ndarray:
    return np.array([float(x) for x in lanes])


def vee(W: np.ndarray) -> np.ndarray:
    return np.array([W[2, 1], W[0, 2], W[1, 0]])


def derivatives(beam: StrainBeam, q, v):
    """Compute S_j, twist and bias of each frame by differentiating the poses."""
    params = parameters(beam)

    def poses(q):
        return jnp.stack(
            [jnp.stack([jnp.asarray(x, float) for x in (*T.R, *T.p)])
             for T in beam.poses(list(q), params)]
        )  # fmt: skip

    along = lambda q: jax.jvp(poses, (q,), (v,))[1]  # noqa: E731
    at, slopes = poses(q), jax.jacfwd(poses)(q)
    rates, seconds = jax.jvp(along, (q,), (v,))
    for g in range(beam.count):
        R = np.asarray(at[g, :9]).reshape(3, 3)
        axes = [
            np.r_[vee(R.T @ slopes[g, :9, j].reshape(3, 3)), R.T @ slopes[g, 9:, j]]
            for j in range(beam.coordinates)
        ]
        W = R.T @ rates[g, :9].reshape(3, 3)
        A = R.T @ seconds[g, :9].reshape(3, 3) - W @ W
        yield at[g], axes, np.r_[vee(W), R.T @ rates[g, 9:]], np.r_[vee(A), R.T @ seconds[g, 9:]]


@pytest.mark.parametrize("name", BEAMS)
def test_columns_and_bias_are_exact_derivatives_of_the_pose(name):
    beam, rng = BEAMS[name], np.random.default_rng(3)
    q, v = jnp.asarray(rng.normal(size=(2, beam.coordinates)))
    frames = beam.frames(list(q), list(v), parameters(beam))
    assert len(frames) == beam.count
    for frame, (pose, axes, twist, bias) in zip(frames, derivatives(beam, q, v), strict=True):
        assert np.abs(numbers([*frame.J, *frame.at]) - pose).max() < 1e-12
        assert np.abs(np.array([numbers(S) for S in frame.axes]) - axes).max() < 1e-12
        assert np.abs(numbers(frame.twist) - twist).max() < 1e-12
        assert np.abs(numbers(frame.bias) - bias).max() < 1e-12
        assert np.abs(np.array(axes).T @ v - numbers(frame.twist)).max() < 1e-12


@pytest.mark.parametrize("name", ["planar_stretched", "bending", "spatial"])
def test_derivatives_at_zero_strain_are_finite(name):
    """First and second derivatives of all frames at q = 0, also by the length."""
    beam, n = BEAMS[name], BEAMS[name].coordinates
    params = jnp.asarray(beam.defaults)

    def tip(x):
        at = beam.poses(list(x[:n]), [x[n], *params[1:]])[beam.tip]
        return jnp.stack([jnp.asarray(y, x.dtype) for y in (*at.R, *at.p)]) @ jnp.arange(12.0)

    x = jnp.zeros(n + 1).at[n].set(1.0)
    assert np.isfinite(jax.grad(tip)(x)).all()
    assert np.isfinite(jax.jvp(jax.grad(tip), (x,), (jnp.ones(n + 1),))[1]).all()


def test_planar_beam_has_planar_arithmetic():
    """Literals: no lane out of the plane of one bending strain is an array."""
    beam = BEAMS["planar"]
    names = iter(jnp.linspace(0.1, 1.0, 2 * beam.coordinates))
    q, v = ([next(names) for _ in range(beam.coordinates)] for _ in range(2))
    for frame in beam.frames(q, v, beam.defaults):
        for motion in (*frame.axes, frame.twist, frame.bias):
            wx, _, wz, _, vy, _ = motion
            assert all(map(is_zero, (wx, wz, vy)))
        assert all(is_literal(S.ang[1]) for S in frame.axes)  # constants times a literal length
        assert all(map(is_zero, frame.bias.ang)) and is_zero(frame.at[1])
        assert sum(map(is_literal, frame.J)) == 5


def test_statements_of_a_planar_beam():
    """A bound on the equations of eight coordinates, which guards against lost zeros."""
    beam = strain_beam({"k_z": 7})
    count = equations(beam)
    assert count < 7_000, count


def equations(beam: StrainBeam) -> int:
    """Count the scalar equations of the frames, traced by q, v and the length."""
    n = beam.coordinates

    def f(q, v, length):
        return beam.frames(list(q), list(v), [length, *beam.defaults[1:]])

    jaxpr = jax.make_jaxpr(f)([0.1] * n, [0.1] * n, 1.0)
    return len(jaxpr.jaxpr.eqns)


def test_velocities_are_left_out_if_they_are_literal_zeros():
    beam = BEAMS["spatial"]
    q = list(jnp.linspace(-0.5, 0.5, beam.coordinates))
    for frame in beam.frames(q, [0.0] * beam.coordinates, beam.defaults):
        assert all(map(is_zero, [*frame.twist, *frame.bias]))


def test_single_precision():
    beam, rng = BEAMS["spatial"], np.random.default_rng(5)
    q, v = rng.normal(size=(2, beam.coordinates))
    params = parameters(beam)

    def lanes(dtype):
        x, y = ([jnp.asarray(a, dtype) for a in b] for b in (q, v))
        got = beam.frames(x, y, params)
        lanes = [a for f in got for a in (*f.J, *f.at, *f.twist, *f.bias, *sum_lanes(f.axes))]
        assert all(is_literal(a) or a.dtype == dtype for a in lanes)
        return numbers(lanes)

    wide = lanes(jnp.float64)
    assert np.abs(lanes(jnp.float32) - wide).max() < 4e-6 * np.abs(wide).max()


def sum_lanes(motions) -> list:
    return [x for S in motions for x in S]


def test_mass_is_the_integral_of_the_section():
    beam = strain_beam({"k_z": 2}, tapered=True, eccentric=True)
    taper = [1.0 + x for x in beam.nodes]
    params = beam.values_of(
        length=2.0, mass_per_length=taper, rotary_inertia=(0.3, 0.1, 0.2), first_moment=(0.5, 0.0)
    )
    own = [f.own for f in beam.frames([0.0] * 3, [0.0] * 3, params)]
    assert abs(sum(float(I.m) for I in own) - 3.0) < 1e-14
    assert abs(sum(float(I.J[0]) for I in own) - 0.6) < 1e-14
    assert abs(sum(float(I.h[1]) for I in own) - 1.0) < 1e-14
    assert is_zero(own[beam.tip].m)


def test_frequencies_of_a_cantilever():
    """Eight coordinates, by K and the mass matrix of the frames. The second and third modes are as
    accurate as degree 7 is; the first one as the rounding of LAPACK (3e-11 with NumPy 2.0)."""
    beam = strain_beam({"k_z": 7})
    n, params = beam.coordinates, beam.values_of(rotary_inertia=(0.0, 0.0, 0.0))
    M = np.zeros((n, n))
    for frame in beam.frames([0.0] * n, [0.0] * n, params):
        S = np.array([numbers(x)[3:] for x in frame.axes])
        M += float(frame.own.m) * S @ S.T
    K = np.diag([1 / (2 * j + 1) for j in range(n)])
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real)[:3]
    want = np.array([3.5160152685562953, 22.034491565680984, 61.69721441355056])
    errors = np.abs(np.sqrt(squares) / want - 1)
    assert (errors < [1e-10, 2e-8, 2e-6]).all(), errors


def test_frames_of_a_circular_arc():
    """The position at any s: a constant curvature k gives (sin(k s), 1 - cos(k s)) / k."""
    places, k, length = (0.1, 0.55, 0.9), 1.2, 2.0
    beam = strain_beam({"k_z": 0}, points=12, frames=places)
    poses = beam.poses([k], beam.values_of(length=length))
    for place, at in zip([*beam.nodes, 1.0, *places], poses, strict=True):
        turned = k * length * place
        want = [np.sin(turned) / k, (1 - np.cos(turned)) / k, 0.0]
        assert np.abs(numbers(at.p) - want).max() < 1e-11  # the interpolant of 12 points


def test_derivative_by_the_length():
    """A beam is L times the beam of unit length with curvatures L q, so that
    dr/dL = (r + sum_j q_j dr/dq_j) / L. Strains e and g have no dimension."""
    beam, L = BEAMS["spatial"], 1.3
    params = jnp.asarray(beam.defaults).at[0].set(L)  # no natural curvature
    q = jnp.asarray(np.random.default_rng(7).normal(size=beam.coordinates))

    def r(q, length):
        tip = beam.poses(list(q), [length, *params[1:]])[beam.tip]
        return jnp.stack([*tip.p])

    curved = jnp.asarray([float(c < 3) for c, _ in beam.coefficients])
    at, along = jax.jvp(lambda x: r(x, L), (q,), (q * curved,))
    by_length = jax.jvp(lambda x: r(q, x), (L,), (1.0,))[1]
    assert np.abs(by_length - (at + along) / L).max() < 1e-13


def test_largest_angle_of_a_cell():
    """Four points of a beam that turns by q: the largest cells lie in the middle."""
    for degrees in ({"k_z": 0}, {"k_y": 0, "k_z": 0}):
        beam = strain_beam(degrees, points=4)
        q = [0.0] * (beam.coordinates - 1) + [20.0]
        gap = max(np.diff([0.0, *beam.nodes, 1.0]))
        assert abs(float(largest_cell_angle(beam, q, beam.defaults)) - 20.0 * gap) < 1e-12
    twice = jax.jit(lambda x: largest_cell_angle(beam, [0.0, x], beam.defaults))
    assert float(twice(8.0)) < np.pi < float(twice(20.0))


def test_equal_configurations_are_one_kind():
    a = strain_beam({"k_z": 2, "k_y": 1}, frames=[0.5])
    b = strain_beam({"k_y": 1, "k_z": 2}, frames=(0.5,), points=6)
    assert a is b and rb.joints.kind(a.name) is a
    assert strain_beam({"k_z": 2}).name != strain_beam({"k_z": 2}, points=7).name


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"degrees": {}}, "without a strain"),
        ({"degrees": "k_z"}, "a mapping"),
        ({"degrees": {"k_z": -1}}, "from 0 to 30"),
        ({"degrees": {"k_z": 1.5}}, "from 0 to 30"),
        ({"degrees": {"k_z": 3}, "points": 3}, "an integer from 4"),
        ({"degrees": {"k_z": 3}, "frames": (0.0,)}, "above 0 and up to 1"),
        ({"degrees": {"k_z": 3}, "frames": (float("nan"),)}, "above 0 and up to 1"),
    ],
)
def test_bad_configurations(arguments, message):
    with pytest.raises(InputError, match=message):
        strain_beam(**arguments)


def test_unknown_names():
    with pytest.raises(UnknownName, match="k_z"):
        strain_beam({"k_3": 1})
    with pytest.raises(UnknownName, match="k_y"):
        strain_beam({"k_z": 1}, natural={"e_x": 1})
    with pytest.raises(UnknownName, match="length"):
        BEAMS["planar"].values_of(lenght=1.0)  # codespell:ignore
    with pytest.raises(InputError, match="expected 3"):
        BEAMS["planar"].values_of(rotary_inertia=(1.0, 2.0))
