"""Errors of the stream decoders.

StreamError     the bytes are not a payload of this stream: damaged, truncated, or for another scene
"""

from __future__ import annotations

from iris_session.protocol.errors import IrisError


class StreamError(IrisError, ValueError):
    """A payload that no encoder of this format makes. The decoder's state is as before the call."""
