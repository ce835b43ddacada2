"""Mechanisms of the tests, built from bodies and loop joints as a user would."""

import jax.numpy as jnp

import rbjax as rb
from rbjax import constraints as rc

#: a rod of 1 m and 1 kg along x of its body, thin
ROD = '<inertial pos="0.5 0 0" mass="1" diaginertia="1e-9 {i} {i}"/>'.format(i=1 / 12)


def pendulum() -> rb.Model:
    """IFToMM A01: a bob of 1 kg in x and z, on a rod of 1 m from the origin."""
    model = rb.load("""<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="bob">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>""")
    ends = rc.Place.on(), rc.Place.on(body="bob")
    return model.with_constraints(rc.Distance(*ends, jnp.array(1.0)))


def four_bars(n: int, joint: type = rc.Spherical) -> tuple[rb.Model, rb.State]:
    """IFToMM A02: n + 1 upright rods on the ground, 1 m apart, n rods across their tips; upright,
    with 1 rad/s. Rod and coupler k are a chain, closed to rod k + 1 by a joint."""
    upright = 'xyaxes="0 0 1 0 1 0"'  # the rod's x is up, its y axis that of the hinge
    bodies = ""
    for k in range(n + 1):
        across = (
            f'<body name="coupler{k}" pos="1 0 0" xyaxes="0 0 -1 0 1 0">'
            f'<joint axis="0 1 0"/>{ROD}</body>'
        )
        bodies += (
            f'<body name="rod{k}" pos="{k} 0 0" {upright}><joint name="rod{k}" axis="0 1 0"/>'
            f"{ROD}{across if k < n else ''}</body>"
        )
    model = rb.load(
        f'<mujoco><option gravity="0 0 -9.81"/><worldbody>{bodies}</worldbody></mujoco>'
    )
    loops = [
        joint.between(model, f"coupler{k}", f"rod{k + 1}", point=[k + 1, 0, 1], axis=[0, 1, 0])
        for k in range(n)
    ]
    v = [x for k in range(n + 1) for x in ([1.0, -1.0] if k < n else [1.0])]
    start = model.default_state().replace(v=jnp.array(v))
    return model.with_constraints(*loops), start
