"""Rules of the code base, one test each, which lists all offenders."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
MAX_LINES = 800
#: One class whose public methods all document their arguments.
LONG = {"iris_session/client/client.py": 1250}

SOCKETS = {"zmq", "socket", "socketserver", "selectors", "ssl", "http", "urllib", "asyncio"}
CLOCKS = {"time", "datetime", "sched", "asyncio"}
THREADS = {"threading", "_thread", "multiprocessing", "concurrent", "queue", "asyncio", "subprocess", "signal"}
RANDOM = {"random", "secrets", "uuid"}
HEAVY = {"numpy", "mujoco", "rerun", "scipy", "cv2", "mink", "open3d"}

#: What a room never imports. Beyond the table: what would make a pure room depend on more than its arguments.
FORBIDDEN = {
    "anchors": SOCKETS | CLOCKS | THREADS | RANDOM | {"mujoco", "rerun"},
    "protocol": SOCKETS | CLOCKS | THREADS | RANDOM | HEAVY,
    "authority": SOCKETS | CLOCKS | THREADS | RANDOM | HEAVY,
    "control": SOCKETS | CLOCKS | THREADS | RANDOM | {"rerun"},
    "physics": {"zmq", "rerun"} | RANDOM,
    "streams": SOCKETS | CLOCKS | THREADS | RANDOM | {"mujoco", "rerun"},
    "scene": SOCKETS | RANDOM | {"rerun"},
    "assets": SOCKETS | {"mujoco", "rerun", "scipy", "cv2", "mink", "open3d"},
    "security": (SOCKETS - {"zmq"}) | RANDOM | HEAVY,
    "system": SOCKETS | RANDOM | HEAVY,
    "link": {"mujoco", "rerun"},
    "alignment": SOCKETS | CLOCKS | RANDOM | {"mujoco", "rerun"},
    "front": {"mujoco", "rerun"},
    "recording": set(),
    "client": {"mujoco", "rerun"},
    "netsim": {"zmq", "mujoco", "rerun"},
    "emulator": {"mujoco", "rerun"},
    "doctor": {"zmq", "mujoco", "rerun"},
    "codegen": SOCKETS | CLOCKS | THREADS | RANDOM | {"mujoco", "rerun"},
}
#: Imports between rooms that are still to be untied.
TRANSITIONAL: set[tuple[str, str]] = set()
#: Rooms whose result may depend on nothing but what they are given: no order of sets, no addresses, no hash seed.
PURE = ("anchors", "protocol", "authority", "control", "streams")
#: The feed and the process of the recorder talk; the rest of `recording` reads and writes files.
RECORDING_SOCKETS = {"feed.py", "process.py"}


@cache
def modules() -> tuple[Path, ...]:
    """All modules of ours, below the checkout."""
    return tuple(sorted([*(ROOT / "iris_session").rglob("*.py"), *(ROOT / "anchors").rglob("*.py")]))


def room_of(path: Path) -> str:
    """`anchors`, a folder of iris_session, or empty for iris_session's own modules."""
    parts = path.relative_to(ROOT).parts
    if parts[0] == "anchors":
        return "anchors"
    return parts[1] if len(parts) > 2 else ""


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path) -> Iterator[str]:
    """Dotted names that a module imports, anywhere in it (also lazily, and for type checkers only)."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import, write the full name"
            assert node.module
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def rooms_imported(path: Path) -> set[str]:
    found = set()
    for name in imports(path):
        first, *rest = name.split(".")
        if first == "anchors":
            found.add("anchors")
        elif first == "iris_session":
            found.add(rest[0] if rest else "iris_session")
    return found


def table() -> dict[str, set[str] | None]:
    """Room -> rooms that it may import, by docs/architecture.md; `None` for everything."""
    rows = re.findall(r"^\| (`.+?) \| (.+?) \| .*\|$", (ROOT / "docs" / "architecture.md").read_text(), re.MULTILINE)
    allowed: dict[str, set[str] | None] = {}
    every = {room for names, _ in rows for room in re.findall(r"`(\w+)`", names)}
    for names, rule in rows:
        named = set(re.findall(r"`(\w+)`", rule))
        every.add("iris_session")
        for room in re.findall(r"`(\w+)`", names):
            if rule.startswith("everything"):
                allowed[room] = every - named if named else None
            else:
                allowed[room] = named
    return allowed


def test_table_names_every_room() -> None:
    assert set(table()) >= {room_of(path) for path in modules()} - {""}
    assert table()["authority"] == {"protocol", "anchors"}
    assert table()["protocol"] == set()
    assert "cli" not in (table()["session"] or {"cli"})
    assert table()["cli"] is None


def test_rooms_import_what_the_table_allows() -> None:
    offenders = []
    for path in modules():
        room = room_of(path)
        if not room:
            continue
        name, allowed = path.relative_to(ROOT), table()[room]
        if allowed is not None:
            transitional = {to for source, to in TRANSITIONAL if source == room}
            wrong = rooms_imported(path) - allowed - {room, *transitional}
            offenders += [f"{name}: {room} may not import {other}" for other in sorted(wrong)]
        outside = {dotted.split(".")[0] for dotted in imports(path)}
        offenders += [f"{name}: {room} never imports {other}" for other in sorted(outside & FORBIDDEN.get(room, set()))]
        if room == "scene" and not path.name.startswith("mujoco_") and "mujoco" in outside:
            offenders.append(f"{name}: in scene only modules named mujoco_* import mujoco")
        if room == "recording" and path.name not in RECORDING_SOCKETS and "zmq" in outside:
            offenders.append(f"{name}: in recording only {sorted(RECORDING_SOCKETS)} import zmq")
    assert not offenders, "\n".join(offenders)


def impurities(module: ast.Module) -> Iterator[str]:
    """Places where a result could depend on hash order, addresses, or hidden random state."""
    for node in ast.walk(module):
        looped = node.iter if isinstance(node, ast.For | ast.comprehension) else None
        calls_set = (
            isinstance(looped, ast.Call)
            and isinstance(looped.func, ast.Name)
            and looped.func.id in ("set", "frozenset")
        )
        if calls_set or isinstance(looped, ast.Set | ast.SetComp):
            yield f"line {getattr(looped, 'lineno', '?')}: loop over a set"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("hash", "id"):
            yield f"line {node.lineno}: {node.func.id}()"
        if isinstance(node, ast.Attribute) and node.attr in ("random", "urandom", "environ"):
            yield f"line {node.lineno}: .{node.attr}"


def test_pure_rooms_depend_on_their_arguments_only() -> None:
    pure = [path for path in modules() if room_of(path) in PURE]
    offenders = [f"{path.relative_to(ROOT)}: {found}" for path in pure for found in impurities(tree(path))]
    assert not offenders, "\n".join(offenders)


def test_impurities_are_found() -> None:
    source = (
        "for a in {1, 2}:\n    pass\nb = [c for c in set(d)]\ne = hash(f)\ng = np.random.normal()\nh = os.environ\n"
    )
    assert [line.split(":")[0] for line in sorted(impurities(ast.parse(source)))] == [
        f"line {n}" for n in (1, 3, 4, 5, 6)
    ]


def test_modules_say_what_lives_in_them() -> None:
    offenders = [str(path.relative_to(ROOT)) for path in modules() if not ast.get_docstring(tree(path))]
    assert not offenders, f"a module begins with a docstring: {offenders}"


def test_files_are_of_readable_length() -> None:
    lines = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n") for path in modules()}
    offenders = [f"{name}: {n} lines" for name, n in lines.items() if n > LONG.get(name, MAX_LINES)]
    assert not offenders, f"more than {MAX_LINES} lines: {offenders}"
