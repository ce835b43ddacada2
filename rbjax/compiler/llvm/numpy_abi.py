"""Tuples and numpy arrays as machine code reads them: the structs of CPython's and numpy's C
interfaces, `PyTupleObject` and `PyArrayObject`.

    object header | count | ... | items
    object header | data | nd | dimensions | strides | base | descr | flags

The members of arrays have had these places since numpy 1.7. `holds` compares them with live
objects, so another Python (without the GIL, of 32 bits) is found out before any code relies on
them.
"""

from __future__ import annotations

import ctypes
import functools

import numpy as np

TYPE, DATA, ND, DIMENSIONS, DESCR, FLAGS = 8, 16, 24, 32, 56, 64
COUNT, ITEMS = 16, tuple.__basicsize__
#: flags: rows one after another, every entry at a multiple of its size
PLAIN = 0x1 | 0x100


@functools.cache
def holds() -> bool:
    """Whether arrays of this Python and this numpy have the layout."""
    if np.ndarray.__basicsize__ < FLAGS + 8 or object.__basicsize__ != DATA:
        return False
    x = np.empty((2, 3), np.float32)
    some = (x, x.T, np.empty((), np.int64), np.empty(0, bool))
    return _tuple_as_expected(some) and all(_as_expected(y) for y in some)


def _tuple_as_expected(x: tuple) -> bool:
    count = ctypes.c_ssize_t.from_address(id(x) + COUNT).value
    items = (ctypes.c_size_t * len(x)).from_address(id(x) + ITEMS)
    return count == len(x) and [*items] == [id(y) for y in x]


def _as_expected(x: np.ndarray) -> bool:
    def word(offset: int) -> int:
        return ctypes.c_size_t.from_address(id(x) + offset).value

    def number(offset: int) -> int:
        return ctypes.c_int.from_address(id(x) + offset).value

    if number(ND) != x.ndim or (word(TYPE), word(DESCR)) != (id(type(x)), id(x.dtype)):
        return False
    shape = (ctypes.c_ssize_t * x.ndim).from_address(word(DIMENSIONS)) if x.ndim else ()
    plain = x.flags.c_contiguous and x.flags.aligned
    same = word(DATA) == x.ctypes.data and tuple(shape) == x.shape
    return same and (number(FLAGS) & PLAIN == PLAIN) == plain
