"""No decision depends on the wall clock, which jumps (daylight saving, NTP, users). Session time is monotonic.

The few readings stamp something for people, or measure what must survive a reboot; each is listed here.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: Calls that read the wall clock, by the last two names of the dotted call.
WALL = {
    *("time.time", "time.time_ns", "time.localtime", "time.gmtime", "time.ctime", "time.strftime"),
    *("datetime.now", "datetime.utcnow", "datetime.today", "date.today"),
}
#: Where it may be read, and the reason.
ALLOWED = {
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


def readings(path: Path) -> Iterator[int]:
    """Yield lines of a module that read the wall clock."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and ".".join(ast.unparse(node.func).split(".")[-2:]) in WALL:
            yield node.lineno


def test_the_wall_clock_is_read_in_few_places_only() -> None:
    found = {
        str(path.relative_to(ROOT)): lines
        for folder in ("iris_session", "anchors")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if (lines := list(readings(path)))
    }
    others = {path: lines for path, lines in found.items() if path not in ALLOWED}
    assert not others, "use time.monotonic_ns (session time), or say here what the wall clock is for"
    assert set(found) == set(ALLOWED), "a reason for nothing"


@pytest.mark.parametrize("text", ["import time\ntime.time()", "import datetime\ndatetime.datetime.now()"])
def test_readings_are_detected(tmp_path: Path, text: str) -> None:
    module = tmp_path / "module.py"
    module.write_text(text)
    assert list(readings(module)) == [2]
