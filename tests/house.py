"""Figures of the house: size, folders, imports, frames, `Any`, public names.

    python -m tests.house [COMMIT]

prints one figure a line. COMMIT: also the lines of each room at that commit.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType, ModuleType

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "rbjax").rglob("*.py"))
#: rooms that were renamed
RENAMED = {"threads": "compiler"}


def code_lines(source: str) -> int:
    """Count the lines with code: without docstrings, comments and blank lines."""
    docs: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            docs |= set(range(value.lineno, (value.end_lineno or value.lineno) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in (
            tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
            tokenize.ENDMARKER,
        ):  # fmt: skip
            lines |= set(range(token.start[0], token.end[0] + 1))
    return len(lines - docs)


def sizes(sources: Iterable[tuple[str, str]]) -> dict[str, Counter[str]]:
    """Sum lines and lines of code by room; a source is a path below rbjax/ and a text."""
    out: dict[str, Counter[str]] = {}
    for path, text in sources:
        room = path.split("/")[0] if "/" in path else "(top)"
        count = Counter(lines=text.count("\n"), code=code_lines(text))
        out.setdefault(RENAMED.get(room, room), Counter()).update(count)
    return out


def sources_at(commit: str) -> Iterator[tuple[str, str]]:
    """Read the Python files of rbjax at a commit."""
    git = ["git", "-C", str(ROOT)]
    names = subprocess.check_output([*git, "ls-tree", "-r", "--name-only", commit, "rbjax"])
    for name in names.decode().split():
        if name.endswith(".py"):
            text = subprocess.check_output([*git, "show", f"{commit}:{name}"]).decode()
            yield name.removeprefix("rbjax/"), text


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def skipped(tree: ast.AST) -> tuple[set[int], set[int]]:
    """Return the nodes below functions, and below `if TYPE_CHECKING`, by id."""
    lazy: set[int] = set()
    typing: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            lazy |= {id(x) for x in ast.walk(node)}
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            typing |= {id(x) for x in ast.walk(node)}
    return lazy - typing, typing


def import_graph() -> tuple[dict[str, set[str]], list[str]]:
    """Return what each module imports when it is loaded, and the imports inside functions."""
    known = {module_of(path): path for path in FILES}
    graph: dict[str, set[str]] = {name: set() for name in known}
    inside: list[str] = []
    for name, path in known.items():
        tree = ast.parse(path.read_text())
        lazy, typing = skipped(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                below = [f"{node.module}.{alias.name}" for alias in node.names]
                names = [x if x in known else str(node.module) for x in below]
            else:
                continue
            ours = {x for x in names if x in known} - {name}
            if ours and id(node) in lazy:
                inside.append(f"{path.relative_to(ROOT)}:{node.lineno}")
            elif id(node) not in typing:
                graph[name] |= ours
    return graph, inside


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Find the strongly connected components of more than one module (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    out: list[list[str]] = []

    def visit(x: str) -> None:
        index[x] = low[x] = len(index)
        stack.append(x)
        for y in graph[x]:
            if y not in index:
                visit(y)
                low[x] = min(low[x], low[y])
            elif y in stack:
                low[x] = min(low[x], index[y])
        if low[x] == index[x]:
            k = stack.index(x)
            if len(stack) - k > 1:
                out.append(sorted(stack[k:]))
            del stack[k:]

    sys.setrecursionlimit(10_000)
    for x in graph:
        if x not in index:
            visit(x)
    return out


def frames() -> tuple[list[str], list[str]]:
    """Trace `rb.forward_dynamics`; return its frames to the first product, and those met twice."""
    import jax
    import jax.numpy as jnp

    import rbjax as rb

    model = rb.load("double_pendulum")
    found: list[FrameType] = []
    bind = jax.lax.mul_p.bind

    def first(*args: object, **params: object) -> object:
        if not found:
            frame: FrameType | None = sys._getframe()
            while frame is not None:
                found.append(frame)
                frame = frame.f_back
        return bind(*args, **params)

    jax.lax.mul_p.bind = first
    try:
        rb.forward_dynamics(model, jnp.ones(2), jnp.ones(2), jnp.ones(2))
    finally:
        jax.lax.mul_p.bind = bind
    ours = [f.f_code for f in found if f"{ROOT}/rbjax/" in f.f_code.co_filename][::-1]
    twice = [code.co_name for code, n in Counter(ours).items() if n > 1]
    return [f"{Path(c.co_filename).stem}.{c.co_name}" for c in ours], twice


def public_names(room: ModuleType) -> dict[str, set[str]]:
    """Return the names of a room and of its packages."""
    out: dict[str, set[str]] = {room.__name__: set()}
    for name in room.__all__:
        x = getattr(room, name)
        if isinstance(x, ModuleType) and hasattr(x, "__all__"):
            out |= public_names(x)
        else:
            out[room.__name__].add(name)
    return out


def main() -> None:
    now = sizes((str(p.relative_to(ROOT / "rbjax")), p.read_text()) for p in FILES)
    then = sizes(sources_at(sys.argv[1])) if sys.argv[1:] else {}
    print(f"{'room':14}{'lines':>8}{'code':>8}{'then':>8}{'code':>8}")
    for room in sorted(now.keys() | then.keys()):
        counts = [x.get(room, Counter()) for x in (now, then)]
        print(f"{room:14}" + "".join(f"{c['lines']:8}{c['code']:8}" for c in counts))
    for title, rooms in (("all", now), ("all then", then)):
        both = sum(rooms.values(), Counter())
        print(f"{title}: {both['lines']} lines, {both['code']} of code")
    if then:
        old = sum((now[room] for room in now.keys() & then.keys()), Counter())
        print(f"rooms of both: {old['lines']} lines, {old['code']} of code")
    folders = Counter(path.parent.relative_to(ROOT).as_posix() for path in FILES)
    print("files in a folder:", folders.most_common(5))
    graph, lazy = import_graph()
    print("circles:", circles(graph))
    print("imports inside functions:", len(lazy), *lazy)
    lines = [
        line
        for path in FILES
        if "compiler" in path.parts
        for line in path.read_text().splitlines()
        if re.search(r"\bAny\b", line) and "import" not in line
    ]
    print("lines with Any in the compiler:", len(lines))
    called, twice = frames()
    print("frames to the first product:", len(called), *called)
    print("frames passed twice:", twice)
    from docs.generate.reference import rooms
    from rbjax import control, sysid

    for room in (control, sysid):
        names = public_names(room)
        print(
            len(set().union(*names.values())),
            "public names:",
            {k: len(x) for k, x in names.items()},
        )
        homes = (path for paths in rooms.results().values() for path in paths)
        found = sum(path.startswith(f"{room.__name__}.") for path in homes)
        print(found, "results without a public name, described after their functions")


if __name__ == "__main__":
    main()
