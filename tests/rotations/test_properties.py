"""Properties of rotations for any axis and angle, near the singular angles 0, pi / 2 and pi too."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rbjax.rotations import quaternion, representations, so3

# A dozen operations on numbers of at most one: measured 5.5 units in the last place.
ROUNDING = 16
QUICK = ("unit_quaternion", "euler_vector", "gibbs", "roll_pitch_yaw")
DTYPES = pytest.mark.parametrize("dtype", [np.float64, np.float32])
once = settings(max_examples=60, derandomize=True, deadline=None, database=None)
many = settings(once, max_examples=1000)

axes = st.one_of(
    st.sampled_from([tuple(row) for row in np.concatenate([np.eye(3), -np.eye(3)])]),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda x: sum(a * a for a in x) > 1e-4),
)
small = st.one_of(st.just(0.0), st.floats(-12, -1).map(lambda k: 10.0**k))
angles = st.one_of(
    st.floats(0, np.pi),
    small,
    small.map(lambda x: np.pi - x),
    small.map(lambda x: np.pi / 2 + x),
    small.map(lambda x: np.pi / 2 - x),
)


@st.composite
def turns(draw) -> np.ndarray:
    """A rotation vector."""
    axis = np.array(draw(axes))
    return axis / np.linalg.norm(axis) * draw(angles)


def close(x, y, dtype, factor: float = ROUNDING) -> None:
    np.testing.assert_allclose(
        np.asarray(x, float), np.asarray(y, float), rtol=0, atol=factor * np.finfo(dtype).eps
    )


@cache
def there_and_back(names: tuple[str, ...]):
    """R -> the matrix of the parameters of R, by each representation."""
    known = representations()

    @jax.jit
    def run(R):
        return {n: known[n].to_matrix(known[n].from_matrix(R)) for n in names}

    return run


def check_round_trips(v: np.ndarray, dtype, names: tuple[str, ...]) -> None:
    R = np.asarray(so3.exp(v)).astype(dtype)
    for name, back in there_and_back(names)(R).items():
        assert back.dtype == dtype and np.isfinite(back).all(), name
        close(back, R, dtype)


@DTYPES
@once
@given(v=turns())
def test_matrices_survive_a_round_trip(dtype, v: np.ndarray) -> None:
    check_round_trips(v, dtype, QUICK)


@pytest.mark.slow
@DTYPES
@many
@given(v=turns())
def test_matrices_survive_a_round_trip_through_all_representations(dtype, v: np.ndarray) -> None:
    check_round_trips(v, dtype, tuple(representations()))


@jax.jit
def products(a, b, v):
    ab = quaternion.multiply(a, b)
    return {
        "the product turns as one after the other": (
            quaternion.rotate(ab, v), quaternion.rotate(a, quaternion.rotate(b, v)),
        ),
        "lengths stay": (jnp.linalg.norm(quaternion.rotate(ab, v)), jnp.linalg.norm(v)),
        "a conjugate undoes": (
            quaternion.rotate(quaternion.conjugate(a), quaternion.rotate(a, v)), v,
        ),
        "matrices multiply alike": (
            quaternion.to_matrix(ab), so3.compose(quaternion.to_matrix(a), quaternion.to_matrix(b)),
        ),
        "a sign is no turn": (quaternion.to_matrix(-a), quaternion.to_matrix(a)),
    }  # fmt: skip


@DTYPES
@once
@given(a=turns(), b=turns(), v=st.tuples(*[st.floats(-1, 1)] * 3))
def test_quaternions_are_a_group_of_rotations(dtype, a, b, v) -> None:
    qa, qb = (np.asarray(quaternion.exp(x)).astype(dtype) for x in (a, b))
    for what, (got, want) in products(qa, qb, np.asarray(v, dtype)).items():
        assert got.dtype == dtype, what
        close(got, want, dtype)


@jax.jit
def logarithms(v):
    q, R = quaternion.exp(v), so3.exp(v)
    return quaternion.to_matrix(q), R, so3.exp(so3.log(R)), so3.exp(quaternion.log(q))


@DTYPES
@once
@given(v=turns())
def test_logarithms_undo_exponentials(dtype, v) -> None:
    by_quaternion, R, *backs = logarithms(v.astype(dtype))
    for x in (by_quaternion, *backs):
        assert x.dtype == dtype
        close(x, R, dtype)
