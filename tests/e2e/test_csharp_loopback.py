"""The C# client beside a session on loopback: aligned by touched marks, and by ZeroMQ without a gateway."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zmq.auth

from tests.csharp.conftest import built as built  # noqa: PLC0414  a fixture
from tests.e2e.browser import printed_address
from tests.e2e.session_process import COMMAND_S, SessionProcess, run_in_process
from tools.csharp.project import Build

pytestmark = [pytest.mark.e2e, pytest.mark.long]


def run_headset(command: list[str], folder: Path, *options: str) -> dict[str, Any]:
    """Let a headset do commands, which must succeed. Return their results by name."""
    done = subprocess.run(
        [*command, "run", "--json", "--identity", str(folder / "identity"), *options],
        capture_output=True,
        text=True,
        check=False,
        timeout=COMMAND_S,
    )
    results = {one["command"]: one for one in map(json.loads, done.stdout.splitlines())}
    assert done.returncode == 0, f"{results} {done.stderr}"
    return results


def test_touched_marks_align_and_the_arm_follows(
    serve: Callable[..., SessionProcess], built: Build, tmp_path: Path
) -> None:
    status, text, errors = run_in_process("anchors", "example", "handover", "--marks")
    assert status == 0, errors
    anchors = tmp_path / "anchors.toml"
    anchors.write_text(text)
    address = printed_address(serve("handover", "--anchors", str(anchors)))
    commands = "join; marks; acquire left; move left 0 0 0.05"
    results = run_headset(built.make_command("dotnet", "headless"), tmp_path, "--address", address, "--do", commands)
    assert results["marks"]["kind"] == "measured"
    assert results["marks"]["true_m"] <= results["marks"]["stated_m"] < 0.006


def make_keys(folder: Path) -> tuple[list[str], list[str]]:
    """Write certificates (docs/network.md). Return the options of a session, and of a client on its list."""
    (folder / "clients").mkdir()
    for name in ("server", "ann"):
        zmq.auth.create_certificates(folder, name)
        (folder / f"{name}.key_secret").chmod(0o600)
    (folder / "ann.key").rename(folder / "clients/ann.key")
    session = ["--curve-key", str(folder / "server.key_secret"), "--curve-clients", str(folder / "clients")]
    return session, ["--curve-server", str(folder / "server.key"), "--curve-key", str(folder / "ann.key_secret")]


@pytest.mark.parametrize(("runtime", "is_encrypted"), [("dotnet", True), ("mono", False)])
def test_a_headset_drives_by_zeromq(
    serve: Callable[..., SessionProcess], built: Build, tmp_path: Path, runtime: str, is_encrypted: bool
) -> None:
    of_session, of_client = make_keys(tmp_path) if is_encrypted else ([], [])
    server = serve("handover", *of_session)
    commands = "join; scene; align; acquire left; move left 0 0 0.05; measure 1"
    command = built.make_command(runtime, "headless")
    results = run_headset(command, tmp_path, "--zmq", server.address, *of_client, "--do", commands)
    assert results["measure"]["states"] > 0
