"""From what a person gave (an address, a name, a URI, a join code) to sockets and keys that can say hello.

    name --beacons--> address --introduction--> key --known?--> (join code: pair, key stored) --> hello

Beacon and introduction are said by anybody. A key is trusted because it was given (URI, `CurveKeys`), was stored
before, has proved the join code, or, without any of these, at first sight; then it is stored once it let us in.
"""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import Final

from iris_session.client.address import Address
from iris_session.client.discovery import LISTEN_S, BeaconListener, FoundSession, ask_introduction, plausible
from iris_session.client.errors import NotConnectedError, SessionNameError, TrustError
from iris_session.client.known_servers import Trust
from iris_session.client.pairing import key_name, pair_key
from iris_session.client.sockets import CurveKeys
from iris_session.protocol.discovery import Introduction
from iris_session.protocol.errors import ProtocolError
from iris_session.security import KeyHome, KeysError

INTRODUCTION_S: Final = 2.5
#: On this machine an answer takes a turn of the front's loop.
LOOPBACK_INTRODUCTION_S: Final = 1.0
RETRY_S: Final = 0.2
#: Between two steps of a meeting: it is brief, and waits for different things.
STEP_NS: Final = 5_000_000


@dataclass(frozen=True, slots=True)
class Wanted:
    """What was given: `address` (without name), or the name `session`. `join_code`: to pair with where needed."""

    address: Address | None
    session: str = ""
    curve: CurveKeys | None = None
    join_code: str = ""


@dataclass(frozen=True, slots=True)
class Met:
    """Where to say hello, and with which keys. `session_id`: as it introduced itself; empty: it did not.

    `store`: the key is trusted at first sight and is to be stored when the session lets us in.
    """

    address: Address
    curve: CurveKeys | None = None
    session_id: str = ""
    session: str = ""
    store: bool = False

    def keep(self) -> None:
        """Stores the session's key. Raises `TrustError` when another one was stored meanwhile."""
        if self.store and self.curve is not None:
            Trust(KeyHome(), self.address).store(self.session, self.curve.server_public.decode())


class Meeting:
    """Goes on until it works, fails for good, or nobody asks any more. `note`: why it still waits."""

    def __init__(self, wanted: Wanted, *, repair: bool = False) -> None:
        self.note = ""
        self._wanted = wanted
        self._repair = repair  # the session has said that our key is not on its list: pair although its key is known
        self._steps = self._meet()

    def step(self) -> Met | None:
        """Goes on without waiting; `None` while there is no result. Raises `ClientError` when there will be none."""
        try:
            next(self._steps)
        except StopIteration as done:
            met: Met = done.value
            return met
        except KeysError as error:
            raise TrustError(str(error)) from error
        return None

    def close(self) -> None:
        """Gives up; frees what is open."""
        self._steps.close()

    def _meet(self) -> Generator[None, None, Met]:
        wanted = self._wanted
        if wanted.curve is not None and wanted.address is not None:
            return Met(wanted.address, wanted.curve)
        while True:
            address, found = wanted.address, None
            if address is None:
                found = yield from self._find(wanted.session)
                address = Address.parse(found.address)
            introduction = yield from self._introduction(address)
            met = yield from self._trusted(address, found, introduction)
            if met is not None:
                return met
            yield from _pause(RETRY_S)

    def _find(self, name: str) -> Generator[None, None, FoundSession]:
        """Waits until a session of that name is heard, and for as long as others of that name would be heard too."""
        with BeaconListener() as listener:
            heard_at: float | None = None
            while True:
                sessions = listener.sessions()
                named = [one for one in sessions if one.name == name]
                if named and heard_at is None:
                    heard_at = time.monotonic()
                if heard_at is not None and time.monotonic() > heard_at + LISTEN_S / 2:
                    break
                others = ", ".join(f"{one.name} ({one.address})" for one in sessions) or "none"
                self.note = (
                    f"session {name!r} was not heard (heard: {others}); broadcasts may be blocked: type its address"
                )
                yield
        if len(named) > 1:
            where = ", ".join(one.address for one in named)
            raise SessionNameError(f"several sessions are called {name!r}: give the address of one of them ({where})")
        return named[0]

    def _introduction(self, address: Address) -> Generator[None, None, Introduction | None]:
        patience_s = LOOPBACK_INTRODUCTION_S if is_loopback(address.host) else INTRODUCTION_S
        try:
            introduction = yield from ask_introduction(address.host, address.port, patience_s)
        except ProtocolError as error:
            self.note = f"what introduces itself at {address} cannot be understood: {error}"
            return None
        except OSError as error:
            why = error.strerror or error
            self.note = (
                f"no introduction at {address}, which is on TCP port {address.port - 1}: {why}; "
                "`serve --port-base N` is joined at port N + 1"
            )
            return None
        if introduction.beacon.control != address.port:
            self.note = f"the session below {address} is another one, on port {introduction.beacon.control}"
            return None  # a forwarded port, or the neighbour of one
        if not plausible(introduction.beacon):
            self.note = f"what introduces itself at {address} is no session"
            return None
        return introduction

    def _trusted(
        self, address: Address, found: FoundSession | None, introduction: Introduction | None
    ) -> Generator[None, None, Met | None]:
        """Decides on the key, and pairs where that is wanted; `None`: nothing can be decided yet."""
        home, code = KeyHome(), self._wanted.join_code or address.join_code
        trust = Trust(home, address, found.name if found is not None else "")
        key = trust.key(None if introduction is None else introduction.server_key, loopback=is_loopback(address.host))
        session_id = "" if introduction is None else introduction.beacon.session_id
        name = address.session if introduction is None else introduction.beacon.session_name
        if found is not None and session_id not in ("", found.session_id):
            raise SessionNameError(
                f"what answers at {address} is not the session {found.name!r} heard there: try again"
            )
        if not key:
            return None if key is None else Met(address, None, session_id, name)
        own = home.load_identity()
        if code and (self._repair or not trust.familiar(key)):
            self.note = f"pairing with the session at {address}"
            yield from pair_key(address, key, own, code, key_name())
            trust.store(name, key)
        else:
            trust.check_name(key)
        curve = CurveKeys(key.encode(), own.public.encode(), own.secret.encode())
        return Met(address, curve, session_id, name, store=not trust.stored)


def settle(wanted: Wanted, timeout_s: float) -> Met:
    """The whole meeting, waiting. Raises `ClientError`; `NotConnectedError` when it took longer than `timeout_s`."""
    meeting = Meeting(wanted)
    until = time.monotonic() + timeout_s
    try:
        while (met := meeting.step()) is None:
            if time.monotonic() > until:
                raise NotConnectedError(f"{meeting.note or 'nobody answered'} (within {timeout_s:g} s)")
            time.sleep(STEP_NS * 1e-9)
        return met
    finally:
        meeting.close()


def is_loopback(host: str) -> bool:
    """Whether an address reaches no further than this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _pause(seconds: float) -> Generator[None, None, None]:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        yield
