"""Documents against the code.

Examples run, commands parse, links and files exist, every reason is explained, and the command line reference has every
option.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from iris_session import Client, SceneBuilder, ScenePublisher, Session, SessionConfig
from iris_session.cli.main import build_parser
from iris_session.demo.run import DemoResult
from iris_session.demo.scenes import scene_path
from iris_session.protocol import names

ROOT = Path(__file__).parents[1]
#: `docs/protocol.md` has its own tests (tests/protocol); only its links are checked here.
PACKAGES = tuple(ROOT / name for name in ("unity_client", "hololens_client"))
PAGES = (
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *(folder / "README.md" for folder in PACKAGES),
    *(page for folder in PACKAGES for page in sorted((folder / "Documentation~").glob("*.md"))),
)
EXAMPLES = tuple(sorted((ROOT / "examples").glob("*.py")))
#: Those that are a session with a loop of their own.
LOOPS = ("share_a_script", "own_loop", "publish_scene")
ADDRESS = "127.0.0.1:7721"
TIMEOUT_S = 120.0

#: Changes for running a block: sessions use free ports, and `run()` without an end takes 0.3 s. Printed text stays.
RUN = """
from iris_session import Session, SessionConfig
SessionConfig.__init__.__defaults__ = tuple(
    0 if value in (7721, 7722) and value is not True else value for value in SessionConfig.__init__.__defaults__
)
_run = Session.run
Session.run = lambda self, seconds=None, until=None: _run(self, 0.3 if seconds is None else seconds, until)
import runpy
runpy.run_path("block.py", run_name="__main__")
"""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page. `line` is that of its opening fence."""

    page: Path
    line: int
    language: str
    text: str

    @property
    def name(self) -> str:
        return f"{self.page.name}:{self.line}"


def blocks(page: Path) -> Iterator[Block]:
    opened: tuple[int, str, int] | None = None
    lines = page.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, 1):
        fence = re.match(r"^\s*```(\w*)", line)
        if fence and opened is None:
            opened = (number, fence[1], number)
        elif fence and opened is not None:
            yield Block(page, opened[0], opened[1], "\n".join(lines[opened[2] : number - 1]))
            opened = None
    assert opened is None, f"{page.name}: the block of line {opened} is not closed" if opened else ""


BLOCKS = tuple(block for page in PAGES for block in blocks(page))
#: A block with a lab address needs keys, and is run by `test_key_files_of_the_network_page_work`.
LAB_ADDRESS = "192.168.0.10"
#: Of a data set that exists: `tests/dataset/test_robomimic.py` plays one in the same way.
SET = "set/dataset.hdf5"
PYTHON = tuple(b for b in BLOCKS if b.language == "python" and LAB_ADDRESS not in b.text and SET not in b.text)
#: Pages whose blocks run in `make test`, those of each in one test; those of the others run in `make test-long`.
FIRST_PAGES = ("README.md", "tutorial.md")
SHELL = tuple(block for block in BLOCKS if block.language == "bash")


def prose(page: Path) -> str:
    """Return the page without its fenced blocks."""
    return re.sub(r"^\s*```.*?^\s*```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


# --- Python ---


@contextlib.contextmanager
def served(folder: Path, *options: str, scene: str = "handover") -> Iterator[str]:
    """Start a session of a scene in its own process; yield its address."""
    command = [sys.executable, "-m", "iris_session.cli.main", "serve", scene, "--no-record", *options]
    process = subprocess.Popen(
        [*command, "--control-port", "0", "--state-port", "0"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        found = re.search(r" on (\S+:\d+),", line)
        assert found, f"no address in {line!r}"
        yield found[1]
    finally:
        process.terminate()
        process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0


@pytest.fixture(scope="module")
def serve(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served(tmp_path_factory.mktemp("serve")) as address:
        yield address


@pytest.fixture
def serve_cloth(tmp_path: Path) -> Iterator[str]:
    with served(tmp_path, scene="cloth") as address:  # half a core at real-time priority: not beside other tests
        yield address


@pytest.fixture
def serve_pictures(tmp_path: Path) -> Iterator[str]:
    with served(tmp_path, "--picture", "operator:64x48@5", "--plain-pictures") as address:
        yield address


@pytest.fixture
def run_python(tmp_path: Path) -> Callable[..., str]:
    """Run a script in its own process in an empty folder; return its output."""

    def run(script: str, *arguments: str) -> str:
        (tmp_path / "block.py").write_text(script, encoding="utf-8")
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", RUN, *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.mark.e2e
@pytest.mark.parametrize("page", FIRST_PAGES)
def test_first_page_works(page: str, serve: str, run_python: Callable[..., str]) -> None:
    """Its blocks of Python, beside the session that it starts."""
    assert any(block.page.name == page and "iris-session serve handover" in block.text for block in SHELL)
    texts = [block.text for block in PYTHON if block.page.name == page]
    assert len(texts) == 2
    for text in texts:
        shown = run_python(text.replace(ADDRESS, serve).replace("range(60_000)", "range(500)"))
        assert "*session.notes" not in text or "http://" in shown or "no page for browsers" in shown


@pytest.mark.long
@pytest.mark.e2e
@pytest.mark.parametrize(
    "block", [pytest.param(block, id=block.name) for block in PYTHON if block.page.name not in FIRST_PAGES]
)
def test_python_block_runs(block: Block, run_python: Callable[..., str], request: pytest.FixtureRequest) -> None:
    text, has_deformables = block.text, "Deformables(client)" in block.text
    if ADDRESS in text:
        has_pictures = ".camera(" in block.text or "cameras=" in block.text
        session = "serve_cloth" if has_deformables else "serve_pictures" if has_pictures else "serve"
        text = text.replace(ADDRESS, request.getfixturevalue(session))
    shown = run_python(text)
    assert not has_deformables or "cloth" in shown, "a deformable was seen"


def _network_page(part: str) -> str:
    """Return the one Python block of the network page that contains `part`."""
    (text,) = (b.text for b in BLOCKS if b.page.name == "network.md" and b.language == "python" and part in b.text)
    return text


def _network_command(part: str) -> list[str]:
    (words,) = (words for where, words in commands() if where.startswith("network.md:") and part in words)
    return words


def _emulate(words: list[str], folder: Path) -> None:
    """Run an `emulate` command of the network page; its people must see something, joining included."""
    done = subprocess.run(
        [sys.executable, "-m", "iris_session.cli.main", *words, "--behaviour", "observer", "--seconds", "12", "--json"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["frames"] > 0


@pytest.mark.long
@pytest.mark.e2e
def test_key_files_of_the_network_page_work(tmp_path: Path, run_python: Callable[..., str]) -> None:
    run_python(_network_page("create_certificates"))
    with served(tmp_path, "--curve-key", "keys/server.key_secret", "--curve-clients", "keys/clients") as address:
        use = _network_page("CurveKeys").replace(f"{LAB_ADDRESS}:7721", address)
        assert re.search(r"\(\d+, 7\)", run_python(use))
        _emulate([address if LAB_ADDRESS in word else word for word in _network_command("--curve-server")], tmp_path)


@pytest.mark.long
@pytest.mark.e2e
def test_join_code_of_the_network_page_works(tmp_path: Path, run_python: Callable[..., str]) -> None:
    join = _network_page("join_code=")
    (shown,) = re.findall(r'join_code="(.+?)"', join)
    with served(tmp_path, "--curve") as address:
        done = subprocess.run(
            [sys.executable, "-m", "iris_session.cli.main", "pair", "--address", address, "--no-wait", "--json"],
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        code = json.loads(done.stdout)["code"]
        text = join.replace(f"{LAB_ADDRESS}:7721", address).replace(shown, code)
        assert re.search(r"\(\d+, 7\)", run_python(text))
        _emulate(["emulate", address], tmp_path)  # the same user's key is on the list now


@pytest.mark.long
@pytest.mark.e2e
@pytest.mark.parametrize("name", LOOPS)
def test_example_of_a_user_loop_is_joined_until_it_ends(name: str, tmp_path: Path) -> None:
    """By a client that holds a robot where there is one."""
    (tmp_path / "block.py").write_text((ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8"))
    output = tmp_path / "output"
    with output.open("w") as file:
        command = [sys.executable, "-W", "error", "-c", RUN, "5"]
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=file, stderr=subprocess.STDOUT)
    try:
        deadline = time.monotonic() + TIMEOUT_S
        while (found := re.search(r"join at (127\.0\.0\.1:[1-9]\d*)\n", output.read_text())) is None:
            assert process.poll() is None, output.read_text()
            assert time.monotonic() < deadline, output.read_text()
            time.sleep(0.02)
        with Client(found[1], role="agent", name="ann") as ann:
            assert ann.wait_for(lambda c: c.scene.state is not None)
            if ann.mirror.robots:
                ann.acquire(["left"])
            ann.start()
            assert process.wait(TIMEOUT_S) == 0, output.read_text()
    finally:
        process.kill()
        process.wait()
    if name == "own_loop":
        assert "ann (agent) drives left" in output.read_text()


@pytest.mark.long
@pytest.mark.e2e
def test_policy_example_moves_its_robot(serve: str, run_python: Callable[..., str]) -> None:
    output = run_python((ROOT / "examples" / "policy.py").read_text(encoding="utf-8"), serve, "6")
    moved = re.search(r"tip moved (\d+) mm", output)
    assert moved, output
    assert int(moved[1]) > 20


@pytest.mark.long
@pytest.mark.e2e
def test_recording_examples_run(tmp_path: Path, run_python: Callable[..., str]) -> None:
    path = tmp_path / "session.rrd"
    config = SessionConfig(control_port=0, state_port=0, record=path)
    with Session(scene_path("handover"), config=config) as session:
        session.run(seconds=0.3)
    output = run_python((ROOT / "examples" / "read_recording.py").read_text(encoding="utf-8"), str(path))
    assert "class closed" in output
    assert re.search(r"hammer: [1-9]\d* frames, travelled 0\.\d+ m", output), output


@pytest.mark.long
@pytest.mark.e2e
def test_recording_example_reads_published_worlds(tmp_path: Path, run_python: Callable[..., str]) -> None:
    path, scene = tmp_path / "session.rrd", SceneBuilder("bench")
    scene.add_box("crate", half_size=(0.1, 0.1, 0.1), movable=True)
    with ScenePublisher(scene, SessionConfig(control_port=0, state_port=0, record=path)) as session:
        for i in range(3):
            session.set_pose("crate", (i * 0.5, 0.0, 0.0))
            session.publish(i / 10)
            session.run(seconds=0.1)
    output = run_python((ROOT / "examples" / "read_recording.py").read_text(encoding="utf-8"), str(path))
    assert "class open" in output
    assert re.search(r"crate: [1-9]\d* frames, travelled 1\.00 m", output), output


def test_every_example_is_run() -> None:
    assert {path.stem for path in EXAMPLES} == {*LOOPS, "policy", "read_recording"}


# --- commands ---

PARSER = build_parser()


def commands() -> Iterator[tuple[str, list[str]]]:
    """Return every `iris-session` command that a page shows, as `(where, arguments)`."""
    for block in SHELL:
        for line in block.text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["iris-session"]:
                yield block.name, words[1 : words.index(">") if ">" in words else None]
    for page in PAGES:
        for code in re.findall(r"`(iris-session [^`]+)`", prose(page).replace("\n", " ")):
            words = shlex.split(code)
            if words[1].islower() and not {"...", "--help"} & set(words):
                yield page.name, words[1:]


@pytest.mark.parametrize(("where", "arguments"), sorted({(w, tuple(a)) for w, a in commands()}), ids=str)
def test_command_parses(where: str, arguments: tuple[str, ...]) -> None:
    kind = {"verify": ["FILE"], "serve": ["SCENE"], "robots": ["SCENE"], "demo": ["handover"]}
    bare = len(arguments) == 1 or (len(arguments) > 1 and arguments[1].startswith("--") and arguments[0] in kind)
    # In running text a command may be named without its arguments.
    completed = [arguments[0], *kind.get(arguments[0], []), *arguments[1:]] if bare and ":" not in where else arguments
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors):
        try:
            PARSER.parse_args(list(completed))
        except SystemExit:
            pytest.fail(f"{where}: iris-session {shlex.join(arguments)}: {errors.getvalue().splitlines()[-1]}")


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    shown = [line.split()[1] for block in SHELL for line in block.text.splitlines() if line.startswith("make ")]
    for page in PAGES:
        shown += re.findall(r"`make (\w+)`", prose(page))
    assert shown
    for target in shown:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"no target {target}"


def test_command_line_reference_has_every_option() -> None:
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    common = _section(page, "Session options")
    commands = _commands()
    sections = {title: title.split(", ") for title in re.findall(r"^## (.+)$", page, re.MULTILINE)}
    assert set(commands) <= {name for together in sections.values() for name in together}
    for title, together in sections.items():
        text = _section(page, title)
        if "#session-options" in text:
            text += common
        known = set().union(*(_options(commands[name]) for name in together if name in commands))
        shown = set(re.findall(r"`(--[a-z-]+)", text))
        assert not known or shown - {"--json"} == known - {"-h", "--help", "--json", "-o"}, f"{title}: {shown ^ known}"


def _commands() -> dict[str, argparse.ArgumentParser]:
    """Return every command of `iris-session` and its parser."""
    actions = PARSER._subparsers
    assert actions is not None
    subparsers = next(a for a in actions._group_actions if isinstance(a, argparse._SubParsersAction))
    return dict(subparsers.choices)


def _options(parser: argparse.ArgumentParser) -> set[str]:
    """Return options of a command and of the actions below it (`keys allow`)."""
    found: set[str] = set()
    for action in parser._actions:
        found.update(action.option_strings)
        if isinstance(action, argparse._SubParsersAction):
            found.update(*(_options(inner) for inner in action.choices.values()))
    return found


def _section(page: str, title: str) -> str:
    found = re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    assert found, f"docs/cli.md has no section '{title}'"
    return found[1]


# --- links and files ---


def slug(title: str) -> str:
    """Return the anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-")


def headings(page: Path) -> set[str]:
    return {slug(title) for title in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_resolve(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"https?:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target} does not exist"
        assert ROOT in (file, *file.parents), f"{page.name}: {target} lies outside the repository"
        if anchor:
            assert anchor in headings(file), f"{page.name}: {target}: no such heading"


#: A name with a folder and one of these endings, written as code, is a file of the repository.
FILE = re.compile(r"`(?!Packages/|Assets/)((?:[\w.-]+/)+[\w.-]+\.(?:py|md|xml|toml|json|png))`")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_files_exist(page: Path) -> None:
    for name in FILE.findall(prose(page)):
        # Modules are named from the root or, in short, from the package.
        folders = (ROOT, ROOT / "iris_session")
        assert any((folder / name).is_file() for folder in folders), f"{page.name}: {name}"


# --- reasons ---

TABLES = re.findall(
    r"<!-- names: (\w+) -->\n(.*?)<!-- end -->",
    (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8"),
    re.DOTALL,
)


@pytest.mark.parametrize(("enumeration", "table"), TABLES, ids=[name for name, _ in TABLES])
def test_every_reason_is_explained(enumeration: str, table: str) -> None:
    values = {v for k, v in vars(getattr(names, enumeration)).items() if k.isupper() and isinstance(v, str)}
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \| (.*?) ?\|$", table, re.MULTILINE)
    assert sorted(code for code, _, _ in rows) == sorted(values)


def test_all_tables_of_reasons_are_there() -> None:
    assert {name for name, _ in TABLES} == {
        "HoldReason",
        "RejectReason",
        "DenialReason",
        "RefusalCode",
        "FaultCode",
        "LateCause",
    }


def test_every_key_of_a_demo_result_is_explained() -> None:
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"<!-- fields: demo -->\n(.*?)<!-- end -->", page, re.DOTALL)
    keys = [key for row in re.findall(r"^\| (`.+?) \|", table, re.MULTILINE) for key in re.findall(r"`(\w+)`", row)]
    assert sorted(keys) == sorted(DemoResult.__struct_encode_fields__)


def test_roles_modes_and_policies_are_in_the_guide() -> None:
    guide = (ROOT / "docs" / "guide.md").read_text(encoding="utf-8")
    wanted = names.Role.ALL | names.LeaseMode.ALL | names.AssignmentPolicy.ALL | names.Device.ALL
    missing = sorted(value for value in wanted | names.EpisodeAction.ALL if not re.search(rf'[`"]{value}["`]', guide))
    assert not missing


# --- failures ---


def test_every_failure_has_a_test() -> None:
    """The page of recovery names tests that exist, for every row of its table."""
    page = (ROOT / "docs" / "recovery.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (?!what fails).+", page.split("## What fails", 1)[1], re.MULTILINE)
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")]
    there = {name for text in texts for name in re.findall(r"^def (test_\w+)", text, re.MULTILINE)}
    assert len(rows) > 15
    for row in rows:
        named = set(re.findall(r"`(test_\w+)`", row))
        assert named, f"no test is named: {row}"
        assert not named - there, f"no such test: {named - there}"
