"""The command `iris-session`: modules of commands; `main` parses and dispatches, `common` is shared.

Errors are one line on standard error. Exit status: 0 done, 1 the work failed (not verified, no handover, bar missed),
2 unusable input, 130 interrupted. What commands do lives in the other packages; here are options and output.
"""

from __future__ import annotations

import os
import signal
from typing import Final

INTERRUPTED: Final = 130


def run_command() -> int:
    """Run the command line of this process: entry point of `iris-session`. Return the exit status.

    Ctrl-C ends the process at once while the modules of the commands are imported: nothing has begun, and an interrupt
    inside an import can come out as another error.
    """
    previous = signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    from iris_session.cli.main import main

    signal.signal(signal.SIGINT, previous)
    return main()
