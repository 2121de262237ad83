"""MCAP: every column as it was read, bodies where the states have them, pictures, depth and masks, what happens."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import mujoco
import numpy as np
import pytest

pytest.importorskip("mcap_protobuf")
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from iris_session.dataset.run import export_dataset
from tests.dataset.support import NAME, record
from tests.dataset.test_robomimic import OPTIONS, read_tables
from tests.replay.support import Played


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def load(folder: Path) -> list[dict[str, Any]]:
    """Read a set with the reader of MCAP: what `episodes.json` says of each, and its messages by topic."""
    if not (folder / "episodes.json").exists():
        return []
    found, decoders = [], DecoderFactory()
    for episode in json.loads((folder / "episodes.json").read_bytes()):
        messages: dict[str, list[Any]] = {}
        with (folder / episode["file"]).open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for schema, channel, message in reader.iter_messages():
                assert schema is not None
                decode = decoders.decoder_for(channel.message_encoding, schema) or json.loads
                data = decode(message.data)
                messages.setdefault(channel.topic, []).append((message.log_time, data))
            (metadata,) = reader.iter_metadata()
        assert metadata.metadata["label"] == episode["label"]
        assert len(messages["/time"]) == episode["frames"]
        found.append({**episode, **messages})
    return found


def decode_video(packets: list[bytes]) -> list[Any]:
    codec = av.CodecContext.create("h264", "r")
    pictures = [picture for data in packets for picture in codec.decode(av.Packet(data))]
    return [picture.to_ndarray(format="rgb24") for picture in [*pictures, *codec.decode(None)]]


def test_a_set_holds_what_was_read(played: Played, tmp_path: Path) -> None:
    report = export_dataset([played.path], tmp_path / "set", "mcap", OPTIONS)
    assert (report.episodes, report.frames) == (3, 30)
    episodes = load(tmp_path / "set")
    model = played.core.world.model
    data = mujoco.MjData(model)
    for episode, (table, images) in zip(episodes, read_tables(played), strict=True):
        times = [k * 10_000_000 for k in range(table.n_frames)]
        for key, values in table.columns.items():
            owner, _, name = key.rpartition(".")
            messages = episode["/" + owner.replace(".", "/", 1) if owner else "/time"]
            assert [time for time, _ in messages] == times
            stored = np.array([message[name] for _, message in messages], values.dtype).reshape(values.shape)
            assert stored.tobytes() == values.tobytes()
        for (_, message), state in zip(episode["/tf"], table.states, strict=True):
            mujoco.mj_setState(model, data, state, int(mujoco.mjtState.mjSTATE_INTEGRATION))
            mujoco.mj_kinematics(model, data)
            transforms = message.transforms
            assert [one.child_frame_id for one in transforms] == [model.body(i).name for i in range(1, model.nbody)]
            at = [(one.translation.x, one.translation.y, one.translation.z) for one in transforms]
            assert np.array(at).tobytes() == data.xpos[1:].tobytes()
        pictures = decode_video([one.data for _, one in episode["/cameras/operator"]])
        error = np.abs(np.array(pictures, float) - np.array(images["operator"], float)).mean()
        assert len(pictures) == table.n_frames
        assert error < 8.0
        for name, encoding in (("operator_depth", "32FC1"), ("operator_mask", "16UC1")):
            raw = [one for _, one in episode[f"/cameras/{name}"]]
            assert {one.encoding for one in raw} == {encoding}
            assert b"".join(one.data for one in raw) == np.array(images[name]).tobytes()
    lines = [(time, one.message) for time, one in episodes[0]["/log"]]
    assert lines[0] == (0, f"success: {NAME} lifts it")
    assert any(text == f"left: {NAME}" for _, text in lines[1:])
    assert any(text == "left: is moved" for _, text in lines)


def test_a_layout_shows_cameras_and_robots(played: Played, tmp_path: Path) -> None:
    export_dataset([played.path], tmp_path / "set", "mcap", OPTIONS)
    text = (tmp_path / "set/foxglove-layout.json").read_text()
    assert "/cameras/operator" in text
    assert "/robots/left.joint_positions[:]" in text
