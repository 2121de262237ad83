"""Budget of a recording: the bytes that its files may take together, and what is left out as it gets used up.

It is used like a small disk. First raw samples, media and assets are left out, and counted; the journal goes
on until the budget is used up. Then the file is closed, and the session goes on without a recording.
"""

from __future__ import annotations

import os
from typing import Final

from iris_session.rrd.paths import part_path

#: Smallest budget [bytes]: a file begins with the model, and its end needs room.
MIN_BUDGET_BYTES: Final = 16_000_000
#: Share of the budget that is left when its end is announced.
LOW_SHARE: Final = 0.2
#: Bytes that are left to the journal, at most: some hours of it. Of a small budget it is a share.
JOURNAL_BYTES: Final = 256 << 20
JOURNAL_SHARE: Final = 0.05
#: Share that is left for what is written at the end, and the least that this needs: most of it is for the part of an
#: index that does not grow with the file.
END_SHARE: Final = 0.02
END_BYTES: Final = 1_000_000
#: Share that assets may take.
ASSETS_SHARE: Final = 0.25


class RecordingBudget:
    """Budget of the recording `path`, as the recorder of file `part` uses it.

    Sizes of that file are with the index that it gets at its end.

    Attributes:
        total_bytes: The budget; 0: there is none.
    """

    def __init__(self, total_bytes: int, path: str, part: int) -> None:
        self.total_bytes = total_bytes
        files = (part_path(path, number) for number in range(1, part))
        self._earlier_bytes = sum(os.path.getsize(file) for file in files if os.path.exists(file)) if total_bytes else 0

    @property
    def assets_bytes(self) -> int | None:
        """Bytes that assets may take in a file; `None` without a budget."""
        return int(self.total_bytes * ASSETS_SHARE) if self.total_bytes else None

    @property
    def max_bytes(self) -> int:
        """Bytes that the file may have in the end; 0: any number."""
        return max(1, self.total_bytes - self._earlier_bytes) if self.total_bytes else 0

    def count_left(self, size: int) -> int:
        """Return the bytes that may be written until the file is closed. `size`: of the file now."""
        return max(0, self.max_bytes - round(max(END_BYTES, END_SHARE * self.total_bytes)) - size)

    def is_short(self, size: int) -> bool:
        """Return whether what is left is left to the journal."""
        return bool(self.total_bytes) and self.count_left(size) < min(JOURNAL_BYTES, JOURNAL_SHARE * self.total_bytes)

    def is_used_up(self, size: int) -> bool:
        """Return whether the file must be closed before it gets `size` bytes."""
        return bool(self.total_bytes) and not self.count_left(size)


def describe_used_budget(total_bytes: int) -> str:
    """Return one line for people about a recording that has ended."""
    return f"recording ended: budget of {total_bytes / 1e6:,.0f} MB is used up"
