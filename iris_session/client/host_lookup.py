"""Names of hosts to network addresses, without waiting: a thread asks the system, which may take many seconds.

Whoever asks for a name that is being looked up waits for the same answer, so a name server that hangs costs one thread
for each name, and those are few.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import socket
import threading
import time
from collections.abc import Generator
from typing import Final

#: Names at a time.
MAX_LOOKUPS: Final = 16
#: An answer that came after its asker had given up is there for the next attempt.
KEPT_S: Final = 10.0


class _Lookup:
    """One name. `answer`: a network address, or the error; `None` while it is looked up."""

    def __init__(self, host: str, family: socket.AddressFamily) -> None:
        self.answer: str | OSError | None = None
        self.done_s = 0.0
        self._host = host
        self._family = family
        threading.Thread(target=self._run, name=f"iris-resolve-{host}", daemon=True).start()

    def _run(self) -> None:
        try:
            answer: str | OSError = str(socket.getaddrinfo(self._host, None, self._family, socket.SOCK_STREAM)[0][4][0])
        except OSError as error:
            answer = error
        except ValueError as error:  # no name at all, as the system's resolver sees it
            answer = OSError(errno.EINVAL, str(error))
        self.done_s = time.monotonic()
        self.answer = answer


_lock = threading.Lock()
_lookups: dict[str, _Lookup] = {}


def resolve_host(host: str, until_s: float) -> Generator[None, None, str]:
    """Resolve the network address of `host`; yields wherever it would wait, until `until_s` (`time.monotonic()`).

    A name means IPv4, as on the sockets that say hello. Raises `OSError`: no such name, no answer.
    """
    with contextlib.suppress(ValueError):
        return str(ipaddress.ip_address(host))
    lookup = _start_lookup(host, socket.AF_INET6 if ":" in host else socket.AF_INET)
    while lookup.answer is None:
        if time.monotonic() > until_s:
            raise TimeoutError(errno.ETIMEDOUT, f"the name {host} is still looked up")
        yield
    if isinstance(lookup.answer, OSError):
        raise lookup.answer
    return lookup.answer


def _start_lookup(host: str, family: socket.AddressFamily) -> _Lookup:
    with _lock:
        now_s = time.monotonic()
        for name, one in list(_lookups.items()):
            if one.answer is not None and (isinstance(one.answer, OSError) or now_s - one.done_s > KEPT_S):
                del _lookups[name]
        if host not in _lookups:
            if len(_lookups) >= MAX_LOOKUPS:
                raise OSError(errno.EAGAIN, "too many names are looked up at a time")
            _lookups[host] = _Lookup(host, family)
        return _lookups[host]
