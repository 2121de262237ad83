"""The anchors file: where sheets and other anchors are, as `serve --anchors` and `anchors solve --out` share it.

The form is that of `anchors.constellation`; what is checked here beyond it is what a session needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from anchors.constellation import Constellation, ConstellationError
from anchors.pose import PoseTuple
from iris_session.session.config_checks import check_anchors
from iris_session.session.errors import ConfigError

HELP: Final = "`iris-session anchors example` prints one that is right"
#: Characters of a name on the wire.
MAX_ID: Final = 64
#: Further away is millimetres taken for metres.
REACH_M: Final = 100.0


def load_anchors(path: Path) -> Constellation:
    """Raises `ConfigError`, in one line that says what would be right."""
    try:
        text = path.expanduser().read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ConfigError(f"anchors file {str(path)!r} cannot be read: {why}; {HELP}") from error
    try:
        found = Constellation.from_toml(text)
    except ConstellationError as error:
        raise ConfigError(f"{path.name}: {' '.join(str(error).split())}; {HELP}") from error
    for name, (p, _) in found.anchors.items():
        if not 0 < len(name) <= MAX_ID:
            raise ConfigError(f"{path.name}: {name[:80]!r} cannot be the id of an anchor: 1 to {MAX_ID} characters")
        if max(map(abs, p)) > REACH_M:
            raise ConfigError(
                f"{path.name}: anchors.{name}.position_m is {max(map(abs, p)):g} m away: are these metres?"
            )
    try:
        check_anchors(found.anchors, found.sizes)
    except ConfigError as error:
        raise ConfigError(f"{path.name}: {error}") from error
    return found


def dump_anchors(anchors: Mapping[str, PoseTuple], sizes: Mapping[str, float]) -> str:
    """A file to edit, which `load_anchors` reads back."""
    reference = next(iter(anchors))
    head = (
        "# Where anchors are: T_world_anchor, metres and a unit quaternion, w first. The origin of a sheet is the\n"
        "# centre of its code, x right, y up along the upright sheet, z out of the paper. `size_m`: edge of the code\n"
        "# as measured; leave it out where not known. `error_m`: 95 % of how well the place is known relative to\n"
        "# the reference.\n"
    )
    errors = dict.fromkeys(anchors, 0.0)
    return head + Constellation(reference, dict(anchors), errors, dict(sizes)).to_toml()
