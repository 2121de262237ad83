"""The container of arrays: exact round trips, and one typed error at most for any bytes."""

from __future__ import annotations

import zlib
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from iris_session.protocol.assets import ARRAYS_MAGIC, ArrayHeader, ArrayInfo
from iris_session.scene import AssetDecodeError, decode_arrays, encode_arrays
from iris_session.scene.arrays import StoredArray

FILTERS = ("none", "shuffle", "delta", "up")


def asset(*infos: ArrayInfo, body: bytes = b"", kind: str = "mesh") -> bytes:
    header = msgspec.msgpack.encode(ArrayHeader(kind, infos))
    return ARRAYS_MAGIC + len(header).to_bytes(4, "little") + header + body


@given(
    st.sampled_from(["u1", "i1", "<u2", "<u4", "<f4"]),
    st.sampled_from(FILTERS),
    st.lists(st.integers(0, 9), min_size=1, max_size=3),
    st.integers(0, 2**32),
)
def test_every_filter_is_lossless(dtype: str, kind: str, shape: list[int], seed: int) -> None:
    if dtype == "<f4" and kind == "delta":
        return
    raw = np.random.default_rng(seed).bytes(int(np.prod(shape)) * np.dtype(dtype).itemsize)
    values: NDArray[Any] = np.frombuffer(raw, dtype).reshape(shape)
    back = decode_arrays(encode_arrays("mesh", [StoredArray("a", values, kind)]), "mesh")["a"]
    assert back.dtype == values.dtype
    assert back.shape == values.shape
    assert back.tobytes() == values.tobytes()


@given(st.binary(max_size=200))
def test_random_bytes_raise_asset_errors_only(data: bytes) -> None:
    for candidate in (data, ARRAYS_MAGIC + data, ARRAYS_MAGIC + len(data).to_bytes(4, "little") + data):
        with pytest.raises(AssetDecodeError):
            decode_arrays(candidate, "mesh")


HUGE = ArrayInfo("a", "f4", (2**40, 3), 4)
#: A stream with data after it.
PACKED = zlib.compress(bytes(30), wbits=-15) + b"more"


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (asset(HUGE, body=b"abcd"), "at most 1073741824"),
        (asset(ArrayInfo("a", "f8", (1,), 8), body=bytes(8)), "unknown dtype"),
        (asset(ArrayInfo("a", "u1", (4,), 4, "wavelet"), body=bytes(4)), "unknown filter"),
        (asset(ArrayInfo("a", "u1", (4,), 4, codec="lzma"), body=bytes(4)), "unknown compression"),
        (asset(ArrayInfo("a", "u1", (4,), 5), body=bytes(4)), "the header"),
        (asset(ArrayInfo("a", "u1", (4,), 3), body=bytes(3)), "need 4"),
        (asset(ArrayInfo("a", "u1", (1,), 1), ArrayInfo("a", "u1", (1,), 1), body=bytes(2)), "same name"),
        (asset(ArrayInfo("a", "u1", (2,), 2, scale=(1.0,), offset=(0.0,)), body=bytes(2)), "scale and offset"),
        (asset(ArrayInfo("a", "u1", (1,), 1, scale=(float("nan"),), offset=(0.0,)), body=b"a"), "not finite"),
        (asset(ArrayInfo("a", "u1", (1,), 1), body=b"a", kind="image"), "'mesh' is expected"),
        (asset(ArrayInfo("a", "u1", (9,), 3, codec="deflate"), body=b"\xff\xff\xff"), "damaged"),
        (asset(ArrayInfo("a", "u1", (30,), len(PACKED), codec="deflate"), body=PACKED), "not one stream"),
    ],
)
def test_malformed_assets_are_rejected_with_reason(data: bytes, text: str) -> None:
    with pytest.raises(AssetDecodeError, match=text):
        decode_arrays(data, "mesh")


def test_decompression_bomb_is_not_unpacked() -> None:
    bomb = zlib.compress(bytes(50_000_000), wbits=-15)
    with pytest.raises(AssetDecodeError, match="not one stream"):
        decode_arrays(asset(ArrayInfo("a", "u1", (100,), len(bomb), codec="deflate"), body=bomb), "mesh")
    honest = asset(ArrayInfo("a", "u1", (50_000_000,), len(bomb), codec="deflate"), body=bomb)
    with pytest.raises(AssetDecodeError, match="at most 1000"):
        decode_arrays(honest, "mesh", max_bytes=1_000)


def test_empty_array_may_not_be_endless_along_an_axis() -> None:
    for shape in ((0, 2**62), (2**62, 0), (0, 2**31, 2**31, 2**31)):
        with pytest.raises(AssetDecodeError, match="along an axis"):
            decode_arrays(asset(ArrayInfo("a", "f4", shape, 0)), "mesh")
    assert decode_arrays(asset(ArrayInfo("a", "f4", (0, 3), 0)), "mesh")["a"].shape == (0, 3)


def test_quantised_arrays_count_with_their_decoded_size() -> None:
    packed = zlib.compress(bytes(3_000), wbits=-15)
    info = ArrayInfo("a", "u1", (1_000, 3), len(packed), codec="deflate", scale=(1.0,) * 3, offset=(0.0,) * 3)
    with pytest.raises(AssetDecodeError, match="12000 bytes, at most 11999"):
        decode_arrays(asset(info, body=packed), "mesh", 11_999)
    assert decode_arrays(asset(info, body=packed), "mesh", 12_000)["a"].nbytes == 12_000
