"""Messages about who may take part: pairing a key, removing a participant, and the audit trail."""

from __future__ import annotations

from typing import Annotated

import msgspec

from iris_session.protocol.common import Count, EventBody, Message, Name, Names, Text

Proof = Annotated[bytes, msgspec.Meta(max_length=64)]


class Pair(Message, frozen=True, tag="pair"):
    """Asks for the key of this connection to be put on the allow-list: all that an unknown key may say.

    `proof`: shows that the sender knows a join code, without telling it (`protocol.pairing`). `name`: under which the
    key is listed, for people.
    """

    name: Name
    proof: Proof
    software: Name = ""


class RemoveParticipant(Message, frozen=True, tag="remove_participant"):
    """A director ends someone's participation. `revoke`: their key is taken off the allow-list too."""

    request_id: Count
    participant: Name
    revoke: bool = False
    reason: Text = ""


class Paired(Message, frozen=True, tag="paired"):
    """The key is on the allow-list. Connect anew to say `hello`: this connection stays that of an unknown key.

    `proof`: shows that the session knows the join code too, so it is the one that gave it out.
    `roles`: what this key may join as; empty: any role.
    """

    proof: Proof
    roles: Names = ()


class Audited(EventBody, frozen=True, tag="audited"):
    """Something that concerns security. `kind`: `AuditKind`. `subject`: fingerprint of a key, or a participant id.

    Repeated ones (wrong codes, unknown keys) come at most once a second and address, with their `count`.
    """

    kind: Name
    subject: Name = ""
    name: Name = ""
    address: Name = ""
    detail: Text = ""
    count: Count = 1
