"""All checks in their order: the way, the door, then what the session says of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec
import psutil

from iris_session.client.address import Address
from iris_session.client.discovery import FoundSession
from iris_session.client.endpoint_resolver import is_loopback
from iris_session.client.errors import ClientError
from iris_session.doctor import condition, door, reach
from iris_session.doctor.findings import OK, Findings, failed, ok
from iris_session.doctor.machine import machine
from iris_session.protocol.names import Role
from iris_session.protocol.status import StatusReport
from iris_session.security import KeyHome, KeysError

LOCAL: Final = "127.0.0.1:7721"
DOOR: Final = ("server_key", "key", "role", "join")
ARRIVAL: Final = ("clock", "state")
CONDITION: Final = (
    "session", "alignment", "alarm", "stale", "align_run", "correction", "agreement", "leases", "robots", "clients",
    "age", "ticks", "media", "recorder", "disk", "drops",
)  # fmt: skip

#: As a person asks: is there a way, am I let in, does anything come, how is the session?
ORDER: Final = (
    "beacon",
    "address",
    "subnet",
    "tcp",
    "introduction",
    "version",
    "server_key",
    "key",
    "code",
    "role",
    "join",
    *ARRIVAL,
    *CONDITION,
)


@dataclass
class Examination:
    """`address`: what was looked at, as far as it is known. `report`: what the session said, if it did."""

    address: str = ""
    findings: Findings = field(default_factory=Findings)
    report: StatusReport | None = None

    @property
    def ok(self) -> bool:
        return self.findings.ok

    def as_dict(self) -> dict[str, object]:
        """For `--json`."""
        return {
            "ok": self.ok,
            "address": self.address,
            "checks": self.findings.as_list(),
            "report": None if self.report is None else msgspec.to_builtins(self.report),
        }


def examine(
    address: str = "",
    *,
    session: str = "",
    code: str = "",
    role: str = Role.OBSERVER,
    told: Callable[[str], None] = lambda _: None,
) -> Examination:
    """Looks at the session at `address` (or called `session`; neither: that of this user, see `here`). Takes seconds.

    `told` hears what is done next. Nothing is changed there: it joins as `doctor`, and leaves. A `code` is used up.
    """
    result = Examination()
    findings = result.findings
    try:
        target = None if session else Address.parse(address or here())
    except ClientError as error:
        findings.add(failed("address", str(error)))
        findings.skip("tcp", *DOOR, *ARRIVAL, *CONDITION)
        return result
    told("listening for sessions")
    heard, found = reach.beacon(session, target)
    findings.add(heard)
    if target is None and not heard.failed:
        target = Address.parse(next(one.address for one in found if one.name == session))
    if target is None:
        findings.skip("address", "subnet", "tcp", "introduction", "version", *DOOR, *ARRIVAL, *CONDITION)
        return result
    result.address = str(target)
    told(f"looking for {target}")
    if not _way(target, findings, found):
        findings.skip("introduction", "version", *DOOR, *ARRIVAL, *CONDITION)
        return result
    _door(result, target, address or str(target), code or target.join_code, role, told)
    return result


def here() -> str:
    """Address of the encrypted session that this user serves on this machine, if it is the only one; else that of a
    session on loopback at the usual port."""
    try:
        notes = KeyHome().sessions.read()
    except KeysError:  # the check `key_home` tells
        notes = []
    return str(Address(notes[0].hosts[0], notes[0].control)) if len(notes) == 1 and notes[0].hosts else LOCAL


def _way(target: Address, findings: Findings, heard: list[FoundSession]) -> bool:
    named, ip = reach.resolved(target)
    findings.add(named)
    if not ip:
        return False
    findings.add(reach.subnet(ip), reach.heard_elsewhere(reach.tcp(target, ip), target, heard))
    return not findings["tcp"].failed


def _door(result: Examination, target: Address, typed: str, code: str, role: str, told: Callable[[str], None]) -> None:
    findings = result.findings
    introduced, version, said = reach.introduction(target)
    base = reach.base_of_ports(target) if introduced.state != OK else None
    if base is not None:
        findings.add(base)
        findings.skip("version", *DOOR, *ARRIVAL, *CONDITION)
        return
    findings.add(introduced, version)
    if version.failed:
        findings.skip(*DOOR, *ARRIVAL, *CONDITION)
        return
    findings.add(door.server_key(target, said))
    if findings["server_key"].failed:
        findings.skip(*DOOR, *ARRIVAL, *CONDITION)
        return
    told(f"joining {target} as {role}")
    visit = door.knock(target, typed, code, role, said)
    findings.add(*visit.findings)
    if any(one.check == "join" and not one.failed for one in visit.findings):
        plain = is_loopback(target.host) and not (said is not None and said.server_key)
        text = "none is needed on the session's own machine" if plain else "this machine's key is on the session's list"
        findings.add(ok("key", text))
    result.report = visit.report
    if visit.report is not None:
        findings.add(*condition.conditions(visit.report, visit.own_id))
    findings.skip(*DOOR, *ARRIVAL, *CONDITION)
    findings.sort(ORDER)


def examine_server(address: str, recordings: Path, *, told: Callable[[str], None] = lambda _: None) -> Examination:
    """Looks at this machine, and at the session that runs on it, if one does. `recordings`: the folder for them.

    `address`: of that session; empty: that of this user, see `here`, else the first that tells of itself from here.
    """
    told("looking at this machine")
    target = Address.parse(address or here())
    result = Examination(str(target))
    result.findings.add(*machine(recordings, target.port))
    named, ip = reach.resolved(target)
    if not ip:
        result.findings.add(named)
        return result
    if reach.tcp(target, ip).failed and not address:
        own = {one.address for addresses in psutil.net_if_addrs().values() for one in addresses}
        local = [found for found in map(_address, reach.beacon("", None)[1]) if found.host in own]
        target = local[0] if local else target
        ip = reach.resolved(target)[1]
    if not reach.tcp(target, ip).failed:
        inside = examine(str(target), told=told)
        result.address, result.report = inside.address, inside.report
        result.findings.add(*(one for one in inside.findings if one.check not in ("beacon", "address", "subnet")))
    return result


def _address(found: FoundSession) -> Address:
    return Address.parse(found.address)
