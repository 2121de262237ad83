"""Short run of `tools/fuzz.py`, and proof that it finds faults. Long runs: docs/evidence/fuzzing.md."""

from __future__ import annotations

import sys
from pathlib import Path
from random import Random
from typing import Any

import pytest

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

import fuzz  # noqa: E402
from fuzz_decoders import DECODERS, Decoder, encoded  # noqa: E402

from iris_session.protocol.common import Lease  # noqa: E402


@pytest.mark.parametrize("target", sorted(DECODERS))
def test_decoders_raise_only_documented_errors(target: str) -> None:
    result = fuzz.fuzz(target, 1000, seed=11)
    assert result.findings == []
    assert 0 < result.accepted < result.inputs == 1000


@pytest.mark.parametrize(
    ("target", "inputs"),
    [("connection", 4000), ("state-stream", 1500), ("core", 1500), ("asset-loader", 2000), ("web-hub", 2000)],
)
def test_random_conversations_keep_state_machines_consistent(target: str, inputs: int) -> None:
    result = fuzz.fuzz(target, inputs, seed=11)
    assert result.findings == []
    assert result.inputs == inputs


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("target", "inputs"), [("front", 10_000), ("front-tcp", 2000), ("front-media", 4000), ("front-assets", 4000)]
)
def test_hostile_peers_do_not_stop_the_front(target: str, inputs: int) -> None:
    """Valid and damaged messages of every type, and damaged handshakes, over real sockets."""
    result = fuzz.fuzz(target, inputs, seed=11)
    assert result.findings == []
    assert result.inputs == inputs


@pytest.mark.long
@pytest.mark.e2e
def test_hostile_browsers_do_not_stop_the_gateway() -> None:
    """WebSocket messages, bytes of WebSockets and requests at a real gateway of a real session."""
    result = fuzz.fuzz("web-gateway", 500, seed=11)
    assert result.findings == []
    assert result.inputs == 500


def test_seed_reproduces_inputs() -> None:
    first, second, other = (DECODERS["client"](Random(seed)) for seed in ("1", "1", "2"))
    made = [first.make() for _ in range(500)]
    assert made == [second.make() for _ in range(500)]
    assert made != [other.make() for _ in range(500)]


def test_finding_is_reported_saved_and_exits_with_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def decode(data: bytes) -> Any:
        if b"robot" in data:
            raise IndexError("planted")
        raise ValueError

    def planted(rng: Random) -> Decoder:
        return Decoder(rng, [lambda rng: encoded(rng, Lease)], decode, (ValueError,))

    monkeypatch.setitem(fuzz.TARGETS, "planted", planted)
    monkeypatch.setattr(sys, "argv", ["fuzz.py", "--target", "planted", "--inputs", "500", "--save", str(tmp_path)])
    assert fuzz.main() == 1
    (found,) = fuzz.fuzz("planted", 500, 1, tmp_path).findings
    assert "IndexError" in found["text"]
    assert b"robot" in Path(found["saved"]).read_bytes()
