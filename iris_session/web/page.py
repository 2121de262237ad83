"""Files of the page. No sockets.

The page is built by `make web` into `iris_session/web/page/`, and is part of the wheel. Without it a small page says
how to build it. Paths of requests are looked up in a table and never become paths of files.
"""

from __future__ import annotations

import hashlib
import mimetypes
import re
from pathlib import Path
from typing import Final, NamedTuple

PAGE_FOLDER: Final = Path(__file__).parent / "page"
INDEX: Final = "index.html"
#: The page as built has some megabytes; more is not the page.
MAX_PAGE_BYTES: Final = 64 << 20
#: Names of files that hold a hash of their content (vite): they never change.
_HASHED: Final = re.compile(r"assets/.+-[A-Za-z0-9_-]{8,}\.\w+$")
_TYPES: Final = {".js": "text/javascript", ".mjs": "text/javascript", ".wasm": "application/wasm",
                 ".webmanifest": "application/manifest+json", ".glb": "model/gltf-binary"}  # fmt: skip
_TEXT: Final = ("text/", "application/json", "application/manifest", "image/svg")

MISSING_PAGE: Final = b"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>iris-session</title>
<h1>iris-session: the page is not built</h1>
<p>The session runs, and this gateway answers. Only the page is missing in this installation.</p>
<p>It was installed from a checkout in which the page was not built. Run <code>make web</code> there, then
<code>pip install '.[web]'</code> again (not needed if you run it from the checkout, or installed it with
<code>-e</code>), and load this address again. A released wheel contains the page.</p>
</html>
"""


class PageFile(NamedTuple):
    """A file of the page: content, type, entity tag, and whether it never changes."""

    data: bytes
    content_type: str
    tag: str
    immutable: bool


def describe_missing_page(folder: Path = PAGE_FOLDER) -> str:
    """Return a remark for people where the page is not built, to follow its address; else nothing."""
    missing = " (the page is missing: run `make web` in the checkout; if not installed with -e, install it again)"
    return "" if (folder / INDEX).exists() else missing


class PageFiles:
    """Files of the page by path, read into memory when the page is first requested, and again after it was built."""

    def __init__(self, folder: Path = PAGE_FOLDER) -> None:
        self._folder = folder
        self._signature: tuple[int, int] | None = None
        self._files: dict[str, PageFile] = {}

    def find(self, path: str) -> PageFile | None:
        """Return the file for the path of a request (`/` is the index), `None` without one."""
        if path in ("/", f"/{INDEX}"):
            self._refresh()
            return self._files.get(INDEX, _make_file(INDEX, MISSING_PAGE))
        return self._files.get(path.removeprefix("/"))

    def _refresh(self) -> None:
        """Read the files if the page was built since."""
        try:
            status = (self._folder / INDEX).stat()
        except OSError:
            self._signature, self._files = None, {}
            return
        signature = status.st_mtime_ns, status.st_size
        if signature == self._signature:
            return
        try:
            self._files = _read_folder(self._folder)
        except OSError:  # it is being built: the next request reads it
            return
        self._signature = signature


def _read_folder(folder: Path) -> dict[str, PageFile]:
    files, total = {}, 0
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink():
            total += path.stat().st_size
            if total > MAX_PAGE_BYTES:
                break
            name = path.relative_to(folder).as_posix()
            files[name] = _make_file(name, path.read_bytes())
    return files


def _make_file(name: str, data: bytes) -> PageFile:
    suffix = Path(name).suffix
    kind = _TYPES.get(suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"
    if kind.startswith(_TEXT):
        kind += "; charset=utf-8"
    return PageFile(data, kind, f'"{hashlib.sha256(data).hexdigest()[:32]}"', bool(_HASHED.search(name)))
