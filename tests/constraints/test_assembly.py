"""Consistent states from guesses; freedoms and redundant rows of mechanisms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.mechanisms import spatial_slider_crank
from rbjax import constraints as rc
from tests.loading.test_constraints import EQUALITIES


def test_mobility_of_mechanisms() -> None:
    model = rb.load("four_bar")
    found = rc.mobility(model, model.default_state().q)
    assert (found.freedoms, found.rank) == (1, 2)
    assert found.redundant == ("Spherical 0, row 1",)  # across the plane
    flat = rc.mobility(model, jnp.array([np.pi / 2, -np.pi / 2, np.pi / 2]))
    assert (flat.freedoms, flat.rank) == (2, 1)
    crank, start = spatial_slider_crank()
    assert rc.mobility(crank, start.q) [:2] == (1, 7)  # fmt: skip


def test_a_guess_is_assembled_with_a_joint_pinned() -> None:
    model = rb.load("four_bar")
    guess = rb.State(jnp.array([0.4, -0.1, 0.3]), jnp.array([2.0, 0.0, 0.0]))
    found = rc.assemble(model, guess, pinned=["left"])
    assert found.success and found.off < 1e-12 and not found.conflicting
    # a parallelogram: both rods alike, the coupler level
    np.testing.assert_allclose(found.state.q, [0.4, -0.4, 0.4], atol=1e-12)
    np.testing.assert_allclose(found.state.v, [2.0, -2.0, 2.0], atol=1e-12)


def test_what_cannot_be_assembled_is_named() -> None:
    model = rb.load("four_bar")
    start = model.default_state()
    far = rc.Distance(rc.Place.on(), rc.Place.on(body="right", point=[1.0, 0, 0]), jnp.array(5.0))
    model = model.with_constraints(far)
    found = rc.assemble(model, start, throw=False)
    assert not found.success and "Distance 1, row 0" in found.conflicting
    with pytest.raises(rb.InputError, match="Distance 1, row 0"):
        rc.assemble(model, start)
    with pytest.raises(rb.UnknownName, match="rod7"):
        rc.assemble(model, start, pinned=["rod7"])


def test_kinds_are_all_there() -> None:
    """All public constraint classes but the base classes, those that files bring among them."""
    public = {name: getattr(rc, name) for name in rc.__all__}
    classes = {name: x for name, x in public.items() if isinstance(x, type)}
    classes = {name: x for name, x in classes.items() if issubclass(x, rc.Constraint)}
    assert rc.kinds() == {n: x for n, x in classes.items() if n not in ("Constraint", "Pair")}
    assert {*EQUALITIES.values()} <= {*rc.kinds().values()}


@pytest.mark.parametrize(
    "kind, soft, dtype",
    [
        (rc.Weld, False, jnp.float64),
        pytest.param(rc.Weld, False, jnp.float32, marks=pytest.mark.slow),
        pytest.param(rc.Weld, True, jnp.float32, marks=pytest.mark.slow),
        pytest.param(rc.Prismatic, False, jnp.float64, marks=pytest.mark.slow),
        pytest.param(rc.Prismatic, True, jnp.float32, marks=pytest.mark.slow),
    ],
)
def test_no_joint_is_closed_half_a_turn_off(kind: type, soft: bool, dtype: type) -> None:
    """The sine of the angle is zero there too. From any guess, half a turn itself included."""
    model = rb.load("free_body")
    joint = kind.between(model, 0, None)
    model = model.with_constraints(rc.Soft.on(model, joint) if soft else joint)
    for degrees in (120.0, 179.0, 180.0):
        for axis in ([1.0, 0, 0], [0.6, 0.8, 0]):
            half = np.deg2rad(degrees) / 2
            q = np.r_[0.1, 0.2, 0.3, np.cos(half), np.sin(half) * np.array(axis)]
            q, v = jnp.asarray(q, dtype), jnp.zeros(6, dtype)
            found = rc.assemble(model, rb.State(q, v))
            assert found.success and abs(abs(float(found.state.q[3])) - 1) < 1e-5, (degrees, axis)


def test_a_distance_of_zero_is_reported_and_is_a_number() -> None:
    model = rb.load("double_pendulum")
    ends = rc.places(model, "upper", "lower", point=[0.0, 0.0, 0.3])
    model = model.with_constraints(rc.Distance(*ends, 1.0))
    off = rc.residual(model, model.default_state())
    np.testing.assert_allclose(off.value, [-1.0], rtol=1e-14)
    assert off.rate.tolist() == [0.0]
    path = rb.rollout(model, model.default_state(), None, 0.01, steps=2)
    assert np.isfinite(path.q).all()
    with pytest.raises(rb.InputError, match="Distance 0, row 0"):
        rc.assemble(model, model.default_state())
    rod = rc.Distance.between(model, None, "lower", point=[0.3, 0, 0], other=[0, 0, 0.4])
    closed = rb.load("double_pendulum").with_constraints(rod)
    np.testing.assert_allclose(rc.residual(closed, closed.default_state()).value, 0.0, atol=1e-15)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("hinges", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_redundant_rows_are_found_in_both_dtypes(hinges: int, dtype: type) -> None:
    """A door on several hinges of one skew line; what rounding leaves of a row does not count."""
    model, random = rb.load("free_body"), np.random.default_rng(0)
    for _ in range(2):
        turn = random.normal(size=4)
        q = jnp.asarray(np.r_[random.normal(size=3), turn / np.linalg.norm(turn)], dtype)
        axis = jnp.array([1.0, 2.0, 3.0])
        joints = [
            rc.Revolute.between(model, None, 0, point=0.1 + 0.7 * k * axis, axis=axis, q=q)
            for k in range(hinges)
        ]
        found = rc.mobility(model.with_constraints(*joints), q)
        assert (found.freedoms, len(found.redundant)) == (1, 5 * (hinges - 1))
        state = jax.tree.map(lambda x: x.astype(dtype), model.default_state())
        closed = rc.assemble(model.with_constraints(*joints), state.replace(q=q + 0.01))
        assert closed.success


def test_mobility_of_nothing() -> None:
    model = rb.load("free_body")
    assert rc.mobility(model, model.default_state().q)[:2] == (6, 0)
