"""`python -m iris_session.emulator`: emulated headsets from the command line, or with JSON lines for a parent
process."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from iris_session.client import ClientError
from iris_session.client.endpoint_resolver import parse_connect_request, resolve_blocking
from iris_session.emulator.operator import load_curve_keys, make_spec_behaviour
from iris_session.emulator.runner import JOIN_TIMEOUT_S, DisturbanceReader, run_headsets
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec

#: Fields of a headset with several numbers, written as `eye=0.3/-0.9/0.5`. Fields of a field have both names:
#: `model.drift_m_per_min=0.03`, `model.sheet.wrong_share=0`.
LISTS: Final = frozenset({"eye", "gaze", "recentre_at_s", "bump_at_s", "bump_m"})


def main(argv: list[str] | None = None) -> int:
    """Run the headsets of a command line."""
    return run(_build_parser().parse_args(argv), "emulator")


def run(options: argparse.Namespace, prog: str) -> int:
    """Return exit status 0 when all succeeded, 1 when one failed, 2 for unusable input. Errors begin with `prog`."""
    try:
        specs = _parse_specs(options)
        sought = parse_connect_request(options.address, options.session, None, options.code)
        for spec in specs:
            make_spec_behaviour(spec, spec.robot)
            load_curve_keys(spec)
    except (msgspec.MsgspecError, OSError, ValueError, ClientError) as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    address = options.address or str(sought.address)
    try:
        if sought.address is None or sought.join_code:
            # All headsets here use the key of this user, which is paired once. A session that revoked it refuses their
            # `hello`; then they pair again with the same code.
            found = resolve_blocking(sought, options.join_timeout).address
            address = address if sought.address is not None else str(found)
    except ClientError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 1
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _frame: stopped.append(received))
    say = _print_json if options.json else _LinePrinter()
    orders = DisturbanceReader(sys.stdin.fileno(), [spec.name for spec in specs]) if options.orders else tuple
    try:
        reports = run_headsets(
            address, specs, options.seconds, say, lambda: bool(stopped), options.join_timeout, orders, options.code
        )
        for report in reports:
            say(report, final=True)
            if report.failed:
                print(f"{prog}: {report.name}: {report.failed}", file=sys.stderr)
    except BrokenPipeError:  # the parent process has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return int(any(report.failed for report in reports))


def _build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m iris_session.emulator", description=__doc__)
    parser.add_argument("--address", default="", help="control channel of the session, HOST:PORT, or an iris:// URI")
    parser.add_argument("--session", default="", metavar="NAME", help="find the session of that name on the network")
    parser.add_argument("--code", default="", metavar="CODE", help="join code, the first time at a session")
    parser.add_argument(
        "--headset", action="append", default=[], metavar="KEY=VALUE,...", help="one headset, see specs"
    )
    parser.add_argument("--specs", default="", metavar="FILE", help="JSON list of HeadsetSpec, - for standard input")
    parser.add_argument("--seconds", type=float, default=None, help="at most this long")
    parser.add_argument(
        "--join-timeout", type=float, default=JOIN_TIMEOUT_S, metavar="S", help="fail when not joined after this time"
    )
    parser.add_argument("--curve-server", default="", metavar="FILE", help="the session's public CURVE key")
    parser.add_argument("--curve-key", default="", metavar="FILE", help="own CURVE secret key, for all headsets here")
    parser.add_argument("--orders", action="store_true", help="take orders from standard input, such as: bump NAME")
    parser.add_argument("--json", action="store_true", help="one JSON object per line on standard output")
    return parser


def _parse_specs(options: argparse.Namespace) -> list[HeadsetSpec]:
    specs: list[HeadsetSpec] = []
    if options.specs == "-" and options.orders:
        raise ValueError("--specs - and --orders both read standard input: write the specs into a file")
    if options.specs:
        data = sys.stdin.buffer.read() if options.specs == "-" else Path(options.specs).read_bytes()
        specs += msgspec.json.decode(data, type=list[HeadsetSpec])
    for text in options.headset:
        pairs: dict[str, Any] = dict(part.partition("=")[::2] for part in text.split(","))
        for key in LISTS & pairs.keys():
            pairs[key] = [float(value) for value in pairs[key].split("/")]
        nested = _nest_fields(pairs)
        _check_fields(nested, HeadsetSpec)
        specs.append(msgspec.convert(nested, HeadsetSpec, strict=False))
    if not specs:
        raise ValueError("no headset: give --headset name=ann,behaviour=giver,robot=left or --specs FILE")
    given = {"curve_server": options.curve_server, "curve_key": options.curve_key}
    keys = {name: file for name, file in given.items() if file}
    return [msgspec.structs.replace(spec, **keys) for spec in specs]


def _nest_fields(pairs: Mapping[str, Any]) -> dict[str, Any]:
    """Nest dotted keys: `model.drift_m_per_min` is a field of the field `model`."""
    nested: dict[str, Any] = {}
    for key, value in pairs.items():
        *path, name = key.split(".")
        inner = nested
        for part in path:
            inner = inner.setdefault(part, {})
            if type(inner) is not dict:
                raise ValueError(f"--headset: {part!r} and {key!r} cannot both be given")
        if name in inner:  # a field of it was given before
            raise ValueError(f"--headset: {key!r} and a field of it cannot both be given")
        inner[name] = value
    return nested


def _check_fields(pairs: Mapping[str, Any], kind: type[msgspec.Struct], path: str = "") -> None:
    """Raise `ValueError` for an unknown field, listing the known ones, also in nested structs."""
    fields = {field.name: field.type for field in msgspec.structs.fields(kind)}
    for name, value in pairs.items():
        if name not in fields:
            known = ", ".join(f"{path}{one}" for one in sorted(fields))
            raise ValueError(f"--headset: unknown field '{path}{name}'; fields: {known}")
        inner = fields[name]
        whole = not (isinstance(inner, type) and issubclass(inner, msgspec.Struct))
        if whole and isinstance(value, Mapping):
            raise ValueError(f"--headset: '{path}{name}' has no fields of its own")
        if isinstance(value, Mapping):
            _check_fields(value, inner, f"{path}{name}.")


def _print_json(report: HeadsetReport, *, final: bool = False) -> None:
    print(msgspec.json.encode({"final": final, **msgspec.to_builtins(report)}).decode(), flush=True)


class _LinePrinter:
    """Print one line per report, and one when a headset has joined a session."""

    def __init__(self) -> None:
        self._joined: dict[str, str] = {}  # session, by name of the headset

    def __call__(self, report: HeadsetReport, *, final: bool = False) -> None:
        if report.session and self._joined.get(report.name) != report.session:
            self._joined[report.name] = report.session
            print(f"     {report.name:<12} joined session {report.session!r} at {report.address}", flush=True)
        phase = next(reversed(report.phases), report.phase)
        if report.lost_s and not report.done:
            phase = f"session lost {report.lost_s:.0f} s ago"
        text = f"{report.name:<12} {phase:<20} samples {report.samples:<6} frames {report.frames:<6}"
        age, error = _format_value(report.age_ms_p99, "ms"), _format_value(report.alignment_error_mm, "mm")
        text += f" age p99 {age}, alignment {error}"
        if report.failed:
            text += f"  FAILED: {report.failed}"
        print(("end  " if final else "     ") + text, flush=True)


def _format_value(value: float, unit: str) -> str:
    """Format a value, `-` while it is not a number (before the first state or alignment)."""
    return "-" if math.isnan(value) else f"{value:.1f} {unit}"


if __name__ == "__main__":
    sys.exit(main())
