"""Raw deflate of zlib for the tests of the C# decoder: contents of all kinds, levels, strategies; damaged streams."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Iterator

STRATEGIES = (zlib.Z_DEFAULT_STRATEGY, zlib.Z_FILTERED, zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE, zlib.Z_FIXED)


def make_contents(rng: random.Random) -> dict[str, bytes]:
    """Return contents whose streams use every kind of block and of codes."""
    words = [bytes(rng.choices(range(97, 123), k=rng.randint(2, 9))) for _ in range(300)]
    text = b" ".join(rng.choices(words, weights=range(300, 0, -1), k=60_000))
    floats = struct.pack("<8000f", *(0.1 * i + rng.gauss(0.0, 0.01) for i in range(8000)))
    noise = rng.randbytes(300_000)
    skewed = bytes(min(255, int(rng.expovariate(0.05))) for _ in range(200_000))
    far = noise[:150_000] + text[:100_000] + noise[:150_000]
    return {
        "empty": b"",
        "one": b"x",
        "short": b"hello, hello, hello",
        "run": bytes(400_000),
        "noise": noise[:140_000],
        "text": text,
        "floats": floats,
        "skewed": skewed,
        "far match": far,
        "long matches": text[:3000] * 90,
        "records": b"".join(struct.pack("<IHBB", i, rng.choice((7, 9, 11)), 3, i & 1) for i in range(20_000)),
        "255": text[:255],
        "256": text[:256],
        "65791": text[:65_791],
        "65792": text[:65_792],
        "sparse": bytes(rng.choice(b"\0\0\0\0\0\0\0\1") for _ in range(50_000)),
    }


def compress(content: bytes, level: int, strategy: int = zlib.Z_DEFAULT_STRATEGY, flushes: int = 0) -> bytes:
    """Return raw deflate of a content, in parts with stored blocks of no length between them if flushed."""
    compressor = zlib.compressobj(level, wbits=-zlib.MAX_WBITS, strategy=strategy)
    step = len(content) // (flushes + 1) + 1
    parts = [
        compressor.compress(content[at : at + step]) + compressor.flush(zlib.Z_FULL_FLUSH if flushes else zlib.Z_BLOCK)
        for at in range(0, len(content), step)
    ]
    return b"".join(parts) + compressor.flush()


def inflate(stream: bytes, size: int) -> bytes | None:
    """Return the content of one stream of just this size, else None."""
    decompressor = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        content = decompressor.decompress(stream, size + 1)
    except zlib.error:
        return None
    return content if len(content) == size and decompressor.eof and not decompressor.unused_data else None


def make_dynamic_block(
    widths: dict[int, int], symbols: list[tuple[int, int]], length_count: int = 257, code: str = "01"
) -> bytes:
    """Return a block with codes of its own, whose content is `AAA`.

    `widths`: of the codes of code lengths, by symbol. `symbols`: code lengths and repetitions with their extra bits.
    `code`: bits of A, then of the end of the block, as many each.
    """
    order = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)
    codes, next_code = {}, 0
    for width in range(1, 8):
        for symbol in sorted(widths):
            if widths[symbol] == width:
                codes[symbol] = format(next_code, f"0{width}b")
                next_code += 1
        next_code <<= 1
    half = len(code) // 2
    bits = "1" + "01" + f"{length_count - 257:05b}"[::-1] + "00000" + f"{19 - 4:04b}"[::-1]
    bits += "".join(f"{widths.get(symbol, 0):03b}"[::-1] for symbol in order)
    extra = {16: 2, 17: 3, 18: 7}
    for symbol, more in symbols:
        bits += codes[symbol] + (f"{more:0{extra[symbol]}b}"[::-1] if symbol in extra else "")
    bits += 3 * code[:half] + code[half:]
    bits += "0" * (-len(bits) % 8)
    return bytes(int(bits[at : at + 8][::-1], 2) for at in range(0, len(bits), 8))


def list_headers() -> Iterator[bytes]:
    """Yield streams with the content `AAA`: a good one, and some whose codes are not as they must be."""
    widths = {1: 1, 18: 2, 0: 2}
    a, b = (
        [(18, 65 - 11), (1, 0), (18, 127), (18, 52 - 11), (1, 0)],
        [(18, 65 - 11), (2, 0), (18, 127), (18, 52 - 11), (2, 0)],
    )
    yield make_dynamic_block(widths, [*a, (1, 0)])
    yield make_dynamic_block(widths, [*a, (0, 0)])  # no distances
    yield make_dynamic_block({1: 2, 18: 2, 0: 2}, [*a, (1, 0)])  # a sequence of bits without meaning
    yield make_dynamic_block({2: 1, 18: 2, 0: 2}, [*b, (0, 0)], code="0001")  # the same of literals
    yield make_dynamic_block(widths, [*a, (18, 30 - 11), (1, 0)], 287)  # too many lengths
    yield make_dynamic_block(widths, [*a, (18, 0)])  # a repetition beyond the last one
    yield make_dynamic_block(widths, [*a[:-1], (0, 0), (1, 0)])  # no end


def list_streams(rng: random.Random) -> Iterator[tuple[bytes, bytes]]:
    """Yield streams and their contents."""
    contents = make_contents(rng)
    for content in contents.values():
        yield from ((compress(content, level), content) for level in (0, 1, 6, 9))
        yield from ((compress(content, 6, strategy), content) for strategy in STRATEGIES[1:])
        yield compress(content, 6, flushes=3), content
    short = contents["text"][:20_000]
    yield from ((compress(short, level, strategy), short) for level in range(10) for strategy in STRATEGIES)


def render_deflate_vectors(seed: int = 1, damaged: int = 2000) -> bytes:
    """Return the number of contents u32, length u32 and bytes of each; then of every stream the number of its content
    (2^32 - 1: it must be refused), the size that is asked for, its length, all u32, and its bytes.
    """
    rng = random.Random(seed)
    vectors: list[tuple[bytes, bytes | None, int]] = []
    vectors += ((stream, content, len(content)) for stream, content in list_streams(rng))
    vectors += ((stream, inflate(stream, 3), 3) for stream in list_headers())
    # Short ones with codes of their own: most of their bytes say which.
    pieces = [
        content[at : at + rng.randrange(300, 2000)] for content in make_contents(rng).values() for at in (0, 5000)
    ]
    sources = [(compress(piece, 6), piece) for piece in pieces if piece]
    for _ in range(damaged):
        stream, content = rng.choice(sources)
        bad = bytearray(stream)
        for _ in range(rng.choice((1, 1, 1, 2, 5))):
            bad[rng.randrange(min(len(bad), rng.choice((3, 64, 3000))))] ^= 1 << rng.randrange(8)
        vectors.append((bytes(bad), inflate(bytes(bad), len(content)), len(content)))
    contents = list(dict.fromkeys(content for _, content, _ in vectors if content is not None))
    numbers = {content: i for i, content in enumerate(contents)}
    parts = [struct.pack("<I", len(contents))]
    parts += [struct.pack("<I", len(content)) + content for content in contents]
    for stream, wanted, size in vectors:
        number = 0xFFFFFFFF if wanted is None else numbers[wanted]
        parts.append(struct.pack("<III", number, size, len(stream)) + stream)
    return b"".join(parts)
