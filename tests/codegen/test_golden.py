"""docs/protocol/golden.json is complete and round-trips; the reference payload equals that of the encoder."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from anchors.pose import Quat, Vec3, quat_normalize, quat_rotate
from iris_session.protocol import codec
from iris_session.protocol.assets import AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.client_messages import ClientEnvelope
from iris_session.protocol.discovery import Beacon
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.media import MediaHeader, MediaPush
from iris_session.protocol.server_messages import Presence, RobotStates, ServerEnvelope, StateHeader
from iris_session.streams.rigid import RigidDecoder, RigidEncoder
from tests.streams.poses import random_poses
from tools.codegen import rigid_reference
from tools.codegen.conversions import from_three, from_unity, to_three, to_unity

GOLDEN = json.loads((Path(__file__).parents[2] / "docs" / "protocol" / "golden.json").read_text())

#: Section -> type, encoder, decoder.
CODECS: dict[str, tuple[Any, Any, Any]] = {
    "client": (ClientEnvelope, codec.encode_client, codec.decode_client),
    "server": (ServerEnvelope, codec.encode_server, codec.decode_server),
    "state_header": (StateHeader, codec.encode_state_header, codec.decode_state_header),
    "presence": (Presence, codec.encode_presence, codec.decode_presence),
    "robot_states": (RobotStates, codec.encode_robot_states, codec.decode_robot_states),
    "media_header": (MediaHeader, codec.encode_media_header, codec.decode_media_header),
    "media_push": (MediaPush, codec.encode_media_push, codec.decode_media_push),
    "asset_request": (AssetRequest, codec.encode_asset_request, codec.decode_asset_request),
    "asset_chunk": (AssetChunk, codec.encode_asset_header, lambda data: codec.decode_asset_chunk(data, 0)),
    "asset_refused": (AssetRefused, codec.encode_asset_header, codec.decode_asset_refused),
    "beacon": (Beacon, codec.encode_beacon, lambda data: msgspec.msgpack.decode(data, type=Beacon)),
}


@pytest.mark.parametrize("section", CODECS)
def test_vectors_round_trip(section: str) -> None:
    kind, encode, decode = CODECS[section]
    for vector in GOLDEN[section]:
        value = msgspec.convert(vector["value"], kind)
        assert encode(value).hex() == vector["hex"], vector["name"]
        assert decode(bytes.fromhex(vector["hex"])) == value, vector["name"]


def test_every_message_and_event_has_vectors() -> None:
    for section, tags in (("client", codec.CLIENT_TYPES), ("server", codec.SERVER_TYPES)):
        names = {vector["name"] for vector in GOLDEN[section]}
        assert names >= {f"{tag}/{make}" for tag in tags for make in ("full", "least", "extreme")}
    events = {vector["name"] for vector in GOLDEN["server"]}
    assert events >= {f"event/{tag}/full" for tag in codec.EVENT_TYPES}


def test_decode_only_vectors_decode_to_their_value() -> None:
    for vector in GOLDEN["decode_only"]:
        expected = msgspec.convert(vector["value"], ClientEnvelope)
        data = bytes.fromhex(vector["hex"])
        assert codec.decode_client(data) == expected, vector["name"]
        assert codec.encode_client(expected) != data, vector["name"]
    for vector in GOLDEN["decode_only_server"]:
        data = bytes.fromhex(vector["hex"])
        assert codec.decode_server(data) == msgspec.convert(vector["value"], ServerEnvelope), vector["name"]
    for kind in ("media_header", "media_push"):
        struct, encode, decode = CODECS[kind]
        for vector in GOLDEN[f"decode_only_{kind}"]:
            expected = msgspec.convert(vector["value"], struct)
            assert decode(bytes.fromhex(vector["hex"])) == expected, vector["name"]
            assert encode(expected).hex() != vector["hex"], vector["name"]


def test_malformed_vectors_are_rejected_with_their_code() -> None:
    for vector in GOLDEN["malformed"]:
        with pytest.raises(ProtocolError) as caught:
            codec.decode_client(bytes.fromhex(vector["hex"]))
        assert caught.value.code == vector["code"], vector["name"]


def test_rigid_vectors_decode() -> None:
    for vector in GOLDEN["rigid"]:
        decoder = RigidDecoder(vector["n_bodies"])
        assert decoder.apply(1, 0, bytes.fromhex(vector["hex"])) == (len(vector["poses"]) == vector["n_bodies"])
        for body, row in vector["poses"].items():
            expected = [math.nan if v is None else v for v in row]
            np.testing.assert_allclose(decoder.poses[int(body)], expected, rtol=0, atol=1e-12)
        assert np.isnan(decoder.poses).all(axis=1).sum() >= vector["n_bodies"] - len(vector["poses"])


def test_reference_and_encoder_give_the_same_bytes() -> None:
    rng = np.random.default_rng(12)
    for n in (0, 1, 9, 64, 150):
        poses = random_poses(rng, n)
        poses[::7, 4:] = 0.0
        poses[::7, 3] = 1.0
        payload = RigidEncoder(n).encode(poses, 1).payload
        assert payload == rigid_reference.encode(n, dict(enumerate(poses.tolist())), {})
        decoder = RigidDecoder(n)
        decoder.apply(1, 0, payload)
        reference = rigid_reference.decode(payload)
        rows = np.array([reference[body] for body in range(n)]).reshape(n, 7)
        np.testing.assert_allclose(decoder.poses, rows, rtol=0, atol=1e-15)


def test_reference_and_encoder_agree_on_escapes() -> None:
    poses = random_poses(np.random.default_rng(13), 10)
    poses[3] = np.nan
    poses[6, 0] = 1e15
    payload = RigidEncoder(10).encode(poses, 1).payload
    rows = dict(enumerate(poses.tolist()))
    escaped = {body: rows.pop(body) for body in (3, 6)}
    assert payload == rigid_reference.encode(10, rows, escaped)


def test_reference_rejects_levels_outside_the_unit_ball() -> None:
    for levels in ((16383, 8191, 8191), (0, 0, 0)):
        with pytest.raises(ValueError, match=re.escape(str(levels))):
            rigid_reference.decode_rotation(levels)


def test_conversions_transform_vectors_like_poses() -> None:
    """Converting a rotated vector equals rotating the converted one, in both engines and in both directions."""
    rng = np.random.default_rng(14)
    for row in random_poses(rng, 50).tolist():
        q = quat_normalize((row[3], row[4], row[5], row[6]))
        v: Vec3 = (row[0], row[1], row[2])
        turned = quat_rotate(q, v)
        for there, back in ((to_unity, from_unity), (to_three, from_three)):
            converted = there((*v, *q))
            engine_q: Quat = (converted[6], converted[3], converted[4], converted[5])
            engine_turned = there((*turned, *q))[:3]
            assert quat_rotate(engine_q, converted[:3]) == pytest.approx(engine_turned, abs=1e-12)
            assert back(converted) == (*v, *q)


def test_axes_of_the_engines() -> None:
    forward, left, up = ((*axis, 1.0, 0.0, 0.0, 0.0) for axis in np.eye(3).tolist())
    assert [to_unity(axis)[:3] for axis in (forward, left, up)] == [(0, 0, 1), (-1, 0, 0), (0, 1, 0)]
    assert [to_three(axis)[:3] for axis in (forward, left, up)] == [(0, 0, -1), (-1, 0, 0), (0, 1, 0)]
