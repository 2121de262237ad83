"""Rules of the code base, one test each, which lists all offenders."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: A file is one concept; longer ones hold two.
MAX_LINES = 800
#: Most parameters of a constructor besides `self`; more are a configuration of their own.
MAX_PARAMETERS = 8
#: Keyword arguments of the public API.
KEYWORD_CONSTRUCTORS = {"iris_session/client/client.py"}
#: A module of fewer lines with one importer is a part of that importer, unless a reason stands here.
SLIVER_LINES = 80
SLIVERS = {
    "tools.codegen.cloud_golden": "one module for each file of vectors",
    "tools.codegen.conversions": "the reference for clients that convert to engine frames",
    "tools.codegen.unity_meta": "the only target of many files, which are no messages",
    "iris_session.doctor.drop_explanations": "a table that grows with every reason",
    "iris_session.emulator.behaviours.wander": "one behaviour per file",
    "iris_session.front.uplink": "the counterpart of downlink",
    "iris_session.security.key_home": "where keys are is looked for by this name",
    "iris_session.session.unique_name": "a listener with a socket of its own",
    "iris_session.simulators.find": "the table of simulators, beside the adapters",
    "iris_session.streams.quantise": "number formats that clients port",
    "iris_session.system.backoff": "the one back-off",
}
#: Words of docstrings and comments for which docs/glossary.md has a standard term.
DENIED_WORDS = re.compile(
    r"\b(somebody|nobody|whoever|befell|told|gives way|gave way|made below|let go of|taken leave|crowd|doors|desk"
    r"|visitors?|neighbou?rs|departures|knock|what bends)\b",
    re.IGNORECASE,
)
#: Words that no text for people has: messages, pages, documentation.
DENIED_IN_TEXTS = re.compile(r"\b(somebody|nobody|whoever)\b", re.IGNORECASE)
#: Questions instead of statements at the beginning of a docstring.
QUESTION = re.compile(r"(What|Who|Whether|Where|When|How|Which|Why)\b")

SOCKETS = {"zmq", "socket", "socketserver", "selectors", "ssl", "http", "urllib", "asyncio"}
CLOCKS = {"time", "datetime", "sched", "asyncio"}
THREADS = {"threading", "_thread", "multiprocessing", "concurrent", "queue", "asyncio", "subprocess", "signal"}
RANDOM = {"random", "secrets", "uuid"}
HEAVY = {"numpy", "mujoco", "rerun", "scipy", "cv2", "mink", "open3d"}

#: Modules that a room never imports, beyond the table: they would make a pure room depend on more than its arguments.
FORBIDDEN = {
    "anchors": SOCKETS | CLOCKS | THREADS | RANDOM | {"mujoco", "rerun"},
    "protocol": SOCKETS | CLOCKS | THREADS | RANDOM | HEAVY,
    "authority": SOCKETS | CLOCKS | THREADS | RANDOM | HEAVY,
    "control": SOCKETS | CLOCKS | THREADS | RANDOM | {"rerun"},
    "physics": {"zmq", "rerun"} | RANDOM,
    "streams": SOCKETS | CLOCKS | THREADS | RANDOM | {"mujoco", "rerun"},
    "scene": SOCKETS | RANDOM | {"rerun"},
    "simulators": SOCKETS | CLOCKS | THREADS | RANDOM | {"mujoco", "rerun"},
    "assets": SOCKETS | {"mujoco", "rerun", "scipy", "cv2", "mink", "open3d"},
    "cloud": SOCKETS | RANDOM,
    "cameras": SOCKETS | RANDOM | {"rerun"},
    "security": (SOCKETS - {"zmq"}) | RANDOM | HEAVY,
    "system": SOCKETS | RANDOM | HEAVY,
    "link": {"mujoco", "rerun"},
    "alignment": SOCKETS | CLOCKS | RANDOM | {"mujoco", "rerun"},
    "front": {"mujoco", "rerun"},
    "journal": (SOCKETS - {"zmq"}) | CLOCKS | THREADS | RANDOM | {"mujoco", "rerun"},
    "rrd": SOCKETS | RANDOM | {"mujoco"},
    "viewer": SOCKETS | CLOCKS | THREADS | RANDOM,
    "recording": {"mujoco"},
    "dataset": SOCKETS | RANDOM | {"zmq", "rerun"},
    "replay": SOCKETS | CLOCKS | THREADS | RANDOM | {"zmq", "rerun"},
    "client": {"mujoco", "rerun"},
    "web": {"mujoco", "rerun"},
    "netsim": {"zmq", "mujoco", "rerun"},
    "emulator": {"mujoco", "rerun"},
    "doctor": {"zmq", "mujoco", "rerun"},
    "codegen": SOCKETS | CLOCKS | THREADS | RANDOM | {"mujoco", "rerun"},
}
#: Rooms whose result depends only on arguments: no set order, no addresses, no hash seed.
PURE = ("anchors", "protocol", "authority", "control", "streams")
#: The feed and the process of the recorder use sockets; the rest of their rooms computes, or reads and writes files.
RECORDER_SOCKETS = {"journal/feed.py", "recording/process.py"}
#: Packages that only the sources of depth frames import. Clocks: they and the process; the client: the process.
CLOUD_SOURCES = {"mujoco", "rerun", "mcap", "pyrealsense2", "pyorbbecsdk"}

#: Calls that read the wall clock, which jumps (daylight saving, NTP, users), by the last two names of the dotted call.
WALL_CLOCK = {
    *("time.time", "time.time_ns", "time.localtime", "time.gmtime", "time.ctime", "time.strftime"),
    *("datetime.now", "datetime.utcnow", "datetime.today", "date.today"),
}
#: Where it may be read: it stamps something for people, or measures what must survive a reboot.
WALL_CLOCK_READERS = {
    "iris_session/security/allow_list.py": "when a key was added or last seen, for people",
    "iris_session/security/join_codes.py": "when a join code ends: shared by processes, outlives a reboot",
    "iris_session/front/pairing.py": "whether a join code is open",
    "iris_session/cli/pair.py": "how long a join code is shown",
    "iris_session/assets/store.py": "which files were used longest ago, as the file system stamps them",
    "iris_session/web/certificate.py": "when a certificate begins and ends, which is wall time by definition",
    "iris_session/bench/web_tab.py": "when a browser, which has no other clock in common, has seen a click",
    "iris_session/cli/view.py": "when a recording was written last, as the file system stamps it, for people",
    "iris_session/session/config.py": "name of a default folder",
    "iris_session/session/processes.py": "when a recording was made, for people",
}


@cache
def modules() -> tuple[Path, ...]:
    """Return all modules of the checkout."""
    folders = ("iris_session", "anchors", "tools/codegen")
    return tuple(sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py")))


def room_of(path: Path) -> str:
    """Return `anchors`, a folder of iris_session, `codegen`, or an empty text for iris_session's own modules."""
    parts = path.relative_to(ROOT).parts
    if parts[0] == "anchors":
        return "anchors"
    return parts[1] if len(parts) > 2 else ""


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree(path)))


@pytest.fixture(scope="module", autouse=True)
def _release_trees() -> Iterator[None]:
    """Release the trees after these tests: a million objects would slow down every later garbage collection."""
    yield
    nodes.cache_clear()
    tree.cache_clear()


@cache
def imports(path: Path) -> frozenset[str]:
    """Return dotted names that a module imports, also lazily and for type checkers only."""
    return frozenset(_find_imports(path))


def _find_imports(path: Path) -> Iterator[str]:
    for node in nodes(path):
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


@cache
def table() -> dict[str, set[str] | None]:
    """Return room -> rooms that it may import, by docs/architecture.md; `None` for everything."""
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
            wrong = rooms_imported(path) - allowed - {room}
            offenders += [f"{name}: {room} may not import {other}" for other in sorted(wrong)]
        outside = {dotted.split(".")[0] for dotted in imports(path)}
        never = FORBIDDEN.get(room, set()) | (set() if room == "codegen" else {"tools"})
        offenders += [f"{name}: {room} never imports {other}" for other in sorted(outside & never)]
        if room == "scene" and not path.name.startswith("mujoco_") and "mujoco" in outside:
            offenders.append(f"{name}: in scene only modules named mujoco_* import mujoco")
        if room == "cloud" and "sources" not in name.parts:
            shell = path.name == "process.py"
            wrong = outside & (CLOUD_SOURCES if shell else CLOUD_SOURCES | CLOCKS)
            wrong |= set() if shell else rooms_imported(path) & {"client"}
            offenders += [f"{name}: in cloud only its sources and process import {one}" for one in sorted(wrong)]
        if room in ("journal", "recording") and f"{room}/{path.name}" not in RECORDER_SOCKETS and "zmq" in outside:
            offenders.append(f"{name}: in {room} only {sorted(RECORDER_SOCKETS)} import zmq")
    assert not offenders, "\n".join(offenders)


def impurities(path: Path) -> Iterator[str]:
    """Yield places where a result could depend on hash order, addresses, or hidden random state."""
    for node in nodes(path):
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
    offenders = [f"{path.relative_to(ROOT)}: {found}" for path in pure for found in impurities(path)]
    assert not offenders, "\n".join(offenders)


def calls(path: Path) -> Iterator[str]:
    """Yield the last two names of every dotted call of a module, such as `time.sleep`."""
    for node in nodes(path):
        if isinstance(node, ast.Call):
            yield ".".join(ast.unparse(node.func).split(".")[-2:])


def test_the_wall_clock_is_read_in_few_places_only() -> None:
    found = {str(path.relative_to(ROOT)) for path in modules() if WALL_CLOCK & {*calls(path)}}
    assert found == set(WALL_CLOCK_READERS), "session time is time.monotonic_ns; or say here what the wall clock is for"


def test_modules_have_docstrings() -> None:
    offenders = [str(path.relative_to(ROOT)) for path in modules() if not ast.get_docstring(tree(path))]
    assert not offenders, f"a module begins with a docstring: {offenders}"


def test_files_have_readable_length() -> None:
    lines = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n") for path in modules()}
    offenders = [f"{name}: {n} lines" for name, n in lines.items() if n > MAX_LINES]
    assert not offenders, f"more than {MAX_LINES} lines: {offenders}"


def dotted_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def importers() -> dict[str, set[str]]:
    """Return module -> our modules that import it, for type checkers only too."""
    known = {dotted_name(path) for path in modules()}
    found: dict[str, set[str]] = {name: set() for name in known}
    for path in (*modules(), *(ROOT / "tools").glob("*.py"), *(ROOT / "examples").glob("*.py")):
        for name in imports(path) & known - {dotted_name(path)}:
            found[name].add(dotted_name(path))
    return found


def circle_from(start: str, imported: dict[str, set[str]]) -> list[str]:
    """Return a path along imports from `start` back to it, or an empty list."""
    ways, seen = [[start]], {start}
    while ways:
        way = ways.pop()
        for after in sorted(imported[way[-1]]):
            if after == start:
                return way
            if after not in seen:
                seen.add(after)
                ways.append([*way, after])
    return []


def test_rooms_have_no_import_cycles() -> None:
    rooms = {dotted_name(path): room_of(path) for path in modules() if path.name != "__init__.py"}
    imported = {
        name: {to for to, by in importers().items() if name in by and rooms.get(to) == room}
        for name, room in rooms.items()
    }
    circles = {tuple(sorted(circle)) for name in rooms if (circle := circle_from(name, imported))}
    assert not circles, "\n".join(" -> ".join(circle) for circle in sorted(circles))


def test_no_slivers() -> None:
    offenders = []
    for path in modules():
        name, text = dotted_name(path), path.read_text(encoding="utf-8")
        if path.name in ("__init__.py", "__main__.py") or "__main__" in text or room_of(path) == "cli":
            continue
        if text.count("\n") < SLIVER_LINES and len(importers()[name]) == 1 and name not in SLIVERS:
            offenders.append(f"{name} ({text.count(chr(10))} lines) <- {next(iter(importers()[name]))}")
    assert not offenders, "merge with the only importer:\n" + "\n".join(offenders)


def test_constructors_have_few_parameters() -> None:
    offenders = []
    for path in modules():
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef) and node.name == "__init__":
                n = len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs) - 1
                if n > MAX_PARAMETERS and str(path.relative_to(ROOT)) not in KEYWORD_CONSTRUCTORS:
                    offenders.append(f"{path.relative_to(ROOT)}:{node.lineno}: {n}")
    assert not offenders, f"more than {MAX_PARAMETERS} parameters:\n" + "\n".join(offenders)


def documented(path: Path) -> Iterator[tuple[int, str]]:
    """Yield comments and docstrings of a module with their lines."""
    docstrings = {
        node.body[0].lineno
        for node in nodes(path)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and ast.get_docstring(node)
    }
    with tokenize.open(path) as file:
        for token in tokenize.generate_tokens(file.readline):
            if token.type == tokenize.COMMENT or (token.type == tokenize.STRING and token.start[0] in docstrings):
                yield from enumerate(token.string.splitlines(), token.start[0])


def test_standard_words() -> None:
    offenders = [
        f"{path.relative_to(ROOT)}:{number}: {found[0]}"
        for path in modules()
        for number, text in documented(path)
        if (found := DENIED_WORDS.search(text))
    ]
    assert not offenders, "docs/glossary.md has standard words:\n" + "\n".join(offenders)


def test_texts_for_people_have_standard_words() -> None:
    offenders = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {found[0]}"
        for path in modules()
        for node in nodes(path)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and (found := DENIED_IN_TEXTS.search(node.value))
    ]
    for path in sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "web_client/src").rglob("*.ts")]):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if found := DENIED_IN_TEXTS.search(line):
                offenders.append(f"{path.relative_to(ROOT)}:{number}: {found[0]}")
    assert not offenders, "\n".join(offenders)


def test_docstrings_are_statements() -> None:
    offenders = []
    for path in modules():
        for node in nodes(path):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node) or ""
                if QUESTION.match(text):
                    offenders.append(f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}: {text.splitlines()[0]}")
    assert not offenders, "a docstring begins with a verb or a noun:\n" + "\n".join(offenders)


def test_one_class_per_name() -> None:
    places: dict[str, list[str]] = {}
    for path in modules():
        for node in tree(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(dotted_name(path))
    offenders = {name: where for name, where in places.items() if len(where) > 1}
    assert not offenders, offenders
