"""Encode arrays to bytes and back: the container of `protocol.arrays`, filters and deflate. Layout in docs/scene.md.

Decoding is safe for untrusted bytes: it raises `AssetDecodeError` and nothing else, and allocates no more than the
header states, which is checked against a limit first.
"""

from __future__ import annotations

import itertools
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.assets import ARRAYS_MAGIC, MAX_ARRAY_BYTES, MAX_ARRAY_HEADER_BYTES, ArrayHeader, ArrayInfo
from iris_session.protocol.codec import make_decoder
from iris_session.protocol.names import ArrayCodec, ArrayFilter
from iris_session.scene.errors import AssetDecodeError, SceneBuildError

Array = NDArray[Any]
_DTYPES: Final = {name: np.dtype(f"<{name}") for name in ("u1", "i1", "u2", "u4", "f4")}
#: Bytes of a quantised number.
_SCALED: Final = 4
#: Rows of fewer bytes are summed by columns: the overhead of one call per row would dominate.
_SHORT_ROW: Final = 256
_PREFIX: Final = struct.Struct("<4sI")
_encoder: Final = msgspec.msgpack.Encoder()
_decode_header: Final = make_decoder(ArrayHeader)
#: Compression level: twice as fast as the default one, for 7 % more bytes (ALOHA).
LEVEL: Final = 1
#: Of zlib: deflate without header and checksum. Assets are addressed by their hash.
_RAW: Final = -zlib.MAX_WBITS


@dataclass(frozen=True)
class StoredArray:
    """One array as it is stored. `scale`, `offset`: of quantised values, see `ArrayInfo`."""

    name: str
    values: Array
    filter: str = ArrayFilter.NONE
    scale: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()


def encode_arrays(kind: str, arrays: Sequence[StoredArray], max_error: float = 0.0) -> bytes:
    """Return the asset of some arrays. Arrays that do not shrink are stored uncompressed."""
    infos, bodies = [], []
    for array in arrays:
        values = np.ascontiguousarray(array.values)
        plain = apply_filter(values, array.filter)
        packed: bytes | memoryview = zlib.compress(plain, LEVEL, wbits=_RAW)
        codec = ArrayCodec.DEFLATE
        if len(packed) >= len(plain):
            packed, codec = plain, ArrayCodec.NONE
        dtype = values.dtype.str.lstrip("<|")
        infos.append(
            ArrayInfo(array.name, dtype, values.shape, len(packed), array.filter, codec, array.scale, array.offset)
        )
        bodies.append(packed)
    header = _encoder.encode(ArrayHeader(kind, tuple(infos), max_error))
    return b"".join((_PREFIX.pack(ARRAYS_MAGIC, len(header)), header, *bodies))


def decode_arrays(
    data: bytes | bytearray | memoryview, kind: str, max_bytes: int = MAX_ARRAY_BYTES
) -> dict[str, Array]:
    """Return the arrays of an asset by name, quantised ones as float32. `max_bytes`: limit of all decoded arrays
    together.
    """
    header, start = read_header(data)
    if header.kind != kind:
        raise AssetDecodeError(f"an asset of kind {header.kind!r}, where {kind!r} is expected")
    total = sum(
        _count_bytes(info) * (_SCALED // _DTYPES[info.dtype].itemsize if info.scale else 1) for info in header.arrays
    )
    if total > max_bytes:
        raise AssetDecodeError(f"arrays of {total} bytes, at most {max_bytes} are read")
    view, found = memoryview(data), {}
    for info in header.arrays:
        found[info.name] = _apply_scale(info, _decode_array(info, view[start : start + info.bytes]))
        start += info.bytes
    return found


def read_header(data: bytes | bytearray | memoryview) -> tuple[ArrayHeader, int]:
    """Return the header, and the offset of the first array. The lengths in it fit `data` exactly."""
    if len(data) < _PREFIX.size:
        raise AssetDecodeError(f"{len(data)} bytes are no asset of arrays")
    magic, length = _PREFIX.unpack_from(data)
    if magic != ARRAYS_MAGIC:
        raise AssetDecodeError(f"no asset of arrays: it begins with {bytes(magic)!r}, not {ARRAYS_MAGIC!r}")
    start = _PREFIX.size + length
    if length > MAX_ARRAY_HEADER_BYTES or start > len(data):
        raise AssetDecodeError(
            f"a header of {length} bytes in an asset of {len(data)}, at most {MAX_ARRAY_HEADER_BYTES}"
        )
    try:
        header = _decode_header(memoryview(data)[_PREFIX.size : start])
    except msgspec.DecodeError as error:
        raise AssetDecodeError(f"header of an asset: {error}") from None
    if start + sum(info.bytes for info in header.arrays) != len(data):
        raise AssetDecodeError("the lengths in the header are not those of the asset")
    if len({info.name for info in header.arrays}) != len(header.arrays):
        raise AssetDecodeError("two arrays of the same name")
    return header, start


def require_array(arrays: Mapping[str, Array], name: str, dtypes: str, shape: Sequence[int | None]) -> Array:
    """Return the array `name`, whose dtype must be one of `dtypes` (`u2 u4`) and whose shape must fit (`None`: any
    length).
    """
    array = arrays.get(name)
    if array is None:
        raise AssetDecodeError(f"the array {name!r} is missing; there are {', '.join(sorted(arrays)) or 'none'}")
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if array.dtype.str.lstrip("<|") not in dtypes.split() or not fits:
        raise AssetDecodeError(
            f"the array {name!r} is {array.dtype.str} {array.shape}, expected {dtypes} {tuple(shape)}"
        )
    return array


# --- filters ---------------------------------------------------------------------------------------------------------


def apply_filter(values: Array, kind: str) -> memoryview:
    """Return the filtered bytes of an array in C order, to be compressed."""
    if kind == ArrayFilter.NONE or not values.size:
        return _encode_bytes(values)
    if kind == ArrayFilter.UP:
        rows = values.reshape(values.shape[0], -1).view(np.uint8)
        up = rows.copy()
        np.subtract(rows[1:], rows[:-1], up[1:])
        return _encode_bytes(up)
    flat = values.reshape(-1)
    if kind == ArrayFilter.DELTA:
        delta = flat.copy()
        np.subtract(flat[1:], flat[:-1], delta[1:])
        flat = delta
    return _encode_bytes(np.ascontiguousarray(flat.view(np.uint8).reshape(-1, values.dtype.itemsize).T))


def _encode_bytes(values: Array) -> memoryview:
    return values.reshape(-1).view(np.uint8).data


def _undo_filter(info: ArrayInfo, plain: bytes | memoryview) -> Array:
    dtype = _DTYPES[info.dtype]
    if info.filter == ArrayFilter.NONE:
        return np.frombuffer(plain, dtype).reshape(info.shape)
    if info.filter == ArrayFilter.UP:
        rows = np.frombuffer(plain, np.uint8).reshape(info.shape[0], -1).copy()
        if rows.shape[1] < _SHORT_ROW:
            np.cumsum(rows, axis=0, dtype=np.uint8, out=rows)
        else:
            for above, row in itertools.pairwise(rows):  # faster than one accumulate: whole rows vectorise
                np.add(above, row, row)
        return rows.view(dtype).reshape(info.shape)
    flat = np.empty(math.prod(info.shape), dtype)
    planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
    target = flat.view(np.uint8).reshape(-1, dtype.itemsize)
    for k in range(dtype.itemsize):  # faster than one transposing copy
        target[:, k] = planes[k]
    if info.filter == ArrayFilter.DELTA:
        np.cumsum(flat, out=flat, dtype=dtype)
    return flat.reshape(info.shape)


def _count_bytes(info: ArrayInfo) -> int:
    if info.dtype not in _DTYPES:
        raise AssetDecodeError(f"unknown dtype {info.dtype!r}, known: {', '.join(_DTYPES)}")
    size = math.prod(info.shape)
    if not size and max(info.shape) > MAX_ARRAY_BYTES:  # not even an empty array can have this shape
        raise AssetDecodeError(
            f"array {info.name!r} has the shape {info.shape}, at most {MAX_ARRAY_BYTES} along an axis"
        )
    return size * _DTYPES[info.dtype].itemsize


def _decode_array(info: ArrayInfo, packed: memoryview) -> Array:
    if info.filter not in (ArrayFilter.NONE, ArrayFilter.SHUFFLE, ArrayFilter.DELTA, ArrayFilter.UP):
        raise AssetDecodeError(f"unknown filter {info.filter!r}")
    if info.filter == ArrayFilter.DELTA and info.dtype == "f4":
        raise AssetDecodeError("differences of float32 are not exact")
    size = _count_bytes(info)
    plain: bytes | memoryview
    if info.codec == ArrayCodec.DEFLATE:
        plain = _inflate(packed, size)
    elif info.codec == ArrayCodec.NONE:
        plain = packed
    else:
        raise AssetDecodeError(f"unknown compression {info.codec!r}")
    if len(plain) != size:
        raise AssetDecodeError(f"array {info.name!r} has {len(plain)} bytes, its shape and dtype need {size}")
    if not size:
        return np.zeros(info.shape, _DTYPES[info.dtype])
    return _undo_filter(info, plain)


def _inflate(packed: memoryview, size: int) -> bytes:
    inflater = zlib.decompressobj(_RAW)
    try:
        plain = inflater.decompress(packed, size + 1)  # room to see that there is more than was asked for
    except zlib.error as error:
        raise AssetDecodeError(f"damaged bytes of an array: {error}") from None
    if len(plain) != size or not inflater.eof or inflater.unused_data:
        raise AssetDecodeError(f"the bytes of an array are not one stream of {size} bytes")
    return plain


def _apply_scale(info: ArrayInfo, stored: Array) -> Array:
    if not info.scale:
        return stored
    last = info.shape[-1]
    if len(info.scale) != last or len(info.offset) != last:
        raise AssetDecodeError(f"array {info.name!r}: scale and offset need {last} values each")
    if not np.isfinite((*info.scale, *info.offset)).all():
        raise AssetDecodeError(f"array {info.name!r}: scale and offset are not finite")
    values = np.empty(stored.shape, np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(last):  # twice as fast as rows of two or three at once
            np.multiply(stored[..., k], np.float32(info.scale[k]), out=values[..., k], dtype=np.float32)
            values[..., k] += np.float32(info.offset[k])
    return values


def to_array(values: Any, what: str) -> NDArray[Any]:
    """Return an argument as an array. Raises `SceneBuildError` for others, such as rows of different lengths."""
    try:
        return np.asarray(values)
    except (TypeError, ValueError) as error:
        raise SceneBuildError(f"{what}: no array: {error}") from None
