"""The legs of a real Go2, and curves found from a simulated joint whose truth is known."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases import go2
from benchmarks.shared.cma_es import cma_es
from rbjax.sysid import Channel, Grid, Recording, Unknown, identify

needs_data = pytest.mark.skipif(
    not go2.DATA.exists(), reason=f"the recording of the Go2 is not there: {go2.DATA}"
)


def mrad(residuals):
    return 1e3 * float(np.sqrt(np.mean(np.square(residuals))))


@pytest.mark.slow
def test_curves_of_a_joint_are_found():
    """Torque and friction by position, from angles without noise: to the last digits."""
    model, T = rb.load("pendulum"), 0.02
    true = {"torque": [[0.3, -0.2, 0.5]], "coulomb": [[0.6, 0.25]]}

    def curved(torque, coulomb):
        curves = rb.forces.JointCurves.of(
            model, model.joint_names, [-2.0, 2.0], torque=jnp.array(torque),
            coulomb=jnp.array(coulomb), smoothing=0.3,
        )  # fmt: skip
        return model.with_forces(curves)

    t = np.arange(61) * T
    push = 12 * np.cos(6 * t[:-1])[:, None]
    truth = curved(**true)
    path = rb.rollout(truth, model.default_state(), push, T, integrator="rk4", kernel=False)
    assert np.ptp(path.q) > 1 and np.abs(path.q).max() < 2 and np.ptp(np.sign(path.v)) == 2
    run = Recording("swing", {
        "q": Channel(t, path.q), "v": Channel(t, path.v), "ctrl": Channel(t[:-1], push),
    })  # fmt: skip
    guess = curved([[0.0, 0.0, 0.0]], [[0.4, 0.0]])
    unknowns = {k: Unknown(f"forces.0.{k}") for k in true}
    found = identify(guess, run, unknowns, grid=Grid(T))
    want = np.concatenate([np.ravel(x) for x in true.values()])
    np.testing.assert_allclose([*found.values.values()], want, atol=1e-7)


def test_the_search_that_it_is_compared_with_searches():
    """CMA-ES on an ellipsoid with axes of 1 to 100, which it must learn."""
    scale = 10 ** np.linspace(0, 2, 6)
    at = np.linspace(-1, 1, 6)
    best, used = cma_es(lambda y: ((scale * (y - at)) ** 2).sum(1), 6, 0.3, 6000, size=16)
    assert used < 6016
    np.testing.assert_allclose(best, at, atol=1e-6)


@needs_data
@pytest.mark.slow
def test_a_real_quadrupeds_legs():
    """Joint dynamics by themselves end on their bounds; friction and torque by position halve the
    error on the half that was held out."""
    model = go2.robot(*go2.LEGS)
    train, test = go2.recording(model), go2.recording(model, go2.HALF, go2.END)
    whole = go2.recording(model, 0, go2.END)
    assert 15.5 < mrad(go2.free_run(go2.nominal(model), whole)) < 16.5  # the source's 16.0
    # as in the source, motions begin at their first sample, and there is one search: these models
    # are compared by what they leave, which is above the noise
    setup, unknowns = go2.joint_dynamics(model)
    usual = identify(
        setup,
        train,
        unknowns,
        grid=go2.GRID,
        max_evaluations=14,
        estimate_initial_state=False,
        restarts=0,
    )
    assert len(usual.values) == 49
    bias = np.array([x for name, x in usual.values.items() if name.startswith("bias")])
    assert (np.abs(bias) > 0.095).sum() >= 5 and usual.values["delay"] < 1e-3
    assert 1e3 * usual.validate([test]).rms > 7
    setup, unknowns = go2.by_position(model)
    found = identify(
        setup,
        train,
        unknowns,
        grid=go2.GRID,
        max_evaluations=14,
        estimate_initial_state=False,
        restarts=0,
    )
    assert mrad(found.rms["q"]) < 1.5
    assert 1e3 * found.validate([test]).rms < 6
    friction = np.asarray(found.model.forces[0].coulomb)
    assert (np.abs(friction[8, 1:]).max() > 0.3) and (friction[:, 0] > 0).all()
