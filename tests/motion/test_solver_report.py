"""Steps whose solver of contacts does not converge are counted and warned about."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact import CoulombContact, SoftContact

#: a plate that moves in a plane, on the floor
PLATE = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.14">
<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
<geom type="box" size="0.1 0.1 0.1" mass="1"/></body></worldbody></mujoco>"""
ONE = SoftContact(iterations=1)
DT, STEPS = 0.002, 12


@pytest.fixture(scope="module")
def model():
    return rb.load(PLATE)


@pytest.fixture(scope="module")
def state(model):
    start = model.default_state()
    return start.replace(q=jnp.array([0.0, -0.037, 0.05]), v=jnp.array([0.3, -1.0, 3.0]))


def capped(model, state, **how):
    with pytest.warns(UserWarning, match="solver of SoftContact did not converge in"):
        return rb.rollout(model, state, None, DT, steps=STEPS, contact=ONE, **how)


def test_a_cap_of_one_iteration_is_reported_and_a_good_run_reports_none(model, state):
    good = rb.rollout(model, state, None, DT, steps=STEPS)
    assert good.unconverged == 0 and 0 < good.worst_error <= 1e-12
    assert good.report.shape == (STEPS + 1, 2) and "converged in all steps" in good.summary()
    bad = capped(model, state, save_every=4)
    assert bad.success and bad.report.shape == (4, 2) and (jnp.diff(bad.report, axis=0) >= 0).all()
    # the steps that `rb.contact.solve` finds unconverged
    each = capped(model, state)
    states = rb.State(each.q[:-1], each.v[:-1])
    found = jax.vmap(lambda s: rb.contact.solve(model, s, contact=ONE))(states)
    assert 0 < bad.unconverged == (~found.success).sum() == each.unconverged
    np.testing.assert_allclose(bad.worst_error, found.error.max(), rtol=1e-6)
    assert f"did not converge in {int(bad.unconverged)} steps" in bad.summary()


def test_batches_loops_over_steps_and_integrators_count_alike(model, state):
    count = capped(model, state).unconverged
    states = jax.tree.map(
        lambda x: jnp.stack([x, x + jnp.array([0.0, 1.0, 0.0]) * (x is state.q)]),
        rb.State(state.q, state.v),
    )  # the second one stays in the air
    with pytest.warns(UserWarning, match="1 of 2 samples, the first of sample 0 before t = "):
        batch = rb.rollout(model, states, None, DT, steps=STEPS, contact=ONE)
    assert batch.unconverged.tolist() == [count, 0]

    def once(s, _):
        return rb.step(model, s, None, DT, contact=ONE), None

    def loop(s):
        return jax.lax.scan(once, s, None, length=STEPS)[0].report

    start = rb.State(state.q, state.v, report=jnp.zeros(2))
    for run in (jax.jit(loop), rb.threads(loop)):
        np.testing.assert_allclose(run(start)[0], count)
    # without a report the structure of the state stays
    assert jax.tree.structure(jax.jit(once)(state, None)[0]) == jax.tree.structure(state)
    rk4 = capped(model, state, integrator="rk4")
    assert STEPS >= rk4.unconverged > 0


def test_a_users_integrator_reports_the_error_at_the_start_of_its_steps(model, state):
    def explicit(field, t, state, inputs, dt):
        a, _ = field.rates(t, state, inputs)
        return rb.State(field.retract(state.q, dt * state.v), state.v + dt * a)

    assert capped(model, state, integrator=explicit).unconverged > 0


def test_an_eager_step_warns_and_returns_the_structure_that_it_was_given(model, state):
    touching = rb.rollout(model, state, None, DT, steps=STEPS // 2).state(-1)
    with pytest.warns(
        UserWarning, match="step: the solver of SoftContact did not converge in 1 step"
    ):
        after = rb.step(model, touching, None, DT, contact=ONE)
    assert after.report is None
    rb.step(model, touching, None, DT)  # without a warning
    with pytest.raises(rb.InputError, match="report has shape"):
        rb.step(model, rb.State(state.q, state.v, report=jnp.zeros(3)), None, DT)


@pytest.mark.filterwarnings("ignore:.*biased at any step size")
def test_gradients_do_not_depend_on_the_report(model, state):
    def end(v, contact=None):
        path = rb.rollout(model, rb.State(state.q, v), None, DT, steps=STEPS, contact=contact)
        return path.q[-1].sum(), path.unconverged

    (rate, count) = jax.jacrev(end, has_aux=True)(state.v)
    assert count == 0 and jnp.isfinite(rate).all()
    report = jax.jacfwd(
        lambda v: rb.rollout(model, rb.State(state.q, v), None, DT, steps=STEPS).report
    )(state.v)
    assert (report == 0).all()


def test_simulate_counts_accepted_steps(model, state):
    ts = jnp.array([0.0, 0.02])
    good = rb.simulate(model, state, ts)
    assert good.unconverged == 0 == good.worst_error
    with pytest.warns(UserWarning, match="simulate: the solver of SoftContact did not converge"):
        bad = rb.simulate(model, state, ts, contact=ONE, dt=0.001)
    assert 0 < bad.unconverged <= bad.stats["num_accepted_steps"] == 20
    assert 1e-12 < bad.worst_error < 10
    # the report does not change the steps
    free = rb.simulate(model.replace(contact=None), state, ts)
    assert free.report is None and free.unconverged == 0


def test_rounds_of_coulomb_and_sweeps_of_moreau_are_reported(model, state):
    sliding = rb.State(jnp.array([0.0, -0.0401, 0.0]), jnp.array([1.0, 0.0, 0.0]))
    with pytest.warns(UserWarning, match="CoulombContact did not converge"):
        bad = rb.rollout(model, sliding, None, DT, steps=5, contact=CoulombContact(rounds=1))
    good = rb.rollout(model, sliding, None, DT, steps=5, contact="coulomb")
    assert bad.unconverged > 0 == good.unconverged and good.worst_error < 1e-11
    few = rb.contact.MoreauContact.of(model, sweeps=1)
    with pytest.warns(UserWarning, match="MoreauContact did not converge"):
        bad = rb.rollout(model, state, None, DT, steps=STEPS, contact=few)
    good = rb.rollout(model, state, None, DT, steps=STEPS, contact="impulse")
    assert bad.unconverged > 0 == good.unconverged


def test_no_warning_inside_jit(model, state):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = jax.jit(lambda s: rb.rollout(model, s, None, DT, steps=STEPS, contact=ONE))(state)
    assert path.unconverged > 0
