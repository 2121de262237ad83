"""MCAP files of ROS 2 and Foxglove, written by its package and read back."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anchors.camera import CameraModel
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceEndedError, SourceError
from tests.cloud.sources.test_rerun_recording import SHAPE, N, encode, make_color, make_depth, read_source

pytest.importorskip("mcap_ros2")
pytest.importorskip("mcap_protobuf")

STEP_NS = 10_000_000
HEADER = "std_msgs/Header header\n"
HEADER_TYPES = (
    "\n================================================================================\nMSG: std_msgs/Header\n"
    "builtin_interfaces/Time stamp\nstring frame_id\n"
    "================================================================================\nMSG: builtin_interfaces/Time\n"
    "int32 sec\nuint32 nanosec\n"
)
IMAGE = "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
COMPRESSED = "string format\nuint8[] data\n"
INFO = "uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
MATRIX = [50.0, 0.0, 31.0, 0.0, 51.0, 23.0, 0.0, 0.0, 1.0]


def write_ros2(
    path: Path,
    *,
    depth: str = "16UC1",
    color: str = "rgb8",
    info: bool = True,
    lens: tuple[str, list[float]] = ("plumb_bob", [0.0] * 5),
) -> None:
    from mcap_ros2.writer import Writer

    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "cam"}
    writer = Writer(str(path))
    schemas = {
        name: writer.register_msgdef(f"sensor_msgs/msg/{name}", HEADER + text + HEADER_TYPES)
        for name, text in (("Image", IMAGE), ("CompressedImage", COMPRESSED), ("CameraInfo", INFO))
    }

    def send(topic: str, schema: str, k: int, message: dict[str, Any]) -> None:
        writer.write_message(topic, schemas[schema], {"header": header, **message}, 10**18 + k * STEP_NS)

    def send_raw(topic: str, k: int, encoding: str, pixels: Any, padding: int = 0) -> None:
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(SHAPE[0], -1)
        rows = np.concatenate([rows, np.zeros((SHAPE[0], padding), np.uint8)], axis=1)
        layout = {"height": SHAPE[0], "width": SHAPE[1], "encoding": encoding, "is_bigendian": 0, "step": rows.shape[1]}
        send(topic, "Image", k, {**layout, "data": rows.tobytes()})

    for k in range(N):
        if info:
            for topic, scale in (("/color/camera_info", 2.0), ("/depth/camera_info", 1.0)):
                matrix = [scale * one for one in MATRIX]
                camera = {
                    "height": SHAPE[0],
                    "width": SHAPE[1],
                    "distortion_model": lens[0] if topic.startswith("/depth") else "plumb_bob",
                    "d": lens[1],
                    "k": matrix,
                }
                send(topic, "CameraInfo", k, camera)
        if depth == "16UC1":
            send_raw("/depth/image", k, depth, make_depth(k), padding=6)
        elif depth == "32FC1":
            send_raw("/depth/image", k, depth, make_depth(k).astype(np.float32) / 1000.0)
        elif depth == "compressedDepth":
            data = bytes(12) + encode(".png", make_depth(k))
            send("/depth/image", "CompressedImage", k, {"format": "16UC1; compressedDepth png", "data": data})
        if color in ("rgb8", "bgr8", "yuv"):
            send_raw("/color/image", k, color, make_color(k)[..., ::-1] if color == "bgr8" else make_color(k))
        elif color == "png":
            send(
                "/color/image",
                "CompressedImage",
                k,
                {"format": "rgb8; png compressed bgr8", "data": encode(".png", make_color(k))},
            )
    writer.finish()


def write_foxglove(path: Path, form: str) -> None:
    """Write depth and colour as compressed pictures, with a calibration."""
    with open(path, "wb") as file:
        send, finish = open_foxglove(file, form)
        for k in range(N):
            send("/cam/calibration", "CameraCalibration", k, {"width": 64, "height": 48, "K": MATRIX, "D": []})
            send("/cam/depth", "CompressedImage", k, {"format": "png", "data": encode(".png", make_depth(k))})
            send("/cam/color", "CompressedImage", k, {"format": "png", "data": encode(".png", make_color(k))})
        finish()


def open_foxglove(file: Any, form: str) -> tuple[Callable[..., None], Callable[[], None]]:
    """Return functions that write a message, and finish the file."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from mcap.writer import Writer
    from mcap_protobuf.writer import Writer as ProtobufWriter

    if form == "json":
        writer = Writer(file)
        writer.start()
        channels: dict[str, int] = {}

        def send_json(topic: str, schema: str, k: int, message: dict[str, Any]) -> None:
            if topic not in channels:
                number = writer.register_schema(f"foxglove.{schema}", "jsonschema", b"{}")
                channels[topic] = writer.register_channel(topic, "json", number)
            coded = {
                key: base64.b64encode(one).decode() if isinstance(one, bytes) else one for key, one in message.items()
            }
            writer.add_message(channels[topic], 10**18 + k * STEP_NS, json.dumps(coded).encode(), 0)

        return send_json, writer.finish

    field = descriptor_pb2.FieldDescriptorProto
    kinds = {
        "CompressedImage": [("data", field.TYPE_BYTES), ("format", field.TYPE_STRING)],
        "CameraCalibration": [
            ("width", field.TYPE_FIXED32),
            ("height", field.TYPE_FIXED32),
            ("D", field.TYPE_DOUBLE),
            ("K", field.TYPE_DOUBLE),
        ],
    }
    proto = descriptor_pb2.FileDescriptorProto(name="foxglove.proto", package="foxglove", syntax="proto3")
    for name, fields in kinds.items():
        one = proto.message_type.add(name=name)
        for number, (key, kind) in enumerate(fields, 1):
            label = field.LABEL_REPEATED if kind == field.TYPE_DOUBLE else field.LABEL_OPTIONAL
            one.field.add(name=key, number=number, type=kind, label=label)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(proto)
    classes = {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}")) for name in kinds}
    protobuf = ProtobufWriter(file)

    def send(topic: str, schema: str, k: int, message: dict[str, Any]) -> None:
        protobuf.write_message(topic, classes[schema](**message), 10**18 + k * STEP_NS)

    return send, protobuf.finish


def read_all(path: Path, **values: Any) -> tuple[Any, list[DepthFrame]]:
    return read_source(CameraSettings(name="a", source="mcap", path=str(path), loop=False, **values))


def check(source: Any, frames: list[DepthFrame]) -> None:
    assert len(frames) == N
    for k, frame in enumerate(frames):
        assert np.array_equal(frame.depth, make_depth(k))
        assert np.array_equal(frame.color, make_color(k))
        assert frame.capture_ns == k * STEP_NS
    assert source.recorded_hz == pytest.approx(1e9 / STEP_NS)
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 50.0, 51.0, 31.0, 23.0)


@pytest.mark.parametrize(("depth", "color"), [("16UC1", "rgb8"), ("32FC1", "bgr8"), ("compressedDepth", "png")])
def test_messages_of_ros_2(tmp_path: Path, depth: str, color: str) -> None:
    write_ros2(tmp_path / "a.mcap", depth=depth, color=color)
    check(*read_all(tmp_path / "a.mcap"))


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("", [0.1, 0.2, 0.3, 0.4]), ("rational_polynomial", [0.1] * 8)],
)
def test_a_lens_of_opencv_s_model_is_taken(tmp_path: Path, model: str, coefficients: list[float]) -> None:
    write_ros2(tmp_path / "a.mcap", lens=(model, coefficients))
    assert read_all(tmp_path / "a.mcap")[0].camera.distortion == tuple(coefficients)


@pytest.mark.parametrize("coefficients", [[0.1, 0.2, 0.3, 0.4], [0.0] * 4])
def test_another_lens_is_refused_unless_the_camera_file_has_intrinsics(
    tmp_path: Path, coefficients: list[float]
) -> None:
    """Four coefficients of a fisheye are not those of OpenCV's other model, and zeros are a fisheye, too."""
    write_ros2(tmp_path / "a.mcap", lens=("equidistant", coefficients))
    with pytest.raises(SourceError, match=r"/depth/camera_info.*'equidistant'"):
        read_all(tmp_path / "a.mcap")
    given = CameraModel(64, 48, 50.0, 51.0, 31.0, 23.0)
    assert read_all(tmp_path / "a.mcap", intrinsics=given)[0].camera == given


@pytest.mark.parametrize("form", ["json", "protobuf"])
def test_messages_of_foxglove(tmp_path: Path, form: str) -> None:
    write_foxglove(tmp_path / "a.mcap", form)
    check(*read_all(tmp_path / "a.mcap"))


@pytest.mark.parametrize(
    ("written", "values"),
    [({"info": False}, {}), ({"depth": ""}, {}), ({"color": "yuv"}, {}), ({}, {"depth": "/other"})],
)
def test_what_is_missing_is_named(tmp_path: Path, written: dict[str, Any], values: dict[str, Any]) -> None:
    write_ros2(tmp_path / "a.mcap", **written)
    with pytest.raises(SourceError) as caught:
        read_all(tmp_path / "a.mcap", **values)
    assert not isinstance(caught.value, SourceEndedError)
    assert "a.mcap" in str(caught.value)


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    write_ros2(tmp_path / "a.mcap")
    data = (tmp_path / "a.mcap").read_bytes()
    middle = len(data) // 4
    for spoiled in (b"", b"no MCAP", data[: len(data) // 2], data[:middle] + bytes(40) + data[middle + 40 :]):
        (tmp_path / "b.mcap").write_bytes(spoiled)
        with pytest.raises(SourceError) as caught:
            read_all(tmp_path / "b.mcap")
        assert not isinstance(caught.value, SourceEndedError)
