"""The process of the impairment proxy: its command line, its commands while it runs, and a handle for callers.

    python -m iris_session.netsim.process --link 127.0.0.2 --profile busy-wifi --seed 1

Commands, one per line on standard input, each answered by one JSON line; `@ADDRESS` picks one link, else all:
`stall`, `resume`, `cut` (close all connections), `reset` (close them by RST), `roam ADDRESS` (change the network:
connections end without notice to the session, new ones come from that address), `profile NAME`, `start` (restart the
profile, with the seed), `stats`, `quit`.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import json
import os
import selectors
import signal
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Final

from iris_session.netsim.profiles import Profile, ProfileError, load_profile
from iris_session.netsim.proxy import ImpairedLink
from iris_session.protocol.errors import IrisError
from iris_session.system.process import PIPE, ChildProcess

ANSWER_TIMEOUT_S: Final = 10.0
#: A real link takes no processor time from its endpoints. Below the tick loop's priority, above all else.
REALTIME_PRIORITY: Final = 2


def make_link_address(number: int) -> str:
    """Return the loopback address of link `number` (0 to 253); each headset has a radio link of its own."""
    return f"127.0.1.{number + 1}"


class ImpairmentError(IrisError):
    """The proxy cannot run. The message is one line that says why."""


class ImpairmentProcess(ChildProcess):
    """A proxy in its own process, as a context.

        with ImpairmentProcess({"127.0.0.2": "busy-wifi"}, ports=[7721, 7722]) as proxy:
            ...  # clients join at 127.0.0.2:7721
            proxy.execute("stall")

    Args:
        links: Profile (a name or a file) by address.
        ports: TCP ports to forward.
        target: Address of the session.
        seed: Of everything random.
        udp: UDP ports to forward.

    Raises:
        ImpairmentError: A port is in use, or a profile is not known.
    """

    def __init__(
        self, links: Mapping[str, str], ports: Sequence[int], *, target: str = "127.0.0.1", seed: int = 0,
        udp: Sequence[int] = (),
    ) -> None:  # fmt: skip
        command = ["--target", target, "--seed", str(seed), "--until-eof", "--ports", ",".join(map(str, ports))]
        command += ["--udp", ",".join(map(str, udp))] if udp else []
        for address, profile in links.items():
            command += ["--link", f"{address}={profile}"]
        super().__init__(__name__, command, stdout=PIPE, stderr=PIPE, own_session=True)
        self._unanswered = 1
        try:
            self._read_answer("start")
        except BaseException:
            self.close()
            raise

    def execute(self, command: str) -> dict[str, Any]:
        """Send a command and return its answer."""
        self.send(command)
        while self._unanswered > 1:
            self._read_answer("an earlier command")
        return self._read_answer(command)

    def send(self, command: str) -> None:
        """Send a command without waiting for its answer."""
        self._unanswered += 1
        try:
            self.write(command.encode() + b"\n")
        except OSError as error:
            raise ImpairmentError(f"the proxy has ended with status {self.exit_status}") from error

    def close(self, *, exit_s: float = 2.0, terminate_s: float = 0.0) -> int:
        """End the process. May be called twice."""
        return super().close(exit_s=exit_s, terminate_s=terminate_s)

    def _read_answer(self, command: str) -> dict[str, Any]:
        try:
            line = self.read_line(ANSWER_TIMEOUT_S)
        except TimeoutError:
            raise ImpairmentError(f"the proxy did not answer {command!r} within {ANSWER_TIMEOUT_S:g} s") from None
        except EOFError:
            messages = self.read_stderr().strip().splitlines()
            raise ImpairmentError(messages[-1] if messages else f"the proxy ended at {command!r}") from None
        self._unanswered -= 1
        answer: dict[str, Any] = json.loads(line)
        if not answer["ok"]:
            raise ImpairmentError(answer["error"])
        return answer


def run_command(links: Sequence[ImpairedLink], line: str) -> dict[str, Any]:
    """Run one command of standard input (see the module docstring). Raises `ProfileError` for an unknown one."""
    words = line.split()
    command = words[0] if words else ""
    named = [word.removeprefix("@") for word in words[1:] if word.startswith("@")]
    rest = [word for word in words[1:] if not word.startswith("@")]
    chosen = [link for link in links if not named or link.address in named]
    if len(chosen) < len(named):
        raise ProfileError(f"no link {' '.join(named)}: there are {', '.join(link.address for link in links)}")
    if command == "stats":
        return {"links": [link.collect_stats() for link in chosen]}
    for link in chosen:
        if command in ("stall", "resume"):
            link.stalled_by_command = command == "stall"
            link.update_stalls()
        elif command in ("cut", "reset"):
            link.close_connections(reset=command == "reset")
        elif command == "roam" and len(rest) == 1:
            link.roam(rest[0])
        elif command == "start":
            link.start_profile(link.profile)
        elif command == "profile" and len(rest) == 1:
            link.start_profile(load_profile(rest[0]))
        else:
            raise ProfileError(
                f"{line!r} is not a command: stall, resume, cut, reset, roam ADDRESS, profile NAME, start, stats, quit"
            )
    return {}


async def serve(links: Sequence[tuple[str, Profile]], options: argparse.Namespace) -> None:
    """Forward until `quit`, a signal, or (with `--until-eof`) the end of standard input."""
    loop = asyncio.get_running_loop()
    done = asyncio.Event()
    made = []
    for number, (address, profile) in enumerate(links):
        link = ImpairedLink(address, options.target, profile, options.seed + number)
        try:
            link.listen(options.ports, options.udp)
        except OSError as error:
            advice = f"the session must listen on {options.target} only, not on all addresses, and no other proxy here"
            raise ImpairmentError(f"cannot listen on {address}: {error.strerror or error}: {advice}") from error
        made.append(link)
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, done.set)
    rest = b""

    def commands() -> None:
        nonlocal rest
        data = os.read(0, 4096)
        if not data:
            loop.remove_reader(0)
            if options.until_eof:
                done.set()
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            if line.strip() == b"quit":
                done.set()
                return
            try:
                answer = {"ok": True, **run_command(made, line.decode(errors="replace"))}
            except ProfileError as error:
                answer = {"ok": False, "error": str(error)}
            print(json.dumps(answer), flush=True)

    loop.add_reader(0, commands)
    gc.freeze()
    with contextlib.suppress(OSError, AttributeError):  # not permitted, or not Linux: `stats` reports the delay
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(REALTIME_PRIORITY))
    print(json.dumps({"ok": True, "ready": [link.address for link in made], "ports": options.ports}), flush=True)
    await done.wait()


def parse_ports(text: str) -> list[int]:
    """Parse an option that takes ports: `7720-7725`, `7721,7722`, or empty."""
    ports: list[int] = []
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        if not first.isdigit() or not (last or first).isdigit() or not 0 < int(first) <= int(last or first) < 65536:
            raise argparse.ArgumentTypeError(f"{text!r} are not valid ports: give for example 7720-7725 or 7721,7722")
        ports += range(int(first), int(last or first) + 1)
    return ports


def build_parser(prog: str | None = None, description: str | None = __doc__) -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog=prog, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--target", default="127.0.0.1", metavar="ADDR", help="where the session is (%(default)s)")
    made.add_argument("--ports", type=parse_ports, default=parse_ports("7720-7726"), help="TCP (default: 7720-7726)")
    made.add_argument("--udp", type=parse_ports, default=[], metavar="PORTS", help="UDP ports (default: none)")
    made.add_argument(
        "--link", action="append", metavar="ADDR[=PROFILE]", help="address of a link, repeatable (127.0.0.2)"
    )
    made.add_argument("--profile", default="good-wifi", help="a name, or a .toml or .json file (%(default)s)")
    made.add_argument("--seed", type=int, default=0, help="of everything random; each further link adds 1")
    made.add_argument("--until-eof", action="store_true", help="end with standard input")
    return made


def main(argv: Sequence[str] | None = None, prog: str | None = None, description: str | None = __doc__) -> int:
    """Exit status 0 after an orderly end, 2 for unusable input."""
    options = build_parser(prog, description).parse_args(argv)
    try:
        parts = [text.partition("=") for text in options.link or ["127.0.0.2"]]
        links = [(address, load_profile(profile or options.profile)) for address, _, profile in parts]
        loop = asyncio.SelectorEventLoop(selectors.SelectSelector())
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(serve(links, options))
    except (ProfileError, ImpairmentError) as error:
        print(f"impairment: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
