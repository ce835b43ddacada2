"""Any function of one sample as one GPU thread: `threads`, and `threads.explain`; and as machine
code of this processor: `compile`."""

from typing import Any

from rbjax.callable_modules import make_modules_callable
from rbjax.threads.backend import wanted as wanted
from rbjax.threads.explain import Explanation as Explanation
from rbjax.threads.explain import explain as explain
from rbjax.threads.function import in_parts as in_parts
from rbjax.threads.function import side_by_side as side_by_side
from rbjax.threads.function import threaded as threaded
from rbjax.threads.function import threads as _threads
from rbjax.threads.lowering import Unsupported as Unsupported
from rbjax.threads.native import compile as compile
from rbjax.threads.nvrtc import quickly as quickly

threads: Any = _threads

__all__ = ["Explanation", "Unsupported", "compile", "explain", "threads"]

make_modules_callable(__name__)
