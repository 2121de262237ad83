"""`iris-session sessions`, and the options for address and name of a session."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

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


@pytest.mark.parametrize(
    ("words", "fields"),
    [
        ("", {"control_port": 7721, "state_port": 7722, "record_clouds_hz": 2.0, "record_assets": "scene"}),
        ("", {"groups": None, "sites": None, "record_budget_bytes": 0, "record": True, "interfaces": ()}),
        ("--port-base 7730", {"control_port": 7731, "state_port": 7732, "beacon_port": 7720}),
        ("--interface eth0 --interface 10.0.0.5", {"interfaces": ("eth0", "10.0.0.5")}),
        ("--advertise lab.example --no-beacon", {"advertise": "lab.example", "beacon_port": 0}),
        ("--no-record --no-web", {"record": False, "web": False}),
        ("--record a.rrd --record-assets all", {"record": "a.rrd", "record_assets": "all"}),
        *((f"--record-clouds {text}", {"record_clouds_hz": hz}) for text, hz in (("2Hz", 2.0), ("0.5", 0.5))),
        *((f"--record-clouds {text}", {"record_clouds_hz": hz}) for text, hz in (("'10 hz'", 10.0), ("off", 0.0))),
        ("--groups 0,1,2 --sites", {"groups": (0, 1, 2), "sites": True}),
        ("--groups '1, 4' --sites none", {"groups": (1, 4), "sites": False}),
        ("--sites 0,3", {"sites": (0, 3)}),
        ("--record-budget 20GB", {"record_budget_bytes": 20 * 10**9}),
        ("--record-budget '1.5 GiB'", {"record_budget_bytes": 3 << 29}),
        ("--record-budget 16mb", {"record_budget_bytes": 16 * 10**6}),
        ("--camera a.toml --camera b.toml", {"cameras": (Path("a.toml"), Path("b.toml"))}),
        ("--picture top --plain-pictures", {"pictures": ("top",), "plain_pictures": True}),
    ],
)
def test_options_of_a_session_are_fields_of_its_configuration(words: str, fields: dict[str, object]) -> None:
    arguments = build_parser().parse_args(["serve", "handover", *shlex.split(words)])
    config = make_session_config(arguments, "x")
    assert {name: getattr(config, name) for name in fields} == fields


def test_the_session_of_a_demo_takes_free_ports() -> None:
    for words, port in ((), 0), (("--port-base", "7730"), 7731):
        arguments = build_parser().parse_args(["demo", "handover", *words])
        assert make_session_config(arguments, "x").control_port == port


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--port-base 7730 --state-port 9", "--port-base sets all ports"),
        ("--port-base 65535", "a base of seven ports: give 1 to 65529"),
        ("--interface eth0 --host 0.0.0.0", "--interface and --host"),
        ("--record-clouds fast", "give 0.01 to 60 a second"),
        ("--record-clouds 61", "give 0.01 to 60 a second"),
        ("--groups visual", "must be numbers of groups"),
        ("--groups=", "must be numbers of groups"),
        ("--sites scene.xml", "must be numbers of groups"),
        ("--record-assets some", "invalid choice: 'some'"),
        *((f"--record-budget={size}", "give 16MB or more, for example 20GB") for size in ("15MB", "20", "1e3GB")),
        ("--no-record --record-budget 1GB", "leave --no-record out"),
        ("--record a.txt", "'a.txt': a recording is one file: give a name that ends in .rrd"),
        ("--record a.rrd --no-record", "--no-record: not allowed with argument --record"),
        ("--assign ann", "NAME=ROBOT[,ROBOT]"),
        ("--unaligned ann", "key:FINGERPRINT"),
        ("--assign ann=left --assignment nearest", "--assignment config"),
        ("--seconds nan", "give seconds above 0"),
    ],
)
def test_unusable_options_of_a_session_are_refused(words: str, text: str, cli: CommandLine) -> None:
    assert text in cli.refuse("serve", "handover", *shlex.split(words))
