"""Run all checks in order: network, joining, then the status of the session."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec
import psutil

from iris_session.client.discovery import Address
from iris_session.client.errors import ClientError
from iris_session.doctor import join_checks, network_checks, session_checks
from iris_session.doctor.findings import OK, Findings, failed, ok
from iris_session.doctor.host_checks import check_host
from iris_session.link.config import is_loopback
from iris_session.protocol.names import Role
from iris_session.protocol.status import StatusReport
from iris_session.security import KeyHome, KeysError

LOCAL: Final = "127.0.0.1:7721"
SESSION_CHECKS: Final = (
    "session", "alignment", "alarm", "stale", "align_run", "correction", "agreement", "pairs", "leases", "robots",
    "clients", "age", "ticks", "streams", "media", "recorder", "disk", "drops",
)  # fmt: skip
#: As a user asks: is there a route, am I admitted, does state arrive, how is the session?
ORDER: Final = (
    "beacon", "address", "subnet", "tcp", "introduction", "version", "server_key", "key", "code", "role", "join",
    "clock", "state", "web_port", "media_port", "assets_port", *SESSION_CHECKS,
)  # fmt: skip
#: Checks that are not made every time.
OPTIONAL: Final = frozenset({"beacon", "code", "web_port", "media_port", "assets_port"})


@dataclass
class DoctorReport:
    """Findings about one session. `address`: of the session, as far as known. `report`: its status, if it answered."""

    address: str = ""
    findings: Findings = field(default_factory=Findings)
    report: StatusReport | None = None

    @property
    def ok(self) -> bool:
        """True if no check failed."""
        return self.findings.ok

    def as_dict(self) -> dict[str, object]:
        """Return the object that `--json` prints."""
        return {
            "ok": self.ok,
            "address": self.address,
            "checks": [msgspec.to_builtins(one) for one in self.findings],
            "report": None if self.report is None else msgspec.to_builtins(self.report),
        }


def run_checks(
    address: str = "",
    *,
    session: str = "",
    code: str = "",
    role: str = Role.OBSERVER,
    on_progress: Callable[[str], None] = lambda _: None,
) -> DoctorReport:
    """Check a session from a client's machine. Takes seconds.

    Joins as participant `doctor` and leaves; nothing else is changed in the session.

    Args:
        address: Address of the session; empty: see `find_default_address`.
        session: Name of the session, instead of an address.
        code: Join code to try; it is used up.
        role: Role to join in.
        on_progress: Called with a short text before each part.
    """
    result = DoctorReport()
    _check_session(result, address, session, code, role, on_progress)
    result.findings.skip(*(check for check in ORDER if check not in OPTIONAL))
    result.findings.sort(ORDER)
    return result


def _check_session(
    result: DoctorReport, address: str, session: str, code: str, role: str, on_progress: Callable[[str], None]
) -> None:
    """Make the checks of `run_checks` until one fails that the others need."""
    findings = result.findings
    try:
        target = None if session else Address.parse(address or find_default_address())
    except ClientError as error:
        findings.add(failed("address", str(error)))
        return
    on_progress("listening for sessions")
    heard, found = network_checks.check_beacon(session, target)
    findings.add(heard)
    if target is None:
        if heard.failed:
            return
        target = Address.parse(next(one.address for one in found if one.name == session))
    result.address = str(target)
    on_progress(f"connecting to {target}")
    named, ip = network_checks.check_address(target)
    findings.add(named)
    if not ip:
        return
    tcp = network_checks.mention_heard_sessions(network_checks.check_tcp(target, ip), target, found)
    findings.add(network_checks.check_subnet(ip), tcp)
    if tcp.failed:
        return
    introduced, version, said = network_checks.check_introduction(target)
    base = network_checks.check_port_base(target) if introduced.state != OK else None
    if base is not None:
        findings.add(base)
        return
    findings.add(introduced, version)
    if version.failed:
        return
    server_key = join_checks.check_server_key(target, said)
    findings.add(server_key)
    if server_key.failed:
        return
    on_progress(f"joining {target} as {role}")
    visit = join_checks.attempt_join(target, address or str(target), code or target.join_code, role, said)
    findings.add(*visit.findings)
    if any(one.check == "join" and not one.failed for one in visit.findings):
        plain = is_loopback(target.host) and not (said is not None and said.server_key)
        text = "not needed on the session's own machine" if plain else "this machine's key is on the session's list"
        findings.add(ok("key", text))
    result.report = visit.report
    if visit.report is not None:
        findings.add(*session_checks.check_session_report(visit.report, visit.own_id))


def find_default_address() -> str:
    """Return the address of the only encrypted session that this user serves on this machine, or else the default
    address on loopback."""
    try:
        notes = KeyHome().sessions.read()
    except KeysError:  # reported by the check `key_home`
        notes = []
    return str(Address(notes[0].hosts[0], notes[0].control)) if len(notes) == 1 and notes[0].hosts else LOCAL


def run_host_checks(
    address: str, recordings: Path, *, on_progress: Callable[[str], None] = lambda _: None
) -> DoctorReport:
    """Check this machine as a server, and the session that runs on it, if there is one.

    Args:
        address: Address of the session; empty: see `find_default_address`, or else the first one of this machine whose
            beacon is heard.
        recordings: Folder of recordings.
        on_progress: Called with a short text before each part.
    """
    on_progress("checking this machine")
    target = Address.parse(address or find_default_address())
    result = DoctorReport(str(target))
    result.findings.add(*check_host(recordings, target.port))
    named, ip = network_checks.check_address(target)
    if not ip:
        result.findings.add(named)
        return result
    if network_checks.check_tcp(target, ip).failed and not address:
        own = {one.address for addresses in psutil.net_if_addrs().values() for one in addresses}
        heard = [Address.parse(found.address) for found in network_checks.check_beacon("", None)[1]]
        target = next((one for one in heard if one.host in own), target)
        ip = network_checks.check_address(target)[1]
    if not network_checks.check_tcp(target, ip).failed:
        inside = run_checks(str(target), on_progress=on_progress)
        result.address, result.report = inside.address, inside.report
        result.findings.add(*(one for one in inside.findings if one.check not in ("beacon", "address", "subnet")))
    return result
