"""Start configuration of a camera process and the reports that it writes. Plain data, no behaviour.

The process reads `CameraStart` as MessagePack from its standard input, never from its arguments, and writes
`CameraReport`s to its standard output, a line of JSON each.
"""

from __future__ import annotations

import msgspec

from iris_session.cloud.camera_file import CloudSettings


class ProcessStart(msgspec.Struct, frozen=True, kw_only=True):
    """Standard input of a process that joins the session as a camera.

    Attributes:
        host, control_port: Control channel of the session.
        server_key, public_key, secret_key: CURVE keys as Z85 text, of the session and of the process; empty for a
            session without encryption.
        parent_pid: The process ends with this one; 0: by a signal only.
        known_fault: Why the process before this one ended. The same is not logged again.
    """

    host: str = "127.0.0.1"
    control_port: int = 7721
    server_key: str = ""
    public_key: str = ""
    secret_key: str = ""
    parent_pid: int = 0
    known_fault: str = ""


class CameraStart(ProcessStart, frozen=True):
    """Standard input of the process of a camera file. `settings`: cameras, pipeline and streams."""

    settings: CloudSettings


class SourceReport(msgspec.Struct, frozen=True):
    """State of the source of one camera.

    Attributes:
        hz: Frames per second.
        fault, detail: A `StreamFault` and one line for people; empty while all is well.
        failures: How often it could not be opened or read.
    """

    hz: float = 0.0
    fault: str = ""
    detail: str = ""
    failures: int = 0


class CameraReport(msgspec.Struct, frozen=True):
    """State of a camera process, written once a second.

    Attributes:
        stream: Name of the cloud's stream.
        connected: The session has admitted the process.
        hz: Clouds per second.
        points, voxel_m, error_m: Of the newest cloud: points in class `full`, edge of the cells, stated error [m],
            `None` for none.
        bytes_per_s: Published, all streams and classes.
        age_ms: From the capture of a cloud to its last sent byte, mean [ms].
        stages_ms: Mean duration of each stage [ms].
        drops: Frames and points that were left out, by reason, since the start.
        cameras: State of each source by name of the camera.
        fault: Why the process ends, empty while all is well.
        warning: One line for people about what the cloud lacks, empty for nothing.
        starting: No cloud was made yet: packages are imported, the filter is compiled, devices are opened.
    """

    stream: str = ""
    connected: bool = False
    hz: float = 0.0
    points: int = 0
    voxel_m: float = 0.0
    error_m: float | None = None
    bytes_per_s: float = 0.0
    age_ms: float = 0.0
    stages_ms: dict[str, float] = {}
    drops: dict[str, int] = {}
    cameras: dict[str, SourceReport] = {}
    fault: str = ""
    warning: str = ""
    starting: bool = False
