"""Plant faults one after the other, and check that `iris-session doctor` names each of them.

    python tools/planted_faults.py                 table of docs/evidence/doctor.md; exit status 1 when one is not named
    python tools/planted_faults.py --only revoked --only full-disk --verbose
    python tools/planted_faults.py --list

The two machines are emulated by `planted_lab`: needs Linux, root, `ip` and `nft`. A fault counts as named when its
check has the expected state and its text has the expected words, when no other check failed except those that follow
from the fault, when the exit status fits, and when the output fits on one screen. Before and after, the doctor must
find nothing failed; otherwise the result does not count. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from planted_lab import COMMAND, Lab, LabError, Machine, check_requirements, system, wait

from iris_session.cli.doctor import format_findings, format_verdict
from iris_session.doctor.findings import FAILED, WARNING, Finding

IMPAIR: Final = str(Path(__file__).with_name("impair.py"))
RECENTRED: Final = """
import sys
from iris_session import Client
from iris_session.protocol.names import Role
with Client(sys.argv[1], role=Role.DIRECTOR, alignment="not_needed", name="dora") as dora:
    dora.start()
    with Client(sys.argv[1], name="ann", devices=("head",)) as ann:
        dora.alignment.place(ann.participant_id, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
        ann.wait_for(lambda c: c.alignment.current is not None and c.alignment.current.kind == "placed")
        ann.alignment.report_tracking_jump()
        ann.wait_for(lambda c: c.alignment.current is None or c.alignment.current.kind == "none")
        print("recentred", flush=True)
        ann.sleep(60)
"""
SLOW_LOOP: Final = """
import time
import mujoco
from iris_session import Session, SessionConfig
from iris_session.demo.scenes import scene_path
config = SessionConfig(control_port=7741, state_port=7742, beacon_port=0, record=False)
with Session(scene_path("handover"), config=config) as session:
    mujoco.set_mjcb_passive(lambda model, data: time.sleep(0.003))  # of 2 ms that a tick has
    print("on", session.address, flush=True)
    session.run()
"""
#: Second address of the server, behind an impaired link.
BEHIND: Final = "10.77.2.3"
#: Observes the sheet all the time, so that the effect of the bump is detected.
BUMPED: Final = "name=ann,behaviour=idle,robot=left,glance_every_s=2,bump_m=0.2/0/0"
#: Introduction of a session of the next protocol version.
FUTURE: Final = """
import socket
from iris_session.protocol.codec import encode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.names import PROTOCOL_VERSION
introduction = Introduction(Beacon(PROTOCOL_VERSION + 1, "s2", "future", "live", "10.77.2.1", 7751, 0, 0, 0, 0))
introducing, control = (socket.create_server(("10.77.2.1", port)) for port in (7750, 7751))
print("listens", flush=True)
while True:
    peer, _ = introducing.accept()
    with peer:
        peer.sendall(encode_introduction(introduction))
"""


@dataclass(frozen=True)
class DoctorCall:
    """Call of the doctor: machine, arguments, and key folder of the user."""

    machine: Machine
    arguments: tuple[str, ...]
    keys: str = "keys"


Plant = Callable[[Lab], AbstractContextManager[DoctorCall]]


@dataclass(frozen=True)
class Fault:
    """Fault to plant. `check` must be in `state` with all `expected` texts. `follows`: checks that fail too."""

    name: str
    planted: str
    plant: Plant
    check: str
    expected: tuple[str, ...]
    state: str = FAILED
    follows: tuple[str, ...] = ()


FAULTS: Final[list[Fault]] = []


def fault(
    planted: str, check: str, *expected: str, state: str = FAILED, follows: tuple[str, ...] = ()
) -> Callable[[Callable[[Lab], Iterator[DoctorCall]]], Plant]:
    """Register a function that plants a fault. `planted`: its description in the table."""

    def decorate(function: Callable[[Lab], Iterator[DoctorCall]]) -> Plant:
        plant = contextmanager(function)
        name = function.__name__.replace("_", "-")
        FAULTS.append(Fault(name, planted, plant, check, expected, state, follows))
        return plant

    return decorate


def from_client(lab: Lab, *options: str, keys: str = "keys") -> DoctorCall:
    return DoctorCall(lab.client, (lab.server.address, *options), keys)


# --- network ---------------------------------------------------------------------------------------------------------


@fault("an address that no machine has", "tcp", "cannot be reached", "lab-1 (10.77.2.1:7721)")
def wrong_address(lab: Lab) -> Iterator[DoctorCall]:
    yield DoctorCall(lab.client, ("10.77.2.99",))


@fault("a port on which nothing listens", "tcp", "nothing listens", "port 7799", "lab-1 (10.77.2.1:7721)")
def wrong_port(lab: Lab) -> Iterator[DoctorCall]:
    yield DoctorCall(lab.client, (f"{lab.server.address}:7799",))


@fault("the client is in 10.88.2.0/24", "subnet", "10.88.2.0/24", "same network", follows=("tcp",))
def wrong_subnet(lab: Lab) -> Iterator[DoctorCall]:
    with lab.client.addressed("10.88.2.2/24"):
        yield from_client(lab)


@fault("the server's firewall drops every TCP port", "tcp", "no answer", "a firewall", "allow TCP 7721")
def firewall(lab: Lab) -> Iterator[DoctorCall]:
    with lab.server.firewall("tcp dport 7720-7726"):
        yield from_client(lab)


@fault("it drops TCP 7722 alone", "state", "no answer", "port 7722 (state)", "allow TCP 7722")
def firewall_state_only(lab: Lab) -> Iterator[DoctorCall]:
    with lab.server.firewall("tcp dport 7722"):
        yield from_client(lab)


@fault("broadcasts are blocked, the address works", "beacon", "blocks broadcasts", "type", state=WARNING)
def broadcasts_blocked(lab: Lab) -> Iterator[DoctorCall]:
    with lab.client.firewall("udp dport 7720"):
        yield from_client(lab)


@fault("broadcasts are blocked, and the session is given by name", "beacon", "'lab-1'", "give its address")
def by_name_without_broadcasts(lab: Lab) -> Iterator[DoctorCall]:
    with lab.client.firewall("udp dport 7720"):
        yield DoctorCall(lab.client, ("--session", "lab-1"))


@fault("a session of the next protocol version", "version", "version 2", "update this machine")
def other_version(lab: Lab) -> Iterator[DoctorCall]:
    with lab.server.running_process(sys.executable, "-c", FUTURE, ready_line="listens"):
        yield DoctorCall(lab.client, (f"{lab.server.address}:7751",))


# --- joining --------------------------------------------------------------------------------------------------------


@fault("a user who has not paired", "key", "not on the session's list", "iris-session pair")
def not_paired(lab: Lab) -> Iterator[DoctorCall]:
    yield from_client(lab, keys="stranger")


@fault("a join code with wrong letters", "code", "join code", "iris-session pair")
def wrong_code(lab: Lab) -> Iterator[DoctorCall]:
    lab.create_code()
    yield from_client(lab, "--code", "7KQ2-M4XD-9PTR", keys="stranger")


@fault("a join code after its time", "code", "expired", "iris-session pair")
def expired_code(lab: Lab) -> Iterator[DoctorCall]:
    code = lab.create_code("--minutes", "0.02")
    time.sleep(1.5)  # its 1.2 s
    yield from_client(lab, "--code", code, keys="stranger")


@fault("`keys revoke` after the user had joined", "key", "admitted before", "revoked", "iris-session pair")
def revoked(lab: Lab) -> Iterator[DoctorCall]:
    joined = lab.client.iris("doctor", lab.server.address, "--code", lab.create_code("--name", "quest-3"), keys="loser")
    if joined.returncode:
        raise LabError(joined.stdout)
    lab.server.iris("keys", "revoke", "quest-3")
    yield from_client(lab, keys="loser")


@fault("an observer's key wants to drive", "role", "may not join", "observer")
def role(lab: Lab) -> Iterator[DoctorCall]:
    lab.server.iris("keys", "allow", "screen", lab.read_public_key("observer"), "--role", "observer")
    yield from_client(lab, "--role", "operator", keys="observer")


@fault("another server at the known address", "server_key", "is known for", "iris-session keys forget")
def other_server(lab: Lab) -> Iterator[DoctorCall]:
    with lab.server.running_process(
        *COMMAND, "serve", "arm", "--no-record", "--host", lab.server.address, "--port-base", "7760",
        ready_line=r"on \S+:\d+,", keys="elsewhere",
    ):  # fmt: skip
        known = lab.client.folder / "victim" / "known_servers.json"
        joined = lab.client.iris("doctor", lab.server.address, "--code", lab.create_code(), keys="victim")
        if joined.returncode:
            raise LabError(joined.stdout)
        known.write_text(known.read_text().replace(":7721", ":7761"))
        yield DoctorCall(lab.client, (f"{lab.server.address}:7761",), "victim")


# --- the session -----------------------------------------------------------------------------------------------------


def emulate(lab: Lab, ready_line: str, *people: str, orders: bool = False) -> AbstractContextManager[Any]:
    """Run emulated headsets, from the time their output matches `ready_line`."""
    headsets = [word for person in people for word in ("--headset", person)]
    options = ["--orders"] if orders else []
    return lab.client.running_process(
        *COMMAND, "emulate", lab.server.address, *headsets, *options, ready_line=ready_line
    )


@fault(
    "a headset that has observed no sheet of the session",
    "alignment",
    "ann has no alignment",
    "none usable of a sheet of this session",
    "session: table",
)
def no_alignment(lab: Lab) -> Iterator[DoctorCall]:
    with emulate(lab, r"ann +look", "name=ann,behaviour=idle,robot=left,anchor_id=elsewhere"):
        yield from_client(lab)


@fault("a headset was recentred", "alignment", "ann has no alignment (lost", "jumped", "bring the sheet into view")
def recentred(lab: Lab) -> Iterator[DoctorCall]:
    with lab.client.running_process(sys.executable, "-c", RECENTRED, lab.server.address, ready_line="recentred"):
        yield from_client(lab)


@fault(
    "a headset was bumped while its alignment run is stopped", "alarm", "ann: the tracking frame jumped",
    "mm", "bring a sheet into view", follows=("alignment",),
)  # fmt: skip
def bumped(lab: Lab) -> Iterator[DoctorCall]:
    with emulate(lab, r"ann +work", BUMPED, orders=True) as ann:
        lab.client.iris("anchors", "align", "stop", "ann", "--address", lab.server.address)
        ann.stdin.write(b"bump ann\n")
        ann.stdin.flush()
        wait(lambda: "ALARM" in lab.client.iris("anchors", "status", lab.server.address).stdout, "an alarm")
        yield from_client(lab)


@fault(
    "both robots are held by other participants",
    "leases",
    "carl has no robot",
    "left: ann",
    "right: bob",
    state=WARNING,
)
def robot_held(lab: Lab) -> Iterator[DoctorCall]:
    here = ("name=ann,behaviour=idle,robot=left", "name=bob,behaviour=idle,robot=right")
    both, wants = r"ann +work[\s\S]*bob +work|bob +work[\s\S]*ann +work", r"carl +\w+ +samples [1-9]"
    with emulate(lab, both, *here), emulate(lab, wants, "name=carl,behaviour=idle,robot=left"):
        wait(lambda: lacks_robot(lab, "carl"), "carl without a robot")
        yield from_client(lab)


def lacks_robot(lab: Lab, name: str) -> bool:
    return any(one["name"] == name and not one["holds"] for one in list_participants(lab))


def list_participants(lab: Lab) -> list[dict[str, Any]]:
    """Return the participants in the status, disconnected ones too."""
    status = json.loads(lab.client.iris("status", lab.server.address, "--json").stdout)
    participants: list[dict[str, Any]] = status["participants"]
    return participants


@fault("a client's program is stopped", "clients", "ann:", "silent", "is the app in front")
def frozen_client(lab: Lab) -> Iterator[DoctorCall]:
    with emulate(lab, r"ann +look +samples [1-9]", "name=ann,behaviour=observer") as ann:
        system("kill", "-STOP", str(ann.pid))
        yield from_client(lab)
    wait(lambda: "ann" not in {one["name"] for one in list_participants(lab)}, "the removal of ann")


@fault(
    "a link of 100 ms each way (`tools/impair.py`)",
    "clock",
    "round trips are long",
    "check the network",
    state=WARNING,
)
def slow_link(lab: Lab) -> Iterator[DoctorCall]:
    yield from serve_behind(lab, "100ms")


@fault(
    "a link of 400 ms each way",
    "join",
    "answers with an introduction",
    "a very slow or lossy link",
    "check the network",
)
def very_slow_link(lab: Lab) -> Iterator[DoctorCall]:
    yield from serve_behind(lab, "400ms")


def serve_behind(lab: Lab, profile: str) -> Iterator[DoctorCall]:
    """Give the server a second address behind a link of this profile."""
    words = (sys.executable, IMPAIR, "--link", f"{BEHIND}={profile}", "--target", lab.server.address)
    with lab.server.addressed(f"{BEHIND}/24", additional=True), lab.server.running_process(*words, ready_line="."):
        yield DoctorCall(lab.client, (BEHIND,))


@fault("physics takes 3 ms of a tick of 2 ms", "ticks", "physics takes longer than a tick", "a larger time step")
def late_ticks(lab: Lab) -> Iterator[DoctorCall]:
    with lab.server.running_process(sys.executable, "-c", SLOW_LOOP, ready_line="on "):
        time.sleep(5.0)  # most of the ten seconds that late ticks are counted over
        yield DoctorCall(lab.server, ("127.0.0.1:7741",))


@fault("the disk below the recording is full", "disk", "the disk is full", "make room", follows=("recorder",))
def full_disk(lab: Lab) -> Iterator[DoctorCall]:
    disk = lab.small_disk(24)
    with lab.server.running_process(
        *COMMAND, "serve", "handover", "--port-base", "7730", "--no-beacon", "--record", str(disk / "session.rrd"),
        ready_line=r"on \S+:\d+,",
    ):  # fmt: skip
        system("sh", "-c", f"cat /dev/zero > {disk}/other 2>/dev/null || true")
        time.sleep(3.0)  # until the recorder has written
        yield DoctorCall(lab.server, ("127.0.0.1:7731",))


@fault("the session's program is stopped", "session", "has not taken a step", "check that program", follows=("join",))
def session_stopped(lab: Lab) -> Iterator[DoctorCall]:
    [session] = lab.server.running[:1]
    system("kill", "-STOP", str(session.pid))
    try:
        time.sleep(1.0)
        yield from_client(lab)
    finally:
        system("kill", "-CONT", str(session.pid))


# --- judging ----------------------------------------------------------------------------------------------------------


SCREEN: Final = (120, 50)
"""Columns and lines of a screen."""
PLAIN: Final = str.maketrans("|`", "/'")
"""Characters replaced in a table, where they have a meaning."""
SETTLE_S: Final = 20.0
"""Late ticks are reported for the last ten seconds: those of the start and of a fault have left it by then."""


def call_doctor(visit: DoctorCall) -> tuple[list[Finding], int, float]:
    """Call the doctor. Return its findings, exit status and duration [s]."""
    began = time.monotonic()
    done = visit.machine.iris("doctor", *visit.arguments, "--json", keys=visit.keys)
    took = time.monotonic() - began
    if not done.stdout:
        raise LabError(f"the doctor itself failed: {done.stderr[-500:]}")
    return [Finding(**one) for one in json.loads(done.stdout)["checks"]], done.returncode, took


def count_screen_lines(findings: list[Finding]) -> int:
    """Return the number of screen lines of the findings."""
    columns, _ = SCREEN
    return sum(
        max(1, len(textwrap.wrap(line, columns))) for line in [*format_findings(findings), format_verdict(findings)]
    )


def judge(one: Fault, findings: list[Finding], status: int) -> str:
    """Return why the fault does not count as named; empty if it does."""
    found = {finding.check: finding for finding in findings}
    if one.check not in found or found[one.check].state != one.state:
        return f"`{one.check}` is {found[one.check].state if one.check in found else 'missing'}, not {one.state}"
    named = found[one.check]
    text = f"{named.text} {named.why} {named.advice}"
    if missing := [words for words in one.expected if words not in text]:
        return f"`{one.check}` lacks {missing}: {text}"
    if not named.advice:
        return f"`{one.check}` has no advice"
    others = {finding.check for finding in findings if finding.failed} - {one.check, *one.follows}
    if others:
        return f"failed too: {', '.join(sorted(others))}"
    if status != (1 if one.state == FAILED else 0):
        return f"exit status {status}"
    if count_screen_lines(findings) > SCREEN[1]:
        return f"{count_screen_lines(findings)} lines are more than a screen"
    return ""


def check_healthy(lab: Lab) -> None:
    """Raise `LabError` if checks fail although nothing is planted: the result does not count then."""
    until = time.monotonic() + SETTLE_S
    while True:
        found, status, _ = call_doctor(from_client(lab))
        bad = [f"{one.check}: {one.text}" for one in found if one.failed]
        if not bad and not status:
            return
        if time.monotonic() > until:
            raise LabError(f"no fault is planted, but {'; '.join(bad) or f'exit status {status}'}")


def format_row(number: int, one: Fault, findings: list[Finding], status: int, took: float) -> str:
    """Return a row of the table, with the texts of the doctor."""
    named = next(finding for finding in findings if finding.check == one.check)
    message = f"{named.text}. Why: {named.why}" if named.why else named.text
    what = [part.translate(PLAIN) for part in (message, named.advice)]
    return (
        f"| {number} | {one.planted} | `{named.check}`, {named.state} | {what[0]} | {what[1]} | {status} | {took:.1f} |"
    )


def examine_all(lab: Lab, chosen: list[Fault], *, verbose: bool) -> list[str]:
    """Print the table. Return a line for each fault that is not named."""
    unnamed = []
    print("| | planted | check | message | advice | status | s |\n|---|---|---|---|---|---|---|")
    for number, one in enumerate(chosen, 1):
        try:
            with one.plant(lab) as visit:
                findings, status, took = call_doctor(visit)
        except LabError as error:
            unnamed.append(f"{one.name}: could not be planted: {error}")
            print(f"| {number} | {one.planted} | **not planted**: {error} | | | | |", flush=True)
            continue
        if verbose:
            print("\n".join([*format_findings(findings), format_verdict(findings)]), file=sys.stderr)
        if why := judge(one, findings, status):
            unnamed.append(f"{one.name}: {why}")
            print(f"| {number} | {one.planted} | **not named**: {why} | | | {status} | {took:.1f} |", flush=True)
        else:
            print(format_row(number, one, findings, status, took), flush=True)
    return unnamed


def main() -> int:
    """Run the command. Exit status 1 if a fault is not named, 2 if the faults could not be planted."""
    names = [one.name for one in FAULTS]
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--only", action="append", choices=names, metavar="FAULT", help="plant this fault only, repeatable"
    )
    parser.add_argument("--list", action="store_true", help="list the faults")
    parser.add_argument("--verbose", action="store_true", help="print the output of the doctor on standard error")
    options = parser.parse_args()
    if options.list:
        print("\n".join(f"{one.name:28s} {one.planted}" for one in FAULTS))
        return 0
    chosen = [one for one in FAULTS if not options.only or one.name in options.only]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(2))  # else namespaces and processes would stay
    try:
        check_requirements()
        with tempfile.TemporaryDirectory(prefix="iris-faults-") as folder, Lab(Path(folder)) as lab:
            lab.server.serve("--interface", lab.server.interface, "--name", "lab-1", "--no-record")
            lab.server.iris("keys", "allow", "client", lab.read_public_key("keys"), "--role", "any")
            check_healthy(lab)
            unnamed = examine_all(lab, chosen, verbose=options.verbose)
            check_healthy(lab)
    except LabError as error:
        print(f"planted_faults: {error}", file=sys.stderr)
        return 2
    print(f"\n{len(chosen) - len(unnamed)} of {len(chosen)} faults are named", *unnamed, sep="\n")
    return 1 if unnamed else 0


if __name__ == "__main__":
    sys.exit(main())
