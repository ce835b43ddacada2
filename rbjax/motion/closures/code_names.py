"""The names in a function's code, from its bytecode instructions."""

from __future__ import annotations

import dis
import functools
import itertools
import sysconfig
from types import CodeType
from typing import Any, NamedTuple

#: packages whose globals do not change
LIBRARIES = frozenset({
    "abc", "builtins", "chex", "cmath", "collections", "dataclasses", "diffrax", "enum", "equinox",
    "functools", "itertools", "jax", "jaxlib", "jaxtyping", "lineax", "math", "numpy", "operator",
    "optax", "optimistix", "rbjax", "types", "typing",
})  # fmt: skip
#: names by which code reads values without naming them: variables, files, other modules
HIDDEN = frozenset({"__import__", "eval", "exec", "globals", "open"})
#: names by which code has side effects, or runs outside the compiled program
UNREADABLE = HIDDEN | {"callback", "io_callback", "pure_callback", "setattr"}
#: names by which code reads attributes of named objects without naming the attributes
DEEP = frozenset({"__dict__", "dir", "getattr", "locals", "vars"})
#: names by which code may detect a tracer instead of a number, and take another branch
CURIOUS = frozenset({
    "Tracer", "hash", "id", "isinstance", "issubclass", "repr", "str", "type",
}) | DEEP  # fmt: skip
#: folders of installed packages; `HIDDEN` names in their code cause no warning
INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")})
WRITING = frozenset({"STORE_GLOBAL", "DELETE_GLOBAL", "STORE_DEREF", "DELETE_DEREF"})


class Names(NamedTuple):
    """The names in a function's code and in its nested functions.

    read: globals that it reads.
    every: all names.
    curious: whether it may detect a tracer.
    compares: whether it compares objects by identity.
    readable: whether it has no side effects and reads only values that it names.
    imports: user modules that it imports.
    """

    read: tuple[str, ...]
    every: frozenset[str]
    curious: bool
    compares: bool
    readable: bool
    imports: frozenset[str]


@functools.lru_cache(4096)
def names_of(code: CodeType) -> Names:
    ops = list(dis.get_instructions(code))
    inner = [names_of(c) for c in code.co_consts if isinstance(c, CodeType)]
    loaded = (op.argval for op in ops if op.opname in {"LOAD_GLOBAL", "LOAD_NAME"})
    read = dict.fromkeys(itertools.chain(loaded, *(x.read for x in inner)))
    every = frozenset(code.co_names).union(*(x.every for x in inner))
    catches = bool(code.co_exceptiontable) or any(op.opname == "MATCH_CLASS" for op in ops)
    pairs = zip([None, *ops], ops, strict=False)
    compares = "hasattr" in every or any(
        op.opname == "IS_OP" and not (before and before.opname == "LOAD_CONST")
        for before, op in pairs
    )
    leaks = any(op.opname in WRITING and op.argval not in code.co_cellvars for op in ops)
    named = (op.argval for op in ops if op.opname == "IMPORT_NAME")
    own = (x for name in named if not of_library(name) for x in (name, name.split(".")[0]))
    imports = frozenset(own).union(*(x.imports for x in inner))
    return Names(
        tuple(read),
        every,
        catches or bool(every & CURIOUS) or any(x.curious for x in inner),
        compares or any(x.compares for x in inner),
        not (leaks or every & UNREADABLE) and all(x.readable for x in inner),
        imports,
    )


def of_library(module: Any) -> bool:
    return isinstance(module, str) and module.split(".")[0] in LIBRARIES
