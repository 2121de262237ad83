"""Models of real robots for tests, from a package, and real pictures, where `IRIS_DATA` has them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from iris_session.demo.scenes.models import WHEEL, find_wheel_folder


def _find_menagerie() -> Path:
    folder = find_wheel_folder()
    if folder is None:
        raise FileNotFoundError(f"{WHEEL} has the robots of these tests: pip install -e '.[all,dev]'")
    return folder


#: Folder of robots of MuJoCo Menagerie.
MENAGERIE: Final = _find_menagerie()
#: Two arms on a table; an arm without a hand, whose flange has a site.
ALOHA: Final = MENAGERIE / "aloha" / "scene.xml"
PANDA: Final = MENAGERIE / "franka_emika_panda" / "panda_nohand.xml"
#: `IRIS_DATA` of the person who runs the tests; empty without. Tests themselves do not have it in their environment.
DATA: Final = os.environ.get("IRIS_DATA", "")
