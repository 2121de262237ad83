"""Discovery of a session: the beacon on UDP, and the introduction that a session sends over TCP to any peer.

Both are public and unauthenticated. Nothing in them is trusted until the CURVE handshake with `server_key`, and the
pairing proof or a pinned fingerprint, have confirmed it.
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from iris_session.protocol.common import Count, Name

#: UDP port of beacons.
DISCOVERY_PORT: Final = 7720
#: The introduction is given on the TCP port below the control port.
INTRODUCTION_OFFSET: Final = -1


class Beacon(msgspec.Struct, frozen=True):
    """UDP discovery datagram, 5 Hz. Never needed: an address can be typed or scanned."""

    protocol: Annotated[int, msgspec.Meta(ge=0)]
    session_id: Name
    session_name: Name
    kind: Name
    host: Name
    control: Count
    state: Count
    media: Count
    assets: Count
    web: Count
    key_fingerprint: Name = ""


class Introduction(msgspec.Struct, frozen=True):
    """Introduction of a session, written to a TCP connection to control port - 1, which is then closed. Nothing is
    read.

    `server_key`: the CURVE public key, Z85 (40 characters); empty: the session is not encrypted (loopback only).
    `pairing`: a join code can be used now. `participants`: how many are connected.
    """

    beacon: Beacon
    server_key: Name = ""
    pairing: bool = False
    participants: Count = 0
