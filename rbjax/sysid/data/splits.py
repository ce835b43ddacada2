"""`split`: random division of recordings into training, validation and test data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbjax.arguments import integer, real_array
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.sysid.arguments import recordings_of
from rbjax.sysid.data.recording import Recording


@displayed
class Split(NamedTuple):
    """Recordings for training, validation and test.

    Fields:
        train: recordings to fit.
        validation: recordings to choose a model by.
        test: recordings to judge the chosen model by.
    """

    train: list[Recording]
    validation: list[Recording]
    test: list[Recording]


def split(
    recordings: Sequence[Recording],
    train: float = 0.6,
    validation: float = 0.2,
    test: float = 0.2,
    *,
    seed: int = 0,
) -> Split:
    """Divide recordings at random into training, validation and test data.

    Segments of one recording stay together, since errors at neighbouring times are correlated.

    Args:
        recordings: the recordings.
        train: share of the recordings for the fit.
        validation: share of the recordings for the choice between models; may be 0.
        test: share of the recordings for the final judgement; may be 0.
        seed: seed of the random numbers.

    Returns:
        `Split`, each part in the given order. Each share above 0 gets at least one recording.

    Raises:
        InputError: shares that do not add up to 1, or fewer recordings than shares.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid import Channel, Recording, split
        >>> seen = Channel([0.0, 1.0], [0.0, 1.0])
        >>> runs = [Recording(f"run {k}", {"q": seen}) for k in range(10)]
        >>> [len(part) for part in split(runs)]
        [6, 2, 2]
    """
    integer("split", "seed", seed, least=0)
    recordings = recordings_of("split", recordings, empty=True)
    shares = real_array("split", "(train, validation, test)", [train, validation, test])
    if not (shares >= 0).all() or abs(shares.sum() - 1) > 1e-9 or train <= 0:
        raise InputError(
            f"split: shares are {train}, {validation}, {test}, expected numbers from 0 to 1 that "
            "add up to 1, with some to train"
        )
    sources = list(dict.fromkeys(r.source for r in recordings))
    used = shares > 0
    if len(sources) < used.sum():
        raise InputError(
            f"split: {len(sources)} recordings ({', '.join(sources)}) for {used.sum()} parts, "
            "expected at least one for each; segments of one recording stay together, so cut a "
            "single one by time with `segment`"
        )
    ends = np.round(np.cumsum(shares) * len(sources)).astype(int)
    counts = np.maximum(np.diff(ends, prepend=0), used)
    while counts.sum() > len(sources):
        counts[counts.argmax()] -= 1
    order = np.random.default_rng(seed).permutation(len(sources))
    part = {sources[i]: k for k, i in zip(np.repeat([0, 1, 2], counts), order, strict=True)}
    return Split(*([r for r in recordings if part[r.source] == k] for k in range(3)))
