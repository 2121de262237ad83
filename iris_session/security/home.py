"""Where keys live: `$IRIS_HOME`, else `$XDG_CONFIG_HOME/iris-session`, else `~/.config/iris-session`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from iris_session.security.allow_list import AllowList
from iris_session.security.curve import KeyPair, pair_in
from iris_session.security.files import KeysBusyError, KeysError, PrivateFolder
from iris_session.security.join_codes import JoinCodes
from iris_session.security.known_servers import KnownServers
from iris_session.security.session_notes import SessionNotes

__all__ = ["KeyHome", "KeysBusyError", "KeysError", "default_path"]

SERVER_KEY: Final = "server.key_secret"
IDENTITY: Final = "identity.key_secret"


def default_path() -> Path:
    """The home of this user's keys."""
    home = os.environ.get("IRIS_HOME")
    if home:
        return Path(home)
    config = os.environ.get("XDG_CONFIG_HOME")
    return (Path(config) if config else Path.home() / ".config") / "iris-session"


class KeyHome:
    """The files of one user. `path`: empty or `None` for the default. Nothing is made before it is needed.

    Every method of it and of its parts raises `KeysError` (one line) for a folder or file that cannot be used.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None) -> None:
        self.folder = PrivateFolder(Path(path) if path else default_path())
        self.clients = AllowList(self.folder)
        self.codes = JoinCodes(self.folder)
        self.servers = KnownServers(self.folder)
        self.sessions = SessionNotes(self.folder)

    @property
    def path(self) -> Path:
        return self.folder.path

    def server_key(self) -> KeyPair:
        """Key pair of the sessions that this user serves, made on first use."""
        return pair_in(self.folder, SERVER_KEY)

    def identity(self) -> KeyPair:
        """Key pair with which this user joins sessions, made on first use."""
        return pair_in(self.folder, IDENTITY)
