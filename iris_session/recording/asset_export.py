"""Export of the assets of a recording into a folder, from which the scenes can be shown on any machine.

The folder is an asset store (`AssetStore`): each asset is a file that has its hash as its name. `scenes.json` lists the
scenes in order, each with the hash of its specification.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from iris_session.assets.store import AssetStore
from iris_session.recording.errors import RecordingError
from iris_session.recording.reader import Recording, check_assets
from iris_session.system.files import write_output

SCENES_FILE: Final = "scenes.json"
#: Nothing is removed from the folder to make room.
_NO_LIMIT: Final = 1 << 62


class AssetExportError(RecordingError):
    """The assets cannot be written to the given place, or there are none."""


class AssetExport(msgspec.Struct, frozen=True):
    """Result of an export.

    `folder`: the asset store. `scenes`, `assets`, `bytes`: how much is in it. `damage`: one line per asset that is
    damaged or missing. `left_out`: one line per asset that was not recorded.
    """

    folder: str
    scenes: int
    assets: int
    bytes: int
    damage: tuple[str, ...]
    left_out: tuple[str, ...]


def export_assets(
    recording: Recording,
    folder: str | Path,
    *,
    force: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> AssetExport:
    """Write the scenes of a recording and their assets into a folder.

    Args:
        recording: An open recording.
        folder: The folder; it is made if it does not exist.
        force: Write into a folder that is not empty.
        progress: Called with a text that says how far it is.

    Returns:
        What was written, and what is damaged or missing.

    Raises:
        AssetExportError: The folder is not empty or cannot be written, or the recording has no assets.
        NotARecordingError: A file can no longer be read.
    """
    root = Path(folder)
    found = check_assets(recording)
    summary = found.summarise()
    if not summary.present:
        why = "its session was to record none" if summary.recorded else "it has no word of them"
        raise AssetExportError(f"{recording.files[0]} holds no assets: {why}")
    try:
        if root.exists() and not root.is_dir():
            raise AssetExportError(f"{root} is no folder: give one that is empty or does not exist")
        if not force and root.exists() and any(root.iterdir()):
            raise AssetExportError(f"the folder {root} is not empty: give another one, or --force")
        store, n, n_bytes = AssetStore(root, _NO_LIMIT), 0, 0
        for address, data in recording.assets():
            store.find(address)  # removes a damaged file of an earlier export, which `put` would take for the asset
            store.put(data)
            n, n_bytes = n + 1, n_bytes + len(data)
            progress(f"{n:,} assets, {n_bytes / 1e6:.1f} MB")
        scenes = [{"step": one.step, "time_s": one.session_time * 1e-9, "hash": one.hash} for one in recording.scenes()]
        write_output(root / SCENES_FILE, json.dumps({"scenes": scenes}, indent=1).encode())
    except OSError as error:
        raise AssetExportError(f"{root} cannot be written: {error.strerror or error}") from error
    damage = (*recording.missing, *recording.damage, *found.list_problems(finished=recording.all_closed))
    return AssetExport(str(root), len(scenes), n, n_bytes, damage, summary.left_out)
