"""Packages of the system (Debian's names) that the tests need, and which of them are missing here.

    python3 tools/system_packages.py            # what is missing, and the command that installs it
    python3 tools/system_packages.py --list     # all names

Without one of them, the tests that need it are not run; with CI=true nothing is: exit status 1. Runs before anything is
installed.
"""

from __future__ import annotations

import ctypes.util
import importlib.util
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path


def _has_library(name: str) -> Callable[[], bool]:
    return lambda: ctypes.util.find_library(name) is not None


def _has_command(*names: str) -> Callable[[], bool]:
    return lambda: any(map(shutil.which, names))


def _has_file(folder: str, pattern: str) -> Callable[[], bool]:
    return lambda: any(Path(folder).glob(pattern))


OPENGL = ("libegl1", "libgl1-mesa-dri", "libopengl0")
CSHARP = (
    "libmono-system-io-compression4.0-cil",
    "libmono-system-numerics4.0-cil",
    "libnunit-framework2.6.3-cil",
    "mono-mcs",
)
_MONO = "/usr/lib/mono/4.5"
#: Name -> what needs it, and a function that tells whether it is here.
PACKAGES: dict[str, tuple[str, Callable[[], bool]]] = {
    "chromium": (
        "tests of the page in a browser",
        lambda: bool(os.environ.get("CHROMIUM")) or _has_command("chromium", "chromium-browser", "google-chrome")(),
    ),
    "fonts-dejavu-core": ("text in pictures of the page", _has_file("/usr/share/fonts", "**/*.ttf")),
    "iproute2": ("tests of two machines on one cable", _has_command("ip")),
    "libegl1": ("drawing without a display", _has_library("EGL")),
    "libgl1-mesa-dri": ("drawing without a display", _has_file("/usr/lib", "**/dri/*swrast*")),
    "libopengl0": ("drawing without a display", _has_library("OpenGL")),
    "libmono-system-io-compression4.0-cil": (
        "tests of the headset apps' C#",
        _has_file(_MONO, "System.IO.Compression.dll"),
    ),
    "libmono-system-numerics4.0-cil": ("tests of the headset apps' C#", _has_file(_MONO, "System.Numerics.dll")),
    "libnunit-framework2.6.3-cil": (
        "tests of the headset apps' C#",
        _has_file("/usr/lib/cli/nunit.framework-2.6.3", "nunit.framework.dll"),
    ),
    "mesa-vulkan-drivers": (
        "looking at recordings in Rerun's viewer (make test-long)",
        _has_file("/usr/share/vulkan/icd.d", "*.json"),
    ),
    "mono-mcs": (
        "tests of the headset apps' C#",
        lambda: _has_command("mono")() and _has_command("mcs")(),
    ),
    "python3-venv": ("make install", lambda: importlib.util.find_spec("ensurepip") is not None),
}


def find_missing() -> list[str]:
    """Return the names of the packages that are not here."""
    return [name for name, (_, is_here) in PACKAGES.items() if not is_here()]


def main(arguments: list[str]) -> int:
    if arguments == ["--list"]:
        print(*PACKAGES)
        return 0
    missing = find_missing()
    for name in missing:
        print(f"missing: {name} ({PACKAGES[name][0]})", flush=True)
    if not missing:
        print("system packages: all are here", flush=True)
        return 0
    print(f"install with: apt-get install --no-install-recommends {' '.join(missing)}", flush=True)
    if os.environ.get("CI"):
        return 1
    print("tests that need them are listed at the end as not run", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
