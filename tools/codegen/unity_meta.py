"""The .meta files of Unity packages: one beside each file and folder, with the id that other files refer to it by.

Unity ignores what has none in a package that comes by a Git URL, since it cannot write there. The id is a hash of the
path, so it is the same in every checkout; it must stay the same when a file that scenes refer to is moved.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

PACKAGES: Final = ("unity_client", "hololens_client")
#: What reads a file, by its suffix; `DefaultImporter` for all others.
_IMPORTERS: Final = {
    ".asmdef": "AssemblyDefinitionImporter",
    ".cs": "MonoImporter",
    ".hlsl": "ShaderIncludeImporter",
    ".json": "TextScriptImporter",
    ".mat": "NativeFormatImporter",
    ".md": "TextScriptImporter",
    ".shader": "ShaderImporter",
    ".txt": "TextScriptImporter",
    ".xml": "TextScriptImporter",
}


def find_outdated(root: Path) -> list[tuple[Path, str]]:
    """Return the .meta files below `root` that are not as they should be, with their text, empty for one too many."""
    wanted = {Path(f"{path}.meta"): text for package in PACKAGES for path, text in _iterate_assets(root, package)}
    present = {path for package in PACKAGES for path in (root / package).rglob("*.meta")}
    found = [(path, "") for path in sorted(present - {*wanted})]
    for path, text in wanted.items():
        if path not in present or path.read_text(encoding="utf-8") != text:
            found.append((path, text))
    return found


def _iterate_assets(root: Path, package: str) -> Iterator[tuple[Path, str]]:
    """Yield the files and folders that Unity imports, with the text of their .meta."""
    for path in sorted((root / package).rglob("*")):
        inside = path.relative_to(root / package)
        hidden = any(part.startswith(".") or part.endswith("~") for part in inside.parts)
        if hidden or path.suffix == ".meta" or (path.is_dir() and not any(path.iterdir())):
            continue
        digest = hashlib.sha256(f"{package}/{inside.as_posix()}".encode()).hexdigest()
        lines = ["fileFormatVersion: 2", f"guid: {digest[:32]}"]
        importer = _IMPORTERS.get(path.suffix, "DefaultImporter")
        if path.is_dir():
            lines.append("folderAsset: yes")
            importer = "DefaultImporter"
        elif inside.as_posix() == "package.json":
            importer = "PackageManifestImporter"
        # The number of the one object in the file of a material.
        main = ["  mainObjectFileID: 2100000"] if path.suffix == ".mat" else []
        yield path, "\n".join([*lines, f"{importer}:", "  externalObjects: {}", *main, ""])
