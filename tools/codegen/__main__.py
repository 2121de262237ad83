"""Write the generated files of a checkout, or check that they are current.

python -m tools.codegen all [--check]        or one of: csharp, typescript, golden, docs, reference, ...
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from tools.codegen import (
    arrays_golden,
    cloud_golden,
    conversations,
    csharp,
    deformable_golden,
    golden,
    reference,
    scene_golden,
    tables,
    typescript,
    typescript_schema,
    unity_meta,
    web_golden,
)

_DOCUMENT: Final = "docs/protocol.md"
#: The target of many files.
UNITY_META: Final = "unity-meta"


def update_document(text: str) -> str:
    """Return `text` of the protocol document with new generated sections. Raises `ValueError` without their markers."""
    for name, table in tables.render_sections().items():
        begin, end = f"<!-- generated:{name} -->", f"<!-- end:{name} -->"
        if text.count(begin) != 1 or text.count(end) != 1:
            raise ValueError(f"{_DOCUMENT} must hold {begin} and {end} once each")
        before, rest = text.split(begin)
        text = f"{before}{begin}\n{table}\n{end}{rest.split(end)[1]}"
    return text


#: Name of a target -> its file, and a function from its present text to the new one.
TARGETS: Final[dict[str, tuple[str, Callable[[str], str]]]] = {
    "csharp": ("unity_client/Runtime/Protocol/Messages.g.cs", lambda _: csharp.render_csharp()),
    "typescript": ("web_client/src/protocol/messages.g.ts", lambda _: typescript.render_typescript()),
    "typescript-schema": ("web_client/src/protocol/schema.g.ts", lambda _: typescript_schema.render_schema()),
    "golden": ("docs/protocol/golden.json", lambda _: golden.render_golden()),
    "scene": ("docs/protocol/scene.json", lambda _: scene_golden.render_scene_golden()),
    "conversations": ("docs/protocol/conversations.json", lambda _: conversations.render_conversations()),
    "arrays": ("docs/protocol/arrays.json", lambda _: arrays_golden.render_golden()),
    "deformable": ("docs/protocol/deformable.json", lambda _: deformable_golden.render_golden()),
    "cloud": ("docs/protocol/cloud.json", lambda _: cloud_golden.render_golden()),
    "web": ("docs/protocol/web.json", lambda _: web_golden.render_golden()),
    "docs": (_DOCUMENT, update_document),
    "reference": ("docs/reference.md", lambda _: reference.render_reference()),
}


def find_outdated(root: Path, names: list[str]) -> list[tuple[Path, str]]:
    """Return the files of the targets `names` below `root` that are not current, each with its new text.

    It is empty for a file that should not be there.
    """
    found = []
    for name in names:
        if name == UNITY_META:
            found += unity_meta.find_outdated(root)
            continue
        relative, make = TARGETS[name]
        path = root / relative
        present = path.read_text(encoding="utf-8") if path.exists() else ""
        text = make(present)
        if text != present:
            found.append((path, text))
    return found


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Exit status 1 with `--check` when a file is not current."""
    parser = argparse.ArgumentParser(prog="python -m tools.codegen", description=__doc__)
    parser.add_argument("what", choices=[*TARGETS, UNITY_META, "all"])
    parser.add_argument("--check", action="store_true", help="write nothing; fail when a file is not current")
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[2], help="the checkout")
    options = parser.parse_args(arguments)
    if not (options.root / _DOCUMENT).exists():
        parser.error(f"{options.root} is not a checkout: {_DOCUMENT} is missing")
    files = find_outdated(options.root, [*TARGETS, UNITY_META] if options.what == "all" else [options.what])
    for path, text in files:
        if not options.check and not text:
            path.unlink()
        elif not options.check:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8", newline="\n")
        print(f"{'not current' if options.check else 'wrote' if text else 'removed'}: {path.relative_to(options.root)}")
    return 1 if options.check and files else 0


if __name__ == "__main__":
    sys.exit(main())
