"""What rows say of themselves, and the same by differentiation."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.constraints import Row
from rbjax.constraints.equations.model_rows import gradient_matrix, rows_of
from rbjax.forces import Context

T = 0.3


@functools.cache
def tree(floating: bool = True) -> rb.Model:
    """A base with a ball, a slide and a hinge: frames on all kinds of paths."""
    free = "<freejoint/>" if floating else ""
    return rb.load(f"""<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
      <body name="base" pos="0 0 1">{free}<geom size="0.1"/>
        <body name="arm" pos="0.2 0 0"><joint type="ball"/><geom size="0.1"/>
          <body name="hand" pos="0.1 0.1 0"><joint type="slide" axis="1 2 0"/><geom size="0.1"/>
          </body></body>
        <body name="leg" pos="-0.2 0 0"><joint axis="0 1 1"/><geom size="0.1"/></body>
      </body></worldbody></mujoco>""")


def rows_at(model: rb.Model, q, v, t=T, a=None) -> tuple[Context, Sequence[Row]]:
    context = Context.of(model, t, rb.State(q, v), None)
    context = context if a is None else context.accelerating(a)
    return context, rows_of(model, context)


def stacked(lanes) -> jax.Array:
    return jnp.stack([jnp.asarray(x, float) for x in lanes]) if lanes else jnp.zeros(0)


def everything(model: rb.Model) -> dict[str, dict | jax.Array]:
    """Own and wanted: of holonomic rows by the value along a path and by displacements, of others
    by the rate along a path and by velocities; the values at rest."""
    state = model.random_state(jax.random.key(3))
    a = jax.random.normal(jax.random.key(4), (model.nv,))
    context, rows = rows_at(model, state.q, state.v, a=a)
    by_value = np.array([row.holonomic for row in rows])

    def values(q, t=T):
        return stacked([r.value for r in rows_at(model, q, state.v, t)[1] if r.holonomic])

    def rates(q, v, t=T):
        return stacked([r.rate for r in rows_at(model, q, v, t)[1] if not r.holonomic])

    def path(s):
        q = rb.integrate(model, state.q, s * state.v + s * s / 2 * a)
        return values(q, T + s), rates(q, state.v + s * a, T + s)

    along = lambda s: jax.jvp(path, (s,), (1.0,))  # noqa: E731
    ((value, rate), (dg, dy)), (_, (ddg, _)) = jax.jvp(along, (0.0,), (1.0,))
    G = jax.jacfwd(lambda dq: values(rb.integrate(model, state.q, dq)))(jnp.zeros(model.nv))
    Y = jax.jacfwd(lambda v: rates(state.q, v))(state.v)

    def both(of_value, of_rate):
        out = jnp.zeros((len(rows), *of_value.shape[1:]))
        return out.at[by_value].set(of_value).at[~by_value].set(of_rate)

    own = {name: stacked([getattr(r, name) for r in rows]) for name in ("rate", "acceleration")}
    own["value"] = stacked([r.value for r in rows if r.holonomic])
    own["gradient"] = gradient_matrix(context, rows)
    want = dict(value=value, rate=both(dg, rate), acceleration=both(ddg, dy), gradient=both(G, Y))
    return {"own": own, "want": want, "rest": values(model.default_state().q)}


def check(model: rb.Model, atol: float = 2e-14) -> dict:
    """Rows are what differentiation makes of them; what `everything` found."""
    found = jax.jit(lambda: everything(model))()
    for name, want in found["want"].items():
        np.testing.assert_allclose(found["own"][name], want, rtol=0, atol=atol, err_msg=name)
    return found
