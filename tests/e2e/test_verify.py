"""Recordings of sessions that are hard to replay verify bit for bit, and a changed byte of a journal is found."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from iris_session.rrd.file import scan_file
from tests.e2e.session_process import run_command
from tests.recording.test_kept_recordings import unpack

pytestmark = pytest.mark.e2e


def test_command_finds_a_flipped_byte(tmp_path: Path) -> None:
    path = unpack("closed", tmp_path)
    data = bytearray(path.read_bytes())
    victim = max(scan_file(path).messages[60:-1], key=lambda message: message.length)  # the last is the index
    data[victim.offset + victim.length // 2] ^= 1
    path.write_bytes(data)
    done = run_command("verify", "--json", str(path), cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    (report,) = json.loads(done.stdout)["files"]
    assert not report["ok"]
    named = [re.search(r"bytes (\d+) to (\d+)", one["text"]) for one in report["problems"]]
    assert any(match and int(match[1]) <= victim.offset < int(match[2]) for match in named), report["problems"]
