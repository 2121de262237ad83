"""Data sets as MCAP, one file per episode, for Foxglove and for whatever reads MCAP.

Numbers are JSON, which has them exactly; transforms of bodies, pictures and the log are Foxglove's own messages. Times
are of the episode: frame k is at k / fps.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from iris_session.dataset.cameras import PictureSpec
from iris_session.dataset.episodes import Plan
from iris_session.dataset.files import SetWriter, Stats
from iris_session.dataset.formats import MODEL
from iris_session.dataset.frames import BOOL, INT, Schema, Table
from iris_session.dataset.video import CODEC_NAME, VideoSink, make_video_name
from iris_session.physics.world import STATE
from iris_session.replay.pictures import Layer
from iris_session.system.extras import require_package

INDEX: Final = "episodes.json"
REQUEST: Final = "iris-session.json"
LAYOUT: Final = "foxglove-layout.json"
EPISODE: Final = "episodes/episode_{:06d}.mcap"
TRANSFORMS: Final = "/tf"
LOG: Final = "/log"
#: Foxglove's names of pixels of depth [m] and of masks.
ENCODINGS: Final = {"float32": "32FC1", "uint16": "16UC1"}
_JSON_TYPES: Final = {INT: "integer", BOOL: "boolean"}


class McapSink(VideoSink):
    """Pictures of one episode: videos, and depth and masks as they are, one after the other in a file."""

    def add(self, look: int, camera: str, image: Layer) -> None:
        if image.ndim == 3:
            super().add(look, camera, image)
            return
        with (self._folder / make_raw_name(look, camera, image.dtype.name)).open("ab") as file:
            file.write(image.tobytes())


def make_raw_name(look: int, layer: str, kind: str) -> str:
    """Return the name of the file of a layer, whose pixels are of a kind of `ENCODINGS`, while it is made."""
    return f"{look}-{layer}.{kind}"


class McapWriter(SetWriter):
    """A set of MCAP files in a folder. Arguments as of `SetWriter`."""

    def __init__(
        self, folder: Path, plan: Plan, schema: Schema, pictures: PictureSpec, request: Mapping[str, Any]
    ) -> None:
        require_package("foxglove", "writing MCAP")
        super().__init__(folder, plan, schema, pictures)
        self._episodes: list[dict[str, Any]] = []
        self.prepare(REQUEST, request)
        if (folder / INDEX).exists():
            self._episodes = json.loads((folder / INDEX).read_bytes())
            for one in self._episodes:
                self.n_episodes, self.n_frames = self.n_episodes + 1, self.n_frames + one["frames"]
                self.note_closed(one["plan_index"], one["look"])
        else:
            self.write_json(REQUEST, request)
            self.write_json(LAYOUT, make_layout(schema, pictures))
            self.write_json(INDEX, [])

    def close_episode(
        self, index: int, look: int, table: Table, pictures: Mapping[tuple[int, str], Stats], folder: Path
    ) -> None:
        # Docstring and arguments: `SetWriter`.
        path, described = self.partial / "episode.mcap", self.describe(index, look, table)
        self._write(path, look, table, folder, described)
        name = EPISODE.format(self.n_episodes)
        self.place(path, name)
        self._episodes.append({"file": name, "frames": table.n_frames, **described})
        self.n_episodes, self.n_frames = self.n_episodes + 1, self.n_frames + table.n_frames
        self.write_json(INDEX, self._episodes)

    def _write(self, path: Path, look: int, table: Table, folder: Path, described: Mapping[str, Any]) -> None:
        """Write the file of an episode."""
        import foxglove
        from foxglove.channels import CompressedVideoChannel, FrameTransformsChannel, LogChannel, RawImageChannel
        from foxglove.mcap import MCAPWriteOptions
        from foxglove.messages import CompressedVideo, FrameTransforms, Log, LogLevel, RawImage, Timestamp

        context = foxglove.Context()
        options = MCAPWriteOptions(compression_threads=0)  # the same bytes on every machine
        with foxglove.open_mcap(path, allow_overwrite=True, context=context, writer_options=options) as writer:
            writer.write_metadata("iris-session", {key: str(value) for key, value in described.items()})
            topics = {
                topic: (foxglove.Channel(topic, schema=_make_json_schema(fields), context=context), fields)
                for topic, fields in self._group_columns().items()
            }
            transforms = FrameTransformsChannel(TRANSFORMS, context=context)
            log = LogChannel(LOG, context=context)
            bodies = _read_transforms(folder / MODEL, table)
            names = [one.name for one in self.pictures.cameras]
            videos = {name: _read_video(folder / make_video_name(look, name)) for name in names}
            layers = _open_layers(folder, look, self.pictures)
            channels = {name: CompressedVideoChannel(f"/cameras/{name}", context=context) for name in videos}
            channels |= {name: RawImageChannel(f"/cameras/{name}", context=context) for name in layers}
            events = list(self._list_events(table, described))
            for k in range(table.n_frames):
                at_ns = k * 1_000_000_000 // self.schema.fps
                stamp = Timestamp(*divmod(at_ns, 1_000_000_000))
                for channel, fields in topics.values():
                    channel.log({name: _to_plain(table.columns[key][k]) for name, key, _ in fields}, log_time=at_ns)
                transforms.log(FrameTransforms(transforms=next(bodies)(stamp)), log_time=at_ns)
                for name, video in videos.items():
                    picture = CompressedVideo(timestamp=stamp, frame_id=name, data=next(video), format=CODEC_NAME)
                    channels[name].log(picture, log_time=at_ns)
                for name, layer in layers.items():
                    height, width = layer.shape[1:]
                    encoding, step = ENCODINGS[layer.dtype.name], width * layer.itemsize
                    kind = {"width": width, "height": height, "encoding": encoding, "step": step}
                    raw = RawImage(timestamp=stamp, frame_id=name, data=layer[k].tobytes(), **kind)
                    channels[name].log(raw, log_time=at_ns)
                for text in (text for frame, text in events if frame == k):
                    line = Log(timestamp=stamp, level=LogLevel.Info, message=text, name="iris-session")
                    log.log(line, log_time=at_ns)

    def _group_columns(self) -> dict[str, list[tuple[str, str, str]]]:
        """Return the columns by topic, each as name in the message, key, and kind."""
        found: dict[str, list[tuple[str, str, str]]] = {}
        for column in self.schema.list_columns():
            owner, _, name = column.key.rpartition(".")
            topic = "/" + owner.replace(".", "/", 1) if owner else "/time"
            found.setdefault(topic, []).append((name, column.key, column.kind))
        return found

    def _list_events(self, table: Table, described: Mapping[str, Any]) -> Iterator[tuple[int, str]]:
        """Yield what happens in an episode, as frame and text."""
        yield 0, f"{described['label']}: {described['task']}"
        yield from ((0, note) for note in table.notes)
        people = (*self.plan.people, "no operator")  # number -1
        for robot in self.schema.robots:
            for quantity, texts in (
                ("operator", people),
                ("engaged", ("holds", "is moved")),
                ("intervention", ("follows its policy", "is taken from its policy")),
            ):
                values = table.columns[robot.make_key(quantity)][:, 0].astype(int)
                changes = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist()]
                for frame in changes if quantity == "operator" else changes[1:]:
                    yield frame, f"{robot.name}: {texts[values[frame]]}"


def make_layout(schema: Schema, pictures: PictureSpec) -> Any:
    """Return a layout of Foxglove that shows an episode, as plain values."""
    import foxglove.layouts as fl

    robots = [f"/robots/{robot.make_key('').split('.')[1]}" for robot in schema.robots]
    images = [
        fl.ImagePanel(
            config=fl.ImageConfig(image_mode=fl.ImageModeConfig(image_topic=f"/cameras/{one.name}")), title=one.name
        )
        for one in pictures.cameras
    ]
    plots = [
        fl.PlotPanel(config=fl.PlotConfig(paths=[fl.PlotSeries(value=f"{robot}.{field}[:]")]), title=f"{robot} {field}")
        for robot in robots
        for field in ("joint_positions", "action")
    ]
    scene = fl.ThreeDeePanel(config=fl.ThreeDeeConfig(follow_tf="world"))
    log = fl.LogPanel(config=fl.LogConfig(topic_to_render=LOG))

    def stack(panels: list[Any], direction: Any = "column") -> Any:
        items = [fl.SplitItem(content=panel) for panel in panels]
        return fl.SplitContainer(direction=direction, items=items)

    layout = fl.Layout(content=stack([stack([scene, *images]), stack([*plots, log])], "row"))
    return json.loads(layout.to_json())


def _make_json_schema(fields: list[tuple[str, str, str]]) -> dict[str, Any]:
    number = {"type": "array", "items": {"type": "number"}}
    properties = {name: {"type": _JSON_TYPES[kind]} if kind in _JSON_TYPES else number for name, _, kind in fields}
    return {"type": "object", "properties": properties}


def _to_plain(row: Any) -> Any:
    """Return numbers of a frame as JSON has them: whole numbers and truths alone, others as a list."""
    return row.tolist() if row.dtype.kind == "f" else row[0].item()


def _read_transforms(path: Path, table: Table) -> Iterator[Any]:
    """Yield, for each frame, a function of its time that returns the transforms of all bodies."""
    from foxglove.messages import FrameTransform, Quaternion, Vector3

    model = mujoco.MjModel.from_binary_path(str(path))
    data = mujoco.MjData(model)
    names = [model.body(i).name or f"body {i}" for i in range(1, model.nbody)]
    for state in table.states:
        mujoco.mj_setState(model, data, state, STATE)
        mujoco.mj_kinematics(model, data)
        poses = list(zip(names, data.xpos[1:].tolist(), data.xquat[1:].tolist(), strict=True))

        def make(stamp: Any, poses: list[Any] = poses) -> list[Any]:
            return [
                FrameTransform(
                    timestamp=stamp,
                    parent_frame_id="world",
                    child_frame_id=name,
                    translation=Vector3(x=p[0], y=p[1], z=p[2]),
                    rotation=Quaternion(w=q[0], x=q[1], y=q[2], z=q[3]),
                )
                for name, p, q in poses
            ]

        yield make


def _read_video(path: Path) -> Iterator[bytes]:
    """Yield the pictures of a video as Foxglove wants them: H.264 with start codes, parameters with every whole one."""
    import av
    from av.bitstream import BitStreamFilterContext

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        convert = BitStreamFilterContext("h264_mp4toannexb", stream)
        for packet in container.demux(stream):
            for converted in convert.filter(packet if packet.size else None):
                yield bytes(converted)


def _open_layers(folder: Path, look: int, pictures: PictureSpec) -> dict[str, Any]:
    """Return depth and masks of an episode by name, each of shape (n, height, width), as far as there are any."""
    shape = (-1, pictures.height, pictures.width)
    return {
        path.name.removeprefix(f"{look}-").removesuffix(f".{kind}"): np.memmap(path, kind, "r").reshape(shape)
        for kind in ENCODINGS
        for path in sorted(folder.glob(make_raw_name(look, "*", kind)))
    }
