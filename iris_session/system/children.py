"""Processes of ours: how they are called, and where they look for modules.

`python -m` puts the working folder before everything else, so a `queue.py` or `zmq.py` of the user there would be taken
for the real one. A child looks only where Python is installed, in the user's PYTHONPATH, and where this package is.
"""

from __future__ import annotations

import os
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from importlib.metadata import Distribution

#: The folder that `iris_session` and `anchors` lie in.
ROOT: Final = Path(__file__).resolve().parents[2]
_DISTRIBUTION: Final = "iris-session"


def command(module: str, *arguments: str) -> list[str]:
    """A module of ours as the main one of a process with this interpreter."""
    return [sys.executable, "-P", "-m", module, *arguments]


def environment(**others: str) -> dict[str, str]:
    """This process's environment, and `others`, for `command`.

    Run from a checkout that is not installed, the package is found by PYTHONPATH. An empty part of that means the
    working folder; it is left out, since `export PYTHONPATH=$PYTHONPATH:...` makes one that nobody asked for.
    """
    folders = [folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder]
    if not _is_installed():
        folders.insert(0, str(ROOT))
    path = {"PYTHONPATH": os.pathsep.join(folders)} if folders else {}
    rest = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return {**rest, **path, **others}


@cache
def _is_installed() -> bool:
    """Whether every process of this interpreter finds this very package."""
    import site
    from importlib import metadata  # only who starts a process needs it: it takes as long as all else here

    folders = [*site.getsitepackages(), site.getusersitepackages()]
    if any(Path(folder).resolve() == ROOT for folder in folders):
        return True
    return any(_links_here(found) for found in metadata.distributions(name=_DISTRIBUTION))


def _links_here(found: Distribution) -> bool:
    """Whether this is an editable installation of the checkout that runs (PEP 610)."""
    import json

    origin = json.loads(found.read_text("direct_url.json") or "{}")
    return bool(origin.get("dir_info", {}).get("editable")) and origin.get("url") == ROOT.as_uri()
