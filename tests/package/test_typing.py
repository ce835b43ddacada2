"""The types that a user's type checker sees."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).parent / "users_script.py"


@pytest.mark.slow
def test_a_users_script_passes_mypy_strict(tmp_path: Path) -> None:
    """As for an installed package: errors inside rbjax do not count, and a wrong name is one."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.read_text() + "\n    rb.nothing\n    rb.mass_matrix(model)\n")
    (tmp_path / "mypy.ini").write_text(
        "[mypy]\nstrict = true\n[mypy-rbjax.*]\nignore_errors = true\n"
        "[mypy-chex.*,mujoco.*,llvmlite.*,optax.*,scipy.*,mpmath.*]\n"
        "ignore_missing_imports = true\n"
    )
    child = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", "mypy.ini", "--cache-dir",
         str(ROOT / ".mypy_cache" / "users_script"), script.name],
        capture_output=True, text=True, cwd=tmp_path, env={"MYPYPATH": str(ROOT), "PATH": ""},
    )  # fmt: skip
    found = child.stdout.splitlines()
    here = [x for x in found if x.startswith("script.py")]
    assert [x.partition("  ")[2] for x in here] == ["[attr-defined]", "[call-arg]"], child.stdout
    assert len(found) == 3, child.stdout + child.stderr
