"""A solver's arguments are checked at construction; its claimed order is measured."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.solvers import (
    Adams,
    adams_bashforth,
    adams_moulton,
    bdf,
    gauss_legendre,
    generalized_alpha,
    hht_alpha,
    lobatto_iiia,
    lobatto_iiic,
    newmark,
    pece,
    radau_iia,
    rkmk,
)
from tests.solvers.scenes import SCENES, flat, solve


@pytest.mark.parametrize(
    ("make", "refused", "taken", "message"),
    [
        (adams_bashforth, (0, 6, 2.5, "2", True), (1, 5), r"Adams-Bashforth: .*from 1 to 5"),
        (adams_moulton, (1, 6, 7, 3.0), (2, 5), r"Adams-Moulton: .*from 2 to 5"),
        (pece, (1, 6), (2, 5), r"PECE: .*from 2 to 5"),
        (lambda how: Adams(3, how), ("typo",), ("none", "once"), r"'typo', expected 'none', 'on"),
        (bdf, (0, 7, 2.0), (1, 6), r"BDF: .*from 1 to 6"),
        (rkmk, (1, 6, 4.0), (2, 5), r"rkmk: .*from 2 to 5"),
        (gauss_legendre, (0, 10, 1.5), (1, 9), r"gauss_legendre: .*from 1 to 9"),
        (radau_iia, (0, 10), (1, 9), r"radau_iia: .*from 1 to 9"),
        (lobatto_iiia, (1, 10), (2, 9), r"lobatto_iiia: .*from 2 to 9"),
        (lobatto_iiic, (1, 10), (2, 9), r"lobatto_iiic: .*from 2 to 9"),
        (generalized_alpha, (-0.1, 1.1, jnp.nan), (0, 1.0), r"rho_inf is .* from 0 to 1"),
        (hht_alpha, (-0.4, 0.3), (-1 / 3, 0.0), r"alpha is .* from -0.33"),
        (newmark, (-1.0,), (0.0, 1 / 4), r"beta is -1.0, expected .* of at least 0"),
        (lambda gamma: newmark(0.25, gamma), (0.4,), (0.5, 0.6), r"gamma is .* of at least 0.5"),
    ],
)
def test_ranges(make, refused, taken, message: str) -> None:
    for value in refused:
        with pytest.raises(rb.InputError, match=message):
            make(value)
    for value in taken:
        make(value)


@pytest.mark.parametrize(
    ("solver", "order"),
    [(newmark(), 2), (newmark(0.3025, 0.6), 1), (hht_alpha(-0.2), 2), (hht_alpha(-1 / 3), 2),
     (generalized_alpha(0.3), 2), (generalized_alpha(jnp.float32(0.7)), 2)],
)  # fmt: skip
def test_the_family_knows_its_order(solver, order: int) -> None:
    assert solver.order(None) == order


@pytest.mark.slow
def test_a_traced_member_of_the_family() -> None:
    """Its numbers may be differentiated and batched over; its order is what is certain."""
    scene = SCENES["second-order"]

    @jax.jit
    @jax.vmap
    def end(rho):
        solver = generalized_alpha(rho)
        assert solver.order(None) == 1
        found = solve(scene.term, solver, scene.y0, scene.args, scene.end, 4, max_steps=4)
        return flat(found.ys)

    got = end(jnp.array([0.2, 0.9]))
    assert abs(got[0] - got[1]).max() > 1e-3


@pytest.mark.slow
def test_newmark_with_damping_is_of_order_one() -> None:
    scene = SCENES["second-order"]

    @jax.jit
    def end(steps):
        solver = newmark(0.3025, 0.6)
        return flat(solve(scene.term, solver, scene.y0, scene.args, scene.end, steps,
                          max_steps=None).ys)  # fmt: skip

    found = [abs(np.asarray(end(n)) - scene.exact).max() for n in (128.0, 256.0, 512.0)]
    np.testing.assert_allclose(np.log2(np.divide(found[:-1], found[1:])), 1, atol=0.1)


@pytest.mark.parametrize("name", ["newmark", "stoermer_verlet", "variational_midpoint"])
def test_a_dict_is_no_pair(name: str) -> None:
    """Its keys are in alphabetical order: omega would be the position."""
    term = diffrax.ODETerm(lambda t, y, _: {"theta": y["omega"], "omega": -y["theta"]})
    y0 = {"theta": jnp.array(1.0), "omega": jnp.array(0.0)}
    with pytest.raises(rb.InputError, match=r"dict.*'omega', 'theta'.*expected a tuple \(q, v\)"):
        diffrax.diffeqsolve(term, rb.solvers.all()[name].make(), 0.0, 1.0, 0.1, y0)


def test_a_pair_has_two_parts() -> None:
    term = diffrax.ODETerm(lambda t, y, _: (y[1], -y[0], y[2]))
    y0 = tuple(jnp.ones(3))
    with pytest.raises(rb.InputError, match=r"3 parts, expected a tuple \(q, v\)"):
        diffrax.diffeqsolve(term, newmark(), 0.0, 1.0, 0.1, y0)


def test_a_pair_with_a_part_of_nothing() -> None:
    """An empty array among others is accepted."""
    none = jnp.zeros(0)
    term = diffrax.ODETerm(lambda t, y, _: (y[1], jax.tree.map(lambda q: -q, y[0])))
    got = diffrax.diffeqsolve(
        term, newmark(), 0.0, 1.0, 0.01, ((jnp.array(1.0), none), (jnp.array(0.0), none))
    ).ys
    np.testing.assert_allclose(got[0][0][0], np.cos(1.0), atol=1e-5)
    assert got[0][1].shape == (1, 0)


@pytest.mark.parametrize(
    ("inertia", "message"),
    [(np.eye(3), r"shape \(3, 3\), expected \(3,\).*principal"),
     (2.0, r"shape \(\), expected \(3,\)"),
     ([1.0, -1.0, 2.0], r"\[ 1. -1.  2.\], expected positive"),
     ([1.0, 0.0, 2.0], "expected positive"), ([1.0, np.nan, 2.0], "expected positive")],
)  # fmt: skip
def test_moments_of_inertia(inertia, message: str) -> None:
    with pytest.raises(rb.InputError, match=message):
        rb.solvers.RigidBody(inertia)


def test_traced_moments_of_inertia() -> None:
    total = jax.jit(jax.vmap(lambda j: rb.solvers.RigidBody(j).inertia.sum()))
    np.testing.assert_allclose(total(jnp.ones((2, 3))), 3.0)
