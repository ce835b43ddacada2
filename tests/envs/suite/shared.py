"""Checks that hold for every task: physics, gradients, float32, episodes of a controller."""

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb


def placed(env, q, v=None, seed=0, **variables):
    """Return the state of an episode with given coordinates and velocities."""
    _, state = env.reset(jax.random.key(seed))
    q = jnp.asarray(q, float)
    v = jnp.zeros_like(q) if v is None else jnp.asarray(v, float)
    own = state.variables | {k: jnp.asarray(x, float) for k, x in variables.items()}
    return state.replace(state=state.state.replace(q=q, v=v), variables=own)


def quiet(env, **values):
    """Return the parameters without noise, with other values."""
    params = env.default_params
    new = params.values | {k: jnp.asarray(x, float) for k, x in values.items()}
    return params.replace(noise=jnp.zeros(()), values=new)


def check_physics(name, seed=0, tolerance=1e-12):
    """A control step is `decimation` steps of `rb.rollout` with the controls of the action."""
    env = rb.envs.make(name, randomise=False)
    _, state = env.reset(jax.random.key(seed))
    model, task = env.task.model, env.task
    low, high = np.asarray(model.actuators.ctrlrange, float).T
    action = np.random.default_rng(seed).uniform(-1.2, 1.2, env.action_size)
    ctrl = (low + high) / 2 + (high - low) / 2 * np.clip(action, -1, 1)
    _, after, _, _, info = env.step_once(jax.random.key(1), state, jnp.asarray(action))
    path = rb.rollout(
        model, state.state, jnp.tile(ctrl, (task.decimation, 1)), env.dt / task.decimation
    )
    np.testing.assert_allclose(after.state.q, path.q[-1], atol=tolerance)
    np.testing.assert_allclose(after.state.v, path.v[-1], atol=tolerance)
    assert int(info["length"]) == 1
    return env


def returns(env, state, params):
    """Return the function of actions (T, na) that computes the sum of the rewards."""

    def of(actions):
        def one(state, action):
            _, state, reward, _, _ = env.step_once(jax.random.key(0), state, action, params)
            return state, reward

        return jax.lax.scan(one, state, actions)[1].sum()

    return of


def check_gradient(env, state, steps=5, seed=0, tolerance=1e-6):
    """The gradient of a short return is that of central differences, in three directions."""
    of = jax.jit(returns(env, state, quiet(env)))
    rng = np.random.default_rng(seed)
    actions = jnp.asarray(rng.uniform(-0.8, 0.8, (steps, env.action_size)))
    slope = jax.jit(jax.grad(of))(actions)
    assert np.isfinite(slope).all()
    for _ in range(3):
        way = rng.normal(size=actions.shape)
        h = 1e-5
        due = (of(actions + h * way) - of(actions - h * way)) / (2 * h)
        # differences of 1e-5 have an error near 1e-10 relative to second derivatives of order 1
        np.testing.assert_allclose((slope * way).sum(), due, rtol=tolerance, atol=1e-9)


def check_float32(name, steps=25, tolerance=1e-3):
    """A motion of float32 stays near that of float64, and all results are of float32."""

    def run(dtype):
        env = rb.envs.make(name, randomise=False)
        _, state = env.reset(jax.random.key(0))
        q, v = (jnp.asarray(x, dtype) for x in begin)
        variables = jax.tree.map(lambda x: jnp.asarray(x, dtype), own)
        state = state.replace(state=state.state.replace(q=q, v=v), variables=variables)
        for action in actions:
            obs, state, reward, _, _ = env.step_once(
                jax.random.key(0), state, jnp.asarray(action, dtype)
            )
        assert {x.dtype for x in (*jax.tree.leaves(obs), reward)} == {jnp.dtype(dtype)}
        return np.asarray(state.state.q), float(reward)

    env = rb.envs.make(name, randomise=False)
    _, state = env.reset(jax.random.key(3))
    begin = np.asarray(state.state.q), np.asarray(state.state.v)
    own = jax.tree.map(np.asarray, state.variables)
    actions = np.random.default_rng(0).uniform(-0.8, 0.8, (steps, env.action_size))
    exact = run("float64")
    with jax.enable_x64(False):
        found = run("float32")
    np.testing.assert_allclose(found[0], exact[0], atol=tolerance)
    np.testing.assert_allclose(found[1], exact[1], atol=tolerance)


def episodes(env, policy, steps, count, params=None):
    """Run a policy in `count` episodes. Return the record of `unroll` and the last states."""
    obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(0), count), params)
    _, state, path = jax.vmap(lambda k, o, s: env.unroll(k, o, s, policy, steps, params))(
        jax.random.split(jax.random.key(1), count), obs, state
    )
    return path, state
