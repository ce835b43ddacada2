"""`threaded(f)` under every transformation of JAX is f under it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.compiler import kernels_available
from rbjax.compiler.jax import launch, tangents
from rbjax.compiler.jax.function import compile_threads, one_program, threads
from rbjax.compiler.llvm import jit as llvm_jit
from tests.compilations import compilations
from tests.tolerances import F64_TRANSFORM, relative_error

RNG = np.random.default_rng(0)
X, Y, W = (jnp.asarray(RNG.normal(size=shape)) for shape in ((7, 3), (7, 4), (5, 3)))


def f(x, y, w=W):
    return jnp.tanh(w @ x) * y.sum(), (x * x).sum()


def first(h):
    """A function of one vector, whose derivatives are small."""
    return lambda x: h(x, Y[0])


def loss(h):
    """A sum over a batch, of an operand that all samples share and of two of their own."""
    return lambda x, y, w: sum(jnp.sin(out).sum() for out in jax.vmap(h, (0, 0, None))(x, y, w))


def closing(h):
    """The same where the shared operand is closed over, a tracer."""
    if h is f:
        return loss(f)
    closed = lambda w: lambda x, y, _: compile_threads(lambda x, y: f(x, y, w))(x, y)  # noqa: E731
    return lambda x, y, w: loss(closed(w))(x, y, 0.0)


def nested(h):
    """All pairs, of a batch of samples and a batch of others."""
    return jax.vmap(jax.vmap(h, (0, None)), (None, 0))


@jax.custom_jvp
def softened(x):
    return jnp.abs(x)


@softened.defjvp
def _(primals, tangents):
    (x,), (t,) = primals, tangents
    return softened(x), jnp.tanh(x) * t  # not the derivative of the value, so that it shows


TRANSFORMED = {
    "one sample": (lambda h: h, (X[0], Y[0])),
    "batch first": (jax.vmap, (X, Y)),
    "batch last": (lambda h: jax.vmap(h, -1, -1), (X.T, Y.T)),
    "batch first and last": (lambda h: jax.vmap(h, (-1, 0), (0, -1)), (X.T, Y)),
    "some without": (lambda h: jax.vmap(h, (0, None)), (X, Y[0])),
    "all pairs": (nested, (X, Y)),
    "all pairs, last": (lambda h: jax.vmap(jax.vmap(h, (0, None)), (None, 1), 1), (X, Y.T)),
    "none has the axis": (lambda h: jax.vmap(lambda _: h(X[0], Y[0])), (X,)),
    "empty": (jax.vmap, (X[:0], Y[:0])),
    "jvp": (lambda h: lambda *a: jax.jvp(h, a, (X[1], Y[1])), (X[0], Y[0])),
    "jvp of vmap": (lambda h: lambda *a: jax.jvp(jax.vmap(h), a, (X[::-1], Y[::-1])), (X, Y)),
    "vjp": (lambda h: lambda *a: jax.vjp(h, *a)[1]((W[:, 0], 2.0)), (X[0], Y[0])),
    "linearize": (lambda h: lambda *a: jax.linearize(h, *a)[1](X[1], Y[1]), (X[0], Y[0])),
    "jacfwd": (lambda h: jax.jacfwd(first(h)), (X[0],)),
    "jacrev": (lambda h: jax.jacrev(first(h)), (X[0],)),
    "hessian": (lambda h: jax.hessian(first(h)), (X[0],)),
    "vmap of jacfwd": (lambda h: jax.vmap(jax.jacfwd(first(h))), (X,)),
    "vmap of jacrev": (lambda h: jax.vmap(jax.jacrev(first(h))), (X,)),
    "vmap of hessian": (lambda h: jax.vmap(jax.hessian(first(h))), (X,)),
    "jacrev of vmap": (lambda h: jax.jacrev(lambda x: jax.vmap(first(h))(X * x)), (X[0],)),
    "hessian of vmap": (lambda h: jax.hessian(lambda x: jax.vmap(first(h))(X * x)), (X[0],)),
    "grad, own and shared": (lambda h: jax.value_and_grad(loss(h), (0, 1, 2)), (X, Y, W)),
    "grad, closed over": (lambda h: jax.grad(closing(h), (0, 1, 2)), (X, Y, W)),
    "vmap of grad": (
        lambda h: jax.vmap(jax.grad(lambda w, *a: jnp.sin(h(*a, w)[0]).sum()), (None, 0, 0)),
        (W, X, Y),
    ),
    "vmap of grad of vmap": (
        lambda h: jax.vmap(jax.grad(lambda s: loss(h)(X, Y, W * s))), (jnp.arange(3.0),)
    ),
    "grad of nested": (
        lambda h: jax.grad(lambda s: (nested(h)(X * s, Y * s)[0] ** 2).sum()), (1.3,)
    ),
}  # fmt: skip


def agree(got, want) -> None:
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        if a.dtype != jax.dtypes.float0:
            assert relative_error(a, b) <= F64_TRANSFORM


# compiled together: a program each would take most of the time
@pytest.fixture(scope="module")
def jitted():
    @jax.jit
    def every(args):
        return {
            name: [transform(h)(*args[name]) for h in (compile_threads(f), f)]
            for name, (transform, _) in TRANSFORMED.items()
        }

    return every({name: args for name, (_, args) in TRANSFORMED.items()})


@pytest.mark.parametrize("name", TRANSFORMED)
def test_jitted(name, jitted):
    agree(*jitted[name])


def bent(h):
    """The gradient of a Jacobian's size, for each sample: through directions in reverse."""
    J = jax.jacfwd(first(h))
    return jax.vmap(jax.grad(lambda x: sum((leaf**2).sum() for leaf in J(x))))


def test_directions_that_lie_last(monkeypatch):
    """As many directions do, the last axis of a Jacobian."""
    monkeypatch.setattr(tangents, "DIRECTIONS", 1)
    cases = {"hessian": TRANSFORMED["vmap of hessian"], "bent": (bent, (X,))}

    def every(g):
        return {name: make(g)(*args) for name, (make, args) in cases.items()}

    agree(jax.jit(lambda: every(compile_threads(f)))(), jax.jit(lambda: every(f))())


EAGER = ("one sample", "batch first", "empty", "jvp", "grad, own and shared", "grad, closed over")


@pytest.mark.parametrize(
    "name", [n if n in EAGER else pytest.param(n, marks=pytest.mark.slow) for n in TRANSFORMED]
)
def test_eager(name):
    transform, args = TRANSFORMED[name]
    agree(transform(compile_threads(f))(*args), transform(f)(*args))


def test_a_custom_rule_is_kept():
    def h(x):
        return (softened(x) ** 2).sum()

    for transform in (jax.grad, jax.jacfwd, jax.hessian):
        agree(jax.vmap(transform(compile_threads(h)))(X), jax.vmap(transform(h))(X))


def test_integers_have_no_tangent():
    def h(x, n):
        return x[n] * n, n + 1, x.sum()

    n = jnp.arange(7, dtype=jnp.int32) % 3
    both = [jax.vjp(jax.vmap(g), X, n) for g in (compile_threads(h), h)]
    agree(both[0][0], both[1][0])
    bars = (X[:, 0], np.zeros(7, jax.dtypes.float0), X[:, 1])
    got, want = (pull(bars) for _, pull in both)
    assert got[1].dtype == jax.dtypes.float0
    agree(got, want)
    still = np.zeros(7, jax.dtypes.float0)
    got, want = (jax.jvp(jax.vmap(g), (X, n), (X, still)) for g in (compile_threads(h), h))
    assert got[1][1].dtype == jax.dtypes.float0
    agree(got, want)


def test_pytrees_and_names():
    def h(tree, *, more):
        return {"sum": tree["a"] + more[0], "twice": (2 * tree["b"], None)}

    args = {"a": X, "b": Y}
    want = jax.vmap(lambda t, m: h(t, more=[m]))(args, X)
    agree(jax.vmap(lambda t, m: compile_threads(h)(t, more=[m]))(args, X), want)


def test_f32_stays_f32():
    got = jax.vmap(compile_threads(f), (0, 0, None))(*(x.astype(jnp.float32) for x in (X, Y, W)))
    assert all(x.dtype == jnp.float32 for x in got)


def test_a_sample_s_sum_is_a_derivative_of_what_is_shared():
    """A cotangent without a batch, batched once more, is a sum for each of the new samples."""

    def gradient(h):
        return jax.vmap(
            jax.grad(lambda w, s: (jax.vmap(h, (0, None, None))(X * s, Y[0], w)[0] ** 2).sum()),
            (None, 0),
        )

    agree(gradient(compile_threads(f))(W, Y[0]), gradient(f)(W, Y[0]))


def test_nothing_is_traced_twice():
    calls = []

    def h(x):
        calls.append(x)
        return jnp.sin(x).sum()

    g = compile_threads(h)
    g(X[0])
    count = len(calls)
    with compilations() as names:
        g(X[1])
    assert len(calls) == count and not names
    mapped = jax.jit(jax.vmap(g))
    mapped(X)
    count = len(calls)
    mapped(X + 1)
    assert len(calls) == count


def test_nested_samples_take_their_own_iterations():
    """A batch of loops inside a program, beside Python's loops."""
    halved = compile_threads(lambda x: jax.lax.while_loop(lambda y: y > 1, lambda y: y / 2, x))
    inside = compile_threads(lambda x: jax.vmap(halved)(x) + x)
    found = jax.jit(jax.vmap(inside))(jnp.asarray([[0.5, 3.0, 40.0], [1000.0, 1.0, 7.0]]))
    expected = [[0.5 + 0.5, 0.75 + 3, 0.625 + 40], [1000 / 1024 + 1000, 1 + 1, 0.875 + 7]]
    np.testing.assert_array_equal(found, expected)


def test_without_a_gpu_threads_is_the_function():
    if not kernels_available():
        text = str(jax.make_jaxpr(threads(f))(X[0], Y[0]))
        assert "threads[" not in text and text == str(jax.make_jaxpr(f)(X[0], Y[0]))
    assert "threads[" in str(jax.make_jaxpr(jax.vmap(compile_threads(f)))(X, Y))
    with pytest.raises(TypeError, match="got int"):
        threads(3)


def test_calls_in_several_loops_share_one_program():
    """One program for arguments of equal shapes, with a traced value that the function closes over;
    values and derivatives are those of the function."""
    x, scale = jnp.array([0.3, -0.7]), jnp.array(1.3)

    def total(scale, x, shared):
        f = lambda y: {"sin": jnp.sin(scale * y), "one": 1}  # noqa: E731
        f = one_program(f) if shared else f
        turn = lambda y, _: (f(y)["sin"], None)  # noqa: E731
        y = jax.lax.scan(turn, x, None, length=2)[0]
        y = jax.lax.scan(turn, y, None, length=3)[0] * f(y)["one"]
        return y.sum() + f(y[0])["sin"]  # a number: another program

    def programs(jaxpr):
        found = set()
        for eqn in jaxpr.eqns:
            found |= {id(eqn.params["program"])} if "program" in eqn.params else set()
            if eqn.primitive.name in ("scan", "jit"):
                found |= programs(eqn.params["jaxpr"].jaxpr)
        return found

    assert len(programs(jax.make_jaxpr(lambda *at: total(*at, True))(scale, x).jaxpr)) == 2
    for g in (lambda f: f, lambda f: jax.grad(f, (0, 1)), lambda f: jax.jacfwd(f, (0, 1))):
        own, plain = (jax.jit(g(lambda *at, shared=k: total(*at, shared))) for k in (True, False))
        for a, b in zip(
            jax.tree.leaves(own(scale, x)), jax.tree.leaves(plain(scale, x)), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=1e-13)


def test_while_loops_of_one_sample_are_optimised_more(monkeypatch):
    """Neighboring operations of one sample become vector operations; samples of a batch are
    vectors already, and programs without such loops gain little."""
    used, register = [], launch.register_host_kernel

    def kernel(written, levels):
        used.append(levels)
        return register(written, levels)

    monkeypatch.setattr(launch, "register_host_kernel", kernel)

    def halved(x):
        return jax.lax.while_loop(lambda y: (y > 1.0).any(), lambda y: 0.5 * y, x)

    x = jnp.asarray([[8.0, 3.0], [0.5, 20.0]])
    one = jax.jit(threads(halved))
    np.testing.assert_array_equal(one(x[0]), [1.0, 0.375])
    np.testing.assert_array_equal(jax.vmap(one)(x), [[1.0, 0.375], [0.015625, 0.625]])
    jax.jit(threads(lambda x: 0.25 * x))(x[0])
    assert used == [llvm_jit.SAMPLE_LEVELS, llvm_jit.LEVELS, llvm_jit.LEVELS]
    monkeypatch.setattr(llvm_jit, "SAMPLE_STATEMENTS", 0)
    jax.jit(threads(lambda x: halved(2.0 * x)))(x[0])
    assert used[-1] == llvm_jit.LEVELS
