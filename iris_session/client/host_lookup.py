"""Resolution of host names without blocking: a thread asks the system, which may take many seconds.

All requests for a name that is being resolved share one answer, so a name server that hangs costs one thread per name,
and there are few names.
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

#: Maximum number of names at a time.
MAX_LOOKUPS: Final = 16
#: Answers by name; one that came after the timeout serves the next attempt.
KEPT_S: Final = 10.0


class _Lookup:
    """Lookup of one name. `answer`: network address or error; `None` while it runs."""

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
        except ValueError as error:  # the system's resolver does not accept it as a name
            answer = OSError(errno.EINVAL, str(error))
        self.done_s = time.monotonic()
        self.answer = answer


_lock = threading.Lock()
_lookups: dict[str, _Lookup] = {}


def resolve_host(host: str, until_s: float) -> Generator[None, None, str]:
    """Resolve the network address of `host`; yields wherever it would wait, until `until_s` (`time.monotonic()`).

    Names are resolved to IPv4 only, as on the sockets of the session. Raises `OSError`: no such name, no answer.
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
