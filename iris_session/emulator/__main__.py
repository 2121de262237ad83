"""`python -m iris_session.emulator`: emulated people from the command line, or driven by a parent with JSON lines."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from iris_session.client import ClientError
from iris_session.client.endpoint_resolver import ConnectRequest, parse_connect_request, resolve_blocking
from iris_session.emulator.equipment import behaviour_of, curve_of
from iris_session.emulator.orders import Orders
from iris_session.emulator.runner import JOIN_TIMEOUT_S, run_headsets
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec

#: Fields of a headset with several numbers, written as `eye=0.3/-0.9/0.5`. Fields of a field have both names:
#: `model.drift_m_per_min=0.03`, `model.sheet.wrong_share=0`.
LISTS: Final = frozenset({"eye", "gaze", "recentre_at_s", "bump_at_s", "bump_m"})


def main(argv: list[str] | None = None, prog: str = "emulator") -> int:
    """Exit status 0 when nobody failed, 1 when somebody did, 2 for unusable input. Errors begin with `prog`."""
    options = _parser().parse_args(argv)
    try:
        specs = _specs(options)
        sought = parse_connect_request(options.address, options.session, None, options.code)
        for spec in specs:
            behaviour_of(spec, spec.robot)
            curve_of(spec)
    except (msgspec.MsgspecError, OSError, ValueError, ClientError) as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    try:
        if sought.address is None or sought.join_code or sought.address.join_code:
            # Everybody here has the key of this user: it is paired once, not by each of them.
            sought = ConnectRequest(resolve_blocking(sought, options.join_timeout).address)
    except ClientError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 1
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _frame: stopped.append(received))
    say = _say_json if options.json else _say_line
    orders = Orders(sys.stdin.fileno(), [spec.name for spec in specs]) if options.orders else tuple
    try:
        reports = run_headsets(
            str(sought.address), specs, options.seconds, say, lambda: bool(stopped), options.join_timeout, orders
        )
        for report in reports:
            say(report, final=True)
            if report.failed:
                print(f"{prog}: {report.name}: {report.failed}", file=sys.stderr)
    except BrokenPipeError:  # whoever started us is gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return int(any(report.failed for report in reports))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m iris_session.emulator", description=__doc__)
    parser.add_argument("--address", default="", help="control channel of the session, HOST:PORT, or an iris:// URI")
    parser.add_argument("--session", default="", metavar="NAME", help="find the session of that name on the network")
    parser.add_argument("--code", default="", metavar="CODE", help="join code, the first time at a session")
    parser.add_argument("--headset", action="append", default=[], metavar="KEY=VALUE,...", help="one person, see specs")
    parser.add_argument("--specs", default="", metavar="FILE", help="JSON list of HeadsetSpec, - for standard input")
    parser.add_argument("--seconds", type=float, default=None, help="at most this long")
    parser.add_argument(
        "--join-timeout", type=float, default=JOIN_TIMEOUT_S, metavar="S", help="give up when no session lets us in"
    )
    parser.add_argument("--curve-server", default="", metavar="FILE", help="the session's public CURVE key")
    parser.add_argument("--curve-key", default="", metavar="FILE", help="our own CURVE secret key, of everybody here")
    parser.add_argument("--orders", action="store_true", help="take orders from standard input, such as: bump NAME")
    parser.add_argument("--json", action="store_true", help="one JSON object per line on standard output")
    return parser


def _specs(options: argparse.Namespace) -> list[HeadsetSpec]:
    specs: list[HeadsetSpec] = []
    if options.specs == "-" and options.orders:
        raise ValueError("--specs - and --orders both read standard input: write the specs into a file")
    if options.specs:
        data = sys.stdin.buffer.read() if options.specs == "-" else _read(options.specs)
        specs += msgspec.json.decode(data, type=list[HeadsetSpec])
    for text in options.headset:
        pairs: dict[str, Any] = dict(part.partition("=")[::2] for part in text.split(","))
        for key in LISTS & pairs.keys():
            pairs[key] = [float(value) for value in pairs[key].split("/")]
        nested = _nested(pairs)
        _check_fields(nested, HeadsetSpec)
        specs.append(msgspec.convert(nested, HeadsetSpec, strict=False))
    if not specs:
        raise ValueError("no headset: give --headset name=ann,behaviour=giver,robot=left or --specs FILE")
    given = {"curve_server": options.curve_server, "curve_key": options.curve_key}
    keys = {name: file for name, file in given.items() if file}
    return [msgspec.structs.replace(spec, **keys) for spec in specs]


def _nested(pairs: Mapping[str, Any]) -> dict[str, Any]:
    """`model.drift_m_per_min` is a field of a field."""
    nested: dict[str, Any] = {}
    for key, value in pairs.items():
        *path, name = key.split(".")
        inner = nested
        for depth, part in enumerate(path, 1):
            whole = ".".join(path[:depth])
            if whole in pairs:
                raise ValueError(f"--headset: {key!r} and {whole!r} cannot both be given")
            inner = inner.setdefault(part, {})
        inner[name] = value
    return nested


def _check_fields(pairs: Mapping[str, Any], kind: type[msgspec.Struct], path: str = "") -> None:
    """Raises `ValueError` that lists the fields there are, also those of a field."""
    fields = {field.name: field.type for field in msgspec.structs.fields(kind)}
    for name, value in pairs.items():
        if name not in fields:
            known = ", ".join(f"{path}{one}" for one in sorted(fields))
            raise ValueError(f"--headset: there is no field '{path}{name}'; fields: {known}")
        inner = fields[name]
        whole = not (isinstance(inner, type) and issubclass(inner, msgspec.Struct))
        if whole and isinstance(value, Mapping):
            raise ValueError(f"--headset: '{path}{name}' has no fields of its own")
        if isinstance(value, Mapping):
            _check_fields(value, inner, f"{path}{name}.")


def _read(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()


def _say_json(report: HeadsetReport, *, final: bool = False) -> None:
    print(msgspec.json.encode({"final": final, **msgspec.to_builtins(report)}).decode(), flush=True)


def _say_line(report: HeadsetReport, *, final: bool = False) -> None:
    phase = next(reversed(report.phases), report.phase)
    text = f"{report.name:<12} {phase:<20} samples {report.samples:<6} frames {report.frames:<6}"
    text += f" age p99 {_known(report.age_ms_p99, 'ms')}, alignment {_known(report.alignment_error_mm, 'mm')}"
    if report.failed:
        text += f"  FAILED: {report.failed}"
    print(("end  " if final else "     ") + text, flush=True)


def _known(value: float, unit: str) -> str:
    """Before there is state or an alignment: not a number."""
    return "-" if math.isnan(value) else f"{value:.1f} {unit}"


if __name__ == "__main__":
    sys.exit(main())
