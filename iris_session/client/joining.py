"""The way of a client to its first hello: it drives a `Meeting`, and looks at who let it in."""

from __future__ import annotations

import time
from typing import Final

from iris_session.client.address import DEFAULT_CONTROL_PORT, Address
from iris_session.client.connection import Connection
from iris_session.client.errors import ClientError, RefusedError, SessionNameError
from iris_session.client.meeting import STEP_NS, Meeting, Met, Wanted
from iris_session.client.sockets import ClientSockets, CurveKeys
from iris_session.client.status import Phase
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.pairing import normalise_code
from iris_session.protocol.server_messages import Welcome

LOCAL: Final = f"127.0.0.1:{DEFAULT_CONTROL_PORT}"


def wanted(address: str, session: str, curve: CurveKeys | None, join_code: str) -> Wanted:
    """What was given, checked. Nothing given: the session on this machine. Raises `ClientError`."""
    if address and session:
        raise ClientError("give an address or the name of a session, not both")
    if curve is not None and (session or join_code):
        raise ClientError("curve= names all keys itself: it goes with an address, without name and join code")
    try:
        code = normalise_code(join_code) if join_code else ""
    except ValueError as error:
        raise ClientError(str(error)) from None
    return Wanted(None if session else Address.parse(LOCAL if address == "" else address), session, curve, code)


class Joining:
    """Part of `Client`."""

    address: str
    connection: Connection
    _sockets: ClientSockets
    _wanted: Wanted
    _meeting: Meeting | None = None
    _met: Met | None = None  # until a session has let us in
    _note = ""
    _paired_anew = False

    def why_not_in(self, when: str) -> str:
        """For people: where we have not been let in, `when`, and what stands in the way as far as we know."""
        if self.connection.put_off is not None and self._meeting is None:
            return f"{self.address} {when}: {RefusedError(self.connection.put_off)}"
        note = self._note if self._meeting is None else self._meeting.note or self._note
        return f"{self.address} {when}: is `iris-session serve` running there?{f' ({note})' if note else ''}"

    def _begin_meeting(self, *, repair: bool = False) -> None:
        self.connection.phase = Phase.IDLE
        self.connection.failure = None
        self._met = None
        self._meeting = Meeting(self._wanted, repair=repair)

    def _step_meeting(self) -> None:
        """Goes on with finding the session, if we still do."""
        if self._meeting is None:
            return
        self.connection.wake_ns = time.monotonic_ns() + STEP_NS
        try:
            met = self._meeting.step()
        except ClientError as error:
            self._end_meeting()
            self._give_up(error)
            return
        if met is not None:
            self._note = self._meeting.note if not met.session_id else ""
            self._end_meeting()
            self._met = met
            self.address = str(met.address)
            self._sockets.aim(met.address.host, met.address.port, met.curve)
            self.connection.open(time.monotonic_ns())

    def _end_meeting(self) -> None:
        if self._meeting is not None:
            self._meeting.close()
            self._meeting = None
            self.connection.wake_ns = 0

    def _look_who_answered(self) -> None:
        """After control messages: the first welcome must be of the session that introduced itself."""
        connection, met = self.connection, self._met
        if met is None:
            return
        if connection.joined and connection.welcome is not None:
            self._met = None
            self._check(met, connection.welcome)
        elif self._may_pair():
            self._paired_anew = True  # once: a key that is taken off the list again stays off
            self._begin_meeting(repair=True)
        elif connection.put_off is not None:
            return  # somebody is there: `connection` says hello again
        elif connection.phase is Phase.WAITING and not met.session_id and self._wanted.curve is None:
            self._begin_meeting()  # nobody was there to introduce himself: somebody may be now

    def _may_pair(self) -> bool:
        failure = self.connection.failure
        unpaired = isinstance(failure, RefusedError) and failure.code == RefusalCode.UNPAIRED
        given = self._wanted.address
        return unpaired and not self._paired_anew and bool(self._wanted.join_code or (given and given.join_code))

    def _check(self, met: Met, welcome: Welcome) -> None:
        if met.session_id not in ("", welcome.session_id):
            text = f"the session {welcome.session_name!r} let us in at {met.address}, where another introduced itself"
            self._give_up(SessionNameError(text))
            return
        try:
            met.keep()
        except ClientError as error:
            self._give_up(error)

    def _give_up(self, error: ClientError) -> None:
        self.connection.failure = error
        self.connection.phase = Phase.REFUSED
