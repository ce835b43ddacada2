"""What fails on a machine (a folder, a compiler, a version, a device) falls back with a true
sentence, or works."""

from __future__ import annotations

import ctypes
import gc
import re
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.compiler import disk_cache
from rbjax.compiler.cuda import driver, nvrtc
from rbjax.compiler.ir.program import batch_first
from rbjax.compiler.ir.statements import Unsupported
from rbjax.compiler.jax import launch, primitive
from rbjax.compiler.jax.function import compile_threads
from rbjax.compiler.jax.garbage import PAUSED, gc_paused
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.llvm import xla_handler as llvm_xla
from rbjax.compiler.lower.write import write_program
from tests.compiler.lowering import lowered
from tests.tolerances import F64_TRANSFORM, relative_error

X = np.random.default_rng(0).normal(size=(40, 3))

# ------------------------------------------------------------------- compiled code on disk


@pytest.fixture
def folder(tmp_path):
    """JAX's cache in a folder of the test."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    disk_cache._warn.cache_clear()
    yield tmp_path / "cache"
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_folder_that_cannot_be_written_is_said_once(folder):
    folder.write_text("a file, where a folder should be")
    with pytest.warns(UserWarning, match=r"not kept on disk.*make .*cache.* writable") as found:
        made = [disk_cache.read_or_make("one.o", lambda: b"code") for _ in range(3)]
        assert made == [b"code"] * 3
    assert len(found) == 1


@pytest.mark.parametrize("step", ["mkdir", "replace", "read_bytes"])
def test_whatever_step_fails_the_code_is_made(folder, monkeypatch, step):
    def fails(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(disk_cache.os if step == "replace" else Path, step, fails)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        assert disk_cache.read_or_make("one.o", lambda: b"code") == b"code"
    assert len(found) == (step != "read_bytes")
    monkeypatch.undo()
    assert [file.name for file in folder.rglob("*.o")] == ["one.o"] * (step == "read_bytes")
    assert not list(folder.rglob("tmp*"))


def test_damaged_code_is_compiled_again(folder):
    made = []
    for damage in (None, b"", b"short", bytes(100)):
        if damage is not None:
            (folder / "rbjax-threads" / "one.o").write_bytes(damage)
        assert disk_cache.read_or_make("one.o", lambda: made.append(1) or b"code") == b"code"
        assert disk_cache.read_or_make("one.o", lambda: made.append(1) or b"code") == b"code"
    assert len(made) == 4


def test_machine_code_runs_without_a_folder(folder, monkeypatch):
    folder.write_text("")
    launch.host_kernels_work.cache_clear()
    llvm_jit._codes.clear()
    try:
        with pytest.warns(UserWarning, match="not kept on disk") as found:
            assert launch.host_kernels_work()
        assert sum("not kept on disk" in str(w.message) for w in found) == 1
    finally:
        launch.host_kernels_work.cache_clear()


# ------------------------------------------------------------------- compilers and versions


@pytest.mark.parametrize("order", [0, 1])
def test_a_kernel_that_the_gpu_s_compiler_rejects_runs_under_xla(gpu, monkeypatch, order):
    def rejects(source, capability):
        raise nvrtc.CompileError("NVRTC does not compile a kernel: error C2143")

    monkeypatch.setattr(launch, "ptx", rejects)
    values = jax.vmap(compile_threads(lambda x: jnp.sin(x) * 2))
    g = jax.grad(lambda x: values(x).sum()) if order else values
    with pytest.warns(UserWarning, match=r"rejects .*error C2143.*runs under XLA"):
        text = lowered(g, X)
    assert launch.GPU_KERNEL not in text and ("cosine" if order else "sine") in text


def test_sums_over_the_batch_count_as_memory_of_a_thread(gpu, monkeypatch):
    """The weights' gradient of a network: each thread holds an array of its size."""
    sizes = []
    monkeypatch.setattr(launch, "ptx", lambda source, capability: sizes.append(source) or "PTX")

    def loss(n):
        def of(w, x):
            layer = compile_threads(lambda x, w: jnp.tanh(w @ x))
            return (jax.vmap(layer, (0, None))(x, w) ** 2).sum()

        return jax.grad(of), (jnp.ones((n, n), np.float32), jnp.ones((8, n), np.float32))

    g, args = loss(8)
    assert lowered(g, *args).count(launch.GPU_KERNEL) == 2
    g, args = loss(129)  # 66,564 bytes
    with pytest.warns(UserWarning, match=r"\d{5,} bytes of arrays in a thread, more than 65536"):
        lowered(g, *args)


def program(batch=()):
    closed = jax.make_jaxpr(lambda x: [x * 2])(1.0)
    places = [batch_first((), batch)]
    return write_program(closed, batch, places, places, platform="cpu")


def test_the_version_of_the_interface_is_that_of_the_offsets():
    """So that XLA can reject the handler when it no longer runs that version."""
    header = Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text()
    number = {name: int(n) for name, n in re.findall(r"#define XLA_FFI_API_(M\w+) (\d+)", header)}
    assert number["MAJOR"] == llvm_xla.MAJOR and number["MINOR"] >= llvm_xla.MINOR
    text = llvm_xla.write_handler(program())[0].text
    assert f"store i64 {llvm_xla.MINOR << 32 | llvm_xla.MAJOR}, ptr %v" in text


@pytest.mark.parametrize("minor", [llvm_xla.MINOR, 99])
def test_a_handler_of_an_unknown_version_runs_under_xla(monkeypatch, minor):
    """XLA asks a handler for its version when it is registered."""
    answer = llvm_xla.METADATA_ANSWER.replace(
        f"store i64 {llvm_xla.MINOR << 32 | llvm_xla.MAJOR}",
        f"store i64 {minor << 32 | llvm_xla.MAJOR}",
    )
    monkeypatch.setattr(llvm_xla, "METADATA_ANSWER", answer)
    monkeypatch.setattr(launch, "_registered", dict(launch._registered))
    if minor == llvm_xla.MINOR:
        assert launch.register_host_kernel(program()).parts == 1
        return
    with pytest.raises(Unsupported, match="a handler that XLA rejects"):
        launch.register_host_kernel(program())
    monkeypatch.setattr(launch, "uses_llvm", lambda: True)
    primitive._warn.cache_clear()
    primitive._kernel.cache_clear()
    with pytest.warns(UserWarning, match="a handler that XLA rejects.*runs under XLA"):
        found = jax.jit(compile_threads(lambda x: jnp.tan(x) * 7))(0.5)
    assert found == pytest.approx(7 * np.tan(0.5))


def test_the_self_test_covers_two_parts(monkeypatch):
    """The threads of XLA's pool are reached by a batch of parts only."""
    made = []
    real = launch.write_handler
    monkeypatch.setattr(launch, "write_handler", lambda *a: made.append(real(*a)) or made[-1])
    launch.host_kernels_work.cache_clear()
    try:
        assert launch.host_kernels_work()
        (module, parts), *_ = made
        assert parts == 2 and "@invite" in module.text

        wrong = llvm_xla.SHARING.replace("icmp slt i64 %index, COUNT", "icmp slt i64 %index, 1")
        wrong = wrong.replace("icmp eq i64 %done, COUNT", "icmp eq i64 %done, 1")
        monkeypatch.setattr(llvm_xla, "SHARING", wrong)
        launch.host_kernels_work.cache_clear()
        with pytest.warns(UserWarning, match="the self-test's result is wrong"):
            assert not launch.host_kernels_work()
    finally:
        monkeypatch.undo()
        launch.host_kernels_work.cache_clear()


def test_threads_that_compile_equal_functions_at_once(monkeypatch):
    """XLA rejects a second handler of one name at another address."""
    monkeypatch.setattr(launch, "_registered", {})
    llvm_jit._codes.clear()
    made, make = [], llvm_jit.compile_object
    monkeypatch.setattr(llvm_jit, "compile_object", lambda *a: made.append(1) or make(*a))
    together = threading.Barrier(8)

    def one(_):
        closed = jax.make_jaxpr(lambda x: [x * 2.000244140625])(1.0)  # of this test only
        places = [batch_first((), ())]
        written = write_program(closed, (), places, places, platform="cpu")
        together.wait(20)
        return launch.register_host_kernel(written)

    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        with ThreadPoolExecutor(8) as pool:
            kernels = list(pool.map(one, range(8)))
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert len({k.name for k in kernels}) == len(made) == 1


def test_compiled_code_is_let_go(monkeypatch):
    monkeypatch.setattr(llvm_jit, "KEPT", 3)
    monkeypatch.setattr(llvm_jit, "_codes", {})
    from rbjax.compiler.llvm import numpy_call

    for k in range(5):
        closed = jax.make_jaxpr(lambda x, k=k: [x + k])(1.0)
        places = [batch_first((), ())]
        llvm_jit.compile_module(numpy_call.write_module(write_program(closed, (), places, places)))
    assert len(llvm_jit._codes) == 3
    assert all(len(key) == 64 for key in llvm_jit._codes)  # a digest, not the text


# ------------------------------------------------------------------- devices


def gpus(*capabilities):
    return lambda backend=None: [
        SimpleNamespace(compute_capability=c, local_hardware_id=3 + k)
        for k, c in enumerate(capabilities)
    ]


@pytest.mark.parametrize(
    ("capabilities", "least", "number"),
    [(["9.0"], "9.0", 3), (["9.0", "8.0"], "8.0", 4), (["10.0", "9.0", "12.0"], "9.0", 4)],
)
def test_kernels_are_compiled_for_the_gpus_of_this_process(
    monkeypatch, capabilities, least, number
):
    monkeypatch.setattr(jax, "local_devices", gpus(*capabilities))
    monkeypatch.setattr(jax, "devices", None)  # those of other processes are not asked
    assert (launch.capability(), launch.ordinal()) == (least, number)


class Driver:
    """What stands for libcuda."""

    def __init__(self):
        self.devices = []

    def __getattr__(self, name):
        def call(*args):
            if name == "cuDeviceGet":
                self.devices.append(args[1])
            if name == "cuDeviceGetAttribute":
                ctypes.cast(args[0], ctypes.POINTER(ctypes.c_int))[0] = 100
            return 0

        return call


def test_the_driver_opens_no_device_of_another_process(monkeypatch):
    libcuda = Driver()
    monkeypatch.setattr(driver, "_driver", lambda: libcuda)
    monkeypatch.setattr(driver, "_compiled", set())
    monkeypatch.delenv("CUDA_CACHE_DISABLE", raising=False)
    driver.compile_ahead("x" * driver.LONG, lambda: 5).join()
    driver.resources("PTX", "name", 5)
    driver.limits("9.0", 5)
    assert libcuda.devices == [5, 5, 5]


@pytest.mark.parametrize(
    ("capability", "lanes"), [("7.0", 64), ("8.0", 64), ("8.6", 128), ("9.0", 128), ("10.0", 128)]
)
def test_lanes_of_a_multiprocessor(monkeypatch, capability, lanes):
    monkeypatch.setattr(driver, "_driver", Driver)
    assert driver.limits(capability).instructions == 100 * lanes * 1e5


def test_the_newest_nvrtc_comes_first():
    files = [
        "/nvidia/cuda_nvrtc/lib/libnvrtc.so.12", "/nvidia/cu13/lib/libnvrtc.so.13",
        "/usr/local/cuda-9/lib64/libnvrtc.so.9.2", "/usr/local/cuda-13/lib64/libnvrtc.so.13.10",
        "/usr/local/cuda-13/lib64/libnvrtc.so.13.9",
    ]  # fmt: skip
    found = [Path(x).name.split(".so.")[1] for x in nvrtc.newest_first(files)]
    assert found == ["13.10", "13.9", "13", "12", "9.2"]


# ------------------------------------------------------------------- the garbage collector


@pytest.fixture
def collector():
    before, enabled = gc.get_threshold(), gc.isenabled()
    gc.enable()
    yield before
    gc.set_threshold(*before)
    (gc.enable if enabled else gc.disable)()


@pytest.mark.parametrize("wish", ["nothing", "disable", "enable", "set_threshold", "never"])
def test_what_the_caller_asks_of_the_collector_stays(collector, wish):
    started, go, seen = threading.Event(), threading.Event(), []
    usual = (0, 10, 10) if wish == "never" else collector
    gc.set_threshold(*usual)

    def work():
        started.set()
        seen.append(gc.get_threshold()[0])
        assert go.wait(20)

    thread = threading.Thread(target=gc_paused()(gc_paused()(work)))
    thread.start()
    assert started.wait(20)
    if wish in ("disable", "enable"):
        getattr(gc, wish)()
    if wish == "set_threshold":
        gc.set_threshold(123, 4, 5)
    go.set()
    thread.join()
    assert seen == [0 if wish == "never" else PAUSED]
    assert gc.isenabled() == (wish != "disable")
    assert gc.get_threshold() == ((123, 4, 5) if wish == "set_threshold" else usual)


def test_calls_that_overlap_and_calls_that_fail_leave_the_collector_as_it_was(collector):
    def fails():
        raise KeyError

    with pytest.raises(KeyError):
        gc_paused()(fails)()
    assert gc.get_threshold() == collector
    first, second = threading.Event(), threading.Event()
    thread = threading.Thread(target=gc_paused()(lambda: first.set() or second.wait(20)))
    thread.start()
    assert first.wait(20)
    gc_paused()(lambda: None)()
    assert gc.get_threshold()[0] == PAUSED  # the first is still at work
    second.set()
    thread.join()
    assert gc.get_threshold() == collector


# ------------------------------------------------------------------- several processes


def test_a_process_compiles_on_its_own_devices(monkeypatch):
    """The first device of all is of another process under `jax.distributed`."""
    monkeypatch.setattr(jax, "devices", None)
    launch.host_kernels_work.cache_clear()
    try:
        assert launch.host_kernels_work()
    finally:
        monkeypatch.undo()
        launch.host_kernels_work.cache_clear()
    monkeypatch.setattr(launch, "uses_llvm", lambda: True)
    got = jax.jit(jax.vmap(compile_threads(jnp.sin)))(X)
    assert relative_error(got, np.sin(X)) <= F64_TRANSFORM
