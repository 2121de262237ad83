"""Run a .NET program: a host for the runtime, which the packages of the tool chain bring without one.

    python coreclr.py RUNTIME_FOLDER PROGRAM.dll [ARGUMENT ...]

The program's libraries lie beside it, or in the folders of `CORECLR_LIBRARIES` (with `:` between).
"""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

#: Of a runtime without ICU, and of processes that live for seconds: no second compilation of what runs often, unless
#: the caller says otherwise.
PROPERTIES = {"System.Globalization.Invariant": "true", "System.GC.Concurrent": "false"}


def run_program(runtime: Path, program: Path, arguments: list[str]) -> int:
    """Run a program in this process. Return its exit status.

    Args:
        runtime: Folder of libcoreclr.so and the framework.
        program: Path of the program's assembly.
        arguments: Its arguments.

    Raises:
        OSError: The runtime does not start.
    """
    folders = [program.resolve().parent, *map(Path, filter(None, os.environ.get("CORECLR_LIBRARIES", "").split(":")))]
    assemblies: dict[str, Path] = {}
    for folder in (runtime, *folders):
        for path in folder.glob("*.dll"):
            assemblies.setdefault(path.name, path)
    properties = {
        **PROPERTIES,
        "TRUSTED_PLATFORM_ASSEMBLIES": ":".join(map(str, assemblies.values())),
        "APP_PATHS": ":".join(map(str, folders)),
        "APP_CONTEXT_BASE_DIRECTORY": f"{folders[0]}/",
        "NATIVE_DLL_SEARCH_DIRECTORIES": ":".join(f"{folder}/" for folder in (runtime, *folders)),
    }
    library = ctypes.CDLL(str(runtime / "libcoreclr.so"))
    host, domain, status = ctypes.c_void_p(), ctypes.c_uint(), ctypes.c_uint()

    def pack(texts: list[str]) -> ctypes.Array[ctypes.c_char_p]:
        return (ctypes.c_char_p * len(texts))(*(os.fsencode(text) for text in texts))

    error = library.coreclr_initialize(
        os.fsencode(program),
        b"program",
        len(properties),
        pack(list(properties)),
        pack(list(properties.values())),
        ctypes.byref(host),
        ctypes.byref(domain),
    )
    if error:
        raise OSError(f"the .NET runtime in {runtime} does not start: error 0x{error & 0xFFFFFFFF:08x}")
    error = library.coreclr_execute_assembly(
        host, domain, len(arguments), pack(arguments), os.fsencode(program), ctypes.byref(status)
    )
    if error:
        raise OSError(f"{program} does not start: error 0x{error & 0xFFFFFFFF:08x}")
    latched = ctypes.c_int()
    library.coreclr_shutdown_2(host, domain, ctypes.byref(latched))
    return ctypes.c_int(status.value).value


if __name__ == "__main__":
    code = run_program(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
    sys.stdout.flush()
    os._exit(code)
