"""Any function of one sample as one GPU thread: `threads`."""

from rbjax.threads.function import threaded as threaded
from rbjax.threads.function import threads as threads
from rbjax.threads.function import wanted as wanted

__all__ = ["threads"]
