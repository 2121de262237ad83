"""Keys and access: CURVE key pairs, the allow-list, join codes, known servers, resume tokens, ZAP authentication.

Files live in one folder per user, readable by that user only (`KeyHome`). Processes share it: every change is made
under a lock and replaces the file as a whole. A file that cannot be read raises a one-line error and is never replaced.

Not here: the pairing exchange on the wire (`protocol.pairing`, `front.pairing`), revocation in a running session
(`front.revocation`), the sockets themselves (`link.sockets`).
"""

from iris_session.security.allow_list import CURVE, DEFAULT_ROLES, WEB, AllowedKey, AllowList
from iris_session.security.curve import (
    KeyPair,
    compute_fingerprint,
    decode_key,
    encode_key,
    load_public,
    load_secret,
)
from iris_session.security.join_codes import JoinCode, JoinCodes
from iris_session.security.key_home import KeyHome, KeysBusyError, KeysError
from iris_session.security.known_servers import KnownServer, KnownServers
from iris_session.security.session_registry import RegisteredSession, SessionRegistry

__all__ = [
    "KeyHome",
    "KeysError",
    "KeysBusyError",
    "KeyPair",
    "compute_fingerprint",
    "decode_key",
    "encode_key",
    "load_public",
    "load_secret",
    "AllowList",
    "AllowedKey",
    "CURVE",
    "WEB",
    "DEFAULT_ROLES",
    "JoinCodes",
    "JoinCode",
    "KnownServers",
    "KnownServer",
    "SessionRegistry",
    "RegisteredSession",
]
