"""The references of the scenes, and solvers whose outcome on them is known."""

import dataclasses
import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rbjax as rb
from rbjax.stability import Arm, Outcome, Top, Truth, attempt, scenes, truth
from rbjax.stability.runs.scenes import SAMPLES, spherical, tumbling

SOLVERS = rb.solvers.all()
SCENES = scenes()


# ------------------------------------------------------------------------------------ the truths


@functools.cache
def robots_acceleration():
    """(model, state) -> v', of the algorithms under test everywhere else."""

    def run(model, state):
        tau = rb.applied_forces(model, state, jnp.zeros(2))
        return rb.forward_dynamics(model, state.q, state.v, tau)

    return jax.jit(run)


@pytest.mark.parametrize("name", [n for n, s in SCENES.items() if isinstance(s.system, Arm)])
def test_the_equations_by_hand_are_the_robots(name: str) -> None:
    """Lagrange's equations in relative angles, here in NumPy, and the articulated-body algorithm,
    which are what the truth in absolute angles and what the solvers see."""
    arm = SCENES[name].system
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, v = rng.normal(size=2) / 2 + 0.7, rng.normal(size=2)
        got = np.asarray(robots_acceleration()(arm.model(), rb.State(jnp.array(q), jnp.array(v))))
        want = relative(arm, q, v)
        np.testing.assert_allclose(got, want, rtol=2e-9 if name == "mass_ratio" else 1e-11)
        if arm.gimbal:
            s, c = np.sin(q[1]), np.cos(q[1])
            at, to = np.array([s * np.cos(q[0]), s * np.sin(q[0]), -c]), np.zeros(3)
            rates = v[0], v[1]
            to = np.array([-s * np.sin(q[0]), s * np.cos(q[0]), 0]) * rates[0] + rates[1] * (
                np.array([c * np.cos(q[0]), c * np.sin(q[0]), s])
            )
            bent = np.asarray(spherical(0.0, (at, to), None)[1])
            along = np.array([c * np.cos(q[0]), c * np.sin(q[0]), s])
            # the polar angle's acceleration, from the bob's along the meridian
            assert along @ bent == pytest.approx(want[1] - s * c * v[0] ** 2, rel=1e-12)


def relative(arm: Arm, q, v) -> np.ndarray:
    """v' in the joints' own angles, from M v' + c = f."""
    (m1, m2), (c1, c2), (i1, i2) = arm.mass, arm.com, arm.about_com
    g = 9.81
    tau = -(np.array(arm.stiffness) + arm.kp) * q - (np.array(arm.damping) + arm.kv) * v
    if arm.gimbal:
        b = i2 + m2 * c2**2
        s, c = np.sin(q[1]), np.cos(q[1])
        mass = np.diag([b * s * s, b])
        bias = np.array([2 * b * s * c * v[0] * v[1], -b * s * c * v[0] ** 2 + m2 * g * c2 * s])
        return np.linalg.solve(mass, tau - bias)
    cross = m2 * c2
    far = i2 + m2 * c2**2
    near = i1 + m1 * c1**2 + m2
    c, s = cross * np.cos(q[1]), cross * np.sin(q[1])
    mass = np.array([[near + far + 2 * c, far + c], [far + c, far]])
    bias = np.array([-s * (2 * v[0] * v[1] + v[1] ** 2), s * v[0] ** 2])
    weight = m2 * g * c2 * np.sin(q.sum())
    bias += np.array([(m1 * c1 + m2) * g * np.sin(q[0]) + weight, weight])
    return np.linalg.solve(mass, tau - bias)


def test_a_truth_is_scipys() -> None:
    scene = SCENES["spring_1e4"]

    def rate(t, y):
        return np.concatenate([y[2:], relative(scene.system, y[:2], y[2:])])

    exact = solve_ivp(rate, (0.0, scene.ts[-1]), np.concatenate(scene.start), method="DOP853",
                      rtol=3e-14, atol=1e-14, t_eval=scene.ts)  # fmt: skip
    found = truth(scene)
    assert np.abs(exact.y[:2].T - found.observed).max() < 1e-10
    assert found.error < 1e-10


def test_a_body_is_the_term_of_rigid_bodies() -> None:
    rng = np.random.default_rng(0)
    body = Top((1.0, 2.0, 3.5), 1.3)
    turn, w = rng.normal(size=4), rng.normal(size=3)
    rate, fast = jax.jit(tumbling)(0.0, (turn, w), (np.array(body.inertia), 1.3))
    spin, want = body.term().vf(0.0, (turn, w), 1.3)
    np.testing.assert_allclose(fast, want, rtol=1e-13)
    # energy stays along the one, and the length along the other
    R = rb.rotations.quaternion.to_matrix(turn)
    power = (np.array(body.inertia) * w) @ np.asarray(fast)
    power += 1.3 * (np.asarray(R) @ np.cross(w, [0.0, 0.0, 1.0]))[2]
    assert abs(power) < 1e-12
    assert abs(turn @ np.asarray(rate)) < 1e-14
    np.testing.assert_array_equal(spin, w)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, s in SCENES.items() if not (s.single or s.adaptive)])
def test_the_truth_is_good(name: str) -> None:
    """Two orders below what the best solver reaches in docs/benchmarks/figures/failure_map.png."""
    scene = SCENES[name]
    found = truth(scene)
    assert np.isfinite(found.observed).all()
    limit = {"fast_top": 1e-8, "dzhanibekov": 1e-8}
    assert found.error < limit.get(name, 1e-10)


# ------------------------------------------------------------------------------------ the solvers


@functools.cache
def solver(name: str) -> diffrax.AbstractSolver:
    return SOLVERS[name].make()


NOTHING = Truth(np.zeros((SAMPLES + 1, 2)), 0.0)  # where the way of failing alone is asked for


@functools.cache
def rigid_limit() -> Truth:
    """A rigid spring: only the second link swings, a rod of 1 m."""
    ts = SCENES["spring_1e9"].ts
    swing = solve_ivp(lambda t, y: [y[1], -1.5 * 9.81 * np.sin(y[0])], (0.0, ts[-1]), [1.0, 0.0],
                      method="DOP853", rtol=1e-13, atol=1e-13, t_eval=ts)  # fmt: skip
    return Truth(np.stack([0 * ts, swing.y[0]], 1), 1e-7)


@pytest.mark.parametrize(
    ("name", "scene", "outcome"),
    [
        ("euler", "spring_1e2", Outcome.DRIFTS),
        ("euler", "spring_1e9", Outcome.BLOWS_UP),
        ("euler", "damping", Outcome.BLOWS_UP),
        ("symplectic_euler", "spring_1e2", Outcome.HOLDS),
        ("symplectic_euler", "spring_1e9", Outcome.BLOWS_UP),
        ("symplectic_euler", "damping", Outcome.BLOWS_UP),
        ("radau_iia2", "spring_1e2", Outcome.HOLDS),
        ("radau_iia2", "spring_1e9", Outcome.HOLDS),
        ("radau_iia2", "damping", Outcome.HOLDS),
    ],
)
def test_known_outcomes(name: str, scene: str, outcome: Outcome) -> None:
    true = rigid_limit() if scene == "spring_1e9" else known_truth(scene)
    found = attempt(solver(name), SCENES[scene], true)
    assert found is not None and found.outcome is outcome, found
    if outcome is Outcome.HOLDS:
        assert found.value < {"spring_1e9": 1e-7, "damping": 1e-6}.get(scene, 1e-2)
    if outcome is Outcome.DRIFTS:
        assert found.what == "energy" and found.value > 0


@functools.cache
def known_truth(name: str) -> Truth:
    return truth(SCENES[name])


@pytest.mark.slow
def test_the_limit_of_verlet_is_two_over_omega() -> None:
    """h omega below and above 2, omega^2 = k / (a - c^2 / b), the stretched arm's."""
    scene = SCENES["spring_1e6"]
    omega = np.sqrt(1e6 / (4 / 3 - 0.25 / (1 / 3)))
    for share, outcome in ((0.9, Outcome.HOLDS), (1.1, Outcome.BLOWS_UP)):
        one = dataclasses.replace(scene, dt=share * 2 / omega, start=((0.0, 0.1), (0.0, 0.0)))
        found = attempt(solver("stoermer_verlet"), one, known_limit(one.ts))
        assert found is not None and found.outcome is outcome, (share, found)


def known_limit(ts: np.ndarray) -> Truth:
    swing = solve_ivp(lambda t, y: [y[1], -1.5 * 9.81 * np.sin(y[0])], (0.0, ts[-1]), [0.1, 0.0],
                      rtol=1e-10, atol=1e-10, t_eval=ts)  # fmt: skip
    return Truth(np.stack([0 * ts, swing.y[0]], 1), 1e-5)


def test_on_a_group_and_off_it() -> None:
    """Two steps of order 2 for a body that flips: both err, one leaves the unit sphere."""
    flips = dataclasses.replace(SCENES["dzhanibekov"], dt=0.2, every=25)
    true = Truth(np.tile([1.0, 0, 0, 0], (SAMPLES + 1, 1)), 0.0)
    off, on = (attempt(solver(name), flips, true) for name in ("heun", "rkmk2"))
    assert off is not None and off.outcome is Outcome.OFF_MANIFOLD and off.value > 1e-3
    assert on is not None and on.outcome is not Outcome.OFF_MANIFOLD


def test_what_does_not_apply() -> None:
    assert attempt(solver("rigid_body_splitting"), SCENES["spring_1e2"], NOTHING) is None
    assert attempt("euler", SCENES["spring_adaptive"], NOTHING) is None
    with pytest.raises(rb.InputError, match="class Euler"):
        attempt(diffrax.Euler, SCENES["spring_1e2"], NOTHING)


@pytest.mark.slow
def test_controllers_run_out_of_steps_and_roots_diverge() -> None:
    found = attempt(solver("rk4"), SCENES["spring_adaptive"], rigid_limit())
    assert found is not None and found.outcome is Outcome.OUT_OF_STEPS
    assert 0 < found.value < 1
    found = attempt(solver("radau_iia2"), SCENES["spring_adaptive"], rigid_limit())
    assert found is not None and found.outcome is Outcome.HOLDS and found.value < 1e-5
    # h omega = 1.4, where BDF 4 is unstable: the vibration grows until the roots are not found
    found = attempt(solver("bdf4"), SCENES["spring_1e6"], known_truth("spring_1e6"))
    assert found is not None and found.outcome is Outcome.NO_ROOT
    # single precision against double, in the same steps
    found = attempt(solver("rkmk4"), SCENES["f32"])
    assert found is not None and found.outcome is Outcome.HOLDS and 1e-6 < found.value < 0.1
