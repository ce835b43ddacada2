"""Warnings of derivatives through impacts, where they are biased and where not."""

import warnings

import jax
import jax.numpy as jnp
import pytest

import rbjax as rb
from rbjax.contact.impact_bias import RAMP, jumps_at_touch, warn_of_impacts
from rbjax.contact.registry import laws

TEXT = """<mujoco><worldbody><geom type="plane" size="0 0 1" {0}/><body pos="0 0 0.15">
<joint type="slide" axis="0 0 1"/><geom size="0.1" mass="1" {0}/></body></worldbody></mujoco>"""
DT = 2e-3
ONE = jnp.ones(1)


def load(options=""):
    return rb.load(TEXT.format(options))


def height_of_rollout(model, steps=5, **how):
    return lambda v: rb.rollout(model, rb.State(0 * v, v), None, DT, steps=steps, **how).q[-1, 0]


def height_of_steps(model, **how):
    def end(v):
        step = lambda i, s: rb.step(model, s, dt=DT, **how)  # noqa: E731
        return jax.lax.fori_loop(0, 3, step, rb.State(0 * v, v)).q[0]

    return end


def height_of_simulate(model, **how):
    ts = jnp.array([0.0, 0.01])
    return lambda v: rb.simulate(model, rb.State(0 * v, v), ts, dt=DT, **how).q[-1, 0]


MOTIONS = {"rollout": height_of_rollout, "step": height_of_steps, "simulate": height_of_simulate}


def test_arrays_are_unchanged_and_only_their_derivatives_warn():
    model = load()
    law = laws()["mujoco"](model)
    both = lambda x, y: warn_of_impacts("f", model, law, x, y, advice=", or g")  # noqa: E731
    assert both(1.0, 2.0) == (1.0, 2.0)
    x, y = jax.vmap(both, (0, 1))(jnp.eye(2), jnp.arange(4.0).reshape(2, 2))
    assert (x == jnp.eye(2)).all() and (y == jnp.arange(4.0).reshape(2, 2).T).all()
    with pytest.warns(UserWarning, match="f: a derivative .* filter this warning, or g$"):
        slope = jax.grad(lambda x: x * both(x, 2.0)[0] + both(3.0, x)[1])(2.0)
    assert slope == 5.0
    assert jax.grad(lambda x: x * both(jax.lax.stop_gradient(x), 1.0)[0])(2.0) == 2.0


@pytest.mark.parametrize("where", MOTIONS)
def test_derivatives_of_motions_warn(where):
    """Reverse and forward mode, under jit, vmap and threads; values and rules that are known to be
    right do not warn."""
    model = load()
    f = MOTIONS[where](model)
    jax.make_jaxpr(f)(ONE)
    modes = [jax.grad(f), jax.grad(jax.jit(f))]
    if where != "simulate":  # its default adjoint is for reverse mode
        modes += [lambda v: jax.jvp(f, (v,), (v,)), lambda v: jax.vmap(jax.grad(f))(v[None])]
    if where == "step":
        modes.append(jax.grad(rb.threads(f)))
    for slope in modes:
        with pytest.warns(UserWarning, match=f"^{where}: a derivative .* biased at any step size"):
            jax.make_jaxpr(slope)(ONE)
    jax.make_jaxpr(jax.grad(MOTIONS[where](load(f'solimp="{RAMP}"'))))(ONE)
    jax.make_jaxpr(jax.grad(MOTIONS[where](model.replace(contact=None))))(ONE)
    if where == "rollout":
        with pytest.warns(UserWarning, match="of a motion with CoulombContact"):
            jax.make_jaxpr(jax.grad(height_of_rollout(model, contact="coulomb")))(ONE)
        jax.make_jaxpr(jax.grad(height_of_rollout(model, contact="impulse")))(ONE)


def test_derivatives_of_one_step_do_not_warn():
    """Of one step by its forces, of a linearisation, and of a rollout of one step."""
    model = load()
    state = model.default_state()
    jax.make_jaxpr(jax.grad(lambda tau: rb.step(model, state, tau=tau, dt=DT).v[0]))(ONE)
    jax.make_jaxpr(lambda v: tuple(rb.linearise(model, rb.State(state.q, v), dt=DT)))(ONE)
    jax.make_jaxpr(jax.grad(height_of_rollout(model, steps=1)))(ONE)
    with pytest.warns(UserWarning, match="take rb.linearise if the motion is one step"):
        jax.make_jaxpr(jax.grad(lambda v: rb.step(model, rb.State(0 * v, v), dt=DT).v[0]))(ONE)


def test_derivatives_by_parameters_warn_if_the_impedance_is_known():
    model = load()

    def end(field, changed):
        geoms = model.geoms.replace(**{field: changed})
        return height_of_rollout(model.replace(geoms=geoms))(-ONE)

    for field in ("friction", "solimp"):
        at = jnp.asarray(getattr(model.geoms, field))
        with pytest.warns(UserWarning, match="biased at any step size"):
            jax.grad(lambda x, field=field: end(field, x))(at)
    jax.make_jaxpr(jax.grad(lambda x: end("solimp", x)))(model.geoms.solimp)  # unknown in a jit


@pytest.mark.parametrize(
    ("options", "jumps"),
    [
        ("", True),
        (f'solimp="{RAMP}"', False),
        ('solimp="0 0.95 0.001 0.5 2"', False),
        ('solimp="0.01 0.95 0.001 0.5 2"', True),
        ('solimp="0.0001 0.95 0 0.5 2"', True),  # a width of zero: the mean of both impedances
        ('solref="-1000 0"', False),  # no damper
        ('solref="-1000 -10"', True),
    ],
)
def test_which_contacts_jump_at_touch(options, jumps):
    model = load(options)
    for name, law in laws().items():
        assert jumps_at_touch(model, law(model)) == (jumps and name != "impulse")
    assert not jumps_at_touch(model.replace(geoms=None), laws()["mujoco"](model))


def test_each_message_is_shown_once():
    """Python shows one message of a place once; a compiled program is not traced again."""
    slope = jax.jit(jax.grad(height_of_steps(load())))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("default")
        jax.make_jaxpr(slope)(ONE), jax.make_jaxpr(slope)(ONE[0] * ONE)
    assert len(found) == 1
