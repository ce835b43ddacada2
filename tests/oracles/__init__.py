"""Reference numbers and models that no code of rbjax produced."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def load(name: str) -> dict[str, Any]:
    """The oracle file `name`.json beside this one, as a dict."""
    return json.loads((Path(__file__).parent / f"{name}.json").read_text())
