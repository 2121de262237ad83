"""Measure the age of state beside 20 Mbit/s of media on slow links, with and without adaptive delivery.

    python tools/media_link.py            prints the table of docs/evidence/links.md

One observer behind the impairment proxy, state and media over one link; the session is a process of its own. Each row
takes `--seconds`, after `--settle` on the slow link.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from statistics import quantiles
from typing import Final

from iris_session import Client, Session, SessionConfig
from iris_session.demo.scenes import scene_path
from iris_session.netsim.process import ImpairmentProcess

LINK: Final = "127.0.0.2"
HZ: Final = 30
FRAME: Final = 83_333
#: Megabits per second of the link; 20 ms each way, half a MiB under way per connection.
RATES: Final = (100, 30, 15, 8, 5, 3)


def serve(*, adapt: bool) -> None:
    """A session with a stream `cloud`, until it is interrupted."""
    config = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False, adapt_media=adapt)
    with Session(scene_path("handover"), config=config) as session:

        def publish() -> None:
            while not session.stopping:
                session.publish_media("cloud", bytes(FRAME))
                time.sleep(1.0 / HZ)

        thread = threading.Thread(target=publish)
        thread.start()
        print(f"on {session.address}", flush=True)
        session.run()
        thread.join()


def row(port: int, proxy: ImpairmentProcess, profile: Path, options: argparse.Namespace) -> str:
    """The end of one line of the table: ages of state, frames of media, the classes that were in use."""
    ages: list[float] = []
    classes: dict[str, float] = {}
    proxy.execute("profile lan")
    with Client(f"{LINK}:{port}", role="observer", name="viewer", alignment="not_needed") as client:
        feed = client.media.subscribe("cloud")
        client.sleep(3.0)  # it learns what is usual on its link
        proxy.execute(f"profile {profile}")
        client.sleep(options.settle)
        client.on_state = lambda state: ages.append(state.age_ns * 1e-6)
        received, end = feed.received, time.monotonic() + options.seconds
        while time.monotonic() < end:
            client.sleep(0.1)
            classes[feed.budget_class] = classes.get(feed.budget_class, 0.0) + 0.1
    cuts = quantiles(ages, n=100) if len(ages) > 1 else [float("nan")] * 99
    share = ", ".join(f"{name} {value / sum(classes.values()):.0%}" for name, value in classes.items())
    media_hz = (feed.received - received) / options.seconds
    return f"{len(ages) / options.seconds:.0f} | {cuts[49]:.0f} / {cuts[98]:.0f} | {media_hz:.1f} | {share}"


def ports_of(port: int) -> list[int]:
    """Control, state and media of the session at that port."""
    with Client(f"127.0.0.1:{port}", role="observer", name="ports", alignment="not_needed") as client:
        assert client.connection.welcome is not None
        there = client.connection.welcome.endpoints
        return [port, there.state, there.media]


def measure(options: argparse.Namespace, profile: Path, *, adapt: bool) -> None:
    """Half of the table."""
    command = [sys.executable, __file__, "--serve", "adaptive" if adapt else "everything"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        match = re.search(r":(\d+)$", process.stdout.readline().strip())
        assert match, "the session did not start"
        port = int(match[1])
        with ImpairmentProcess({LINK: "lan"}, ports_of(port)) as proxy:
            for rate in options.rates:
                phase = {"delay_ms": 20, "rate_mbit": rate}
                profile.write_text(json.dumps({"window_kib": 512, "phases": [phase]}))
                measured = row(port, proxy, profile, options)
                print(f"| {rate:g} | {'yes' if adapt else 'no'} | {measured} |", flush=True)
        process.send_signal(signal.SIGINT)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--settle", type=float, default=6.0)
    parser.add_argument("--rates", type=float, nargs="*", default=RATES, metavar="MBIT")
    parser.add_argument("--serve", choices=("adaptive", "everything"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(adapt=options.serve == "adaptive")
        return
    print(
        "| link, Mbit/s | adaptive | state, Hz | its age p50 / p99, ms | media, Hz | class |\n|---|---|---|---|---|---|"
    )
    with tempfile.TemporaryDirectory() as folder:
        for adapt in (True, False):
            measure(options, Path(folder) / "slow.json", adapt=adapt)


if __name__ == "__main__":
    main()
