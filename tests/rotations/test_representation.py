"""Every representation of attitude: round trips, rate maps, accelerations, singularities.

The matrices are written here in a hundred digits from the definitions; rate maps are differences of
them. No formula is shared with rbjax.
"""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mpf
from scipy.spatial.transform import Rotation

from rbjax import InputError, UnknownName
from rbjax.rotations import convert, mrp_shadow, mrp_short, quaternion, representations, so3
from rbjax.rotations.euler import SEQUENCES
from rbjax.rotations.representation import Representation
from rbjax.rotations.vectorial import VECTORIAL
from tests.robots import QUICK
from tests.rotations import exact
from tests.rotations.exact import assert_jets, jets, our_jets
from tests.tolerances import F64_ROUNDING, relative_error

REPS = representations()
EULER = {n: r for n, r in REPS.items() if hasattr(r.formulas, "sequence")}
# two more, that do not cover all attitudes
PARTIAL = {n: Representation(n, VECTORIAL[n]) for n in ("linear", "reduced_euler_rodrigues")}
QUATERNIONS = Rotation.random(10_000, rng=np.random.default_rng(0)).as_quat(scalar_first=True)

# ---------------------------------------------------------------- definitions, a hundred digits

# phi of |p|, for p = p(phi) n
ANGLE_OF = {
    "euler_vector": lambda p: p,
    "linear": lambda p: mpmath.asin(p),
    "reduced_euler_rodrigues": lambda p: 2 * mpmath.asin(p / 2),
    "cayley": lambda p: 2 * mpmath.atan(p / 2),
    "gibbs": lambda p: 2 * mpmath.atan(p),
    "wiener_milenkovic": lambda p: 4 * mpmath.atan(p / 4),
    "mrp": lambda p: 4 * mpmath.atan(p),
}
PARAMETER_OF = {
    "euler_vector": lambda t: t,
    "linear": np.sin,
    "reduced_euler_rodrigues": lambda t: 2 * np.sin(t / 2),
    "cayley": lambda t: 2 * np.tan(t / 2),
    "gibbs": lambda t: np.tan(t / 2),
    "wiener_milenkovic": lambda t: 4 * np.tan(t / 4),
    "mrp": lambda t: np.tan(t / 4),
}


def vectorial_matrix(name, p):
    size = exact.norm(p)
    if not size:
        return mpmath.eye(3)
    return exact.turn([a / size for a in p], ANGLE_OF[name](size))


def elementary(axis, angle):
    return exact.turn([mpf(axis == a) for a in "xyz"], angle)


def euler_matrix(sequence, intrinsic, x):
    a, b, c = (elementary(s, t) for s, t in zip(sequence, x, strict=True))
    return a * b * c if intrinsic else c * b * a


def definition(name):
    """x -> R in a hundred digits."""
    if name in ANGLE_OF:
        return functools.partial(vectorial_matrix, name)
    if name in EULER:
        kind, _, sequence = name.rpartition("_")
        named = {"zyz": ("zyz", True), "roll_pitch_yaw": ("xyz", False)}
        return functools.partial(euler_matrix, *named.get(name, (sequence, kind == "intrinsic")))
    return {
        "unit_quaternion": exact.quaternion_matrix,
        "unit_quaternion_xyzw": lambda x: exact.quaternion_matrix([x[3], *x[:3]]),
        "axis_angle": lambda x: exact.turn([a / exact.norm(x[:3]) for a in x[:3]], x[3]),
        "rotation_matrix": lambda x: mpmath.matrix(3, 3) + mpmath.matrix([x[:3], x[3:6], x[6:]]),
        "two_columns": gram_schmidt,
    }[name]


def gram_schmidt(x):
    n = exact.norm(x[:3])
    u = [a / n for a in x[:3]]
    along = sum(a * b for a, b in zip(u, x[3:], strict=True))
    v = [b - along * a for a, b in zip(u, x[3:], strict=True)]
    n = exact.norm(v)
    v = [a / n for a in v]
    w = exact.hat(u) * mpmath.matrix(v)
    return mpmath.matrix([u, v, list(w)]).T


# ------------------------------------------------------------------------------ round trips


def test_there_are_thirty_and_more_in_a_stable_order() -> None:
    assert len(REPS) >= 30 and list(representations()) == list(REPS)
    assert len({n.split("_")[1] for n in REPS if n.startswith(("intr", "extr"))}) == 12
    for rep in REPS.values():
        assert rep.size >= 3 and rep.singular_set and rep.name in repr(rep)


F32_SLOW = pytest.param(np.float32, 2e-6, marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1_000, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("dtype", "limit"), [(np.float64, 1e-14), F32_SLOW])
def test_round_trips_among_all(dtype, limit, count) -> None:
    """Random rotations from each representation into each other one and back."""
    q = jnp.asarray(QUATERNIONS[:count], dtype)
    trips = {}
    for name, rep in REPS.items():

        def trip(q, rep=rep):
            return rep.to_quaternion(rep.from_quaternion(q))

        trips[name] = jax.jit(trip, compiler_options=QUICK).lower(q).compile()

    @jax.jit
    def off(a, b):  # in f64, so that the measure has no error of its own
        a, b = a.astype(float), b.astype(float)
        return quaternion.distance(a, b).max()

    for name, there in trips.items():
        once = there(q)
        worst = {other: float(off(once, back(once))) for other, back in trips.items()}
        assert max(worst.values()) <= limit, (name, max(worst, key=worst.get), max(worst.values()))


@pytest.mark.parametrize(("dtype", "limit"), [(np.float64, 1e-14), (np.float32, 2e-6)])
def test_round_trips_through_the_matrix(dtype, limit) -> None:
    R = jnp.asarray(quaternion.to_matrix(QUATERNIONS), dtype)

    @jax.jit
    def backs(R):
        return {name: rep.to_matrix(rep.from_matrix(R)) for name, rep in REPS.items()}

    R64 = R.astype(float)
    for name, back in backs(R).items():
        assert back.dtype == dtype
        assert so3.distance(R64, back.astype(float)).max() <= limit, name


def test_is_what_scipy_has() -> None:
    """Angles where the ranges agree; scipy's upper case is intrinsic."""
    r = Rotation.from_quat(QUATERNIONS[:500], scalar_first=True)
    for s in SEQUENCES:
        for name, theirs in ((f"intrinsic_{s}", s.upper()), (f"extrinsic_{s}", s)):
            got, want = REPS[name].from_quaternion(QUATERNIONS[:500]), r.as_euler(theirs)
            assert np.abs(np.sin((got - want) / 2)).max() < 1e-12, name
    np.testing.assert_allclose(REPS["mrp"].from_quaternion(QUATERNIONS[:500]), r.as_mrp(),
                               atol=1e-14)  # fmt: skip
    np.testing.assert_allclose(
        REPS["euler_vector"].from_matrix(r.as_matrix()), r.as_rotvec(), atol=1e-13
    )


# ------------------------------------------------------------------------- against digits


def maps(rep):
    """The four rate matrices in a row."""
    names = ("body_rate_matrix", "space_rate_matrix")
    names += tuple(f"inverse_{n}" for n in names)

    def f(x):
        return jnp.concatenate([getattr(rep, n)(x).reshape(-1) for n in names])

    return f


def exact_maps(to_matrix):
    def f(x):
        both = exact.rate_matrices(to_matrix, x)
        back = [E.T * (E * E.T) ** -1 for E in both]  # the inverse, or that of least norm
        return [a for M in (*both, *back) for a in M]

    return f


@pytest.mark.parametrize("name", ANGLE_OF)
def test_vectorial_maps(name) -> None:
    """With two derivatives, from 0 to pi - 1e-9 where they reach (Table A.1: test_vectorial.py)."""
    rep = (REPS | PARTIAL)[name]
    reach = {"linear": 1.5, "reduced_euler_rodrigues": 2.5}.get(name, np.pi)
    angles = np.array([a for a in exact.ANGLES if a <= reach])[::2]
    x = PARAMETER_OF[name](angles)[:, None] * np.array([1.0, -2.0, 2.0]) / 3
    size = np.maximum(1.0, np.linalg.norm(x, axis=1, keepdims=True))
    d = np.array([0.3, -0.7, 0.5]) * size  # the scale on which a large parameter varies
    got = our_jets(maps(rep), x, d)
    want = jets(exact_maps(definition(name)), x, d)
    for block in (slice(0, 18), slice(18, 36)):  # a map and its inverse are of different size
        ours = [*(g[:, block] for g in got[:3]), got[3]]
        tiny = min(np.abs(w[:, block]).max(1).min() for w in want[:1])
        assert_jets([*ours[:3], 0 * got[3]], [w[:, block] for w in want], floor=min(1e-3, tiny))
    assert np.isfinite(got[3]).all()
    np.testing.assert_allclose(
        rep.singularity_distance(x), rep.formulas.singular_angle - angles, atol=4e-8 / (4 - reach)
    )


# two of three axes and two of two, in both orders of axes; round trips go through every one
FEW = ("zyx", "yzx", "zxz", "yzy")


@pytest.mark.parametrize(
    "sequence",
    [pytest.param(s, marks=() if s in FEW else pytest.mark.slow) for s in SEQUENCES],
)
def test_euler_maps(sequence) -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-3, 3, (5, 3))
    proper = sequence[0] == sequence[2]
    x[:, 1] = np.array([1e-3, 0.7, -1.1, 1.5, 2.9]) + (0 if proper else 0.2)
    d = np.tile([0.3, -0.7, 0.5], (5, 1))
    for name in (f"intrinsic_{sequence}", f"extrinsic_{sequence}"):
        rep = REPS[name]
        got = our_jets(maps(rep), x, d)
        want = jets(exact_maps(definition(name)), x, d)
        near = 1 / np.asarray(rep.singularity_distance(x)).min()
        for block, slack in ((slice(0, 18), 1), (slice(18, 36), near)):
            for g, w, limit in zip(got[:3], want, (1e-15, 1e-12, 1e-12), strict=True):
                error = relative_error(g[:, block], w[:, block], batch_dims=1)
                assert error.max() <= limit * max(1, slack / 100), (name, error)
        R = np.asarray(rep.to_matrix(x))
        with mpmath.mp.workdps(30):
            digits = [definition(name)(exact.numbers(row)) for row in x]
        want = np.array([[float(a) for a in M] for M in digits]).reshape(-1, 3, 3)
        assert relative_error(R, want) <= 1e-15


@pytest.mark.parametrize(
    "name", ["unit_quaternion", "unit_quaternion_xyzw", "axis_angle", "two_columns"]
)
def test_redundant_maps(name) -> None:
    """Values, on the constraint; the inverse of least norm is the one that keeps it."""
    rep = REPS[name]
    x = np.array(rep.from_quaternion(QUATERNIONS[:6]))
    if name == "axis_angle":
        x[:3, 3] = [1e-6, 1e-3, np.pi - 1e-9]
    got = np.asarray(jax.jit(jax.vmap(maps(rep)))(x))
    f = exact_maps(definition(name))
    with mpmath.mp.workdps(exact.DIGITS):
        want = np.array([[float(a) for a in f(exact.numbers(row))] for row in x])
    n = 6 * rep.size
    # an axis and two columns are of unit length to rounding only
    assert relative_error(got[:, :n], want[:, :n], batch_dims=1).max() <= 2e-15
    if name != "two_columns":
        assert relative_error(got[:, n:], want[:, n:], batch_dims=1).max() <= 2e-15


# one of each kind; the other Euler sequences differ from these by the names of axes
MOVING = [n for n in REPS if n not in EULER] + [
    *("roll_pitch_yaw", "zyz", "intrinsic_xzy", "extrinsic_xyx"),
]


@jax.jit
def kinematics(q, a, b):
    """Of R exp(a t + b t^2/2), a turn with omega_body = a and alpha_body = b at t = 0."""
    out = {}
    for name in MOVING:
        rep = REPS[name]

        def x(t, rep=rep):
            return rep.from_quaternion(
                quaternion.multiply(q, quaternion.exp(a * t + b * t * t / 2))
            )

        def rate(t, x=x):
            return jax.jvp(x, (t,), (1.0,))

        (x0, xd), (_, xdd) = jax.jvp(rate, (0.0,), (1.0,))
        turned = quaternion.to_matrix(q)
        out[name] = {
            "omega": (rep.body_rate_matrix(x0) @ xd, a),
            "omega space": (rep.space_rate_matrix(x0) @ xd, turned @ a),
            "alpha": (rep.body_acceleration(x0, xd, xdd), b),
            "alpha space": (rep.space_acceleration(x0, xd, xdd), turned @ b),
            "x'": (rep.inverse_body_rate_matrix(x0) @ a, xd),
            "x' space": (rep.inverse_space_rate_matrix(x0) @ (turned @ a), xd),
            "x''": (rep.second_rate_from_body(x0, a, b), xdd),
            "x'' space": (rep.second_rate_from_space(x0, turned @ a, turned @ b), xdd),
            "distance": rep.singularity_distance(x0),
        }
    return out


def test_rates_and_accelerations_along_a_motion() -> None:
    rng = np.random.default_rng(3)
    for q, a, b in zip(QUATERNIONS[:4], rng.normal(size=(4, 3)), rng.normal(size=(4, 3)),
                       strict=True):  # fmt: skip
        for name, pairs in kinematics(q, a, b).items():
            slack = 1 + 1 / min(1.0, float(pairs.pop("distance")))
            for what, (got, want) in pairs.items():
                assert relative_error(got, want, floor=1.0) <= slack**3 * F64_ROUNDING, (name, what)


# ------------------------------------------------------------------------ singular attitudes


@jax.jit
def all_about(R):
    out = {}
    for name, rep in REPS.items():
        x, transpose = jax.vjp(rep.from_matrix, R)
        slope = transpose(jnp.cos(jnp.arange(rep.size, dtype=x.dtype)))
        inverse = rep.inverse_body_rate_matrix(x)
        out[name] = x, rep.to_matrix(x), slope, inverse, rep.singularity_distance(x)
    return out


def singular_attitudes():
    """Quarter and half turns about axes, and products of them: every sequence is locked in some."""
    quarter = Rotation.from_rotvec(np.pi / 2 * np.eye(3))
    several = [Rotation.identity(), *quarter, *(a * a for a in quarter)]
    several += [a * b for a in quarter for b in quarter]
    several += [quarter[1] * Rotation.from_rotvec([t, 0, 0]) for t in (0.7, 1e-9)]
    exactly = [np.round(r.as_matrix()) if i < 16 else r.as_matrix() for i, r in enumerate(several)]
    return np.stack(exactly)


def test_singular_attitudes_have_a_right_answer_and_a_flag() -> None:
    locked: set[str] = set()
    for R in singular_attitudes():
        for name, (x, back, slope, inverse, distance) in all_about(R).items():
            assert np.isfinite(x).all() and np.isfinite(inverse).all(), name
            assert np.isfinite(slope).all(), name
            assert not np.isnan(distance) and distance >= 0
            assert np.abs(back - R).max() < 1e-14, (name, R, back)
            if distance < 1e-12:
                locked.add(name)
                assert np.abs(inverse).max() > 1e10  # loud, where a rate has no answer
    assert locked >= EULER.keys() | {"gibbs", "cayley", "axis_angle"}


def test_gimbal_lock_nearby() -> None:
    """The attitude is accurate to rounding at any distance from the singularity."""
    off = 10.0 ** np.arange(-17, 0)

    @jax.jit
    def errors(off):
        out = {}
        for name, rep in EULER.items():
            middle = (0.0 if rep.formulas.proper else np.pi / 2) + off
            x = jnp.stack([0.4 + 0 * off, middle, -1.3 + 0 * off], -1)
            q = rep.to_quaternion(x)
            back = rep.to_quaternion(rep.from_quaternion(q))
            out[name] = (q, back, rep.singularity_distance(x))
        return out

    for name, (q, back, distance) in errors(off).items():
        assert quaternion.distance(q, back).max() <= F64_ROUNDING, name
        np.testing.assert_allclose(distance, off, rtol=1e-14, atol=3e-16)


def test_distances() -> None:
    assert all(np.isinf(REPS[n].singularity_distance(REPS[n].from_matrix(np.eye(3))))
               for n in ("rotation_matrix", "unit_quaternion", "unit_quaternion_xyzw"))  # fmt: skip
    turn = np.array([0.0, 0.0, 1.0])
    lefts = dict.fromkeys(("gibbs", "cayley"), np.pi - 1) | {"axis_angle": 1.0}
    lefts |= dict.fromkeys(("euler_vector", "mrp", "wiener_milenkovic"), 2 * np.pi - 1)
    for name, left in lefts.items():
        x = REPS[name].from_matrix(so3.exp(turn))
        assert float(REPS[name].singularity_distance(x)) == pytest.approx(left)
    two = REPS["two_columns"]
    assert float(two.singularity_distance([1.0, 0, 0, 2.0, 1e-3, 0])) == pytest.approx(5e-4)


def test_shadow_of_modified_rodrigues_parameters() -> None:
    p = np.asarray(REPS["mrp"].from_quaternion(QUATERNIONS[:100]))
    assert (np.linalg.norm(p, axis=1) <= 1).all()
    shadow = mrp_shadow(p)
    same = REPS["mrp"].to_matrix(shadow)
    assert relative_error(same, REPS["mrp"].to_matrix(p)) <= 1e-13
    np.testing.assert_allclose(mrp_short(shadow), p, rtol=1e-14)
    np.testing.assert_array_equal(mrp_short(p), p)
    assert np.isfinite(mrp_shadow(np.zeros(3))).all()
    assert np.isfinite(jax.jit(jax.jacrev(mrp_short))(np.zeros(3))).all()


# -------------------------------------------------------------------------------- the door


def test_convert() -> None:
    x = REPS["gibbs"].from_quaternion(QUATERNIONS[:5])
    y = convert(x, "gibbs", "zyz")
    assert relative_error(REPS["zyz"].to_matrix(y), REPS["gibbs"].to_matrix(x)) <= 1e-13
    with pytest.raises(UnknownName, match=r"unknown representation 'rodrigues'.*'gibbs'"):
        convert(x, "rodrigues", "zyz")
    with pytest.raises(InputError, match=r"x has shape \(5, 3\), expected \(..., 4\)"):
        convert(x, "axis_angle", "zyz")


def test_single_precision_stays() -> None:
    """Traced, not run: what runs in f32 is in the round trips."""
    for name, rep in REPS.items():
        x = jax.ShapeDtypeStruct((rep.size,), jnp.float32)
        v = jax.ShapeDtypeStruct((3,), jnp.float32)
        results = [jax.eval_shape(maps(rep), x), jax.eval_shape(rep.singularity_distance, x)]
        results += [jax.eval_shape(rep.body_acceleration, x, x, x)]
        results += [jax.eval_shape(rep.second_rate_from_space, x, v, v)]
        assert {a.dtype for a in results} == {np.dtype(np.float32)}, name
