"""Journal of a session: header, one row per step, keyframes, and the checks that identify changes. Pure.

A step is `(now_ns, entries, n_ticks)`; its row also holds the digest of the step's result and a hash chained over all
rows. Every field and every entry has its own CRC-32, so that damage is attributed to a field or an entry even if the
bytes no longer decode. CRCs detect accidents; the chain detects rows that were left out, moved or rewritten.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Sequence
from typing import Final

import msgspec

from iris_session.protocol.common import Count, Name, Nanoseconds, Pose
from iris_session.protocol.entries import Entry, encode_entry
from iris_session.protocol.server_messages import BodyInfo
from iris_session.protocol.specs import ObjectSpec, RobotSpec

#: Format of recordings. It changes with the meaning of rows, snapshots or their simulation.
FORMAT: Final = 5
#: Formats that are read, verified and resumed. Rows of format 4 all have whole digests, and none are packed.
READ_FORMATS: Final = (4, FORMAT)
#: The newest iris-session that verifies and resumes recordings of an earlier format. Format 4 came with the control law
#: that holds from measured joints.
VERIFIERS: Final = {3: "iris-session 0.1.0 at commit 90b3e12"}
CLOSED: Final = "closed"  # all code is part of iris-session: re-simulated bit for bit
OPEN: Final = "open"  # a user loop or a real robot: the plant's state comes from the rows
HASH_BYTES: Final = 16
#: Bytes that a quiet row keeps of its digest. A step that differs is missed by these alone once in 16 million times,
#: and its difference persists: the following steps differ too, and a keyframe compares the whole state.
QUIET_DIGEST_BYTES: Final = 3
#: Largest MuJoCo model that is read from a recording, uncompressed.
MAX_MODEL_BYTES: Final = 1 << 30
#: `JournalRow.digest` of a step that raised an error: it has no result, and no step follows.
CRASHED: Final = b""
#: `JournalRow.entries` of a step that nothing came in for.
NO_ENTRIES: Final = b"\x90"

#: Fields of a row with a CRC of their own, in the order of `JournalRow.field_crcs`. `entry_index` is the array header
#: of `entries` with `entry_lengths` and `entry_crcs`.
FIELDS: Final = ("step", "now_ns", "n_ticks", "digest", "plant", "entry_index")

_STEP = struct.Struct("<qqq")
_encoder = msgspec.msgpack.Encoder()


class Continues(msgspec.Struct, frozen=True):
    """Point that a resumed session continues: the state after `step` of the recording whose first file is `file`.

    `chain`: that of the row (the root chain if no step was taken). `file`: name in the same folder.
    """

    file: str
    step: int
    chain: bytes


class Settings(msgspec.Struct, frozen=True):
    """Settings of the recording process, not of the simulation, which a resumed session adopts.

    `state_hz`: rate of state frames [Hz]. `keyframe_s`: interval of keyframes [s]. `realtime`: a real-time priority was
    requested. `adapt_media`: slow links receive fewer media frames. `anchor_sizes`: edge of the printed sheets [m].
    `anchor_marks`: positions of their marks in the anchor frame [m]. `record_clouds_hz`: rate of point clouds and
    pictures in the recording [Hz]. `record_assets`, `record_budget_bytes`: as in `SessionConfig`.
    """

    state_hz: float
    keyframe_s: float
    realtime: bool
    adapt_media: bool = True
    anchor_sizes: dict[str, float] = {}
    anchor_marks: dict[str, dict[str, tuple[float, float, float]]] = {}
    record_clouds_hz: float = 2.0
    record_assets: str = "scene"
    record_budget_bytes: int = 0


class SessionHeader(msgspec.Struct, frozen=True):
    """Header of a recording: all that is needed to understand and re-simulate it. Holds no key, secret or token.

    `recording_class`: `closed` or `open`. `config`: the session's configuration as its composer encodes it. `model`:
    `pack_model` of the MuJoCo model's binary form (mjb). `bodies`: the streamed bodies in the order of state poses.
    `versions`: of Python, the libraries and the platform, see `environment.py`. `continues`: the recording that this
    one continues, None for the first of a session. `origin_ns`, `boot_id`: session time zero on CLOCK_MONOTONIC, and
    the boot of the machine that this clock belongs to. `anchors`: `T_world_anchor` of each sheet that headsets are
    aligned to. `settings`: None if not recorded. `origin_utc_ns`: session time zero since 1970-01-01 UTC [ns], by the
    clock of the machine when the recording began; 0 if not recorded.
    """

    session_id: Name
    session_name: Name
    recording_class: Name
    tick_period_ns: Nanoseconds
    config: bytes = b""
    model: bytes = b""
    scene_hash: Name = ""
    robots: tuple[RobotSpec, ...] = ()
    objects: tuple[ObjectSpec, ...] = ()
    bodies: tuple[BodyInfo, ...] = ()
    versions: dict[str, str] = {}
    created_utc: str = ""
    format: int = FORMAT
    continues: Continues | None = None
    origin_ns: int = 0
    boot_id: str = ""
    anchors: dict[str, Pose] = {}
    settings: Settings | None = None
    origin_utc_ns: int = 0

    @property
    def begins_after(self) -> int:
        """The step before the first row: -1, or the step that a resumed session continues."""
        return -1 if self.continues is None else self.continues.step


class JournalRow(msgspec.Struct, frozen=True, array_like=True):
    """One step. Make it with `make_row`.

    `entries`: MessagePack array of `iris_session.protocol.entries.Entry`; `entry_lengths` and `entry_crcs`: bytes and
    CRC-32 of each. `plant`: in class `open`, the plant's `mjSTATE_INTEGRATION` at the start of this step. `digest`:
    16 bytes over the whole result of the step, fewer in a quiet row, or `CRASHED`. `chain`: 16 bytes over the previous
    row's chain and this whole row.

    A row without entries and plant is quiet: of its digest it keeps the first `QUIET_DIGEST_BYTES`.
    """

    step: Count
    now_ns: Nanoseconds
    n_ticks: Count
    entries: bytes
    entry_lengths: tuple[int, ...]
    entry_crcs: tuple[int, ...]
    digest: bytes
    chain: bytes
    field_crcs: tuple[int, ...]
    plant: bytes = b""


class Keyframe(msgspec.Struct, frozen=True, array_like=True):
    """Snapshots after step `step`, from which the session can be restored.

    `step` -1: the initial state. `status`: the control report that the authority receives in the next step, as its
    composer encodes it. `chain` (of row `step`) and `crcs` (see `SNAPSHOTS`) are filled in by `seal_keyframe`.
    """

    step: int
    plant: bytes
    authority: bytes
    controller: bytes
    status: bytes = b""
    chain: bytes = b""
    crcs: tuple[int, ...] = ()


#: The snapshots of a keyframe, in the order of `Keyframe.crcs`; a last CRC is that of `step` and `chain`.
SNAPSHOTS: Final = ("plant", "authority", "controller", "status")


class RowProblem(msgspec.Struct, frozen=True):
    """A change found in a row. `entry`: index of the changed entry, -1 if it is not an entry."""

    step: int
    field: str
    text: str
    entry: int = -1


def header_root(header: SessionHeader) -> bytes:
    """Return the chain value before the first row: 16 bytes that bind the rows to this header."""
    return blob_root(_encoder.encode(header))


def blob_root(blob: bytes) -> bytes:
    """Return `header_root` of an encoded header, also of one with fewer fields than this version writes."""
    return hashlib.blake2b(blob, digest_size=HASH_BYTES).digest()


def seal_blob(blob: bytes) -> bytes:
    """Return `blob` preceded by its CRC-32 (4 bytes, little-endian)."""
    return zlib.crc32(blob).to_bytes(4, "little") + blob


def open_blob(sealed: bytes) -> tuple[bytes, bool]:
    """Return the blob of `seal_blob`, and whether its CRC-32 is correct."""
    blob = sealed[4:]
    return blob, zlib.crc32(blob).to_bytes(4, "little") == sealed[:4]


def pack_model(mjb: bytes) -> bytes:
    """Compress a binary MuJoCo model for `SessionHeader.model`."""
    return zlib.compress(mjb, 6)


def unpack_model(packed: bytes) -> bytes:
    """Decompress the result of `pack_model`, at most `MAX_MODEL_BYTES`.

    Raises `zlib.error` for damaged bytes, and for a model above the limit: a foreign file must not use up the memory.
    """
    decompressor = zlib.decompressobj()
    mjb = decompressor.decompress(packed, MAX_MODEL_BYTES)
    if not decompressor.eof:
        large = len(mjb) >= MAX_MODEL_BYTES
        raise zlib.error(f"the model has more than {MAX_MODEL_BYTES >> 20} MiB" if large else "the model is cut")
    return mjb


def array_header(n: int) -> bytes:
    """Return the MessagePack header of an array of `n` items."""
    if n < 16:
        return bytes((0x90 | n,))
    return struct.pack(">BH", 0xDC, n) if n < 65536 else struct.pack(">BI", 0xDD, n)


def make_row(
    prev_chain: bytes,
    step: int,
    now_ns: int,
    n_ticks: int,
    entries: Sequence[Entry],
    digest: bytes,
    plant: bytes = b"",
) -> JournalRow:
    """Return the row of one step. `prev_chain`: `chain` of the previous row, `header_root(header)` for the first.

    `digest`: the whole one; a quiet row keeps its beginning.
    """
    if entries:
        encoded = [encode_entry(entry) for entry in entries]
        head = array_header(len(encoded))
        blob = head + b"".join(encoded)
        lengths, crcs = tuple(map(len, encoded)), tuple(map(zlib.crc32, encoded))
    else:
        head = blob = NO_ENTRIES
        lengths = crcs = ()
        digest = digest if plant else digest[:QUIET_DIGEST_BYTES]
    ints = _STEP.pack(step, now_ns, n_ticks)
    field_crcs = _field_crcs(ints, digest, plant, head, lengths, crcs)
    chain = _chain(prev_chain, ints, blob, digest, plant, (*lengths, *crcs, *field_crcs))
    return JournalRow(step, now_ns, n_ticks, blob, lengths, crcs, digest, chain, field_crcs, plant)


def is_quiet(row: JournalRow) -> bool:
    """Return whether a row is quiet: it has no entries and no plant, and keeps the beginning of its digest."""
    return len(row.digest) == QUIET_DIGEST_BYTES and not row.plant and row.entries == NO_ENTRIES


def is_result(row: JournalRow, digest: bytes) -> bool:
    """Return whether `digest`, that of a step taken again, is the one of `row`, as far as the row keeps it."""
    return row.digest == (digest[:QUIET_DIGEST_BYTES] if is_quiet(row) else digest)


def check_row(prev_chain: bytes, row: JournalRow) -> RowProblem | None:
    """Return the changed field or entry of `row`; None if it is as written after the row with `prev_chain`."""
    if compute_chain(prev_chain, row) == row.chain:
        return None
    problem = _field_problem(prev_chain, row) or _entry_problem(row)
    if problem is not None:
        return problem
    text = "the chain does not continue: its own value was changed, or rows before it were left out, moved or rewritten"
    return RowProblem(row.step, "chain", text)


def check_fields(row: JournalRow) -> RowProblem | None:
    """Check a row like `check_row` but without the chain, if its predecessor is missing."""
    return _field_problem(None, row) or _entry_problem(row)


def seal_keyframe(keyframe: Keyframe, chain: bytes) -> Keyframe:
    """Return `keyframe` with the chain value of its row and its CRCs."""
    return msgspec.structs.replace(keyframe, chain=chain, crcs=_keyframe_crcs(keyframe, chain))


def check_keyframe(keyframe: Keyframe) -> str:
    """Return the name of the first field that differs from its CRC, empty if all are as written."""
    now = _keyframe_crcs(keyframe, keyframe.chain)
    if len(keyframe.crcs) != len(now):
        return "crcs"
    changed = [name for name, a, b in zip((*SNAPSHOTS, "step"), now, keyframe.crcs, strict=True) if a != b]
    return changed[0] if changed else ""


def _keyframe_crcs(keyframe: Keyframe, chain: bytes) -> tuple[int, ...]:
    snapshots = (zlib.crc32(getattr(keyframe, name)) for name in SNAPSHOTS)
    return (*snapshots, zlib.crc32(chain, zlib.crc32(_packed((keyframe.step,)))))


def compute_chain(prev_chain: bytes, row: JournalRow, field_crcs: tuple[int, ...] | None = None) -> bytes:
    """Return the correct chain value of `row`, to continue checking after a row whose `chain` was changed.

    `field_crcs`: in place of its own.
    """
    numbers = (*row.entry_lengths, *row.entry_crcs, *(row.field_crcs if field_crcs is None else field_crcs))
    ints = _STEP.pack(row.step, row.now_ns, row.n_ticks)
    return _chain(prev_chain, ints, row.entries, row.digest, row.plant, numbers)


def _chain(prev_chain: bytes, ints: bytes, blob: bytes, digest: bytes, plant: bytes, numbers: tuple[int, ...]) -> bytes:
    parts = (prev_chain, ints, digest, _packed(numbers), blob, plant)
    return hashlib.blake2b(b"".join(parts), digest_size=HASH_BYTES).digest()


def _packed(numbers: tuple[int, ...]) -> bytes:
    """Pack numbers as int64. Larger ones, made by damage, fit no checksum either, so their encoding does not matter."""
    try:
        return struct.pack(f"<{len(numbers)}q", *numbers)
    except struct.error:
        return repr(numbers).encode()


def _field_crcs(
    ints: bytes, digest: bytes, plant: bytes, head: bytes, lengths: tuple[int, ...], crcs: tuple[int, ...]
) -> tuple[int, ...]:
    """Return the CRCs of `FIELDS`. `ints`: step, now_ns, n_ticks as three int64."""
    crc = zlib.crc32
    index = head if not lengths else head + _packed((*lengths, *crcs))
    return (crc(ints[:8]), crc(ints[8:16]), crc(ints[16:]), crc(digest), crc(plant), crc(index))


def _field_problem(prev_chain: bytes | None, row: JournalRow) -> RowProblem | None:
    head_bytes = max(0, len(row.entries) - sum(row.entry_lengths))
    head = row.entries[:head_bytes]
    ints = _STEP.pack(row.step, row.now_ns, row.n_ticks)
    now = _field_crcs(ints, row.digest, row.plant, head, row.entry_lengths, row.entry_crcs)
    if now == row.field_crcs:
        return None
    if prev_chain is not None and compute_chain(prev_chain, row, now) == row.chain:
        return RowProblem(row.step, "field_crcs", "the checksums of the fields were changed, the fields are intact")
    if len(row.field_crcs) != len(FIELDS):
        return RowProblem(row.step, "field_crcs", f"{len(row.field_crcs)} field checksums, expected {len(FIELDS)}")
    changed = [name for name, a, b in zip(FIELDS, now, row.field_crcs, strict=True) if a != b]
    if changed == ["entry_index"]:
        return _index_problem(row, head)
    return RowProblem(row.step, changed[0], f"field {', '.join(changed)} was changed")


def _index_problem(row: JournalRow, head: bytes) -> RowProblem:
    if len(row.entry_crcs) == len(row.entry_lengths) and head == array_header(len(row.entry_lengths)):
        for i, data in enumerate(_slices(row)):
            if zlib.crc32(data) != row.entry_crcs[i]:
                return RowProblem(row.step, "entry_crcs", f"the checksum or length of entry {i} was changed", i)
    return RowProblem(row.step, "entries", "the index of the entries (count, lengths, checksums) was changed")


def _entry_problem(row: JournalRow) -> RowProblem | None:
    for i, (data, crc) in enumerate(zip(_slices(row), row.entry_crcs, strict=False)):
        if zlib.crc32(data) != crc:
            return RowProblem(row.step, "entries", f"entry {i} was changed", i)
    return None


def _slices(row: JournalRow) -> list[bytes]:
    at = len(row.entries) - sum(row.entry_lengths)
    out = []
    for length in row.entry_lengths:
        out.append(row.entries[at : at + length])
        at += length
    return out
