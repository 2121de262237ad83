"""In which line of a JSON file something is wrong, for people who edit it by hand. Nothing here reads files."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from typing import Final

import msgspec

_INDEX: Final = re.compile(r"\$\[(\d+)\]")
_BLANK: Final = re.compile(r"[\s\[,]*")


def trouble(text: str, error: msgspec.MsgspecError) -> str:
    """What is wrong with a JSON list that msgspec did not take, and in which line, as one line."""
    try:
        json.loads(text)
    except json.JSONDecodeError as malformed:
        return f"line {malformed.lineno}: {malformed.msg}"
    except RecursionError:
        return "nested too deep"
    except ValueError as other:  # a number of thousands of digits
        return str(other)
    found = _INDEX.search(str(error))
    if found is None:
        return str(error)
    return f"line {line_of(text, int(found[1]))}: {error}"


def line_of(text: str, index: int) -> int:
    """The line, from 1, in which entry `index` of a JSON list begins; of a list that is none, the last that is read."""
    decoder, at = json.JSONDecoder(), _skip(text, 0)
    with suppress(ValueError, RecursionError):  # somebody edits the file just now
        for _ in range(index):
            _, end = decoder.raw_decode(text, at)
            at = _skip(text, end)
    return text.count("\n", 0, at) + 1


def _skip(text: str, at: int) -> int:
    blank = _BLANK.match(text, at)
    return blank.end() if blank is not None else at
