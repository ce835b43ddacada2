"""`fit` against motions whose numbers are known: exact, noisy, and impossible ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Unknown, fit
from tests.compilations import compilations

MODEL = rb.load("double_pendulum")
START = rb.State(jnp.array([0.4, -0.3]), jnp.zeros(2))
STEPS, SAVE = 150, 3
PUSH = jnp.asarray(np.random.default_rng(0).normal(size=(STEPS, MODEL.nu)))
UNKNOWNS = {
    "mass": Unknown("bodies.mass", 1, positive=True),
    "centre": Unknown("bodies.com", (1, 2)),
    "damping": Unknown("joints.damping", 0, positive=True),
}
TRUTH = {"mass": 1.7, "centre": -0.31, "damping": 0.35}


def changed(numbers: dict[str, float]) -> rb.Model:
    bodies, joints = MODEL.bodies, MODEL.joints
    return MODEL.replace(
        bodies=bodies.replace(
            mass=bodies.mass.at[1].set(numbers["mass"]),
            com=bodies.com.at[1, 2].set(numbers["centre"]),
        ),
        joints=joints.replace(damping=joints.damping.at[0].set(numbers["damping"])),
    )


@pytest.fixture(scope="module")
def seen() -> jax.Array:
    return rb.rollout(changed(TRUTH), START, PUSH, 0.01, save_every=SAVE).q


def run(measured, state=START, ctrls=PUSH, **options):
    guess = changed({"mass": 1.0, "centre": -0.25, "damping": 0.1})
    return fit(guess, state, ctrls, measured, UNKNOWNS, dt=0.01, save_every=SAVE, **options)


def test_exact_motion_gives_the_numbers_back(seen):
    found = run(seen)
    assert found.ok and found.rms < 1e-9
    for name, value in TRUTH.items():
        assert abs(found.values[name] / value - 1) < 1e-6, name
    np.testing.assert_allclose(found.model.bodies.mass[1], TRUTH["mass"], rtol=1e-6)
    np.testing.assert_allclose(found.model.bodies.com[1, 2], TRUTH["centre"], rtol=1e-6)


def test_standard_errors_are_the_scatter(seen):
    """Over 40 measurements with noise, estimates scatter as the standard errors say."""
    rng = np.random.default_rng(1)
    scores = []
    for _ in range(40):
        found = run(seen + 1e-3 * rng.normal(size=seen.shape))
        assert found.ok and abs(found.rms / 1e-3 - 1) < 0.3
        scores.append([(found.values[n] - TRUTH[n]) / found.errors[n] for n in TRUTH])
    spread = np.sqrt(np.mean(np.square(scores), 0))
    # the root mean square of 40 standard normal numbers: 1 within 0.34 in 99.8 % of cases
    assert (abs(spread - 1) < 0.34).all(), spread


def test_another_measurement_compiles_nothing(seen):
    run(seen)
    other = seen * 1.001
    with compilations() as compiled:
        run(other)
    assert not compiled


@pytest.mark.slow
def test_too_few_steps_are_said(seen):
    assert not run(seen, max_steps=1).ok


def test_what_is_wrong_is_said(seen):
    with pytest.raises(rb.InputError, match=r"measured has shape \(10, 2\), expected \(51, 2\)"):
        run(seen[:10])
    with pytest.raises(rb.UnknownName, match=r"bodies\.weight"):
        fit(MODEL, START, PUSH, seen, {"x": Unknown("bodies.weight", 0)}, save_every=SAVE)
    heavy = {"x": Unknown("bodies.com", (1, 2), positive=True)}
    with pytest.raises(rb.InputError, match="positive first guess"):
        fit(changed(TRUTH), START, PUSH, seen, heavy, save_every=SAVE)


BEND = {"damping": UNKNOWNS["damping"]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"measured": np.full((51, 2), np.nan)}, r"measured\[0, 0\] is nan, expected finite"),
        ({"measured": np.zeros((51, 2), complex)}, "measured has dtype complex128"),
        ({"ctrls": None}, "ctrls is NoneType, expected an array"),
        ({"ctrls": np.ones((150, 3))}, r"ctrls has shape \(150, 3\), expected \(150, 0\): one row"),
        ({"unknowns": {}}, "no unknowns, expected e"),
        ({"unknowns": {"m": Unknown("bodies.mass", 7)}}, r"bodies.mass has shape \(2,\) and no"),
        ({"unknowns": {"m": Unknown("bodies.com", 0)}}, ".* at index 0, expected"),
        ({"save_every": 0}, "save_every = 0, expected a whole number of at least 1"),
        ({"max_steps": 0}, "max_steps = 0, expected a whole number of at least 1"),
        ({"dt": -0.01}, "dt is -0.01, expected a positive step"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    given = {
        "ctrls": PUSH, "measured": np.zeros((51, 2)), "unknowns": BEND, "save_every": SAVE
    } | arguments  # fmt: skip
    with pytest.raises(rb.InputError, match=f"fit: {message}"):
        fit(changed(TRUTH), START, **given)


def test_data_in_single_precision_are_fitted_in_double(seen):
    def short(x):
        return jnp.asarray(x, jnp.float32)

    found = run(short(seen), state=jax.tree.map(short, START), ctrls=short(PUSH))
    assert found.ok
    for name, value in TRUTH.items():
        assert abs(found.values[name] / value - 1) < 1e-4, name
