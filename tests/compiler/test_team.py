"""Programs of a team of threads, by the emitted C and as whole kernels on the host, against XLA."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.scipy.linalg import solve_triangular

from rbjax.compiler.cuda import team
from rbjax.compiler.ir.program import batch_first, batch_last
from rbjax.compiler.ir.statements import Barrier, Loop, walk
from rbjax.compiler.jax import launch, primitive
from rbjax.compiler.jax.function import compile_threads
from rbjax.compiler.lower.write import write_program
from rbjax.control.optimal.shooting.backward_pass import Bounds, Feedback, backward_pass
from rbjax.control.optimal.shooting.expansion import Quadratic
from tests.compiler.block import emulated
from tests.compiler.host import COMPILER, GPU_ASKED, by_xla, many_on_host, written
from tests.tolerances import F64_TRANSFORM, relative_error

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
host_only = pytest.mark.skipif(GPU_ASKED, reason="counts what a GPU's kernel does on the host")
HOST = not GPU_ASKED
RNG = np.random.default_rng(0)


def numbers(*shape):
    return RNG.normal(size=shape)


def positive(*shape):
    """Positive definite matrices."""
    x = numbers(*shape)
    return x @ x.swapaxes(-1, -2) + shape[-1] * np.eye(shape[-1])


# ------------------------------------------------------------------- many small functions


def kalman(P, F, H, Q, R, zs):
    """A Kalman filter of more states than a thread has room for."""

    def step(carry, z):
        x, P = carry
        x, P = F @ x, F @ P @ F.T + Q
        S = H @ P @ H.T + R
        K = jnp.linalg.solve(S, H @ P).T
        return (x + K @ (z - H @ x), P - K @ H @ P), (x, K)

    return lax.scan(step, (jnp.zeros(len(F)), P), zs)


def counted(A, x):
    """A `while` over a matrix, with a branch inside."""

    def turn(now):
        k, A, x = now
        A = lax.cond(k % 2 == 0, lambda A: A / jnp.abs(A).sum(), lambda A: A.T + x, A)
        return k + 1, A, A @ x + x

    return lax.while_loop(lambda now: (now[0] < 5) & (now[2].sum() < 100), turn, (0, A, x))


def moved(A, k):
    """Slices and updates at indices that are not known."""
    o = jnp.int32(0)
    A = lax.dynamic_update_slice(A, 2 * lax.dynamic_slice(A, (k, o), (3, 6)), (o, k))
    return A.at[:, k].add(1.0), A[k], A[::-1, 1:4], lax.dynamic_index_in_dim(A.T, k, 1)


def pieces(A, x):
    B = jnp.concatenate([A, A.T[:, ::-1], jnp.stack([x, x * x, -x])])
    C = jnp.pad(B, ((1, 0), (0, 2)))
    return B, C, jnp.split(B, 5), jnp.tril(A), jnp.where(A > 0, A, x[:, None]), jnp.tile(x, 4)


def reduced(A, x):
    B = A[:, None] * x[None, :, None] + A.T[None]
    return (
        B.sum(), B.sum(0), B.max((0, 2)), B.min(1), jnp.all(B > -9), jnp.any(x < A, 0), B.argmax(),
        A.argmin(1), jnp.cumsum(A, 0), (A * A).sum(), jnp.prod(x), jnp.linalg.norm(A), A.mean(),
    )  # fmt: skip


def products(A, B, x):
    return (
        A @ B, A.T @ B.T, A @ x, x @ A @ x, jnp.einsum("ij,jk,kl->il", A, B, A),
        jnp.einsum("ij,ij->j", A, B), jnp.outer(x, x) @ A, (A + 2 * B) @ (A - B).T, A @ B + B @ A,
    )  # fmt: skip


def scattered(A, x, at):
    A = A.at[at, 1].add(x[:3]).at[:, at].multiply(2.0)
    return A, A[at], A[at, at], A.at[at].set(0.0), jnp.zeros(90).at[at].add(x[:3])


def solved(A, B, x, big, right):
    L, M = jnp.linalg.cholesky(A), jnp.linalg.cholesky(big)
    solve = functools.partial(lax.linalg.triangular_solve, left_side=True, lower=True)
    return (
        L, M, jax.scipy.linalg.cho_solve((L, True), B), jax.scipy.linalg.cho_solve((L, True), x),
        solve(M, right), solve(M, right, transpose_a=True),
        lax.linalg.triangular_solve(M, right.T, left_side=False, lower=True),
        lax.linalg.triangular_solve(L, B.T, left_side=False, lower=True, transpose_a=True),
        solve(L, B, unit_diagonal=True), jnp.linalg.solve(A, B), jnp.linalg.inv(big),
        solve(jnp.kron(jnp.eye(2), M), jnp.concatenate([right, 2 * right])),
    )  # fmt: skip


def sorted_rows(A):
    return jnp.sort(A, 1), jnp.argsort(A[0]), lax.top_k(A[1], 3)[0], jnp.sort(A.reshape(-1))


def elementwise(A, x):
    y = jnp.sin(A) * jnp.exp(-x) + jnp.sqrt(jnp.abs(A)) / (1 + x**2)
    k = (10 * A).astype(jnp.int32)
    return y, y.T + A, k % 3, k // 3, jnp.clip(A, -x, x), y < A, jnp.float32(A) * 2, -y[0], A**3


def sums_in_turn(A, xs):
    """A loop inside a loop; the carry changes places."""

    def outer(carry, x):
        A, B = carry
        B = lax.fori_loop(0, 3, lambda k, B: B + 0.1 * k * A @ B, B)
        return (B, A.T + x), B[0]

    return lax.scan(outer, (A, 0.1 * A), xs, reverse=True)


A6, S6, x6 = numbers(3, 6, 6), positive(3, 6, 6), numbers(3, 6)
A12, B12, x12 = numbers(3, 12, 12), numbers(3, 12, 12), numbers(3, 12)
K = np.array([0, 1, 3], np.int32)
ZOO = {
    "kalman": (kalman, (
        positive(3, 10, 10), 0.2 * numbers(3, 10, 10), numbers(3, 3, 10), positive(3, 10, 10),
        positive(3, 3, 3), numbers(3, 4, 3),
    )),
    "while and cond": (counted, (0.1 * A12, x12)),
    "dynamic slices": (moved, (A6, K)),
    "pieces": (pieces, (A6, x6)),
    "reductions": (reduced, (A6, x6)),
    "long reductions": (reduced, (A12, x12)),
    "products": (products, (A12, B12, x12)),
    "small products": (products, (A6[:, :3, :3], A6[:, 3:, 3:], x6[:, :3])),
    "scatter": (scattered, (A6, x6, np.array([[0, 2, 2], [1, 1, 1], [5, 0, 3]]))),
    "factors": (solved, (S6, numbers(3, 6, 12), x6, positive(3, 11, 11), numbers(3, 11, 5))),
    "sort": (sorted_rows, (A6,)),
    "elementwise": (elementwise, (A6, x6)),
    "nested loops": (sums_in_turn, (0.3 * A12, numbers(3, 4, 12))),
}  # fmt: skip


def in_both_orders(cases):
    """The results of the programs of teams; also with the turns of a team's loops the other way
    round, for they are independent."""
    flags = ("-O0", "-ffp-contract=off")
    return [many_on_host(cases, flags, team=True, backwards=x) for x in (False, True)[: 1 + HOST]]


def test_small_functions():
    cases = list(ZOO.values())
    wants = by_xla(cases)
    for found in in_both_orders(cases):
        for name, got, want in zip(ZOO, found, wants, strict=True):
            for g, w in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
                assert (g.dtype, g.shape) == (w.dtype, w.shape), name
                tolerance = 1e-6 if g.dtype == np.float32 else F64_TRANSFORM
                assert np.max(relative_error(g, w), initial=0) < tolerance, name


# ------------------------------------------------------------------- the backward pass


def problem(n, m, N=3, batch=2, bounded=True, opens=False, by_velocities=True):
    """A batch of linear-quadratic problems as arguments of `backward_pass`."""
    r = np.random.default_rng(n)
    f = lambda *s: r.normal(size=(batch, *s))  # noqa: E731

    def definite(*shape):
        x = f(*shape)
        return x @ x.swapaxes(-1, -2) + np.eye(shape[-1])

    h = np.full(batch, 0.1) if by_velocities else None
    A, B = 0.3 * f(N, n, n), f(N, n, m)
    if by_velocities:  # dq+ = dq + h dv+
        k = n // 2
        rows = np.concatenate([np.eye(k), np.zeros((k, k))], 1) + 0.1 * A[:, :, k:]
        A = np.concatenate([rows, A[:, :, k:]], 2)
        B = np.concatenate([0.1 * B[:, :, k:], B[:, :, k:]], 2)
    path = Quadratic(f(N), f(N, n), definite(N, n, n), f(N, m), definite(N, m, m), 0.1 * f(N, n, m))
    end = Quadratic(f(), f(n), definite(n, n), f(m), definite(m, m), f(n, m))
    low = -np.abs(f(N, m)) - 0.1
    bounds = Bounds(low, low + 1.5) if bounded else None
    wide = np.full((batch, n), 0.2)
    first = (np.tile(np.arange(n) % 2.0, (batch, 1)), -wide, wide) if opens else None
    return A, B, f(N + 1, n), path, end, bounds, first, np.full(batch, 1e-6), h


CASES = {
    "12/6, bounded, by velocities": problem(12, 6),
    "14/7, by velocities": problem(14, 7, bounded=False),
    "14/7": problem(14, 7, bounded=False, by_velocities=False),
    "13/5, bounded": problem(13, 5, by_velocities=False),
    "4/1, bounded": problem(4, 1),
    "4/2": problem(4, 2, bounded=False),
    "10/5, an open start": problem(10, 5, opens=True),
}


def close(got: Feedback, want: Feedback, tolerance: float = 1e-11) -> None:
    """Of problems whose numbers are of order one."""
    for name, g, w in zip(Feedback._fields, got, want, strict=True):
        assert np.shape(g) == np.shape(w), name
        assert np.max(relative_error(g, w)) < tolerance, name


@pytest.mark.parametrize("names", [
    ["12/6, bounded, by velocities", "14/7"],
    pytest.param(list(CASES), marks=pytest.mark.slow),
], ids=["two", "all"])  # fmt: skip
def test_backward_pass(names):
    cases = [(backward_pass, CASES[name]) for name in names]
    wants = by_xla(cases)
    for found in in_both_orders(cases):
        for got, want in zip(found, wants, strict=True):
            close(got, want)
            assert want.ok.all()
    held = np.abs(wants[0].K).max(-1) == 0  # some bounds hold, others do not
    assert held.any() and not held.all()


def whole_kernel(f, args, size, in_turn, layout=batch_first):
    """The results of a kernel on the host, and its program."""
    program, tree, avals = written(f, *args, layout=layout, team=True)
    code = team.kernel(program, team=size)
    shapes = [
        jax.ShapeDtypeStruct(lay.shape, a.dtype)
        for lay, a in zip(program.layouts[1], avals, strict=True)
    ]
    found = emulated(code, jax.tree.leaves(args), shapes, in_turn)
    return jax.tree.unflatten(tree, found), program


@host_only
@pytest.mark.parametrize(("size", "in_turn"), [
    (32, -1),
    pytest.param(32, 1, marks=pytest.mark.slow),
    pytest.param(64, 1, marks=pytest.mark.slow),
])  # fmt: skip
def test_threads_run_far_ahead_of_each_other(size, in_turn):
    """From barrier to barrier, one thread at a time."""
    args = CASES["12/6, bounded, by velocities"]
    found, _ = whole_kernel(backward_pass, args, size, in_turn)
    close(found, by_xla([(backward_pass, args)])[0])


@host_only
@pytest.mark.parametrize("name", [
    name if name == "while and cond" else pytest.param(name, marks=pytest.mark.slow) for name in ZOO
])  # fmt: skip
def test_small_functions_with_threads_far_ahead(name):
    f, args = ZOO[name]
    (want,) = by_xla([(f, args)])
    for in_turn in (1, -1):
        found, _ = whole_kernel(f, args, 32, in_turn)
        for g, w in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
            tolerance = 1e-6 if g.dtype == np.float32 else F64_TRANSFORM
            assert np.max(relative_error(g, w)) < tolerance


@host_only
def test_slices_and_shapes_of_arrays_that_are_computed_when_read():
    """They change the index of the entries only; two axes that become one need memory."""

    def f(x, y):
        part = (x * x + y)[1:7:2, 2:]
        row = (x - 2 * y)[2:3].reshape(8)
        return part.reshape(3, 1, 6) * x[0, :6], row * y[0], (x * y + 1.0).reshape(64) * 2.0

    args = numbers(3, 8, 8), numbers(3, 8, 8)
    (want,) = by_xla([(f, args)])
    found, _ = whole_kernel(f, args, 32, 1)
    for g, w in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(g, w, rtol=F64_TRANSFORM, atol=F64_TRANSFORM)


@host_only
def test_without_barriers_a_kernel_is_wrong(monkeypatch):
    """So the tests above see that they are there."""
    args = CASES["14/7, by velocities"]
    want = by_xla([(backward_pass, args)])[0]
    monkeypatch.setattr(team.TeamPrinter, "barrier", "")
    found, _ = whole_kernel(backward_pass, args, 32, -1)
    assert not np.allclose(found.V, want.V)


@host_only
def test_what_a_knot_takes():
    """Barriers of a knot, each some 20 to 40 cycles of a GPU; bytes of shared memory."""
    program, _, _ = written(backward_pass, *problem(14, 7, bounded=False), team=True)
    block = program.builder.block
    (knots,) = (s for s in block.statements if isinstance(s, Loop) and not s.team)
    assert sum(isinstance(s, Barrier) for s in walk(knots.body)) < 12
    assert team.shared_bytes(block) <= 24 * 1024  # in f64; jax 0.10 needs 64 bytes more than 0.11


@host_only
def test_a_second_solve_takes_the_solution_as_it_is_now():
    """One loop solves two systems in a row only if the first solution is passed on as it was."""

    def solve(L, B, **how):
        return solve_triangular(L, B, lower=True, **how)

    rng = np.random.default_rng(0)
    L = np.tril(rng.normal(size=(3, 6, 6))) + 4 * np.eye(6)
    wide, square = rng.normal(size=(3, 6, 12)), rng.normal(size=(3, 6, 6))
    cases = [
        (lambda L, B: [solve(L, solve(L, B))], (L, wide)),
        (lambda L, B: [solve(L, solve(L, B), trans=1)], (L, wide)),
        (lambda L, B: [solve(L, solve(L, B).at[0, 0].set(5.0))], (L, wide)),
        (lambda L, B: [solve(L, solve(L, B).at[:, 1].add(B[:, 0]))], (L, wide)),
        (lambda L, B: [solve(L, solve(L, B).T)], (L, square)),
        (lambda L, B: [solve(L, solve(L, B)[:, ::-1])], (L, wide)),
        (lambda L, B: [solve(L, solve(L, B)[::-1])], (L, square)),
        (lambda L, B: [solve(L[:4, :4], solve(L, B).reshape(4, 18))], (L, wide)),
    ]  # fmt: skip
    for (f, args), got in zip(cases, many_on_host(cases, team=True), strict=True):
        want = jax.vmap(f)(*args)
        np.testing.assert_allclose(jax.tree.leaves(got)[0], want[0], rtol=1e-12, atol=1e-13)


# ------------------------------------------------------------------- which programs run so


def kernels(f, monkeypatch, *args):
    """The kernels that f becomes on a GPU."""
    made = []
    monkeypatch.setattr(launch, "capability", lambda: "9.0")
    monkeypatch.setattr(launch, "ordinal", lambda: 0)
    monkeypatch.setattr(launch, "kernels_work", lambda: True)
    monkeypatch.setattr(launch, "ptx", lambda source, capability: made.append(source) or "PTX")
    primitive._kernel.cache_clear()
    jax.jit(f).trace(*args).lower(lowering_platforms=("cuda",))
    return made


def by_team(A, x):
    def step(x, _):
        return jnp.tanh(A @ x), None

    return lax.scan(step, x, None, 3)[0]


@host_only
def test_values_by_a_team_derivatives_by_a_thread(monkeypatch):
    f = compile_threads(by_team, team=True)
    is_team = [
        "lane=threadIdx.x" in source
        for g in (jax.vmap(f), jax.vmap(jax.grad(lambda A, x: f(A, x).sum())))
        for source in kernels(g, monkeypatch, A12, x12)
    ]
    assert is_team == [True, False]
    shared = kernels(jax.vmap(f, (None, 0)), monkeypatch, A12[0], x12)
    assert len(shared) == 1 and "lane=threadIdx.x" in shared[0]


@host_only
def test_arrays_that_do_not_fit(monkeypatch):
    def large(x):
        A = jnp.outer(x, x) + 1
        return (A @ A).sum(0)

    f = jax.vmap(compile_threads(large, team=True))
    (source,) = kernels(f, monkeypatch, numbers(2, 60))
    assert "lane=threadIdx.x" not in source
    assert not team.fits(written(large, numbers(2, 60), team=True)[0])


@host_only
def test_other_layouts_and_sums():
    """Samples last; a result that is summed over the batch is one partial sum a block."""
    w, xs = numbers(12, 12), numbers(5, 12)

    def f(w, x):
        return jnp.outer(w @ x, x), w @ x

    closed = jax.make_jaxpr(f)(w, xs[0])
    ins = [batch_first((12, 12), ()), batch_last((12,), (5,))]
    ins[0] = type(ins[0])((12, 12), (None,))
    outs = [batch_first((12, 12), ()), batch_last((12,), (5,))]
    program = write_program(closed, (5,), ins, outs, (True, False), team=True)
    shapes = [jax.ShapeDtypeStruct(s, np.float64) for s in ((12, 12), (12, 5))]
    total, each = emulated(team.kernel(program), [w, xs.T], shapes, 1)
    assert np.max(relative_error(total, np.einsum("ij,bj,bk->ik", w, xs, xs))) < F64_TRANSFORM
    assert np.max(relative_error(each, w @ xs.T)) < F64_TRANSFORM


@pytest.mark.parametrize(("samples", "threads"), [(1, 128), (1000, 64), (4096, 32)])
def test_size_of_a_team(samples, threads):
    assert team.team_size(samples) == threads
