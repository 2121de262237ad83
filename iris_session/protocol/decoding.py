"""MessagePack decoders of one type that raise one kind of error, for bytes that may be damaged."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeVar

import msgspec

Bytes = bytes | bytearray | memoryview
T = TypeVar("T")
#: What `msgspec` raises for bytes of anybody: schema and syntax, text that is not UTF-8, nesting, numbers.
BAD_BYTES: Final = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, OverflowError)


def decoder(kind: type[T]) -> Callable[[Bytes], T]:
    """Bytes to a `kind`. Raises `msgspec.DecodeError` (or its subclass `ValidationError`) and nothing else."""
    decode = msgspec.msgpack.Decoder(kind).decode

    def checked(data: Bytes) -> T:
        try:
            return decode(data)
        except msgspec.DecodeError:
            raise
        except BAD_BYTES as error:
            raise msgspec.DecodeError(str(error)) from None

    return checked
