"""The machine that a session runs on, or is to run on: scheduling, processors, disk, keys, ports, addresses, clock."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path
from typing import Any, Final

import psutil

from iris_session.doctor.findings import Finding, failed, ok, warning
from iris_session.doctor.session_checks import FULL_DISK, LOW_DISK
from iris_session.protocol.discovery import DISCOVERY_PORT
from iris_session.security import KeyHome, KeysError

CONTROL_PORT: Final = 7721
#: TCP ports of a session, from the control port.
PORT_OFFSETS: Final = {
    -1: "introduction",
    0: "control",
    1: "state",
    2: "media",
    3: "assets",
    4: "web",
    5: "media ingest",
}
CLOCK_SOURCE: Final = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
SLOW_CLOCKS: Final = frozenset({"hpet", "acpi_pm", "jiffies", "pit"})


def check_host(folder: Path, control_port: int = CONTROL_PORT) -> list[Finding]:
    """All findings. `folder`: where recordings go."""
    return [
        check_scheduling(),
        check_processors(),
        check_memory(),
        check_disk_space(folder),
        check_key_home(),
        check_ports(control_port),
        check_interfaces(),
        check_clock_source(),
    ]


def check_scheduling() -> Finding:
    """Whether the tick loop may run before other work."""
    from iris_session.system.priority import tick_priority

    with tick_priority() as reached:
        pass
    if reached == "realtime":
        return ok("scheduling", "real-time priority is permitted: other programs do not make ticks late")
    if len(os.sched_getaffinity(0)) < 2:
        return warning("scheduling", "one processor only: no real-time priority, it would starve the network")
    advice = "a line `@realtime - rtprio 20` in /etc/security/limits.d, see docs/network.md"
    return warning("scheduling", "no real-time priority: other programs can make ticks late", "", advice)


def check_processors() -> Finding:
    """How many, and how busy."""
    count, load = os.cpu_count() or 1, os.getloadavg()[0]
    busy = sorted(
        ((p.info["cpu_percent"] or 0.0, p.info["name"], p.pid) for p in _sample_processes(0.3)),
        reverse=True,
        key=lambda x: x[0],
    )
    text = f"{count} processors, load {load:.1f}"
    top = ", ".join(f"{name} ({pid}) {share:.0f} %" for share, name, pid in busy[:3] if share > 10.0)
    if count < 2:
        return warning("processors", text, "physics and network share one processor", "use a machine with two or more")
    if load > count:
        return warning("processors", text, f"more work than processors: {top}", "end other programs")
    return ok("processors", text + (f"; busiest: {top}" if top else ""))


def _sample_processes(interval_s: float) -> list[psutil.Process]:
    """All processes, with their share of a processor over `interval_s`."""
    for process in psutil.process_iter(["cpu_percent"]):
        del process  # the first look begins the measurement
    psutil.cpu_percent(interval_s)
    return list(psutil.process_iter(["cpu_percent", "name"]))


def check_memory() -> Finding:
    """What is left of it."""
    left = psutil.virtual_memory().available
    text = f"{left / 1e9:.1f} GB of memory are free"
    if left < 500e6:
        return warning("memory", text, "a session that is swapped out stands still", "end other programs")
    return ok("memory", text)


def check_disk_space(folder: Path) -> Finding:
    """Room for recordings in `folder`, or where it will be made."""
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    free = psutil.disk_usage(str(there)).free
    text = f"{free / 1e9:.1f} GB free at {there}"
    if not os.access(there, os.W_OK):
        return failed("disk", f"{there} cannot be written", "", "record elsewhere (--record), or mend its permissions")
    if free < FULL_DISK:
        return failed("disk", text, "no room for recordings", "make room, or record elsewhere (--record)")
    return warning("disk", text, "", "make room") if free < LOW_DISK else ok("disk", text)


def check_key_home() -> Finding:
    """Whether the home of keys can be read by its owner only, and is not damaged."""
    home = KeyHome()
    folder = home.path
    if not folder.exists():
        return ok("key_home", f"{folder} is made with the first encrypted session")
    loose = [path.name for path in (folder, *sorted(folder.iterdir())) if stat.S_IMODE(path.lstat().st_mode) & 0o077]
    if loose:
        advice = f"chmod -R go= {folder}"
        return failed("key_home", f"others may read {', '.join(loose)} in {folder}", "these are secrets", advice)
    try:
        clients, codes = home.clients.read(), home.join_codes.read()
    except KeysError as error:
        return failed("key_home", str(error), "", "mend or remove that file; removing it takes its entries away")
    return ok("key_home", f"{folder}: {len(clients)} keys on the list, {len(codes)} join codes")


def check_ports(control: int) -> Finding:
    """Whether the ports of a session are free, and who has them."""
    wanted = {control + offset: name for offset, name in PORT_OFFSETS.items()}
    taken: dict[int, str] = {}
    for port in wanted:
        if _is_port_in_use(port):
            taken[port] = "another program"
    for connection in _list_connections():
        if connection.status == psutil.CONN_LISTEN and connection.laddr.port in taken:
            taken[connection.laddr.port] = _describe_process(connection.pid)
    if not taken:
        return ok("ports", f"TCP {min(wanted)} to {max(wanted)} and UDP {DISCOVERY_PORT} are free for a session")
    text = "; ".join(
        f"{', '.join(f'{port} ({wanted[port]})' for port, one in sorted(taken.items()) if one == who)}: {who}"
        for who in dict.fromkeys(taken[port] for port in sorted(taken))
    )
    if all("iris_session.front" in who for who in taken.values()):
        return ok("ports", f"a session has {text}; another one here needs --port-base")
    advice = "end that program, or start the session with --port-base"
    return warning("ports", f"in use: {text}", "another program has ports of a session", advice)


def _is_port_in_use(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            return True
    return False


def _list_connections() -> list[Any]:
    try:
        return list(psutil.net_connections("tcp"))
    except psutil.AccessDenied:
        return []


def _describe_process(pid: int | None) -> str:
    if pid is None:
        return "a program of another user"
    try:
        process = psutil.Process(pid)
        return f"{' '.join(process.cmdline()[:5])[:80] or process.name()} (process {pid})"
    except psutil.Error:
        return f"process {pid}"


def check_interfaces() -> Finding:
    """The addresses that others can type."""
    from iris_session.doctor.network_checks import list_own_networks

    up = psutil.net_if_stats()
    typed = [
        f"{one.address} ({name})"
        for name, addresses in sorted(psutil.net_if_addrs().items())
        for one in addresses
        if one.family == socket.AF_INET and not one.address.startswith("127.") and (name not in up or up[name].isup)
    ]
    if not typed and not list_own_networks():
        return warning("interfaces", "this machine is in no network", "", "connect it: only its own programs can join")
    return ok("interfaces", f"others type one of: {', '.join(typed) or 'IPv6 only'}")


def check_clock_source() -> Finding:
    """Whether reading the clock is quick: a tick does so a dozen times."""
    try:
        source = CLOCK_SOURCE.read_text().strip()
    except OSError:
        return ok("clock_source", "the clock source is not told by this system")
    if source in SLOW_CLOCKS:
        return warning(
            "clock_source", f"the clock source is {source}", "reading it takes microseconds", "tsc, if it is stable"
        )
    return ok("clock_source", f"the clock source is {source}")
