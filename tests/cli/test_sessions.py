"""`iris-session sessions`, and the options for address and name of a session."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from iris_session.cli.common import CommandError
from iris_session.cli.main import build_parser
from iris_session.cli.serve import make_session_config
from iris_session.client import FoundSession
from iris_session.security import KeyHome, KeyPair, compute_fingerprint, decode_key
from tests.cli.conftest import CommandLine

KEY = KeyPair.generate().public
PLAIN = FoundSession("handover", "127.0.0.1:7721", "s1", "live", "", ("127.0.0.1:7721",))
NEW = FoundSession("lab-1", "10.0.0.5:7721", "s2", "live", "mark", ("10.0.0.5:7721", "10.1.0.5:7721"))
KNOWN = FoundSession("lab-2", "10.0.0.6:7721", "s3", "replay", compute_fingerprint(decode_key(KEY)), ("10.0.0.6:7721",))


@pytest.fixture
def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[FoundSession]:
    """Replace discovery on the network of this machine."""
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "keys"))
    found: list[FoundSession] = []
    monkeypatch.setattr("iris_session.client.find_sessions", lambda seconds: found)
    return found


def test_sessions_are_listed_with_known_keys(found: list[FoundSession], cli: CommandLine) -> None:
    KeyHome().known_servers.pin("10.0.0.6:7721", "lab-2", KEY)
    found += [PLAIN, NEW, KNOWN]
    plain, new, known = cli.run("sessions").splitlines()
    assert plain.split()[:3] == ["handover", "127.0.0.1:7721", "live"]
    assert "not encrypted" in plain
    assert "(new: join" in new
    assert known.split()[:3] == ["lab-2", "10.0.0.6:7721", "replay"]
    assert "(new" not in known
    rows = cli.json("sessions")["sessions"]
    assert [(row["encrypted"], row["known"]) for row in rows] == [(False, False), (True, False), (True, True)]
    assert rows[1]["addresses"] == ["10.0.0.5:7721", "10.1.0.5:7721"]


def test_empty_network_exits_with_1_and_advice(found: list[FoundSession], cli: CommandLine) -> None:
    assert "type the address" in cli.run("sessions", status=1)
    assert cli.json("sessions", status=1) == {"ok": False, "sessions": []}


def options(*words: str) -> argparse.Namespace:
    return build_parser().parse_args(["serve", "handover", *words])


def test_block_of_ports_is_one_option() -> None:
    config = make_session_config(options("--port-base", "7730"), "x")
    assert (config.control_port, config.state_port, config.beacon_port) == (7731, 7732, 7720)
    config = make_session_config(options(), "x")
    assert (config.control_port, config.state_port) == (7721, 7722)
    demo = build_parser().parse_args(["demo", "handover"])
    assert make_session_config(demo, "x").control_port == 0
    demo = build_parser().parse_args(["demo", "handover", "--port-base", "7730"])
    assert make_session_config(demo, "x").control_port == 7731
    with pytest.raises(CommandError, match="--port-base"):
        make_session_config(options("--port-base", "7730", "--state-port", "9"), "x")
    for text in ("65535", "x"):
        with pytest.raises(SystemExit):
            options("--port-base", text)


def test_host_and_interface_are_exclusive() -> None:
    given = options("--interface", "eth0", "--interface", "10.0.0.5", "--advertise", "lab.example", "--no-beacon")
    config = make_session_config(given, "x")
    assert (config.interfaces, config.advertise, config.beacon_port) == (("eth0", "10.0.0.5"), "lab.example", 0)
    with pytest.raises(CommandError, match="--interface and --host"):
        make_session_config(options("--interface", "eth0", "--host", "0.0.0.0"), "x")


def test_rate_of_recorded_clouds() -> None:
    for text, hz in (("2Hz", 2.0), ("0.5", 0.5), ("10 hz", 10.0), ("off", 0.0), ("0", 0.0)):
        assert make_session_config(options("--record-clouds", text), "x").record_clouds_hz == hz
    assert make_session_config(options(), "x").record_clouds_hz == 2.0
    for text in ("fast", "61", "nan"):
        with pytest.raises(SystemExit):
            options("--record-clouds", text)


def test_groups_and_sites_that_clients_show() -> None:
    for text, groups in (("0,1,2", (0, 1, 2)), ("3", (3,)), ("1, 4", (1, 4))):
        assert make_session_config(options("--groups", text), "x").groups == groups
    for given, sites in ((["--sites"], True), (["--sites", "none"], False), (["--sites", "0,3"], (0, 3))):
        assert make_session_config(options(*given), "x").sites == sites
    config = make_session_config(options(), "x")
    assert (config.groups, config.sites) == (None, None)
    for wrong in (["--groups", "visual"], ["--groups", ""], ["--sites", "scene.xml"]):
        with pytest.raises(SystemExit):
            options(*wrong)


def test_assets_of_recordings() -> None:
    assert make_session_config(options("--record-assets", "all"), "x").record_assets == "all"
    assert make_session_config(options(), "x").record_assets == "scene"
    with pytest.raises(SystemExit):
        options("--record-assets", "some")


def test_budget_of_recordings(cli: CommandLine) -> None:
    for text, n_bytes in (("20GB", 20 * 10**9), ("1.5 GiB", 3 << 29), ("16mb", 16 * 10**6)):
        assert make_session_config(options("--record-budget", text), "x").record_budget_bytes == n_bytes
    assert make_session_config(options(), "x").record_budget_bytes == 0
    for text in ("15MB", "20", "1e3GB", "9" * 400 + "GB"):
        with pytest.raises(SystemExit) as ended:
            options(f"--record-budget={text}")
        assert ended.value.code == 2
        assert "is not a size for a recording: give 16MB or more, for example 20GB" in cli.err
    with pytest.raises(CommandError, match="leave --no-record out"):
        make_session_config(options("--no-record", "--record-budget", "1GB"), "x")
