"""Bad arguments of regressors, filters, motions and designs: an error of rbjax each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid as y

nan = float("nan")
m = rb.load("double_pendulum")
q, T = np.zeros((5, 2)), np.arange(5.0)
S = y.design.Fourier.random(jax.random.key(0), jnp.zeros(1), 2, period=6.0)


def I(q, v, a):  # noqa: E743
    return jnp.concatenate([q, a], 1)


CALLS = {
    "regressor model": lambda: y.torque.regressor(5, q[0], q[0], q[0]),
    "regressor q": lambda: y.torque.regressor(m, "x", q[0], q[0]),
    "regressor q nan": lambda: y.torque.regressor(m, q[0] * nan, q[0], q[0]),
    "regressor shape": lambda: y.torque.regressor(m, q, q, q),
    "regressor v": lambda: y.torque.regressor(m, q[0], None, q[0]),
    "regressor tau": lambda: y.torque.regressor(
        m, q[0], q[0], q[0], joint_terms=["gear_loss"], tau=np.ones(5)
    ),
    "regressor tau2": lambda: y.torque.regressor(
        m, q[0], q[0], q[0], joint_terms=["gear_loss"], tau="x"
    ),
    "regressor terms": lambda: y.torque.regressor(m, q[0], q[0], q[0], joint_terms=[5]),
    "regressor terms2": lambda: y.torque.regressor(m, q[0], q[0], q[0], joint_terms=[[]]),
    "regressor smoothing": lambda: y.torque.regressor(m, q[0], q[0], q[0], smoothing="x"),
    "regressor smoothing True": lambda: y.torque.regressor(m, q[0], q[0], q[0], smoothing=True),
    "om rows": lambda: y.torque.observation_matrix(m, q, q, q, rows=5),
    "om rows2": lambda: y.torque.observation_matrix(m, q, q, q, rows=["x"]),
    "om rows3": lambda: y.torque.observation_matrix(m, q, q, q, rows=[9]),
    "om rows4": lambda: y.torque.observation_matrix(m, q, q, q, rows=[]),
    "om n": lambda: y.torque.observation_matrix(m, q, q[:3], q),
    "om none": lambda: y.torque.observation_matrix(m, None, q, q),
    "om true": lambda: y.torque.observation_matrix(m, q, q, q, rows=[True]),
    "names": lambda: y.torque.parameter_names(5),
    "names t": lambda: y.torque.parameter_names(m, "viscous"),
    "values": lambda: y.torque.parameter_values(None),
    "values t": lambda: y.torque.parameter_values(m, ["x"]),
    "lp": lambda: y.data.low_pass("x", q, 1.0),
    "lp c": lambda: y.data.low_pass(np.arange(50.0), np.arange(50.0), "x"),
    "lp c2": lambda: y.data.low_pass(np.arange(50.0), np.arange(50.0), None),
    "lp c3": lambda: y.data.low_pass(np.arange(50.0), np.arange(50.0), nan),
    "lp none": lambda: y.data.low_pass(None, None, 1.0),
    "lp ord": lambda: y.data.low_pass(np.arange(50.0), np.arange(50.0), 0.1, order=0),
    "fourier": lambda: y.design.Fourier(
        jnp.zeros(1), jnp.ones((1, 1)), jnp.zeros((1, 1)), period="x"
    ),
    "fourier 0": lambda: y.design.Fourier(
        jnp.zeros(1), jnp.ones((1, 1)), jnp.zeros((1, 1)), period=0
    ),
    "fourier none": lambda: y.design.Fourier(None, jnp.ones((1, 1)), jnp.zeros((1, 1)), period=1.0),
    "fourier str": lambda: y.design.Fourier("x", "y", "z", period=1.0),
    "fourier nan": lambda: y.design.Fourier(
        jnp.zeros(1) * nan, jnp.ones((1, 1)), jnp.zeros((1, 1)), period=1.0
    ),
    "fr key": lambda: y.design.Fourier.random(5, jnp.zeros(1), 2, 1.0),
    "fr h": lambda: y.design.Fourier.random(jax.random.key(0), jnp.zeros(1), 0, 1.0),
    "fr h2": lambda: y.design.Fourier.random(jax.random.key(0), jnp.zeros(1), 1.5, 1.0),
    "fr q0": lambda: y.design.Fourier.random(jax.random.key(0), "x", 2, 1.0),
    "fr q0 2": lambda: y.design.Fourier.random(jax.random.key(0), 0.0, 2, 1.0),
    "fr speed": lambda: y.design.Fourier.random(jax.random.key(0), jnp.zeros(1), 2, 1.0, speed=nan),
    "fr period": lambda: y.design.Fourier.random(jax.random.key(0), jnp.zeros(1), 2, -1.0),
    "sp": lambda: y.design.Spline(jnp.ones((1, 2)), 1.0),
    "sp2": lambda: y.design.Spline("x", 1.0),
    "sp3": lambda: y.design.Spline(jnp.ones((1, 5)), nan),
    "spr": lambda: y.design.Spline.random(jax.random.key(0), jnp.zeros(1), 2, 1.0),
    "spr2": lambda: y.design.Spline.random(jax.random.key(0), jnp.zeros(1), 1.5, 1.0),
    "spr3": lambda: y.design.Spline.random(jax.random.key(0), jnp.zeros(1), 5, 1.0, size="x"),
    "ml": lambda: y.design.MotionLimits(low=1.0),
    "ml2": lambda: y.design.MotionLimits(speed="x"),
    "ml3": lambda: y.design.MotionLimits(speed=nan),
    "ml4": lambda: y.design.MotionLimits(low=1.0, high=0.0),
    "ml5": lambda: y.design.MotionLimits(low="a", high="b"),
    "ml6": lambda: y.design.MotionLimits(torque=1.0, model=5),
    "ml7": lambda: y.design.MotionLimits(own=5),
    "design start": lambda: y.design.design_experiment(5, I),
    "design info": lambda: y.design.design_experiment(S, 5),
    "design info none": lambda: y.design.design_experiment(S, lambda q, v, a: None),
    "design limits": lambda: y.design.design_experiment(S, I, 5),
    "design crit": lambda: y.design.design_experiment(S, I, criterion="X"),
    "design samples": lambda: y.design.design_experiment(S, I, samples=0),
    "design rounds": lambda: y.design.design_experiment(S, I, rounds=1.5),
    "design steps": lambda: y.design.design_experiment(S, I, steps="x"),
    "design known": lambda: y.design.design_experiment(S, I, known=np.ones(3)),
    "design known nan": lambda: y.design.design_experiment(S, I, known=np.full((2, 2), nan)),
    "design known str": lambda: y.design.design_experiment(S, I, known="x"),
    "design limits joints": lambda: y.design.design_experiment(
        S, I, y.design.MotionLimits(speed=np.ones(3)), rounds=1, steps=1
    ),
    "in_si": lambda: y.data.in_si("x"),
    "in_si 5": lambda: y.data.in_si(5),
    "in_si list": lambda: y.data.in_si([]),
    "consistent model": lambda: y.torque.consistent(5, q, q),
    "consistent W": lambda: y.torque.consistent(m, "x", q),
    "consistent spread": lambda: y.torque.consistent(
        m, np.ones((9, 2, 20)), np.ones((9, 2)), spread="x"
    ),
    "consistent spread 0": lambda: y.torque.consistent(
        m, np.ones((9, 2, 20)), np.ones((9, 2)), spread=0.0
    ),
    "consistent steps": lambda: y.torque.consistent(
        m, np.ones((9, 2, 20)), np.ones((9, 2)), max_steps=0
    ),
    "consistent terms": lambda: y.torque.consistent(
        m, np.ones((9, 2, 20)), np.ones((9, 2)), joint_terms="viscous"
    ),
    "random_motions n": lambda: y.torque.random_motions(m, 0),
    "random_motions m": lambda: y.torque.random_motions(5, 3),
    "base": lambda: y.torque.base_parameters(5),
    "base terms": lambda: y.torque.base_parameters(m, joint_terms="x"),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_bad_arguments_are_named(call):
    with pytest.raises(rb.RbjaxError) as caught:
        call()
    assert 25 < len(str(caught.value)) < 1200
