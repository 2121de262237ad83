"""Reference of the Python API as Markdown, from the docstrings of the public names.

Sections are the comments of `iris_session.__all__`. Docstrings follow Google's style; their text is taken as it is.
"""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from typing import Any, Final

import iris_session

#: Classes that are reached through a public one, and stand behind it in the reference.
REACHED: Final = {
    "Session": ("iris_session.session.status.SessionStatus",),
    "ScenePublisher": ("iris_session.session.simulator_session.SimulatorSession",),
    "Client": (
        "iris_session.client.scene.ClientScene",
        "iris_session.client.media.ClientMedia",
        "iris_session.client.media.MediaFeed",
        "iris_session.client.assets.ClientAssets",
        "iris_session.client.assets.AssetFetch",
        "iris_session.client.alignment.ClientAlignment",
    ),
    "Recording": (
        "iris_session.replay.recorded_session.RecordedRobot",
        "iris_session.replay.recorded_session.RecordedObject",
        "iris_session.replay.recorded_session.TimeSeries",
        "iris_session.replay.recorded_session.CommandSeries",
        "iris_session.recording.records.DeviceSamples",
        "iris_session.recording.episodes.RecordedEpisode",
    ),
}
#: Title of each section and the first public name in it, in the order of `__all__`.
SECTIONS: Final = (
    ("Sessions", "Session"),
    ("Scenes", "SceneBuilder"),
    ("Clients", "Client"),
    ("Recordings", "Recording"),
)
_HEADING: Final = re.compile(r"^(Args|Returns|Raises|Yields|Attributes):$")


def render_reference() -> str:
    """Return the text of docs/reference.md."""
    lines = [
        "# Reference",
        "",
        "Every public name of `iris_session`, from its docstring: `python -m tools.codegen reference`.",
        "Metres, radians, quaternions `(w, x, y, z)`; times in seconds unless a name ends in `_ns`.",
        "",
    ]
    starts = {name: title for title, name in SECTIONS}
    for name in iris_session.__all__:
        if name in starts:
            lines += [f"## {starts[name]}", ""]
        lines += _render_name(name, getattr(iris_session, name))
        for path in REACHED.get(name, ()):
            module, _, reached = path.rpartition(".")
            lines += _render_name(reached, getattr(import_module(module), reached))
    return "\n".join(lines).rstrip() + "\n"


def _render_name(name: str, value: Any) -> list[str]:
    """Return the lines of one class, function or constant."""
    if inspect.isclass(value):
        lines = [f"### {name}", "", *_render_docstring(value)]
        if issubclass(value, BaseException):
            return lines
        for member, function in _public_members(value):
            if isinstance(function, property):
                lines += [f"**`{name}.{member}`**", "", *_render_docstring(function)]
            else:
                lines += [f"**`{name}.{member}{_render_signature(function)}`**", "", *_render_docstring(function)]
        return lines
    if callable(value):
        return [f"### {name}", "", f"`{name}{_render_signature(value)}`", "", *_render_docstring(value)]
    return [f"### {name}", "", f"`{value!r}`", ""]


def _public_members(value: type) -> list[tuple[str, Any]]:
    """Return methods and properties that are documented, in the order of their definition, inherited ones last."""
    members: dict[str, Any] = {}
    for owner in value.__mro__:
        if owner.__module__.partition(".")[0] not in ("iris_session", "anchors"):
            continue
        for name, member in vars(owner).items():
            function = member.__func__ if isinstance(member, classmethod | staticmethod) else member
            if not name.startswith("_") and (inspect.isfunction(function) or isinstance(function, property)):
                members.setdefault(name, function)
    return list(members.items())


def _render_signature(function: Any) -> str:
    """Return the parameters without `self`, and what is returned."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return "()"
    parameters = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    plain = [p.replace(annotation=_Plain(p.annotation)) if p.annotation is not p.empty else p for p in parameters]
    returned = signature.return_annotation
    signature = signature.replace(
        parameters=plain, return_annotation=returned if returned is signature.empty else _Plain(returned)
    )
    return str(signature)


class _Plain:
    """An annotation that is shown without quotes."""

    def __init__(self, annotation: Any) -> None:
        self._text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)

    def __repr__(self) -> str:
        return self._text


def _render_docstring(value: Any) -> list[str]:
    """Return the docstring with its sections as lists."""
    lines: list[str] = []
    in_section = is_prose = False
    for line in (inspect.getdoc(value) or "").splitlines():
        heading = _HEADING.match(line)
        if heading:
            in_section, is_prose = True, heading[1] in ("Returns", "Yields")
            lines += [f"*{heading[1]}*", ""]
        elif in_section and is_prose and line.startswith("    "):
            lines.append(line.strip())
        elif in_section and re.match(r"^ {4}\S", line):
            lines.append(f"- {line.strip()}")
        elif in_section and line.startswith("     "):
            lines.append(f"  {line.strip()}")
        else:
            in_section = in_section and not line.strip()
            lines.append(line)
    return [*lines, ""]
