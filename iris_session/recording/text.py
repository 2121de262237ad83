"""Events, denials and the session as lines that a person reads in the Rerun viewer. Pure."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from iris_session.protocol.server_messages import (
    ConsentRequested,
    EpisodeChanged,
    EStopChanged,
    Event,
    Gap,
    Handover,
    Notice,
    ParticipantLeft,
    SamplesRejected,
)
from iris_session.recording.journal import SessionHeader
from iris_session.recording.messages import DenialRecord


class LogLine(NamedTuple):
    """`level`: a Rerun log level (`INFO`, `WARN`, `CRITICAL`)."""

    level: str
    text: str


_LEVELS: dict[type, str] = {
    EStopChanged: "CRITICAL",
    Gap: "ERROR",
    Notice: "WARN",
    SamplesRejected: "WARN",
    ParticipantLeft: "WARN",
    ConsentRequested: "INFO",
    EpisodeChanged: "INFO",
    Handover: "INFO",
}


def describe_event(event: Event) -> LogLine:
    """`#12 lease_changed target=left holder=p1 ...`: the number, the kind, and every field that says something."""
    body: dict[str, Any] = msgspec.to_builtins(event.body)
    kind = body.pop("event")
    fields = " ".join(_fields(body))
    return LogLine(_LEVELS.get(type(event.body), "INFO"), f"#{event.event_seq} {kind} {fields}".rstrip())


def describe_denial(record: DenialRecord) -> LogLine:
    """What was refused to whom, why, and what to do."""
    denial = record.denial
    parts = [f"connection {record.connection}: {denial.reason}: {denial.message}"]
    if denial.holder:
        parts.append(f"held by {denial.holder_name or denial.holder}")
    if denial.advice:
        parts.append(denial.advice)
    return LogLine("WARN", "; ".join(parts))


def describe_session(header: SessionHeader) -> str:
    """Markdown page about the recording."""
    versions = "\n".join(f"| {name} | {value} |" for name, value in header.versions.items())
    return (
        f"# {header.session_name}\n\n"
        f"Session `{header.session_id}`, class **{header.recording_class}**, {header.created_utc}\n\n"
        f"Robots: {', '.join(r.name for r in header.robots) or 'none'}. "
        f"Objects: {', '.join(o.name for o in header.objects) or 'none'}. "
        f"Bodies: {len(header.bodies)}. Tick: {header.tick_period_ns / 1e6:g} ms.\n\n"
        f"| library | version |\n|---|---|\n{versions}\n"
    )


def _fields(body: dict[str, Any], prefix: str = "") -> list[str]:
    out = []
    for name, value in body.items():
        if isinstance(value, dict):
            out += _fields(value, f"{prefix}{name}.")
        elif name == "covariance" or value in ("", None, [], ()):
            continue
        elif isinstance(value, float):
            out.append(f"{prefix}{name}={value:.6g}")
        else:
            out.append(f"{prefix}{name}={value}")
    return out
