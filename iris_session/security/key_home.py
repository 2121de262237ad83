"""The folder of a user's keys: `$IRIS_HOME`, else `$XDG_CONFIG_HOME/iris-session`, else `~/.config/iris-session`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from iris_session.security.allow_list import AllowList
from iris_session.security.curve import KeyPair, find_pair, load_or_create_pair
from iris_session.security.join_codes import JoinCodes
from iris_session.security.known_servers import KnownServers
from iris_session.security.private_folder import KeysBusyError, KeysError, PrivateFolder
from iris_session.security.session_registry import SessionRegistry

__all__ = ["KeyHome", "KeysBusyError", "KeysError", "find_key_home"]

SERVER_KEY: Final = "server.key_secret"
IDENTITY: Final = "identity.key_secret"


def find_key_home() -> Path:
    """Return the folder of this user's keys."""
    home = os.environ.get("IRIS_HOME")
    if home:
        return Path(home)
    config = os.environ.get("XDG_CONFIG_HOME")
    return (Path(config) if config else Path.home() / ".config") / "iris-session"


class KeyHome:
    """The key files of one user. `path`: empty or `None` for the default. Nothing is created before it is needed.

    All methods of it and of its parts raise `KeysError` (one line) for a folder or file that cannot be used.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None) -> None:
        self.folder = PrivateFolder(Path(path) if path else find_key_home())
        self.clients = AllowList(self.folder)
        self.join_codes = JoinCodes(self.folder)
        self.known_servers = KnownServers(self.folder)
        self.sessions = SessionRegistry(self.folder)

    @property
    def path(self) -> Path:
        return self.folder.path

    def load_server_key(self) -> KeyPair:
        """Return the key pair of the sessions that this user serves, created on first use."""
        return load_or_create_pair(self.folder, SERVER_KEY)

    def find_server_key(self) -> KeyPair | None:
        """Return the key pair of the sessions that this user serves, `None` while there is none."""
        return find_pair(self.folder, SERVER_KEY)

    def find_identity(self) -> KeyPair | None:
        """Return the key pair with which this user joins sessions, `None` while there is none."""
        return find_pair(self.folder, IDENTITY)

    def load_identity(self) -> KeyPair:
        """Return the key pair with which this user joins sessions, created on first use."""
        return load_or_create_pair(self.folder, IDENTITY)
