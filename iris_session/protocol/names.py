"""Every open enumeration of the protocol: the known values, as plain strings.

Enumerations on the wire are open. A value that is not listed here decodes without error and is answered by a typed
denial (`DenialReason.UNKNOWN_VALUE`), so an old server and a new client can still talk.
"""

from __future__ import annotations

from typing import Final

PROTOCOL_VERSION: Final = 1
#: Version of `SceneSpec` that this package writes and reads.
SCENE_VERSION: Final = 1


class Role:
    """Rights of a participant. Reserved for later message types: `camera`, `source`."""

    OPERATOR: Final = "operator"
    OBSERVER: Final = "observer"
    DIRECTOR: Final = "director"
    AGENT: Final = "agent"
    LEADER: Final = "leader"
    GATEWAY: Final = "gateway"
    RECORDER: Final = "recorder"
    CAMERA: Final = "camera"
    SOURCE: Final = "source"
    ALL: Final = frozenset(
        {"operator", "observer", "director", "agent", "leader", "gateway", "recorder", "camera", "source"}
    )
    #: Roles that may hold a lease on a robot or object.
    DRIVING: Final = frozenset({"operator", "director", "agent", "leader"})


class Device:
    """Tracked sources of input of one participant."""

    HEAD: Final = "head"
    CONTROLLER_LEFT: Final = "controller/left"
    CONTROLLER_RIGHT: Final = "controller/right"
    HAND_LEFT: Final = "hand/left"
    HAND_RIGHT: Final = "hand/right"
    JOINTS: Final = "joints"
    GAZE: Final = "gaze"
    DESKTOP: Final = "desktop"
    TARGET: Final = "target"  # a policy's end-effector target
    ALL: Final = frozenset(
        {
            "head",
            "controller/left",
            "controller/right",
            "hand/left",
            "hand/right",
            "joints",
            "gaze",
            "desktop",
            "target",
        }
    )


class SampleKind:
    """Payload of a `Sample` that counts."""

    POSE: Final = "pose"
    TWIST: Final = "twist"
    JOINTS: Final = "joints"
    ALL: Final = frozenset({"pose", "twist", "joints"})


class TargetKind:
    """Kind of a target."""

    ROBOT: Final = "robot"
    OBJECT: Final = "object"


class LeaseMode:
    """Rule by which a robot's lease passes between participants."""

    EXCLUSIVE: Final = "exclusive"
    REQUEST: Final = "request"
    TAKEOVER: Final = "takeover"
    PRIORITY: Final = "priority"
    SHARED: Final = "shared"
    ALL: Final = frozenset({"exclusive", "request", "takeover", "priority", "shared"})


class AssignmentPolicy:
    """Rule that chooses a robot for a participant that names none."""

    CONFIG: Final = "config"
    JOIN_ORDER: Final = "join-order"
    NEAREST: Final = "nearest"
    DIRECTOR: Final = "director"
    ALL: Final = frozenset({"config", "join-order", "nearest", "director"})


class AlignmentKind:
    """Origin of `T_world_tracking` of a participant.

    `fingertip`: marks touched with a fingertip, or with a tip that is not calibrated; `persistent`: an anchor that the
    device kept, confirmed by no touch yet. Both are good enough to look, not to drive.
    """

    NONE: Final = "none"
    MEASURED: Final = "measured"
    PLACED: Final = "placed"
    NOT_NEEDED: Final = "not_needed"
    FINGERTIP: Final = "fingertip"
    PERSISTENT: Final = "persistent"
    VIEW_ONLY: Final = frozenset({"fingertip", "persistent"})


class AlignAction:
    """Action of `align`. `start`: measure anew, from nothing; `stop`: keep the alignment in force, ignore further
    observations.
    """

    START: Final = "start"
    STOP: Final = "stop"
    ALL: Final = frozenset({"start", "stop"})


class AlarmKind:
    """Evidence that an alignment is wrong.

    `changed`: an anchor is observed elsewhere than seconds ago. `differs`: and elsewhere than by the alignment. `jump`:
    the tracking frame moved at once, which voids the alignment. `two_places`: one id is observed in two places, to and
    fro: there are two prints of it.
    """

    CHANGED: Final = "changed"
    DIFFERS: Final = "differs"
    JUMP: Final = "jump"
    TWO_PLACES: Final = "two_places"
    ALL: Final = frozenset({"changed", "differs", "jump", "two_places"})


class AlignmentDoubt:
    """Reason why an alignment in force is *unconfirmed*: it begins no engagement until a look at an anchor confirms or
    replaces it. Empty: none.
    """

    AGED: Final = "aged"  # no look for so long that drift alone may exceed the bound at the robot
    UNVERIFIED: Final = "unverified"  # another one has aligned by a sheet since this headset last saw it
    CONTRADICTED: Final = "contradicted"  # later looks disagree with it
    ALL: Final = frozenset({"aged", "unverified", "contradicted"})


class AnchorKind:
    """Kind of an observation: the form of the anchor, or the way in which it was found.

    `touch`: a tip or a fingertip on a mark. `tip`: a controller turned while its tip stayed in a hole. `persistent`: a
    place that the device kept since an earlier alignment. `point`: a tip or a fingertip on any point that others touch
    too, to measure how far apart their worlds are.
    """

    QR: Final = "qr"
    BOARD: Final = "board"
    CONTROLLER: Final = "controller"
    TOUCH: Final = "touch"
    TIP: Final = "tip"
    PERSISTENT: Final = "persistent"
    POINT: Final = "point"
    NOT_SEEN: Final = frozenset({"touch", "tip", "persistent", "point"})
    ALL: Final = frozenset({"qr", "board", "controller", "touch", "tip", "persistent", "point"})


class ObservationSource:
    """Source of an observation, whose constant errors are known by size (docs/anchors.md, "Biases").

    `qr_camera`: a detector of the application, on pictures of a camera. `qr_system`: codes that the system of the
    headset tracks. `holder`: a tracked controller in its holder. `touch`: a tip on a mark.
    """

    QR_CAMERA: Final = "qr_camera"
    QR_SYSTEM: Final = "qr_system"
    HOLDER: Final = "holder"
    TOUCH: Final = "touch"
    ALL: Final = frozenset({"qr_camera", "qr_system", "holder", "touch"})


class SessionKind:
    """Kind of a session."""

    LIVE: Final = "live"
    REPLAY: Final = "replay"


class CommandKind:
    """Kind of a robot's command."""

    HOLD: Final = "hold"
    POSE: Final = "pose"
    TWIST: Final = "twist"
    JOINTS: Final = "joints"


class HoldReason:
    """Reason why a robot holds. Exactly one is given with every hold command."""

    NO_LEASE: Final = "no_lease"
    NO_SAMPLE: Final = "no_sample"  # a lease, but nothing counted yet
    CLUTCH_OPEN: Final = "clutch_open"
    STALE: Final = "stale"  # no counted sample within the freshness bound
    NOT_WORN: Final = "not_worn"
    UNTRACKED: Final = "untracked"
    UNALIGNED: Final = "unaligned"
    REJECTED: Final = "rejected"  # the engaged sender's own sample was rejected; clutch again
    ESTOP: Final = "estop"
    DISCONNECTED: Final = "disconnected"
    GAP: Final = "gap"  # the session stood still; clutch again
    SCENE_CHANGED: Final = "scene_changed"  # reset or new epoch; clutch again
    INTERVENTION: Final = "intervention"  # mode `priority`, sent to the agent: a human has the robot
    REARM: Final = "rearm"  # engagement ended (release, takeover, new tracking epoch); clutch again
    VIEW_ONLY: Final = "view_only"  # the alignment is good enough to look, not to drive
    EMULATED: Final = "emulated"  # the position of the device is an estimate, not a measurement
    ZERO_POSE: Final = "zero_pose"  # the device reports the origin of its tracking frame; clutch again
    FROZEN: Final = "frozen"  # the device reports one pose again and again; clutch again
    JUMP: Final = "jump"  # the pose of the device jumped; clutch again
    UNCONFIRMED: Final = "unconfirmed"  # the alignment is doubted (`AlignmentDoubt`): glance at a sheet; clutch again
    EPISODE: Final = (
        "episode"  # an episode is closing: its verdict is missing, or the scene is being reset; clutch again
    )


class RejectReason:
    """Reason why a sample was rejected. Counted per participant, device and reason."""

    CONNECTION_EPOCH: Final = "connection_epoch"
    SCENE_EPOCH: Final = "scene_epoch"
    TRACKING_EPOCH: Final = "tracking_epoch"
    LEASE_VERSION: Final = "lease_version"
    NOT_HOLDER: Final = "not_holder"
    ALIGNMENT_VERSION: Final = "alignment_version"
    SEQ: Final = "seq"
    STALE: Final = "stale"
    FUTURE: Final = "future"
    NOT_FINITE: Final = "not_finite"
    NOT_UNIT: Final = "not_unit"
    TOO_FAST: Final = "too_fast"
    SHAPE: Final = "shape"  # payload missing, or of the wrong length for this robot
    UNKNOWN_VALUE: Final = "unknown_value"
    UNKNOWN_TARGET: Final = "unknown_target"
    ROLE: Final = "role"
    UNALIGNED: Final = "unaligned"
    QUOTA: Final = "quota"
    DEVICE: Final = "device"  # device not declared in hello, or does not fit the kind
    LEADER_APART: Final = "leader_apart"
    KIND_MISMATCH: Final = "kind"  # others drive this shared robot by samples of another kind
    VIEW_ONLY: Final = "view_only"  # the alignment is good enough to look, not to drive
    EMULATED: Final = "emulated"  # the position is an estimate, not a measurement
    ZERO_POSE: Final = "zero_pose"  # the origin of the tracking frame, as some runtimes report before they have a pose
    FROZEN: Final = "frozen"  # one pose again and again, to the last bit
    JUMP: Final = "jump"  # farther from the pose before than its motion and time explain
    UNCONFIRMED: Final = "unconfirmed"  # it would engage while the alignment is doubted (`AlignmentDoubt`)


class DenialReason:
    """Reason why a request was denied."""

    HELD: Final = "held"  # someone else has the lease
    CONSENT_PENDING: Final = "consent_pending"
    CONSENT_REFUSED: Final = "consent_refused"
    ROLE: Final = "role"
    UNKNOWN_TARGET: Final = "unknown_target"
    UNKNOWN_PARTICIPANT: Final = "unknown_participant"
    UNKNOWN_REQUEST: Final = "unknown_request"
    UNKNOWN_VALUE: Final = "unknown_value"
    LEASE_VERSION: Final = "lease_version"
    NOT_HOLDER: Final = "not_holder"
    NOT_JOINED: Final = "not_joined"
    ALREADY_JOINED: Final = "already_joined"
    ESTOP: Final = "estop"
    UNALIGNED: Final = "unaligned"
    ALIGNMENT_REFUSED: Final = "alignment_refused"
    EPISODE_STATE: Final = "episode_state"
    QUEUE_FULL: Final = "queue_full"
    QUOTA: Final = "quota"
    SESSION_FULL: Final = "session_full"
    USER_OWNED: Final = "user_owned"  # e.g. pause or reset of a loop that the user drives
    POLICY: Final = "policy"  # the assignment policy leaves this to the configuration or a director
    INVALID: Final = "invalid"  # values out of range (non-finite pose, n_ticks < 1, ...)
    WITHDRAWN: Final = "withdrawn"  # the sender took the request back
    TOO_FAR: Final = "too_far"  # more often a wrong number than intended: confirm with `force`
    VIEW_ONLY: Final = "view_only"  # the alignment is good enough to look, not to drive


class RefusalCode:
    """Reason why the front refused a `hello`, before the authority received it."""

    VERSION: Final = "version"
    IDENTITY: Final = "identity"
    MALFORMED: Final = "malformed"
    TOO_LARGE: Final = "too_large"
    RATE: Final = "rate"
    GATEWAY_ONLY: Final = "gateway_only"
    RESUME_TOKEN: Final = "resume_token"
    FULL: Final = "full"
    UNPAIRED: Final = "unpaired"  # the key is not on the allow-list: pair first
    CODE: Final = "code"  # a join code that is wrong, used, expired, or was tried too often


class FaultCode:
    """Reason of a `ProtocolFault`: a rejected message, or a change in the state of the session."""

    VERSION: Final = "version"
    MALFORMED: Final = "malformed"
    TOO_LARGE: Final = "too_large"
    RATE: Final = "rate"
    HELLO: Final = "hello"  # this connection has not sent `hello`, or the front was restarted: send it again
    DROPPED: Final = "dropped"  # the session closed this connection
    STALLED: Final = "stalled"  # the session does not step: robots hold
    RECOVERED: Final = "recovered"
    SESSION_ENDED: Final = "session_ended"
    REVOKED: Final = "revoked"  # the key was taken off the allow-list, or a director removed the participant


class EpisodeAction:
    """Action of `episode`."""

    START: Final = "start"
    STOP: Final = "stop"  # it is over, the verdict follows
    SUCCESS: Final = "success"
    FAILURE: Final = "failure"
    UNKNOWN: Final = "unknown"
    DISCARD: Final = "discard"  # asked twice
    RERECORD: Final = "rerecord"  # discard and begin the same number again; asked twice
    TAKE_OVER: Final = "take_over"  # lead it from now on
    RESET: Final = "reset"
    ALL: Final = frozenset(
        {"start", "stop", "success", "failure", "unknown", "discard", "rerecord", "take_over", "reset"}
    )


class EpisodeState:
    """State of an episode (`EpisodeChanged`)."""

    IDLE: Final = "idle"  # of a task before its first episode
    COUNTDOWN: Final = "countdown"  # it begins at `until_ns`
    RUNNING: Final = "running"
    CONFIRM: Final = "confirm"  # running, and a discard was asked for: once more until `until_ns` confirms it
    LEFT: Final = "left"  # running, and its leader is disconnected: it can be taken over until `until_ns`
    CLOSING: Final = "closing"  # over: the verdict is missing, or the scene is being reset; robots hold
    SUCCESS: Final = "success"
    FAILURE: Final = "failure"
    DISCARDED: Final = "discarded"
    UNKNOWN: Final = "unknown"
    CANCELLED: Final = "cancelled"  # in the countdown: the number is used again
    ALL: Final = frozenset(
        {
            *("idle", "countdown", "running", "confirm", "left", "closing"),
            *("success", "failure", "discarded", "unknown", "cancelled"),
        }
    )
    #: States in which it is recorded.
    RECORDED: Final = frozenset({"running", "confirm", "left"})
    #: States in which the next episode can begin.
    OVER: Final = ALL - RECORDED - {"countdown", "closing"}


class ControlAction:
    """Action of `control`."""

    PAUSE: Final = "pause"
    RESUME: Final = "resume"
    STEP: Final = "step"
    RESET: Final = "reset"
    ALL: Final = frozenset({"pause", "resume", "step", "reset"})


class AuditKind:
    """Kind of an `Audited` event."""

    PAIRED: Final = "paired"
    CODE_REFUSED: Final = "code_refused"
    CODE_EXHAUSTED: Final = "code_exhausted"  # too many wrong attempts: the code is void
    KEY_REFUSED: Final = "key_refused"  # an unknown key tried to do more than pair
    KEY_REVOKED: Final = "key_revoked"
    ROLE_REFUSED: Final = "role_refused"
    REMOVED: Final = "removed"
    RENAMED: Final = "renamed"  # by itself or a director
    ROLE_CHANGED: Final = "role_changed"  # by a director
    GATEWAY_REFUSED: Final = "gateway_refused"  # `on_behalf_of` from a participant that is no gateway
    TOKEN_REFUSED: Final = "token_refused"  # unknown or used up, as after an earlier session
    TOKEN_MISUSED: Final = "token_misused"  # it is that of a participant with another key
    FLOOD: Final = "flood"  # a client sends more than its limits for seconds


class BudgetClass:
    """Share of media that a client gets, from everything to nothing. State and control are never cut."""

    FULL: Final = "full"
    HALF: Final = "half"
    QUARTER: Final = "quarter"
    NONE: Final = "none"


class ThermalState:
    """Temperature of a headset by what it does about it. Empty where it does not say."""

    NOMINAL: Final = "nominal"
    WARM: Final = "warm"
    HOT: Final = "hot"  # it renders less, and may turn itself off


class AssetRefusal:
    """Reason why a request for an asset is refused. After the last four the same request may succeed later."""

    UNKNOWN: Final = "unknown_asset"  # of neither the present scene nor the one before
    BAD_RANGE: Final = "bad_range"
    VERSION: Final = "version"
    MALFORMED: Final = "malformed"
    TOO_MANY: Final = "too_many_outstanding"
    NOT_ALLOWED: Final = "not_allowed"  # the connection that the request names is not welcome, or not the sender's
    RATE: Final = "rate"
    BUSY: Final = "busy"
    #: Refusals that may end with time.
    PASSING: Final = frozenset({"too_many_outstanding", "not_allowed", "rate", "busy"})


class MediaEncoding:
    """Encoding of the bytes of a media frame."""

    BYTES: Final = "bytes"  # only source and receiver know
    DEFORMABLE: Final = "deformable"  # vertices of a mesh of the scene, docs/deformables.md
    CLOUD: Final = "cloud"  # points with colours, world frame, docs/clouds.md
    JPEG: Final = "jpeg"  # the picture of a camera, docs/clouds.md


class StreamAudience:
    """Audience of a media stream. Unknown values: as `all`."""

    ALL: Final = "all"
    REMOTE: Final = (
        "remote"  # a person in the room sees it anyway: a client in passthrough does not subscribe by itself
    )


class StreamFault:
    """Fault that the source of a media stream has found; empty without one."""

    FROZEN: Final = "frozen"  # frames come, and are all the same
    NO_DEPTH: Final = "no_depth"  # no pixel has a depth
    SATURATED: Final = "saturated"  # depth or colour at the end of its range
    SIZE: Final = "size"  # frames have another size than the intrinsics, or depth than colour
    MOVED: Final = "moved"  # the camera is not where it was calibrated
    POSE: Final = "pose"  # the pose is not finite, or that of its body is not known
    CLOCK: Final = "clock"  # times of capture jump, or lie in the future
    SLOW: Final = "slow"  # frames come later than the source means to hold
    SOURCE: Final = "source"  # the device or recording delivers no frames
    ALL: Final = frozenset({"frozen", "no_depth", "saturated", "size", "moved", "pose", "clock", "slow", "source"})


class LateCause:
    """Part of a late tick that took the time."""

    SCHEDULER: Final = "scheduler"  # the process was ready but did not run
    PHYSICS: Final = "physics"
    CONTROL: Final = "control"
    AUTHORITY: Final = "authority"
    OUTPUT: Final = "output"  # sending state, decisions, and to the recorder
    SUPERVISION: Final = "supervision"  # restart of a process
    OWNER: Final = "owner"  # the user's loop


# --- scene specification and assets ---


class GeometryKind:
    """Shape of a visual. Sizes are those of `Geometry.size`."""

    PLANE: Final = "plane"
    HFIELD: Final = "hfield"
    SPHERE: Final = "sphere"
    CAPSULE: Final = "capsule"
    ELLIPSOID: Final = "ellipsoid"
    CYLINDER: Final = "cylinder"
    BOX: Final = "box"
    MESH: Final = "mesh"
    SDF: Final = "sdf"  # a signed distance field, which comes as the mesh of its surface
    ALL: Final = frozenset({"plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf"})


class TextureKind:
    """Mapping of a texture onto a surface."""

    IMAGE: Final = "2d"
    CUBE: Final = "cube"  # looked up by the direction from the visual's centre
    SKYBOX: Final = "skybox"  # around the whole scene
    ALL: Final = frozenset({"2d", "cube", "skybox"})


class TextureRole:
    """Use of a texture in a material. `rgb`, `rgba`: its colour, the only one that every client must draw."""

    RGB: Final = "rgb"
    OCCLUSION: Final = "occlusion"
    ROUGHNESS: Final = "roughness"
    METALLIC: Final = "metallic"
    NORMAL: Final = "normal"
    OPACITY: Final = "opacity"
    EMISSIVE: Final = "emissive"
    RGBA: Final = "rgba"
    ORM: Final = "orm"  # occlusion, roughness, metallic in r, g, b
    USER: Final = "user"


class ColorSpace:
    """Encoding of the values of a texture. `auto`: as they are, without conversion."""

    AUTO: Final = "auto"
    LINEAR: Final = "linear"
    SRGB: Final = "srgb"


class LightKind:
    """Kind of a light."""

    SPOT: Final = "spot"
    DIRECTIONAL: Final = "directional"
    POINT: Final = "point"
    IMAGE: Final = "image"  # a texture lights the scene from all around
    ALL: Final = frozenset({"spot", "directional", "point", "image"})


class Follow:
    """Motion of a light or camera. Unknown values: like `fixed`."""

    FIXED: Final = "fixed"  # with its body, by its pose in the body
    TRACK: Final = "track"  # position with its body, orientation fixed in the world
    TRACK_COM: Final = "trackcom"  # as `track`, with the centre of mass of the body's subtree
    TARGET_BODY: Final = "targetbody"  # position with its body, directed at the target's frame
    TARGET_BODY_COM: Final = "targetbodycom"  # as `targetbody`, at the centre of mass of the target's subtree


class AssetEncoding:
    """Encoding of the bytes of an asset."""

    ARRAYS: Final = "arrays"  # `protocol.assets`: a header and compressed arrays
    PNG: Final = "png"
    JPEG: Final = "jpeg"
    OPAQUE: Final = "opaque"  # a texture in a form of its own, for example KTX: as the simulator has it


class ArrayKind:
    """Meaning of an asset of arrays."""

    MESH: Final = "mesh"
    IMAGE: Final = "image"
    GRID: Final = "grid"  # a height field
    DEFORMABLE: Final = "deformable"  # the topology and rest shape of a deformable


class ArrayName:
    """Meaning of an array of an asset; which ones a kind has is in docs/scene.md."""

    INDEX: Final = "index"  # of a mesh: three corners a triangle
    POSITION: Final = "position"
    NORMAL: Final = "normal"
    UV: Final = "uv"
    COLOR: Final = "color"  # of corners, 0..255: multiplies the colour of the visual that uses the mesh
    PIXELS: Final = "pixels"
    ELEVATION: Final = "elevation"
    ELEMENTS: Final = "elements"  # of a deformable: two vertices an edge, three a triangle
    VERTEX: Final = "vertex"  # of a deformable: numbers in the simulator
    PLAN: Final = "plan"  # of a deformable's stream


class ArrayFilter:
    """Transformation of an array before compression."""

    NONE: Final = "none"
    SHUFFLE: Final = "shuffle"  # first bytes of all elements, then second bytes, ...
    DELTA: Final = "delta"  # differences of consecutive elements modulo 2^bits, then `shuffle`
    UP: Final = "up"  # bytes minus the byte one row above, modulo 256


class ArrayCodec:
    """Compression of an array."""

    NONE: Final = "none"
    DEFLATE: Final = "deflate"  # one raw stream (RFC 1951), to the last byte
