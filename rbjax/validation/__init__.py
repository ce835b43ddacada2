"""Side-by-side comparison with MuJoCo C and MJX."""

from rbjax.callable_modules import make_modules_callable
from rbjax.validation.compare import compare
from rbjax.validation.report import Error, Report, Row

__all__ = ["Error", "Report", "Row", "compare"]

make_modules_callable(__name__)
