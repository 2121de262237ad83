"""Checks of keys, join codes, roles and joining, and of the state stream: join as a client does, explain failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

from iris_session.client import Client, ClientError, RefusedError, VersionError
from iris_session.client.core.state_stream import SceneState
from iris_session.client.discovery import Address
from iris_session.client.errors import NotConnectedError, RequestTimeoutError, SessionNameError, TrustError
from iris_session.doctor import network_checks
from iris_session.doctor.findings import Finding, failed, ok, warning
from iris_session.protocol.discovery import Introduction
from iris_session.protocol.names import DenialReason, RefusalCode
from iris_session.protocol.pairing import normalise_code
from iris_session.protocol.server_messages import Endpoints
from iris_session.protocol.status import StatusReport, compute_quantiles
from iris_session.security import KeyHome, KeysError, compute_fingerprint, decode_key

JOIN_S: Final = 4.0
STATE_S: Final = 3.0
#: Time in which state is observed. Our own report is at most a second old afterwards, and all others have arrived.
SAMPLE_S: Final = 1.5
ANSWER_S: Final = 2.0
#: Ages of the state at the doctor [ms]: above it, this machine or its link is slow.
OLD_MS: Final = 100.0
UNSURE_CLOCK_MS: Final = 20.0
NAME: Final = "doctor"
NOT_LISTED: Final = "this machine's key is not on the session's list"
PAIR_ADVICE: Final = "on the server's machine: iris-session pair; then here: iris-session doctor {} --code CODE"
NEW_CODE_ADVICE: Final = "ask for a new one, on the server's machine: iris-session pair"


@dataclass
class JoinAttempt:
    """Result of an attempt to join. `report`: status of the session, if it answered. `own_id`: our participant id."""

    findings: list[Finding] = field(default_factory=list)
    report: StatusReport | None = None
    own_id: str = ""


def check_server_key(address: Address, introduction: Introduction | None) -> Finding:
    """Check whether the key in the introduction is the one known for this address."""
    home = KeyHome()
    try:
        known, own = home.known_servers.find_by_address(str(address)), {note.server for note in home.sessions.read()}
    except KeysError as error:
        return failed("server_key", str(error), "", "repair or remove that file")
    stored = address.server_key or ("" if known is None else known.key)
    if introduction is None:
        return Finding("server_key", "skipped", "not known: no introduction")
    if not introduction.server_key:
        return ok("server_key", "not encrypted: for clients of the same machine only")
    mark = compute_fingerprint(decode_key(introduction.server_key))
    if not stored and mark in own:
        return ok("server_key", f"its key {mark} is this user's own")
    if not stored:
        text = f"its key {mark} is not known here yet"
        return warning("server_key", text, "", "pair with a code of `iris-session pair`, which proves whose key it is")
    if stored != introduction.server_key:
        return failed(
            "server_key",
            f"its key is {mark}, but {compute_fingerprint(decode_key(stored))} is known for {address}",
            "another server answers there, or the session has new keys",
            f"ask its owner; if the keys are new: iris-session keys forget {address}, then pair again",
        )
    return ok("server_key", f"its key {mark} is the known one")


def attempt_join(target: Address, typed: str, code: str, role: str, introduction: Introduction | None) -> JoinAttempt:
    """Join as participant `doctor`, observe state and status, and leave.

    Args:
        target: Address of the session.
        typed: Address as the user gave it; keys of servers are stored by it.
        code: Join code; empty: none.
        role: Role to join in.
        introduction: Introduction of the session, if it was received.
    """
    visit = JoinAttempt()
    states: list[SceneState] = []
    try:
        if code:
            normalise_code(code)
    except ValueError as error:
        visit.findings.append(failed("code", str(error), "", NEW_CODE_ADVICE))
        return visit
    try:
        client = Client(typed, role=role, name=NAME, alignment="not_needed", join_code=code, on_state=states.append)
    except ClientError as error:
        visit.findings.append(failed("join", str(error)))
        return visit
    try:
        client.connect(JOIN_S)
    except ClientError as error:
        _explain_failed_join(client, error, visit, target, introduction)
    else:
        _inspect_joined_session(client, states, role, bool(code), visit)
    finally:
        client.close()
    return visit


def _explain_failed_join(
    client: Client, error: ClientError, attempt: JoinAttempt, target: Address, introduction: Introduction | None
) -> None:
    if isinstance(error, NotConnectedError):
        try:
            attempt.report = client.status(ANSWER_S)
        except ClientError:
            pass
        else:
            text = "the session listens, but admits no participant: it does not step"
            attempt.findings.append(failed("join", text, "see the check `session`", "check the program that owns it"))
            return
    if isinstance(error, NotConnectedError) and introduction is not None:
        text = f"the session answers with an introduction, but did not admit us within {JOIN_S:g} s"
        why = f"a very slow or lossy link, or a session that does not step ({error})"
        attempt.findings.append(failed("join", text, why, "check the network, and the program that owns the session"))
    elif isinstance(error, RefusedError) and error.code == RefusalCode.UNPAIRED:
        attempt.findings.append(explain_unpaired_key(target, introduction))
    else:
        attempt.findings.append(explain_refusal(error))


def explain_unpaired_key(target: Address, introduction: Introduction | None) -> Finding:
    """Explain that our key is not on the list of a session: our own, one that admitted us before, or a new one."""
    pair = PAIR_ADVICE.format(target)
    try:
        home, key = KeyHome(), "" if introduction is None else introduction.server_key
        mark = compute_fingerprint(decode_key(key)) if key else ""
        if any(note.server == mark for note in home.sessions.read()):
            why = "the session belongs to this user; nevertheless the user's key must be allowed once"
            return failed("key", NOT_LISTED, why, "iris-session keys allow me")
        before = home.known_servers.find_by_address(str(target)) is not None
    except KeysError as error:
        return failed("key", NOT_LISTED, str(error), pair)
    why = "it was admitted before, and revoked since (`iris-session keys revoke`)" if before else ""
    return failed("key", NOT_LISTED, why, f"ask the owner of the session; {pair}" if before else pair)


def explain_refusal(error: ClientError) -> Finding:
    """Return why joining failed, as a finding of the check that the error belongs to."""
    text = str(error)
    if isinstance(error, VersionError):
        return network_checks.check_version(max(error.supported_versions, default=0))
    if isinstance(error, TrustError):
        return failed("server_key", text, "", "ask the owner of the session; see docs/security.md")
    if isinstance(error, SessionNameError):
        return failed("beacon", text, "", "give the address of the session")
    if isinstance(error, RefusedError):
        if error.code == RefusalCode.CODE:
            why = "a code works once, and expires after ten minutes unless `pair --minutes` sets another time"
            advice = f"{error.advice}; else {NEW_CODE_ADVICE}" if error.advice else NEW_CODE_ADVICE
            return failed("code", f"the join code was refused: {error.message}", why, advice)
        if error.code == DenialReason.ROLE:
            text = f"this key may not join in this role: {error.message}"
            advice = "join in another role, or allow this one for the key, on the server's machine"
            return failed("role", text, error.advice, f"{advice}: iris-session keys allow")
        return failed("join", f"refused ({error.code}): {error.message}", "", error.advice)
    if isinstance(error, NotConnectedError):
        advice = (
            "compare the port with the one that `iris-session serve` prints, and try without the firewall between; "
            "if the session has new keys: iris-session keys forget, then pair again"
        )
        return failed("join", "the port accepts connections, but no session answers", text, advice)
    return failed("join", text)


def _inspect_joined_session(
    client: Client, states: list[SceneState], role: str, coded: bool, attempt: JoinAttempt
) -> None:
    attempt.own_id = client.participant_id
    attempt.findings += [
        ok("role", f"admitted as {role}"),
        ok("join", f"joined as {client.participant_id}"),
    ]
    if coded:
        attempt.findings.append(ok("code", "the join code was accepted, or not needed"))
    try:
        client.wait_for(lambda _: bool(states), STATE_S)
        states.clear()
        client.sleep(SAMPLE_S)
        attempt.report = client.status(ANSWER_S)
    except (RequestTimeoutError, NotConnectedError) as error:
        attempt.findings.append(failed("join", f"the connection did not last: {error}", "", "check the network"))
    welcome = client.connection.welcome
    endpoints = Endpoints() if welcome is None else welcome.endpoints
    attempt.findings += [_check_clock(client), _check_state(client, states, endpoints.state)]
    attempt.findings += check_ports(Address.parse(client.address), endpoints)


def _check_clock(client: Client) -> Finding:
    bound_ms, rtt_ms = client.clock_error_ns() * 1e-6, client.connection.clock.rtt_ns * 1e-6
    text = f"session time is known to {bound_ms:.1f} ms, round trip {rtt_ms:.1f} ms"
    if bound_ms > UNSURE_CLOCK_MS:
        return warning("clock", text, "round trips are long or vary much", "check the network: Wi-Fi, power saving")
    return ok("clock", text)


def check_ports(address: Address, endpoints: Endpoints) -> list[Finding]:
    """Check whether the ports of the page, of media and of assets accept connections; those that the session has."""
    ip = network_checks.check_address(address)[1]
    ports = {"web": endpoints.web, "media": endpoints.media, "assets": endpoints.assets}
    return [network_checks.check_tcp(address, ip, port, f"{name}_port", name) for name, port in ports.items() if port]


def _check_state(client: Client, states: list[SceneState], port: int) -> Finding:
    """Check the state that we received, or why none arrived. `port`: of the state."""
    if not states:
        address = Address.parse(client.address)
        client.close()  # the next check takes seconds without heartbeats: we would be reported as disconnected
        ip = network_checks.check_address(address)[1]
        finding = network_checks.check_tcp(address, ip, port, "state", "state")
        if finding.failed:
            return finding
        text, why = f"no state arrives, but port {port} accepts connections", "the session may have stopped stepping"
        return failed("state", text, why, "see the check `session`; if it steps, join again")
    return check_state_age(states, client.connection.stream.counters.queued_old)


def check_state_age(states: Sequence[SceneState], missed: int) -> Finding:
    """Check the age of the states received within `SAMPLE_S`. `missed`: frames that waited too long in a queue."""
    text = f"state arrives at {len(states) / SAMPLE_S:.0f} Hz"
    new = [b for a, b in pairwise(states) if b.header.session_time != a.header.session_time]
    if len(states) > 1 and not new:  # one state, sent repeatedly
        age_s = states[-1].age_ns * 1e-9
        why = "nothing new is published"
        return warning("state", f"{text}, always the one of {age_s:.1f} s ago", why, "check the program that publishes")
    ages = compute_quantiles(state.age_ns for state in new or states)
    assert ages is not None
    text = f"{text}, age p50 {ages.p50:.1f} ms, p99 {ages.p99:.1f} ms"
    if ages.p99 > OLD_MS:
        why = f"{missed} frames waited too long in a queue" if missed else "see the check `age`"
        return warning("state", text, why, "check network and load of this machine")
    return ok("state", text)
