"""Controllers of the wheeled tasks and of the flexible arm: evidence that each task can be solved,
and returns that a policy should beat. Each is a function (observation, key) -> action."""

import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_continuous_are, solve_discrete_are

import rbjax as rb
from rbjax.envs.suite.flexible_arm import flexible_arm


def back_up(wheelbase=0.5, drawbar=0.8, behind=0.15):
    """Linear-quadratic steering of the trailer's axle onto the line y = 0, per metre backwards,

    y' = -t,   t' = (g + behind s / wheelbase) / drawbar,   g' = t' + s / wheelbase,

    with a speed in proportion to the distance from the bay.
    """
    A = np.array([[0, -1, 0], [0, 0, 1 / drawbar], [0, 0, 1 / drawbar]])
    turn = behind / wheelbase / drawbar
    B = np.array([[0], [turn], [turn + 1 / wheelbase]])
    P = solve_continuous_are(A, B, np.diag([4.0, 2.0, 1.0]), np.eye(1))
    K = jnp.asarray((B.T @ P)[0])

    def policy(obs, key):
        x, y, c, s, _, hitch = obs[:6]
        off = jnp.stack([y, jnp.arctan2(s, c), hitch])
        target = -(K.astype(obs.dtype) @ off)
        return jnp.stack([jnp.clip(-0.8 * x, -0.5, 0.3), jnp.clip(target / 0.6, -1.0, 1.0)])

    return policy


def pursue(friction=0.15, look=0.35, grip=0.75):
    """Pure pursuit of a point ahead, at the speed at which the curvature ahead needs a part of the
    friction; the torque keeps the slip of the rear tyre small."""

    def policy(obs, key):
        v = obs[3]
        rims, points = obs[7:9], obs[9:21].reshape(6, 2)
        distance = jnp.sqrt((points**2).sum(-1))
        bends = jnp.abs(2 * points[:, 1] / distance**2)
        # the speed at a point, and the speed from which the car can brake to it
        square = grip * friction * 9.81 / jnp.maximum(bends, 0.05)
        target = jnp.sqrt(
            (square + 2 * 0.4 * friction * 9.81 * jnp.maximum(distance - 0.5, 0)).min()
        )
        aim = jnp.clip((look + 0.35 * jnp.abs(v) - distance[0]) / 0.4, 0, 2.99)
        i = jnp.floor(aim).astype(int)
        p = points[i] + (aim - i) * (points[i + 1] - points[i])
        steering = jnp.arctan(0.33 * 2 * p[1] / (p**2).sum())
        torque = jnp.clip(0.3 * (target - v), -0.15, 0.15)
        slip = rims[1] - v
        torque = torque - 0.3 * jnp.sign(slip) * jnp.maximum(
            jnp.abs(slip) - 0.15 - 0.05 * jnp.abs(v), 0
        )
        return jnp.stack([jnp.clip(torque / 0.4, -1, 1), jnp.clip(steering / 0.5, -1, 1)])

    return policy


def damp(env):
    """Linear-quadratic regulator of the arm at rest, from the privileged observation, in the angle
    from the goal."""
    model = flexible_arm().astype(jnp.zeros(()).dtype)
    A, B = np.eye(8), np.zeros((8, 1))
    step = rb.linearise(model, model.default_state(), jnp.zeros(1), env.task.dt)
    one = np.asarray(step.A, float)
    for _ in range(env.task.decimation):
        A, B = one @ A, one @ B + np.asarray(step.B, float)
    Q = np.diag([20.0, 1, 1, 1, 0.5, 0.01, 0.01, 0.01])
    P = solve_discrete_are(A, B, Q, np.eye(1))
    K = jnp.asarray(np.linalg.solve(np.eye(1) + B.T @ P @ B, B.T @ P @ A))[0]

    def policy(obs, key):
        full = obs["critic"]
        off = jnp.concatenate([full[:1], full[5:8], full[1:2], full[8:11]])
        return jnp.clip(-(K.astype(off.dtype) @ off)[None] / 1.5, -1.0, 1.0)

    return policy
