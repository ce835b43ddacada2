"""Imports run only down the layers: a check of every import of every file."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "rbjax").rglob("*.py"))

# What a room stands on directly; it may import that and all below it.
FLOORS = {
    "errors": "",
    "status": "",
    "_jax_compat": "",
    "arguments": "errors",
    "optional": "errors",
    "progress": "optional",
    "style": "optional",
    "html_page": "errors",
    "svg": "style",
    "display": "html_page svg",
    "compiling": "progress display arguments _jax_compat",
    "rank_tolerances": "",
    "meshes": "compiling",
    "lanes": "meshes rank_tolerances",
    "compiler": "lanes",
    "rotations": "lanes",
    "spatial": "rotations",
    "body": "spatial",
    "joints": "spatial",
    "model": "joints",
    "dynamics": "body model compiler",
    # above dynamics, which never adds a force of its own: a wrench at a site needs its Jacobian
    "forces": "dynamics",
    "constraints": "forces",
    "contact": "constraints solvers",
    "solvers": "rotations",
    "motion": "solvers constraints contact",
    "estimation": "motion",
    "sensors": "motion",
    "loading": "sensors",  # a file has sensors, which read accelerations
}
# The users' rooms stand on all of that and do not know each other, but for three pairs.
FLOORS |= dict.fromkeys(
    "wheeled planning sysid kinematics stability flexible".split(),  # noqa: SIM905
    "estimation loading status",
)
FLOORS |= {"control": "kinematics status"}
FLOORS |= {"envs": "control wheeled flexible sysid"}  # tasks of all robots
PEERS = {("wheeled", "control"), ("planning", "wheeled"), ("sysid", "flexible")}
FLOORS |= {"recommend": "stability wheeled control"}  # runs motions to choose how
# Inside a room: a folder, and the packages that its files may not import.
STOREYS = {
    "stability/theory/": ("rbjax.stability.runs",),
    **{
        f"contact/{folder}/": tuple(f"rbjax.contact.{name}" for name in above.split())
        for folder, above in {
            "geometry": "rows problem solver impacts soft coulomb compliant registry",
            "rows": "problem solver impacts soft coulomb compliant registry",
            "problem": "solver impacts soft coulomb compliant registry",
            "solver": "impacts soft coulomb compliant registry",
        }.items()
    },
    **{
        f"compiler/{folder}/": tuple(f"rbjax.compiler.{name}" for name in above.split())
        for folder, above in {
            "ir": "passes lower cuda llvm jax",
            "passes": "lower cuda llvm jax",
            "lower": "cuda llvm jax",
            "cuda": "lower llvm jax",
            "llvm": "lower cuda jax",
        }.items()
    },
}
# may import anything; "" is __init__.py
TOP = {"", "validation", "demo", "cli", "plotting", "viewer"}
GUESTS = {  # packages that only some files may import
    "mujoco": ("loading/", "validation/", "plotting", "cli"),
    "optax": ("sysid", "control", "envs", "demo"),
    "jax.config": ("compiler/disk_cache",),  # the caller's; read to keep kernels beside JAX's cache
}


def below(room: str, seen: frozenset[str] = frozenset()) -> frozenset[str]:
    for floor in {*FLOORS[room].split()} - seen:
        seen = below(floor, seen | {floor})
    return seen


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of all that a file imports; reading jax.config counts."""
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else ()
            base = [*above, *filter(None, [node.module])]
            yield from ((node.lineno, ".".join([*base, alias.name])) for alias in node.names)
        elif isinstance(node, ast.Attribute) and ast.unparse(node) == "jax.config":
            yield node.lineno, "jax.config"


def room_of(dotted: str) -> str:
    """The package that `rbjax.room.anything` names; else it is a name of rbjax/__init__.py."""
    room = dotted.split(".")[1] if "." in dotted else ""
    return room if room in FLOORS.keys() | TOP else ""


def allowed(path: Path, name: str) -> bool:
    file = path.relative_to(ROOT / "rbjax").as_posix()
    for guest, hosts in GUESTS.items():
        if f"{name}.".startswith(f"{guest}."):
            return file.startswith(hosts)
    here, there = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts)), room_of(name)
    for folder, above in STOREYS.items():
        if file.startswith(folder) and f"{name}.".startswith(tuple(f"{x}." for x in above)):
            return False
    if here in TOP or not f"{name}.".startswith("rbjax."):
        return True
    return there == here or there in below(here) or (here, there) in PEERS


def test_every_room_has_its_place_in_the_plan():
    rooms = {path.relative_to(ROOT / "rbjax").with_suffix("").parts[0] for path in FILES}
    unplaced = rooms - FLOORS.keys() - TOP - {"__init__", "__main__"}
    assert not unplaced, f"give {unplaced} a floor in tests/test_layers.py"


def test_imports_point_down():
    found = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in FILES
        for line, name in imports(path)
        if not allowed(path, name)
    ]
    assert not found, "\n".join(["", *found])


def test_a_folder_has_at_most_twenty_files():
    folders = Counter(path.parent.relative_to(ROOT).as_posix() for path in FILES)
    assert max(folders.values()) <= 20, folders.most_common(3)


def test_a_file_is_one_idea():
    lengths = {path.relative_to(ROOT): len(path.read_text().splitlines()) for path in FILES}
    long = {str(path): lines for path, lines in lengths.items() if lines > 400}
    assert not long, f"more than 400 lines: {long}"


#: names of JAX and its libraries that are private, or that their versions change
UNSTABLE = re.compile(
    r"jax\._src|\._impl\b|manual_axis_type|call_wrapped|axis_context|debug_info|source_info"
    r"|call_hi_primitive|mhlo\.|xla\.gpu|equinox\._|equinox\.internal import|eqxi\b|\"init_state\""
)


def test_private_names_of_jax_stand_in_one_file():
    found = [
        f"{path.relative_to(ROOT)}:{n}: {match[0]}"
        for path in FILES
        if path.name != "_jax_compat.py"
        for n, line in enumerate(path.read_text().splitlines(), 1)
        if (match := UNSTABLE.search(line))
    ]
    assert not found, "\n".join(["use rbjax._jax_compat:", *found])


def test_benchmarks_do_not_import_tests():
    found = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in sorted((ROOT / "benchmarks").rglob("*.py"))
        for line, name in imports(path)
        if f"{name}.".startswith("tests.")
    ]
    assert not found, "\n".join(["move what both need to benchmarks/cases", *found])
