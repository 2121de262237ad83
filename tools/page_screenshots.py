"""Pictures of the page for the documentation: the dashboard while a demo runs, on a desktop and on a phone.

    python tools/page_screenshots.py docs/img

Starts `iris-session demo handover`, opens its page in Chromium, waits until the operators hold their robots, and writes
`dashboard.png` and `dashboard-phone.png`. Needs the built page (`make web`) and Chromium (Debian: `chromium`).
"""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Final

from tests.e2e.browser import Browser
from tests.e2e.session_process import COMMAND

START_S: Final = 90.0
#: After both robots are held: until hands are at work [s].
SETTLE_S: Final = 8.0
BOTH_HELD: Final = "[...document.querySelectorAll('[data-robot] .holder')].every((one) => one.textContent !== 'free')"


def wait_for_address(output: Path, process: subprocess.Popen[bytes]) -> str:
    """Return the address of the page that the demo prints. Raises `SystemExit`."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and process.poll() is None:
        match = re.search(r"in a browser: (https?://\S+)", output.read_text(errors="replace"))
        if match:
            return match.group(1)
        time.sleep(0.1)
    raise SystemExit(f"the demo printed no address of a page:\n{output.read_text(errors='replace')[-2000:]}")


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where to write the pictures")
    folder = parser.parse_args().folder.resolve()
    with tempfile.TemporaryDirectory() as scratch:
        output = Path(scratch) / "demo.out"
        command = [*COMMAND, "demo", "handover", "--timeout", "240", "--record", str(Path(scratch) / "session.rrd")]
        with output.open("wb") as out:
            process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        browser = Browser()
        try:
            address = wait_for_address(output, process)
            page = browser.open("desktop", address, width=1280, height=800)
            page.wait_until_ready()
            page.wait(BOTH_HELD)
            time.sleep(SETTLE_S)
            page.screenshot(folder / "dashboard.png")
            page.close()
            phone = browser.open("phone", address, width=390, height=844, phone=True)
            phone.wait_until_ready()
            time.sleep(3.0)
            phone.screenshot(folder / "dashboard-phone.png")
        finally:
            browser.close()
            process.terminate()
            process.wait()


if __name__ == "__main__":
    main()
