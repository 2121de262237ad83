"""The root of all errors of the package, and errors in the bytes of a peer.

Each text is one line: what is wrong, the value, and what would be right.

IrisError
|-- SessionError             of a session that the program owns (`session.errors`)
|-- ClientError              of a client: no session, a refusal, a denial (`client.errors`)
|-- PhysicsError             a model or robots file that cannot be used (`physics.errors`)
|-- ControlError             robots that cannot be driven (`control.config`)
|-- SceneBuildError          a scene or file that cannot be composed (`scene.errors`)
|-- SimulatorError           a simulation of another simulator that cannot be shown (`simulators.adapter`)
|-- SceneError               an operation that does not fit a scene (`protocol.scene`)
|-- AssetStoreError          the store of assets (`assets.errors`)
|-- RecordingError           a recording that cannot be read or written (`journal.errors`)
|-- StreamError              bytes of a stream that cannot be decoded (`streams.errors`)
|-- FrontError               the process with the sockets cannot start (`link.config`)
|-- DiscoveryError           beacons cannot be received (`link.discovery`)
|-- KeysError                keys and allow-lists (`security`)
|-- SourceError              a depth camera (`cloud.frames`)
|-- CameraFileError          a camera file (`cloud.camera_file`)
|-- ProfileError             a profile of a link (`netsim.profiles`)
|-- ImpairmentError          an impaired link cannot start (`netsim.process`)
|-- BenchError               a benchmark without a result (`bench.report`)
`-- ProtocolError            bytes of a peer; `code` (a `RefusalCode`) goes into `Refused` or `ProtocolFault`
    |-- MalformedError           not MessagePack, or not a message of the schema (unknown type, missing or wrong field)
    |-- ProtocolVersionError     another protocol version; `version` is the peer's
    |-- TooLargeError            more bytes than the limit of its type
    `-- RateError                more messages of a type than its rate allows

The package `anchors` is usable alone, so its errors are its own.
"""

from __future__ import annotations

from typing import ClassVar

from iris_session.protocol.names import PROTOCOL_VERSION, RefusalCode

#: Characters of an error text: fits the `Text` of the message that carries it to the peer.
MAX_ERROR_TEXT = 400


class IrisError(Exception):
    """Base of every error that iris-session raises for its user. Any other error is a defect."""


class ProtocolError(IrisError):
    """Base of errors in the bytes of a peer. `str(error)` has at most `MAX_ERROR_TEXT` characters: fit for the peer."""

    code: ClassVar[str]

    def __init__(self, text: str) -> None:
        super().__init__(text if len(text) <= MAX_ERROR_TEXT else text[: MAX_ERROR_TEXT - 3] + "...")


class MalformedError(ProtocolError):
    """The bytes are not a message of this protocol."""

    code = RefusalCode.MALFORMED


class ProtocolVersionError(ProtocolError):
    """The peer uses protocol version `version`."""

    code = RefusalCode.VERSION

    def __init__(self, version: int) -> None:
        super().__init__(f"protocol version {version}, this side speaks {PROTOCOL_VERSION}: update the older side")
        self.version = version


class TooLargeError(ProtocolError):
    """A message of `size` bytes, where `limit` are allowed."""

    code = RefusalCode.TOO_LARGE

    def __init__(self, what: str, size: int, limit: int) -> None:
        super().__init__(f"{what} of {size} bytes, at most {limit} are allowed")
        self.size = size
        self.limit = limit


class RateError(ProtocolError):
    """More messages of type `what` than `per_second` (and a burst of `burst`)."""

    code = RefusalCode.RATE

    def __init__(self, what: str, per_second: float, burst: int) -> None:
        super().__init__(f"too many {what} messages: at most {per_second:g} per second, {burst} at once")
