"""The memory of a thread: arrays that share theirs, inverses in place, implicit formulations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.compiler.cuda.kernels import ARRAY_BYTES_UP_TO, STATEMENTS_UP_TO
from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.statements import Block, If, Load, Loop, Reserve, Store, While, walk
from rbjax.compiler.passes.liveness import share_memory
from rbjax.dynamics.drivers import choice
from rbjax.lanes import inverse
from tests.compiler.host import COMPILER, on_host, written
from tests.compiler.test_constraints import gradient_of, step_of

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
F64 = np.dtype(np.float64)


def reserved(block: Block) -> list[int]:
    return [s.array.size for s in walk(block) if isinstance(s, Reserve)]


def used(block: Block) -> list[int]:
    """The arrays of loads and stores, in order."""
    return [s.array.id for s in walk(block) if isinstance(s, Load | Store)]


def test_arrays_one_after_another_share_memory() -> None:
    """Two in turn share; one that lasts does not; the largest decides the size."""
    b = Builder()
    lasting = b.local(F64, 5)
    b.store(lasting, None, 0, F64.type(1))
    for size in (3, 9, 4):
        array = b.local(F64, size)
        b.store(array, None, 0, F64.type(size))
        b.load(array, None, 0)
    b.load(lasting, None, 0)
    share_memory(b.block)
    assert sorted(reserved(b.block)) == [5, 9]
    first, *short, last = used(b.block)
    assert first == last and len(set(short)) == 1 and first not in short


def test_types_do_not_share() -> None:
    b = Builder()
    for kind in (F64, np.dtype(np.int32)):
        array = b.local(kind, 3)
        b.store(array, None, 0, kind.type(1))
    share_memory(b.block)
    assert reserved(b.block) == [3, 3]


@pytest.mark.parametrize("kind", ["loop", "while"])
def test_what_a_loop_reads_lasts_until_its_end(kind: str) -> None:
    """Of an array from outside the next turn needs what is read early in this one."""
    b = Builder()
    outside = b.local(F64, 2)
    b.store(outside, None, 0, F64.type(1))
    body = Block()
    node = Loop(b.var(np.int32), 3, False, body)
    if kind == "while":
        node = While(Block(), np.bool_(True), body)
    b.block.statements.append(node)
    with b.inside(body):
        b.load(outside, None, 0)
        own = [b.local(F64, 2) for _ in range(2)]
        for array in own:
            b.store(array, None, 0, F64.type(2))
    after = b.local(F64, 2)
    b.store(after, None, 0, F64.type(3))
    share_memory(b.block)
    first, again, one, two, last = used(b.block)
    assert first == again and first not in (one, two) and last in (first, one, two)


def test_branches_share_memory() -> None:
    b = Builder()
    node = If(b.var(bool), Block(), Block())
    b.block.statements.append(node)
    for block in (node.then, node.otherwise):
        with b.inside(block):
            array = b.local(F64, 2)
            b.store(array, None, 0, F64.type(2))
    share_memory(b.block)
    assert reserved(b.block) == [2]


@needs_compiler
def test_inverses() -> None:
    """Real and complex ones beside LAPACK's; pivots where the diagonal is zero; in place."""
    rng = np.random.default_rng(0)
    re, im = rng.normal(size=(2, 4, 12, 12))
    re[0] -= np.diag(np.diag(re[0]))

    def both(re, im):
        return inverse(re)[0], inverse(re, im)

    real, (x, y) = on_host(both, jnp.array(re), jnp.array(im))
    one = np.broadcast_to(np.eye(12), re.shape)
    np.testing.assert_allclose(real @ re, one, atol=1e-11)
    np.testing.assert_allclose((x + 1j * y) @ (re + 1j * im), one, atol=1e-12)
    want = jax.jit(jax.vmap(both))(re, im)
    np.testing.assert_allclose(want[1][0], x, atol=1e-12)
    assert written(both, re, im)[0].array_bytes < 1.1 * 3 * 144 * 8


def bytes_of(scene: str, name: str, of) -> int:
    """The bytes of a thread in f64."""
    model = rb.load(scene).astype(jnp.float64)
    model = choice.on_threads(model, F64)
    state = model.default_state()
    q, v = np.asarray(state.q)[None], np.ones((1, model.nv))
    program = written(of(model, name), q, v)[0]
    assert program.statements < STATEMENTS_UP_TO
    return program.array_bytes


@pytest.mark.slow
@pytest.mark.parametrize("name", ["index_2", "index_3", "ggl"])
@pytest.mark.parametrize(
    "scene, of", [("four_bar", step_of), ("four_bar", gradient_of), ("delta", step_of)]
)
def test_implicit_steps_fit_a_thread(scene: str, of, name: str) -> None:
    assert bytes_of(scene, name, of) < ARRAY_BYTES_UP_TO
