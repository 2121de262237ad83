"""Loopback addresses for tests whose servers restart on the same ports."""

from __future__ import annotations

import random
import sys

_RANDOM = random.SystemRandom()


def make_loopback_address() -> str:
    """Return a loopback address that no other test uses, on systems where all of 127.0.0.0/8 is loopback.

    While a front restarts, or until a session is resumed, its ports are free. On an address of its own no other test
    gets them as its free ports.
    """
    if sys.platform != "linux":
        return "127.0.0.1"
    return f"127.{_RANDOM.randint(1, 254)}.{_RANDOM.randint(0, 255)}.{_RANDOM.randint(1, 254)}"
