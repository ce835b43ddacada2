"""The values that a function can read, as a cache key and operands.

A function is its code and the values that the code can reach: defaults, cells, globals by name, and
the same of these values. `Reader` traverses them. Numbers become operands, and the function can be
rebuilt with other numbers. Other values are part of the key, by value, or by identity for constant
objects (modules, types and functions of libraries). An object that cannot be rebuilt from its parts
(a class, an instance, a user's module) is part of the key with all its parts.
"""

from __future__ import annotations

import builtins
import functools
import itertools
import os
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from types import (
    BuiltinFunctionType,
    CellType,
    FunctionType,
    GetSetDescriptorType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.motion.closures.code_names import DEEP, HIDDEN, INSTALLED, Names, names_of, of_library

#: levels, by the values that become operands: arrays and floats; arrays; only tracers
FLOATS, ARRAYS, TRACERS = range(3)
ATOMS = frozenset({type(None), bool, int, str, bytes, range, type(...)})
FIXED = (BuiltinFunctionType, np.ufunc, type(jax.jit(lambda: None)))  # compared by identity
LARGEST = 1 << 16  # largest numpy array in a key, bytes
MOST = 2_000  # largest number of objects to read

#: function from the operands, and the functions rebuilt before by number, to a value; None: the
#: value itself
Maker = Callable[[Sequence, dict[int, Any]], Any] | None


class UnreadableError(Exception):
    """Raised if a function may read values that the reader cannot find."""


class HiddenError(UnreadableError):
    """Raised if a user's code reads variables or files without naming them, so that its result may
    change without its key. Arguments: the name of the code, and the function by which it reads."""


class Same:
    """A wrapper that compares an object by identity."""

    __slots__ = ("x",)

    def __init__(self, x: Any) -> None:
        self.x = x

    def __hash__(self) -> int:
        return id(self.x)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.x is other.x


MISSING = Same(None)  # an empty cell, or an undefined global


#: attributes in which an object stores its fields, which are read directly
PLACES = (GetSetDescriptorType, MemberDescriptorType, type(Names.read))


class Reader:
    """Reads a function and the values that it refers to.

    `read` returns the key of a value, and a function that makes the value from the operands.

    operands: the numbers read so far.

    Arguments of `read`: held, whether x is a part of an object that cannot be rebuilt; names, the
    names in the code that reads x.
    """

    def __init__(self, level: int) -> None:
        self.level = level
        self.operands: list[jax.Array] = []
        self.places: dict[int, tuple[int, Any]] = {}  # array operands, by identity
        self.known: dict[int, tuple[int, Any]] = {}  # numpy arrays of the key, by identity
        # whether code reads attributes without naming them; whether a user's module is read
        self.deep = self.of_modules = False
        self.seen: dict[tuple, tuple[Any, Maker] | None] = {}

    def read(
        self, x: Any, held: bool = False, names: frozenset[str] = frozenset()
    ) -> tuple[Any, Maker]:
        kind = type(x)
        if kind in ATOMS or isinstance(x, (np.dtype, Enum)):
            return (kind, x), None
        if x is MISSING:
            return x, None
        if kind in (float, complex):  # by repr: zeros have signs, and nan equals nan
            known = held or self.level > FLOATS
            return ((kind, repr(x)), None) if known else self._operand(jnp.asarray(x), x)
        if isinstance(x, jax.core.Tracer):
            if held:
                raise UnreadableError
            return self._operand(x, x)
        if isinstance(x, jax.Array):
            return (Same(x), None) if held or self.level > ARRAYS else self._operand(x, x)
        if isinstance(x, (np.ndarray, np.generic)):
            return self._of_numpy(x, held)
        at = (id(x), held, names if kind is ModuleType else ())
        if at not in self.seen:
            n = len(self.seen)
            if n > MOST:
                raise UnreadableError
            again = ("again", n), (lambda _, made: made[n]) if not held else None
            self.seen[at] = again if held or kind is FunctionType else None
            key, make = self._object(x, held, names, n)
            self.seen[at] = again[0], make
            return key, make
        found = self.seen[at]
        if found is None:  # a list that contains itself
            raise UnreadableError
        return found

    def _operand(self, x: jax.Array, source: Any) -> tuple[Any, Maker]:
        """Add x, the JAX array of `source`, to the operands, unless an operand of the same array
        exists."""
        i, is_array = len(self.operands), not isinstance(source, (float, complex))
        if is_array and id(source) in self.places:
            i = self.places[id(source)][0]
            return ("operand", i), lambda operands, _: operands[i]
        if is_array:
            self.places[id(source)] = i, source  # a reference, so that the id stays unique
        self.operands.append(x)
        return "operand", lambda operands, _: operands[i]

    def _of_numpy(self, x: Any, held: bool) -> tuple[Any, Maker]:
        """Read a numpy array. Integer arrays, mostly indices, are part of the key."""
        if x.dtype.kind not in "biufc":
            raise UnreadableError
        if x.dtype.kind in "fc" and not held and self.level <= ARRAYS:
            # a copy: the caller may change x before the program reads it
            return self._operand(jnp.array(x), x)
        if x.nbytes > LARGEST:
            raise UnreadableError
        # equal arrays may differ in identity (`x is y`), so the key contains their index
        which, _ = self.known.setdefault(id(x), (len(self.known), x))
        return (type(x), x.dtype, x.shape, x.tobytes(), which), None

    def _object(self, x: Any, held: bool, names: frozenset[str], n: int) -> tuple[Any, Maker]:
        kind = type(x)
        if _named_by_library(x):
            return Same(x), None
        if kind is FunctionType:
            return self._function(x, held, n)
        if kind is ModuleType:
            return self._module(x, names)
        if isinstance(x, FIXED):
            owner = getattr(x, "__self__", None)
            home = owner.__module__ if isinstance(owner, type) else x.__module__
            if kind is BuiltinFunctionType and not of_library(home):
                raise UnreadableError  # a clock, or a method of a C object
            return Same(x), None
        if isinstance(x, type):
            return self._class(x)
        if kind is MethodType:
            return self._parts(kind, (x.__func__, x.__self__), held, lambda v: kind(*v))
        if kind in (functools.partial, jax.tree_util.Partial):
            given = (x.func, x.args, x.keywords)
            return self._parts(kind, given, held, lambda v: kind(v[0], *v[1], **v[2]))
        if x is os.environ:
            return ("environ", *sorted(x.items())), None
        if kind in (dict, defaultdict):  # in insertion order: a pytree would sort the keys
            due, keys = tuple(x), tuple(self.read(k, True)[0] for k in x)
            first: tuple = () if kind is dict else (x.default_factory,)
            missing = tuple(self.read(f, True)[0] for f in first)
            again: Any = kind
            make = lambda v: again(*first, zip(due, v, strict=True))  # noqa: E731
            return self._parts((kind, keys, missing), x.values(), held, make)
        if kind in (set, frozenset):
            return self._parts(kind, x, True)
        leaves, tree = jax.tree.flatten(x, is_leaf=lambda y: y is not x and not _is_plain(y))
        if leaves and leaves[0] is x:  # not a pytree
            return self._instance(x)
        # functions in static fields compare by identity, and may read values that change
        fields = [f for f in getattr(x, "__dict__", {}).values() if callable(f)]
        static = [f for f in fields if not any(f is y for y in leaves)]
        about = tree, self._parts(kind, [kind, *static], True)[0]
        return self._parts(about, leaves, held, lambda v: jax.tree.unflatten(tree, v))

    def _parts(
        self,
        about: Any,
        parts: Iterable,
        held: bool,
        make: Callable[[list], Any] = list,
        names: frozenset[str] = frozenset(),
    ) -> tuple[Any, Maker]:
        """Read the parts of an object. Return its key (`about`, then the keys of the parts) and its
        maker, which is None if no part has operands."""
        parts = list(parts)
        read = [self.read(x, held, names) for x in parts]
        key = (about, *(k for k, _ in read))
        makers = [m for _, m in read]
        if held or not any(makers):
            return key, None
        kept = [x if m is None else None for x, m in zip(parts, makers, strict=True)]

        def made_again(operands: Sequence, made: dict[int, Any]) -> Any:
            pairs = zip(kept, makers, strict=True)
            return make([x if m is None else m(operands, made) for x, m in pairs])

        return key, made_again

    def _function(self, f: FunctionType, held: bool, n: int) -> tuple[Any, Maker]:
        code, home, name = f.__code__, f.__globals__, f.__name__
        library = of_library(home.get("__name__"))
        if library and not f.__closure__:
            return Same(f), None
        names = names_of(code)
        if library:  # the globals of a library do not change
            held |= names.curious or not names.readable
        else:
            usual = home.get("__builtins__") in (builtins, vars(builtins))
            hidden = sorted(names.every & HIDDEN)
            if hidden and not code.co_filename.startswith(INSTALLED):
                raise HiddenError(f.__qualname__, hidden[0])
            later = (names.curious or names.compares) and not held and self.level < TRACERS
            known = all(x in sys.modules for x in names.imports)
            if later or not (usual and names.readable and known):
                raise UnreadableError
            self.deep |= bool(names.every & DEEP)
            self._check_modules()
        read = () if library else names.read
        about = {k: x for k, x in vars(f).items() if k != "__wrapped__"}
        by_name = f.__kwdefaults__ or {}
        imports = () if library else sorted(names.imports)
        groups = [
            f.__defaults__ or (),
            by_name.values(),
            [_content(cell) for cell in f.__closure__ or ()],
            [home.get(k, MISSING) for k in read],
            about.values(),
            [sys.modules[k] for k in imports],
        ]
        ends = list(itertools.accumulate(map(len, groups)))
        key, values = self._parts(
            (code, *ends, *by_name, *about), itertools.chain(*groups), held, names=names.every
        )
        if values is None:
            return key, None
        own = {k: home.get(k) for k in ("__builtins__", "__name__", "__package__")}
        known_names, about_names = tuple(by_name), tuple(about)

        def make(operands: Sequence, made: dict[int, Any]) -> FunctionType:
            if n not in made:
                scope = home if library else dict(own)
                cells = tuple(CellType() for _ in code.co_freevars)
                made[n] = f = FunctionType(code, scope, name, None, cells)
                found = values(operands, made)
                parts = [found[i:j] for i, j in zip([0, *ends], ends, strict=False)]
                f.__defaults__ = tuple(parts[0])
                f.__kwdefaults__ = dict(zip(known_names, parts[1], strict=True))
                for cell, x in zip(cells, parts[2], strict=True):
                    if x is not MISSING:
                        cell.cell_contents = x
                scope |= {k: x for k, x in zip(read, parts[3], strict=True) if x is not MISSING}
                vars(f).update(zip(about_names, parts[4], strict=True))
            return made[n]

        return key, make

    def _module(self, module: ModuleType, names: frozenset[str]) -> tuple[Any, Maker]:
        """Read the attributes of a user's module that the code names."""
        if of_library(module.__name__):
            if module.__name__ == "numpy.random" or (module is np and "random" in names):
                raise UnreadableError
            return Same(module), None
        self.of_modules = True
        self._check_modules()
        inside = vars(module)
        if not names or "__getattr__" in inside:
            raise UnreadableError
        read = sorted(names & inside.keys())
        return self._parts((Same(module), *read), [inside[k] for k in read], True, names=names)

    def _check_modules(self) -> None:
        """Raise if code reads attributes without naming them and a user's module is read: the key
        contains only the named attributes of a module."""
        if self.deep and self.of_modules:
            raise UnreadableError

    def _class(self, kind: type) -> tuple[Any, Maker]:
        """Read a class: its identity, and for a user's class its attributes and the values that its
        methods read."""
        found: list[Any] = []
        bases = () if issubclass(kind, Enum) else kind.__mro__
        for base in bases:
            for name, x in {} if of_library(base.__module__) else vars(base).items():
                for way in ("method", "__func__", "fget", "func"):
                    x = getattr(x, way, x)
                made = isinstance(x, FunctionType) and x.__module__.startswith("namedtuple_")
                inner = name[:2] == "__" and not isinstance(x, FunctionType)
                if not (made or inner or name == "_abc_impl" or isinstance(x, PLACES)):
                    found += [name, x]
        return self._parts(Same(kind), found, True)

    def _instance(self, x: Any) -> tuple[Any, Maker]:
        """Read an object by its class and its state, if pickle would use only these."""
        kind = type(x)
        if of_library(kind.__module__) and kind.__hash__ not in (None, object.__hash__):
            return (kind, x), None
        if any(
            getattr(kind, way) is not getattr(object, way)
            for way in ("__reduce__", "__reduce_ex__", "__getstate__")
            if hasattr(object, way)
        ):
            raise UnreadableError
        reduced: Any = object.__reduce_ex__(x, 2)
        state, *items = reduced[2:]
        if any(item is not None for item in items):
            raise UnreadableError
        plain, slots = state if isinstance(state, tuple) else (state, None)
        both = (plain or {}) | (slots or {})
        held = {k: v for k, v in both.items() if k[:2] != "__"}  # without documentation
        return self._parts(("object", *held), [kind, *held.values()], True)


def _named_by_library(x: Any) -> bool:
    module: Any = getattr(x, "__module__", None)
    name = getattr(x, "__name__", "")
    return of_library(module) and vars(sys.modules.get(module, object)).get(name) is x


def _is_plain(x: Any) -> bool:
    """Check whether a pytree node is a list, a tuple or an rbjax object, whose static values
    compare by value."""
    return type(x) in (list, tuple) or type(x).__module__.startswith("rbjax.")


def _content(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # an empty cell
        return MISSING
