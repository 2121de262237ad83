"""Checks of the machine that serves a session: scheduling, processors, disk, keys, ports, addresses, clock."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any, Final

import psutil

from iris_session.doctor.findings import Finding, failed, ok, warning
from iris_session.doctor.session_checks import FULL_DISK, LOW_DISK
from iris_session.protocol.discovery import DISCOVERY_PORT
from iris_session.security import KeyHome, KeysError

CONTROL_PORT: Final = 7721
#: TCP ports of a session, the first one below the control port.
PORT_NAMES: Final = ("introduction", "control", "state", "media", "assets", "web", "media ingest")
CLOCK_SOURCE: Final = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
SLOW_CLOCKS: Final = frozenset({"hpet", "acpi_pm", "jiffies", "pit"})


def check_host(folder: Path, control_port: int = CONTROL_PORT) -> list[Finding]:
    """Return all findings about this machine. `folder`: of recordings."""
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
    """Check whether the tick loop may run with real-time priority."""
    from iris_session.system.priority import tick_priority

    with tick_priority() as reached:
        pass
    if reached == "realtime":
        return ok("scheduling", "real-time priority is permitted: other programs do not delay ticks")
    if len(os.sched_getaffinity(0)) < 2:
        return warning("scheduling", "one processor only: no real-time priority, which would starve the network")
    advice = "add a line `@robotics - rtprio 10` to /etc/security/limits.d, see docs/network.md"
    return warning("scheduling", "no real-time priority: other programs can delay ticks", "", advice)


def check_processors() -> Finding:
    """Check number and load of the processors."""
    count, load = os.cpu_count() or 1, os.getloadavg()[0]
    for process in psutil.process_iter(["cpu_percent"]):
        del process  # the first call begins the measurement
    psutil.cpu_percent(0.3)
    found = psutil.process_iter(["cpu_percent", "name"])
    busy = sorted(((p.info["cpu_percent"] or 0.0, p.info["name"], p.pid) for p in found), key=lambda one: -one[0])
    text = f"{count} processors, load {load:.1f}"
    top = ", ".join(f"{name} ({pid}) {share:.0f} %" for share, name, pid in busy[:3] if share > 10.0)
    if count < 2:
        return warning("processors", text, "physics and network share one processor", "use a machine with two or more")
    if load > count:
        return warning("processors", text, f"more work than processors: {top}", "end other programs")
    return ok("processors", text + (f"; busiest: {top}" if top else ""))


def check_memory() -> Finding:
    """Check the free memory."""
    left = psutil.virtual_memory().available
    text = f"{left / 1e9:.1f} GB of memory are free"
    if left < 500e6:
        return warning("memory", text, "a session that is swapped out does not step", "end other programs")
    return ok("memory", text)


def check_disk_space(folder: Path) -> Finding:
    """Check the space for recordings in `folder`, or in the existing folder above it."""
    existing = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    free = psutil.disk_usage(str(existing)).free
    text = f"{free / 1e9:.1f} GB free at {existing}"
    if not os.access(existing, os.W_OK):
        return failed("disk", f"{existing} is not writable", "", "record elsewhere (--record), or change permissions")
    if free < FULL_DISK:
        return failed("disk", text, "no space for recordings", "make room, or record elsewhere (--record)")
    return warning("disk", text, "", "make room") if free < LOW_DISK else ok("disk", text)


def check_key_home() -> Finding:
    """Check that the folder of keys is readable by its owner only, and not damaged."""
    home = KeyHome()
    folder = home.path
    if not folder.exists():
        return ok("key_home", f"{folder} does not exist yet: the first encrypted session creates it")
    loose = [path.name for path in (folder, *sorted(folder.iterdir())) if stat.S_IMODE(path.lstat().st_mode) & 0o077]
    if loose:
        advice = f"chmod -R go= {folder}"
        return failed("key_home", f"others may read {', '.join(loose)} in {folder}", "these are secrets", advice)
    try:
        clients, codes = home.clients.read(), home.join_codes.read()
    except KeysError as error:
        return failed("key_home", str(error), "", "repair or remove that file; removing it deletes its entries")
    return ok("key_home", f"{folder}: {len(clients)} keys on the list, {len(codes)} join codes")


def check_ports(control: int) -> Finding:
    """Check that the ports of a session are free, and name the programs that use them."""
    wanted = dict(enumerate(PORT_NAMES, control - 1))
    taken = {port: "another program" for port in wanted if _is_port_in_use(port)}
    for connection in _list_connections():
        if connection.status == psutil.CONN_LISTEN and connection.laddr.port in taken:
            taken[connection.laddr.port] = _describe_process(connection.pid)
    if not taken:
        return ok("ports", f"TCP {min(wanted)} to {max(wanted)} and UDP {DISCOVERY_PORT} are free for a session")
    text = "; ".join(
        f"{', '.join(f'{port} ({wanted[port]})' for port, one in sorted(taken.items()) if one == who)}: {who}"
        for who in dict.fromkeys(taken[port] for port in sorted(taken))
    )
    if all("iris_session." in who or "iris-session" in who for who in taken.values()):
        return ok("ports", f"used by a session: {text}; a second session on this machine needs --port-base")
    advice = "end that program, or start the session with --port-base"
    return warning("ports", f"in use: {text}", "another program uses ports of a session", advice)


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
        return f"{_name_program(process.cmdline()) or process.name()} (process {pid})"
    except psutil.Error:
        return f"process {pid}"


def _name_program(command: Sequence[str]) -> str:
    """Return the name of the program of a command line, with module or script for Python; no folders, no options."""
    name = PurePath(command[0]).name if command else ""
    arguments = iter(command[1:] if name.startswith("python") else ())
    for argument in arguments:
        if argument == "-m":
            return f"{name} -m {next(arguments, '')}"
        if argument == "-c":
            break
        if not argument.startswith("-"):
            return f"{name} {PurePath(argument).name}"
    return name


def check_interfaces() -> Finding:
    """List the addresses at which other machines reach this one."""
    from iris_session.doctor.network_checks import list_own_networks

    up = psutil.net_if_stats()
    typed = [
        f"{one.address} ({name})"
        for name, addresses in sorted(psutil.net_if_addrs().items())
        for one in addresses
        if one.family == socket.AF_INET and not one.address.startswith("127.") and (name not in up or up[name].isup)
    ]
    if not typed and not list_own_networks():
        return warning(
            "interfaces", "no network: only programs of this machine can join", "", "connect it to a network"
        )
    return ok("interfaces", f"addresses for other machines: {', '.join(typed) or 'IPv6 only'}")


def check_clock_source() -> Finding:
    """Check that reading the clock is fast: a tick reads it a dozen times."""
    try:
        source = CLOCK_SOURCE.read_text().strip()
    except OSError:
        return ok("clock_source", "this system does not report its clock source")
    if source in SLOW_CLOCKS:
        return warning(
            "clock_source", f"the clock source is {source}", "reading it takes microseconds", "use tsc, if it is stable"
        )
    return ok("clock_source", f"the clock source is {source}")
