"""Filter and smoother beside dense Gaussian conditioning, and on a manifold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import rbjax as rb
from rbjax.errors import InputError
from rbjax.estimation.kalman import StateSpace, kalman_filter, kalman_smoother
from rbjax.motion.linearise import box_minus, box_plus
from rbjax.rotations import quaternion

N, n, l, m = 9, 3, 2, 2  # transitions, state, process noise, readings
RNG = np.random.default_rng(0)
A = RNG.normal(size=(n, n)) / 2
B, G, H = RNG.normal(size=(n, 1)), RNG.normal(size=(n, l)), RNG.normal(size=(m, n))
U, Y = RNG.normal(size=(N, 1)), RNG.normal(size=(N + 1, m))
Y[3] = np.nan  # a sample that did not arrive
Y[6, 1] = np.nan  # and one of its columns
W, R = np.array([[0.5, 0.2], [0.2, 0.3]]), np.array([[0.2, 0.05], [0.05, 0.1]])
X0, P0 = RNG.normal(size=n), np.diag([1.0, 0.5, 2.0])


def linear(p=1.0):
    return StateSpace.of(lambda x, u, w: p * (A @ x) + B @ u + G @ w, lambda x: H @ x)


def found(P0=P0, Y=Y, p=1.0, W=W, R=R):
    return kalman_filter(linear(p), jnp.asarray(X0), P0, U, Y, W, R)


def dense(P0):
    """Mean and covariance of the whole trajectory, and the rows that read it."""
    steps = [np.eye(n)]
    mean = [X0]
    for k in range(N):
        mean.append(A @ mean[-1] + B @ U[k])
        steps.append(A @ steps[-1])
    F = np.zeros(((N + 1) * n, n + N * l))  # of the first state and all noise
    for k in range(N + 1):
        F[k * n : (k + 1) * n, :n] = steps[k]
        for j in range(k):
            F[k * n : (k + 1) * n, n + j * l : n + (j + 1) * l] = steps[k - 1 - j] @ G
    Q = np.kron(np.eye(N), W)
    noise = np.block([[P0, np.zeros((n, N * l))], [np.zeros((N * l, n)), Q]])
    seen = ~np.isnan(Y).ravel()
    C = np.kron(np.eye(N + 1), H)[seen]
    V = np.kron(np.eye(N + 1), R)[np.ix_(seen, seen)]
    return np.concatenate(mean), F @ noise @ F.T, C, V, Y.ravel()[seen]


@pytest.mark.parametrize("P0", [P0, np.zeros((n, n))], ids=["open start", "known start"])
def test_a_linear_system_is_conditioned_as_one_dense_gaussian(P0):
    """Covariances of the first states are singular where the start is known."""
    mean, P, C, V, y = dense(P0)
    S = C @ P @ C.T + V
    gain = np.linalg.solve(S, C @ P).T
    state, covariance = mean + gain @ (y - C @ mean), P - gain @ C @ P

    @jax.jit
    def both(P0):
        f = found(P0)
        return f, kalman_smoother(linear(), f)

    f, s = both(P0)
    np.testing.assert_allclose(s.state.ravel(), state, atol=1e-10)
    blocks = np.stack([covariance[k : k + n, k : k + n] for k in range(0, len(mean), n)])
    np.testing.assert_allclose(s.covariance, blocks, atol=1e-10)
    np.testing.assert_allclose(f.state[-1], state[-n:], atol=1e-10)
    np.testing.assert_allclose(f.covariance[-1], blocks[-1], atol=1e-10)
    want = stats.multivariate_normal(C @ mean, S).logpdf(y)
    np.testing.assert_allclose(f.log_likelihood, want, rtol=1e-10)
    # innovations are white: the likelihood is the product of theirs
    z, Sz = np.asarray(f.innovation), np.asarray(f.innovation_covariance)
    each = [stats.multivariate_normal(np.zeros(m), Sz[k]).logpdf(z[k]) for k in range(N + 1)]
    missing = np.isnan(Y).sum() * np.log(2 * np.pi) / 2
    np.testing.assert_allclose(sum(each) + missing, want, rtol=1e-10)
    assert np.isnan(Y[3]).all() and not z[3].any() and (Sz[3] == np.eye(m)).all()


def test_the_smoother_is_least_squares():
    """The maximum a posteriori of x_0 and all w, by dense linear least squares."""
    s = jax.jit(lambda: kalman_smoother(linear(), found()))()
    half = [np.linalg.cholesky(np.linalg.inv(x)).T for x in (P0, W, R)]

    def path(v):
        x, w = [v[:n]], v[n:].reshape(N, l)
        for k in range(N):
            x.append(A @ x[-1] + B @ U[k] + G @ w[k])
        return np.array(x)

    def residual(v):
        off = path(v) @ H.T - Y
        rows = [half[0] @ (v[:n] - X0), (v[n:].reshape(N, l) @ half[1].T).ravel()]
        for k in range(N + 1):
            there = ~np.isnan(Y[k])
            if there.any():
                inverse = np.linalg.cholesky(np.linalg.inv(R[np.ix_(there, there)])).T
                rows.append(inverse @ off[k, there])
        return np.concatenate(rows)

    zero = np.zeros(n + N * l)
    r = residual(zero)
    J = np.stack([residual(e) - r for e in np.eye(zero.size)], 1)
    v = -np.linalg.lstsq(J, r, rcond=None)[0]
    np.testing.assert_allclose(s.state, path(v), atol=1e-10)


def test_the_smoother_is_that_of_rauch_tung_and_striebel():
    """By their own recursion, with the inverse of the predicted covariance."""
    f = jax.jit(found)()
    s = jax.jit(lambda f: kalman_smoother(linear(), f))(f)
    x, P = np.asarray(f.state[-1]), np.asarray(f.covariance[-1])
    for k in range(N - 1, -1, -1):
        before, ahead = np.asarray(f.covariance[k]), np.asarray(f.predicted_covariance[k + 1])
        D = before @ A.T @ np.linalg.inv(ahead)
        x = f.state[k] + D @ (x - f.predicted[k + 1])
        P = before + D @ (P - ahead) @ D.T
        np.testing.assert_allclose(s.state[k], x, atol=1e-10)
        np.testing.assert_allclose(s.covariance[k], P, atol=1e-10)


def test_precise_sensors_leave_no_negative_variance():
    """Twelve decades between the start's variance and the noise's."""
    f = jax.jit(lambda: found(1e6 * np.eye(n), R=1e-6 * np.eye(m)))()
    assert np.linalg.eigvalsh(f.covariance).min() >= -1e-12
    np.testing.assert_allclose(f.covariance, np.swapaxes(f.covariance, 1, 2), atol=1e-12)


def test_compiled_batched_and_as_long_as_it_wants():
    f = lambda p: found(p=p).log_likelihood  # noqa: E731
    many = jax.jit(jax.vmap(f))(jnp.array([0.8, 1.0]))
    np.testing.assert_allclose(many[1], jax.jit(f)(1.0), rtol=1e-12)

    def program(count):
        zeros = jnp.zeros((count, 1)), jnp.zeros((count + 1, m))
        return jax.make_jaxpr(lambda: kalman_filter(linear(), jnp.asarray(X0), P0, *zeros, W, R))()

    assert len(str(program(10))) >= len(str(program(99))) - 200  # one loop, not a program by length


SPINNING = """<mujoco><option gravity="0 0 0" timestep="0.02"/><worldbody><body>
<joint name="ball" type="ball"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.02 0.03 0.04"/></body></worldbody></mujoco>"""


def test_attitudes_are_filtered_wherever_they_point():
    """A body that turns, driven by random torques: another world frame changes nothing, and the
    smoother errs less than the filter, and that less than the sensor."""
    model, T, count = rb.load(SPINNING), 0.02, 60
    rng = np.random.default_rng(3)

    def move(x, u, w):
        v = x.v + w
        return rb.State(rb.integrate(model, x.q, T * v), v)

    space = StateSpace(
        move, lambda x, y: rb.difference(model, x.q, y),
        lambda x, dx: box_plus(model, x, dx), lambda a, b: box_minus(model, a, b),
    )  # fmt: skip
    x = rb.State(jnp.array([1.0, 0, 0, 0]), jnp.array([2.0, -1.0, 3.0]))
    truth, seen, sigma = [], [], 0.1
    for _ in range(count + 1):
        truth.append(np.asarray(x.q))
        seen.append(np.asarray(rb.integrate(model, x.q, sigma * rng.normal(size=3))))
        x = move(x, 0.0, 0.05 * rng.normal(size=3))
    truth, seen = jnp.array(truth), jnp.array(seen)

    @jax.jit
    def both(seen):
        begin = rb.State(seen[0], jnp.zeros(3))
        P = jnp.array([sigma**2] * 3 + [9.0] * 3)
        there = jnp.ones((count + 1, 3), bool).at[0].set(False)
        f = kalman_filter(
            space, begin, P, jnp.zeros(count), seen, jnp.full(3, 0.05**2), jnp.full(3, sigma**2),
            arrived=there,
        )  # fmt: skip
        return f, kalman_smoother(space, f)

    f, s = both(seen)
    by = jnp.array([0.5, 0.5, -0.5, 0.5])
    turned = jax.vmap(lambda q: quaternion.multiply(by, q))
    g, t = both(turned(seen))
    np.testing.assert_allclose(g.log_likelihood, f.log_likelihood, rtol=1e-10)
    np.testing.assert_allclose(t.state.v, s.state.v, atol=1e-10)
    np.testing.assert_allclose(t.covariance, s.covariance, atol=1e-10)
    off = [jax.vmap(lambda a, b: rb.difference(model, a, b))(truth, q)
           for q in (s.state.q, f.state.q, seen)]  # fmt: skip
    rms = [float(jnp.sqrt((x[10:] ** 2).mean())) for x in off]
    assert rms[0] < 0.85 * rms[1] and rms[1] < 0.85 * rms[2]
    # innovations are as large as they are said to be: chi^2 of 180 numbers, 3 sigma
    S = jnp.linalg.inv(f.innovation_covariance)
    scaled = jnp.einsum("ki,kij,kj", f.innovation, S, f.innovation)
    assert abs(scaled / 180 - 1) < 3 * np.sqrt(2 / 180)


def test_bad_arguments():
    with pytest.raises(InputError, match="noise has shape"):
        found(R=np.ones((2, 3)))
    with pytest.raises(InputError, match="one more than inputs"):
        found(Y=Y[:-1])
