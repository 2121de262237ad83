// Messages of the iris-session protocol. Written by `python -m tools.codegen typescript`: do not edit.
//
// Fields with a `?` may be missing in what is received: their value is then that of `DEFAULTS`. Values of open
// enumerations may be others than those listed.
// Some types are called like those of three.js and of browsers: `import type * as wire` keeps them apart.

export const PROTOCOL_VERSION = 1;
export const TOPIC_RIGID = "rigid";
export const TOPIC_PRESENCE = "presence";
export const RIGID_FORMAT = 2;
/** Edge of the position lattice [m]. */
export const RIGID_LATTICE_M = 6.103515625e-05;
export const RIGID_POSITION_BITS = 18;
export const RIGID_ROTATION_CENTRE = 8191;
export const SCENE_VERSION = 1;
export const MAX_SCENE_BYTES = 32000000;
export const ARRAYS_MAGIC = "IRA1";

/** Rights of a participant. Reserved for later message types: `camera`, `source`. */
export const Role = {
  OPERATOR: "operator",
  OBSERVER: "observer",
  DIRECTOR: "director",
  AGENT: "agent",
  LEADER: "leader",
  GATEWAY: "gateway",
  RECORDER: "recorder",
  CAMERA: "camera",
  SOURCE: "source",
} as const;
export type Role = (typeof Role)[keyof typeof Role] | (string & {});

/** Tracked sources of input of one participant. */
export const Device = {
  HEAD: "head",
  CONTROLLER_LEFT: "controller/left",
  CONTROLLER_RIGHT: "controller/right",
  HAND_LEFT: "hand/left",
  HAND_RIGHT: "hand/right",
  JOINTS: "joints",
  GAZE: "gaze",
  DESKTOP: "desktop",
  TARGET: "target",
} as const;
export type Device = (typeof Device)[keyof typeof Device] | (string & {});

/** Payload of a `Sample` that counts. */
export const SampleKind = {
  POSE: "pose",
  TWIST: "twist",
  JOINTS: "joints",
} as const;
export type SampleKind = (typeof SampleKind)[keyof typeof SampleKind] | (string & {});

/** Kind of a target. */
export const TargetKind = {
  ROBOT: "robot",
  OBJECT: "object",
} as const;
export type TargetKind = (typeof TargetKind)[keyof typeof TargetKind] | (string & {});

/** Rule by which a robot's lease passes between participants. */
export const LeaseMode = {
  EXCLUSIVE: "exclusive",
  REQUEST: "request",
  TAKEOVER: "takeover",
  PRIORITY: "priority",
  SHARED: "shared",
} as const;
export type LeaseMode = (typeof LeaseMode)[keyof typeof LeaseMode] | (string & {});

/** Rule that chooses a robot for a participant that names none. */
export const AssignmentPolicy = {
  CONFIG: "config",
  JOIN_ORDER: "join-order",
  NEAREST: "nearest",
  DIRECTOR: "director",
} as const;
export type AssignmentPolicy = (typeof AssignmentPolicy)[keyof typeof AssignmentPolicy] | (string & {});

/**
 * Origin of `T_world_tracking` of a participant.
 *
 * `fingertip`: marks touched with a fingertip, or with a tip that is not calibrated; `persistent`: an anchor that the
 * device kept, confirmed by no touch yet. Both are good enough to look, not to drive.
 */
export const AlignmentKind = {
  NONE: "none",
  MEASURED: "measured",
  PLACED: "placed",
  NOT_NEEDED: "not_needed",
  FINGERTIP: "fingertip",
  PERSISTENT: "persistent",
} as const;
export type AlignmentKind = (typeof AlignmentKind)[keyof typeof AlignmentKind] | (string & {});

/**
 * Action of `align`. `start`: measure anew, from nothing; `stop`: keep the alignment in force, ignore further
 * observations.
 */
export const AlignAction = {
  START: "start",
  STOP: "stop",
} as const;
export type AlignAction = (typeof AlignAction)[keyof typeof AlignAction] | (string & {});

/**
 * Evidence that an alignment is wrong.
 *
 * `changed`: an anchor is observed elsewhere than seconds ago. `differs`: and elsewhere than by the alignment. `jump`:
 * the tracking frame moved at once, which voids the alignment. `two_places`: one id is observed in two places, to and
 * fro: there are two prints of it.
 */
export const AlarmKind = {
  CHANGED: "changed",
  DIFFERS: "differs",
  JUMP: "jump",
  TWO_PLACES: "two_places",
} as const;
export type AlarmKind = (typeof AlarmKind)[keyof typeof AlarmKind] | (string & {});

/**
 * Reason why an alignment in force is *unconfirmed*: it begins no engagement until a look at an anchor confirms or
 * replaces it. Empty: none.
 */
export const AlignmentDoubt = {
  AGED: "aged",
  UNVERIFIED: "unverified",
  CONTRADICTED: "contradicted",
} as const;
export type AlignmentDoubt = (typeof AlignmentDoubt)[keyof typeof AlignmentDoubt] | (string & {});

/**
 * Kind of an observation: the form of the anchor, or the way in which it was found.
 *
 * `touch`: a tip or a fingertip on a mark. `tip`: a controller turned while its tip stayed in a hole. `persistent`: a
 * place that the device kept since an earlier alignment. `point`: a tip or a fingertip on any point that others touch
 * too, to measure how far apart their worlds are.
 */
export const AnchorKind = {
  QR: "qr",
  BOARD: "board",
  CONTROLLER: "controller",
  TOUCH: "touch",
  TIP: "tip",
  PERSISTENT: "persistent",
  POINT: "point",
} as const;
export type AnchorKind = (typeof AnchorKind)[keyof typeof AnchorKind] | (string & {});

/**
 * Source of an observation, whose constant errors are known by size (docs/anchors.md, "Biases").
 *
 * `qr_camera`: a detector of the application, on pictures of a camera. `qr_system`: codes that the system of the
 * headset tracks. `holder`: a tracked controller in its holder. `touch`: a tip on a mark.
 */
export const ObservationSource = {
  QR_CAMERA: "qr_camera",
  QR_SYSTEM: "qr_system",
  HOLDER: "holder",
  TOUCH: "touch",
} as const;
export type ObservationSource = (typeof ObservationSource)[keyof typeof ObservationSource] | (string & {});

/** Kind of a session. */
export const SessionKind = {
  LIVE: "live",
  REPLAY: "replay",
} as const;
export type SessionKind = (typeof SessionKind)[keyof typeof SessionKind] | (string & {});

/** Kind of a robot's command. */
export const CommandKind = {
  HOLD: "hold",
  POSE: "pose",
  TWIST: "twist",
  JOINTS: "joints",
} as const;
export type CommandKind = (typeof CommandKind)[keyof typeof CommandKind] | (string & {});

/** Reason why a robot holds. Exactly one is given with every hold command. */
export const HoldReason = {
  NO_LEASE: "no_lease",
  NO_SAMPLE: "no_sample",
  CLUTCH_OPEN: "clutch_open",
  STALE: "stale",
  NOT_WORN: "not_worn",
  UNTRACKED: "untracked",
  UNALIGNED: "unaligned",
  REJECTED: "rejected",
  ESTOP: "estop",
  DISCONNECTED: "disconnected",
  GAP: "gap",
  SCENE_CHANGED: "scene_changed",
  INTERVENTION: "intervention",
  REARM: "rearm",
  VIEW_ONLY: "view_only",
  EMULATED: "emulated",
  ZERO_POSE: "zero_pose",
  FROZEN: "frozen",
  JUMP: "jump",
  UNCONFIRMED: "unconfirmed",
  EPISODE: "episode",
} as const;
export type HoldReason = (typeof HoldReason)[keyof typeof HoldReason] | (string & {});

/** Reason why a sample was rejected. Counted per participant, device and reason. */
export const RejectReason = {
  CONNECTION_EPOCH: "connection_epoch",
  SCENE_EPOCH: "scene_epoch",
  TRACKING_EPOCH: "tracking_epoch",
  LEASE_VERSION: "lease_version",
  NOT_HOLDER: "not_holder",
  ALIGNMENT_VERSION: "alignment_version",
  SEQ: "seq",
  STALE: "stale",
  FUTURE: "future",
  NOT_FINITE: "not_finite",
  NOT_UNIT: "not_unit",
  TOO_FAST: "too_fast",
  SHAPE: "shape",
  UNKNOWN_VALUE: "unknown_value",
  UNKNOWN_TARGET: "unknown_target",
  ROLE: "role",
  UNALIGNED: "unaligned",
  QUOTA: "quota",
  DEVICE: "device",
  LEADER_APART: "leader_apart",
  KIND_MISMATCH: "kind",
  VIEW_ONLY: "view_only",
  EMULATED: "emulated",
  ZERO_POSE: "zero_pose",
  FROZEN: "frozen",
  JUMP: "jump",
  UNCONFIRMED: "unconfirmed",
} as const;
export type RejectReason = (typeof RejectReason)[keyof typeof RejectReason] | (string & {});

/** Reason why a request was denied. */
export const DenialReason = {
  HELD: "held",
  CONSENT_PENDING: "consent_pending",
  CONSENT_REFUSED: "consent_refused",
  ROLE: "role",
  UNKNOWN_TARGET: "unknown_target",
  UNKNOWN_PARTICIPANT: "unknown_participant",
  UNKNOWN_REQUEST: "unknown_request",
  UNKNOWN_VALUE: "unknown_value",
  LEASE_VERSION: "lease_version",
  NOT_HOLDER: "not_holder",
  NOT_JOINED: "not_joined",
  ALREADY_JOINED: "already_joined",
  ESTOP: "estop",
  UNALIGNED: "unaligned",
  ALIGNMENT_REFUSED: "alignment_refused",
  EPISODE_STATE: "episode_state",
  QUEUE_FULL: "queue_full",
  QUOTA: "quota",
  SESSION_FULL: "session_full",
  USER_OWNED: "user_owned",
  POLICY: "policy",
  INVALID: "invalid",
  WITHDRAWN: "withdrawn",
  TOO_FAR: "too_far",
  VIEW_ONLY: "view_only",
} as const;
export type DenialReason = (typeof DenialReason)[keyof typeof DenialReason] | (string & {});

/** Reason why the front refused a `hello`, before the authority received it. */
export const RefusalCode = {
  VERSION: "version",
  IDENTITY: "identity",
  MALFORMED: "malformed",
  TOO_LARGE: "too_large",
  RATE: "rate",
  GATEWAY_ONLY: "gateway_only",
  RESUME_TOKEN: "resume_token",
  FULL: "full",
  UNPAIRED: "unpaired",
  CODE: "code",
} as const;
export type RefusalCode = (typeof RefusalCode)[keyof typeof RefusalCode] | (string & {});

/** Reason of a `ProtocolFault`: a rejected message, or a change in the state of the session. */
export const FaultCode = {
  VERSION: "version",
  MALFORMED: "malformed",
  TOO_LARGE: "too_large",
  RATE: "rate",
  HELLO: "hello",
  DROPPED: "dropped",
  STALLED: "stalled",
  RECOVERED: "recovered",
  SESSION_ENDED: "session_ended",
  REVOKED: "revoked",
} as const;
export type FaultCode = (typeof FaultCode)[keyof typeof FaultCode] | (string & {});

/** Action of `episode`. */
export const EpisodeAction = {
  START: "start",
  STOP: "stop",
  SUCCESS: "success",
  FAILURE: "failure",
  UNKNOWN: "unknown",
  DISCARD: "discard",
  RERECORD: "rerecord",
  TAKE_OVER: "take_over",
  RESET: "reset",
} as const;
export type EpisodeAction = (typeof EpisodeAction)[keyof typeof EpisodeAction] | (string & {});

/** State of an episode (`EpisodeChanged`). */
export const EpisodeState = {
  IDLE: "idle",
  COUNTDOWN: "countdown",
  RUNNING: "running",
  CONFIRM: "confirm",
  LEFT: "left",
  CLOSING: "closing",
  SUCCESS: "success",
  FAILURE: "failure",
  DISCARDED: "discarded",
  UNKNOWN: "unknown",
  CANCELLED: "cancelled",
} as const;
export type EpisodeState = (typeof EpisodeState)[keyof typeof EpisodeState] | (string & {});

/** Action of `control`. */
export const ControlAction = {
  PAUSE: "pause",
  RESUME: "resume",
  STEP: "step",
  RESET: "reset",
} as const;
export type ControlAction = (typeof ControlAction)[keyof typeof ControlAction] | (string & {});

/** Kind of an `Audited` event. */
export const AuditKind = {
  PAIRED: "paired",
  CODE_REFUSED: "code_refused",
  CODE_EXHAUSTED: "code_exhausted",
  KEY_REFUSED: "key_refused",
  KEY_REVOKED: "key_revoked",
  ROLE_REFUSED: "role_refused",
  REMOVED: "removed",
  RENAMED: "renamed",
  ROLE_CHANGED: "role_changed",
  GATEWAY_REFUSED: "gateway_refused",
  TOKEN_REFUSED: "token_refused",
  TOKEN_MISUSED: "token_misused",
  FLOOD: "flood",
} as const;
export type AuditKind = (typeof AuditKind)[keyof typeof AuditKind] | (string & {});

/** Share of media that a client gets, from everything to nothing. State and control are never cut. */
export const BudgetClass = {
  FULL: "full",
  HALF: "half",
  QUARTER: "quarter",
  NONE: "none",
} as const;
export type BudgetClass = (typeof BudgetClass)[keyof typeof BudgetClass] | (string & {});

/** Temperature of a headset by what it does about it. Empty where it does not say. */
export const ThermalState = {
  NOMINAL: "nominal",
  WARM: "warm",
  HOT: "hot",
} as const;
export type ThermalState = (typeof ThermalState)[keyof typeof ThermalState] | (string & {});

/** Reason why a request for an asset is refused. After the last four the same request may succeed later. */
export const AssetRefusal = {
  UNKNOWN: "unknown_asset",
  BAD_RANGE: "bad_range",
  VERSION: "version",
  MALFORMED: "malformed",
  TOO_MANY: "too_many_outstanding",
  NOT_ALLOWED: "not_allowed",
  RATE: "rate",
  BUSY: "busy",
} as const;
export type AssetRefusal = (typeof AssetRefusal)[keyof typeof AssetRefusal] | (string & {});

/** Encoding of the bytes of a media frame. */
export const MediaEncoding = {
  BYTES: "bytes",
  DEFORMABLE: "deformable",
  CLOUD: "cloud",
  JPEG: "jpeg",
} as const;
export type MediaEncoding = (typeof MediaEncoding)[keyof typeof MediaEncoding] | (string & {});

/** Audience of a media stream. Unknown values: as `all`. */
export const StreamAudience = {
  ALL: "all",
  REMOTE: "remote",
} as const;
export type StreamAudience = (typeof StreamAudience)[keyof typeof StreamAudience] | (string & {});

/** Fault that the source of a media stream has found; empty without one. */
export const StreamFault = {
  FROZEN: "frozen",
  NO_DEPTH: "no_depth",
  SATURATED: "saturated",
  SIZE: "size",
  MOVED: "moved",
  POSE: "pose",
  CLOCK: "clock",
  SLOW: "slow",
  SOURCE: "source",
} as const;
export type StreamFault = (typeof StreamFault)[keyof typeof StreamFault] | (string & {});

/** Part of a late tick that took the time. */
export const LateCause = {
  SCHEDULER: "scheduler",
  PHYSICS: "physics",
  CONTROL: "control",
  AUTHORITY: "authority",
  OUTPUT: "output",
  SUPERVISION: "supervision",
  OWNER: "owner",
} as const;
export type LateCause = (typeof LateCause)[keyof typeof LateCause] | (string & {});

/** Shape of a visual. Sizes are those of `Geometry.size`. */
export const GeometryKind = {
  PLANE: "plane",
  HFIELD: "hfield",
  SPHERE: "sphere",
  CAPSULE: "capsule",
  ELLIPSOID: "ellipsoid",
  CYLINDER: "cylinder",
  BOX: "box",
  MESH: "mesh",
  SDF: "sdf",
} as const;
export type GeometryKind = (typeof GeometryKind)[keyof typeof GeometryKind] | (string & {});

/** Mapping of a texture onto a surface. */
export const TextureKind = {
  IMAGE: "2d",
  CUBE: "cube",
  SKYBOX: "skybox",
} as const;
export type TextureKind = (typeof TextureKind)[keyof typeof TextureKind] | (string & {});

/** Use of a texture in a material. `rgb`, `rgba`: its colour, the only one that every client must draw. */
export const TextureRole = {
  RGB: "rgb",
  OCCLUSION: "occlusion",
  ROUGHNESS: "roughness",
  METALLIC: "metallic",
  NORMAL: "normal",
  OPACITY: "opacity",
  EMISSIVE: "emissive",
  RGBA: "rgba",
  ORM: "orm",
  USER: "user",
} as const;
export type TextureRole = (typeof TextureRole)[keyof typeof TextureRole] | (string & {});

/** Encoding of the values of a texture. `auto`: as they are, without conversion. */
export const ColorSpace = {
  AUTO: "auto",
  LINEAR: "linear",
  SRGB: "srgb",
} as const;
export type ColorSpace = (typeof ColorSpace)[keyof typeof ColorSpace] | (string & {});

/** Kind of a light. */
export const LightKind = {
  SPOT: "spot",
  DIRECTIONAL: "directional",
  POINT: "point",
  IMAGE: "image",
} as const;
export type LightKind = (typeof LightKind)[keyof typeof LightKind] | (string & {});

/** Motion of a light or camera. Unknown values: like `fixed`. */
export const Follow = {
  FIXED: "fixed",
  TRACK: "track",
  TRACK_COM: "trackcom",
  TARGET_BODY: "targetbody",
  TARGET_BODY_COM: "targetbodycom",
} as const;
export type Follow = (typeof Follow)[keyof typeof Follow] | (string & {});

/** Encoding of the bytes of an asset. */
export const AssetEncoding = {
  ARRAYS: "arrays",
  PNG: "png",
  JPEG: "jpeg",
  OPAQUE: "opaque",
} as const;
export type AssetEncoding = (typeof AssetEncoding)[keyof typeof AssetEncoding] | (string & {});

/** Meaning of an asset of arrays. */
export const ArrayKind = {
  MESH: "mesh",
  IMAGE: "image",
  GRID: "grid",
  DEFORMABLE: "deformable",
} as const;
export type ArrayKind = (typeof ArrayKind)[keyof typeof ArrayKind] | (string & {});

/** Meaning of an array of an asset; which ones a kind has is in docs/scene.md. */
export const ArrayName = {
  INDEX: "index",
  POSITION: "position",
  NORMAL: "normal",
  UV: "uv",
  COLOR: "color",
  PIXELS: "pixels",
  ELEVATION: "elevation",
  ELEMENTS: "elements",
  VERTEX: "vertex",
  PLAN: "plan",
} as const;
export type ArrayName = (typeof ArrayName)[keyof typeof ArrayName] | (string & {});

/** Transformation of an array before compression. */
export const ArrayFilter = {
  NONE: "none",
  SHUFFLE: "shuffle",
  DELTA: "delta",
  UP: "up",
} as const;
export type ArrayFilter = (typeof ArrayFilter)[keyof typeof ArrayFilter] | (string & {});

/** Compression of an array. */
export const ArrayCodec = {
  NONE: "none",
  DEFLATE: "deflate",
} as const;
export type ArrayCodec = (typeof ArrayCodec)[keyof typeof ArrayCodec] | (string & {});

/** A rigid transform `T_a_b`: position `p` [m] of frame b in a, rotation `q` `[w, x, y, z]` from b to a. */
export type Pose = [
  p: [number, number, number],
  q: [number, number, number, number],
];

/** Target of a sample, and the lease that it is driven under. `lease_version` is the fencing token. */
export type Target = [
  name: string,
  lease_version: number,
  kind?: TargetKind,
];

/**
 * Public state of one lease. `holder` is a participant id, empty when free.
 *
 * `expires_ns` is the session time at which the grace period of a disconnected holder ends, 0 while it is connected.
 * `sub_holders` and `weights` have the same length: everyone who shares the target (mode `shared`, objects), or an
 * agent and the human who stands by (mode `priority`; the one in charge is `holder` and has weight 1, the other 0). In
 * mode `shared` a token stays valid for its holder when others join and raise `lease_version`. `scale`: motion scaling
 * of a robot for its `holder`, 1 by default.
 */
export interface Lease {
  target: string;
  kind: TargetKind;
  mode: LeaseMode;
  holder: string;
  lease_version: number;
  expires_ns?: number;
  queue?: string[];
  sub_holders?: string[];
  weights?: number[];
  scale?: number;
}

/**
 * A typed denial: the reason (`DenialReason`), the holder of the target, and advice.
 *
 * Texts that list what would have been right are cut to the length of a `Text`.
 */
export interface Denial {
  reason: DenialReason;
  message: string;
  advice?: string;
  target?: string;
  holder?: string;
  holder_name?: string;
}

/**
 * `T_world_tracking` of one participant, as accepted by the authority.
 *
 * `covariance`: 6x6 row-major, order (x, y, z [m], rx, ry, rz [rad]), world frame, empty when unknown; that of the
 * position is stated at `pivot_world`.
 * `error_at_anchor_m`, `error_at_robot_m`: stated p95 of the position error at the anchor and at the robot.
 */
export interface Alignment {
  version: number;
  kind: AlignmentKind;
  T_world_tracking: Pose;
  tracking_epoch?: number;
  covariance?: number[];
  error_at_anchor_m?: number;
  error_at_robot_m?: number;
  offset?: boolean;
  pivot_world?: [number, number, number];
}

/** The newest sample that entered the IK target behind the `ctrl` in use, for one robot. All times session time. */
export type Applied = [
  robot: string,
  participant: string,
  device: Device,
  seq: number,
  capture_ns: number,
  receive_ns: number,
  step_ns: number,
];

/** Ports of the other channels on the host of the control channel. `media_ingest`: for media sources. */
export interface Endpoints {
  state?: number;
  media?: number;
  assets?: number;
  web?: number;
  media_ingest?: number;
}

/** One row of the roster. */
export interface ParticipantInfo {
  id: string;
  name: string;
  role: Role;
  connected: boolean;
  devices?: Device[];
  worn?: boolean;
  tracking_epoch?: number;
  alignment?: Alignment | null;
}

/**
 * An actuator of a robot. `low`, `high`: limits of its `ctrl`.
 *
 * `scale`, `offset`: `ctrl = scale * x + offset` asks for the position x: of the joint [rad or m], or of the gripper,
 * 0 open to 1 closed. `scale` 0: it is not controlled by position.
 */
export type ActuatorInfo = [
  name: string,
  low: number,
  high: number,
  scale?: number,
  offset?: number,
];

/**
 * A robot as clients need it. `site_body`: id of the body that carries the end-effector site; `T_body_site`.
 *
 * `actuators`: in the order of `RobotState.ctrl`, one for each of the joints (none for a robot that only its owner's
 * program moves), then those of the gripper. `kind`: `arm`, or `hand`: it follows joints only, no poses.
 */
export interface RobotInfo {
  name: string;
  joints: string[];
  base_body: number;
  site_body: number;
  T_body_site: Pose;
  gripper: boolean;
  actuators?: ActuatorInfo[];
  kind?: string;
}

/** One streamed rigid body: its index in state frames is its position in `Snapshot.bodies`. */
export type BodyInfo = [
  id: number,
  name: string,
  moving: boolean,
  object?: boolean,
];

/**
 * A mark of an anchor that can be touched, such as a printed cross. `p_anchor`: its position in the anchor frame
 * [m].
 */
export interface AnchorMark {
  id: string;
  p_anchor: [number, number, number];
}

/**
 * An anchor of the session. `size_m`: edge of its sheet, `error_m`: stated p95 of its position; 0: unknown.
 * `marks`: in the order in which they are best touched.
 */
export interface AnchorInfo {
  id: string;
  T_world_anchor: Pose;
  size_m?: number;
  error_m?: number;
  marks?: AnchorMark[];
}

/** Median and 99th percentile [ms] over the last seconds; null where nothing was measured. */
export type Quantiles = [
  p50: number,
  p99: number,
];

/**
 * Camera of a media stream: pinhole with OpenCV's distortion, and where it is.
 *
 * `fx`, `fy`, `cx`, `cy` [px]: the centre of the first pixel is at 0. `distortion`: 0, 4, 5 or 8 coefficients (k1, k2,
 * p1, p2, k3, ...). `position`, `orientation`: pose of the optical frame (x right, y down, z forward) in the frame of
 * `body`, a body of the scene; in the world if that is empty.
 */
export interface StreamCamera {
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  distortion?: number[];
  body?: string;
  position?: [number, number, number];
  orientation?: [number, number, number, number];
}

/**
 * Description of a stream by its source. `title`: for people; empty: the stream's name. `hz`: frames per second
 * that it means to hold, 0 for a stream at rest. `fault`: why its frames are wrong, or do not come; `detail`: the same
 * in one line, for people. The session passes on 64 characters of the title, and 256 of the detail.
 */
export interface StreamInfo {
  title?: string;
  audience?: StreamAudience;
  camera?: StreamCamera | null;
  hz?: number;
  fault?: StreamFault;
  detail?: string;
}

/**
 * One media stream, and the class that a client gets. `mbit_per_s`: of that class, as measured. `encoding`: of its
 * newest frame, so that a client knows what it would get before it subscribes. `title`, `audience`, `camera`, `hz`,
 * `fault`, `detail`: of its newest `StreamInfo`. `stale`: no frame came for so long that the newest one shows what
 * was. `taken_by`: what this client sends under the name is refused, because the stream is of that source; else empty.
 */
export interface StreamBudget {
  stream: string;
  budget_class?: BudgetClass;
  mbit_per_s?: number;
  encoding?: MediaEncoding;
  title?: string;
  audience?: StreamAudience;
  camera?: StreamCamera | null;
  fault?: StreamFault;
  detail?: string;
  stale?: boolean;
  taken_by?: string;
  hz?: number;
}

/** Observations of one anchor by a headset: their number in this run, and the age of the newest. */
export interface AnchorSeen {
  anchor_id: string;
  observations: number;
  age_ns: number;
}

/**
 * State of the alignment of one participant, beyond `AlignmentChanged`.
 *
 * `error_at_anchor_m`, `error_at_robot_m`: stated p95. `pending_m`, `pending_rad`: size of a correction that waits, or
 * slides in. `advice`: why the estimator refuses, or warns. `alarm`: the last `AlarmKind` that no new alignment has
 * resolved yet, `alarm_ns` ago. `unusable`: observations that could not be used, since the run began. `doubt`: why it
 * is unconfirmed and begins no engagement (`AlignmentDoubt`), empty for not so. `confirmed_ns`: since the last look
 * that agreed with it, -1 without an alignment.
 */
export interface AlignmentReport {
  version?: number;
  running?: boolean;
  offset?: boolean;
  error_at_anchor_m?: number;
  error_at_robot_m?: number;
  residual_tilt_rad?: number;
  observations?: number;
  viewpoints?: number;
  unusable?: number;
  pending_m?: number;
  pending_rad?: number;
  advice?: string;
  alarm?: AlarmKind;
  alarm_size_m?: number;
  alarm_ns?: number;
  seen?: AnchorSeen[];
  doubt?: AlignmentDoubt;
  confirmed_ns?: number;
}

/**
 * The newest comparison of two headsets, `age_ns` ago; fields as in `HeadsetsCompared`. `outdated`: one of them has
 * been aligned elsewhere since.
 */
export interface CrossCheckReport {
  a: string;
  b: string;
  anchor_id: string;
  error_m: number;
  error_rad: number;
  expected_p95_m: number;
  age_ns: number;
  n?: number;
  touched?: boolean;
  outdated?: boolean;
}

/**
 * Two headsets that are not known to have the same world: `other` has aligned by an anchor since `participant` last
 * saw it, and the anchor may have been moved in between. A glance of `participant` at it verifies the pair.
 */
export interface UnverifiedReport {
  participant: string;
  other: string;
  anchor_id: string;
}

/** One anchor of the session. `size_m`: edge of the printed sheet, 0 for not known. */
export interface AnchorReport {
  anchor_id: string;
  T_world_anchor: Pose;
  size_m?: number;
}

/**
 * One e-stop that is in force: its number, and who stopped the session `age_ns` ago, for which reason.
 *
 * `participant`, `name`: empty for a connection that had not joined.
 */
export interface StopReport {
  stop_seq: number;
  participant: string;
  name: string;
  reason: string;
  age_ns: number;
}

/**
 * One participant, as the session sees it. Times in `*_ns` are durations until now, -1 for never.
 *
 * `capture_to_receive`: device to front. `state_age`: end of tick to application, as its client reports it.
 * `alignment_void_ns`: since the tracking frame jumped and voided the alignment, -1 for not so. `lost`: why it is
 * disconnected (`silent`, `closed`, `slow`, ...), empty while connected. `rejected`: samples by reason, `drops`:
 * messages dropped, both since it joined. `reported`: its client reports. `media`: the streams that it subscribed to,
 * `budget_class` the lowest of theirs, empty without one. `media_bytes_per_s`: sent to it, `media_drops`: frames that
 * its link did not take in time, since it joined. `display_hz`, `battery`, `charging`, `thermal`, `dropped_frames`,
 * `shown_age_ms`: as in `ClientReport`.
 */
export interface ParticipantReport {
  id: string;
  name: string;
  role: Role;
  connected: boolean;
  address?: string;
  software?: string;
  worn?: boolean;
  heard_ns?: number;
  alignment?: AlignmentKind;
  alignment_age_ns?: number;
  alignment_void_ns?: number;
  alignment_error_m?: number;
  tracking_epoch?: number;
  holds?: string[];
  waits_for?: string[];
  samples_per_s?: number;
  capture_to_receive?: Quantiles | null;
  state_age?: Quantiles | null;
  missed_share?: number;
  rtt_ms?: number;
  bytes_per_s?: number;
  budget_class?: BudgetClass;
  rejected?: Record<string, number>;
  drops?: number;
  reported?: boolean;
  lost?: string;
  media?: StreamBudget[];
  media_bytes_per_s?: number;
  media_drops?: number;
  alignment_report?: AlignmentReport | null;
  display_hz?: number;
  battery?: number;
  charging?: boolean;
  thermal?: string;
  dropped_frames?: number;
  shown_age_ms?: number;
}

/** One robot: its holder, its state, and the reason why it holds. */
export interface RobotReport {
  name: string;
  mode: LeaseMode;
  holder?: string;
  holder_name?: string;
  state?: CommandKind;
  hold_reason?: HoldReason;
  receive_to_step?: Quantiles | null;
  queue?: string[];
}

/**
 * State of the recorder: `off` (nothing is recorded), `running`, `hangs` (silent for 5 s), `dead` (being replaced),
 * `failed` (the file cannot be written) or `ended` (its budget is used up). `disk_free_bytes` 0: not known.
 * `spilled_bytes`: what waits in memory for a recorder that is behind. `text`: its last message, for people.
 * `bytes_per_hour`: what the recording costs an hour at the rate of the last half minute; 0: not known yet.
 */
export interface RecorderReport {
  state?: string;
  path?: string;
  bytes_written?: number;
  disk_free_bytes?: number;
  lost_rows?: number;
  spilled_bytes?: number;
  text?: string;
  bytes_per_hour?: number;
}

/**
 * One media stream, at its best class. `source`: its publisher's name, empty for the session's own process.
 * `subscribers`: participants that subscribed to it. `encoding`, `age_ms`: of the newest frame; its age since the
 * session received it. `title`, `audience`, `fault`, `detail`, `stale`: as in `StreamBudget`.
 */
export interface MediaStreamReport {
  stream: string;
  hz?: number;
  mbit_per_s?: number;
  source?: string;
  subscribers?: number;
  encoding?: MediaEncoding;
  age_ms?: number;
  title?: string;
  audience?: StreamAudience;
  fault?: StreamFault;
  detail?: string;
  stale?: boolean;
}

/**
 * The assets channel. `served`: assets of the present scene. Since the front began: `bytes_sent`, `requests`, and
 * `refusals`, of requests and connections. `waiting`: connections with an unanswered request.
 */
export interface AssetsReport {
  served?: number;
  bytes_sent?: number;
  requests?: number;
  refusals?: number;
  waiting?: number;
}

/**
 * First message of a connection.
 *
 * `secret`: client-made 128-bit secret that stands for the key on plain loopback; behind a gateway the 32 bytes of a
 * web identity. `resume_token`: from the last `Welcome`, single use. `alignment`: `measured`, or `not_needed` for
 * policies, leaders, desktop and remote VR. `certificate_hash`: of a gateway, SHA-256 of the SubjectPublicKeyInfo of
 * the certificate that it shows to those behind it.
 */
export interface Hello {
  type: "hello";
  role: Role;
  name: string;
  software?: string;
  devices?: Device[];
  capabilities?: string[];
  alignment?: AlignmentKind;
  secret?: Uint8Array;
  resume_token?: Uint8Array;
  join_code?: string;
  certificate_hash?: Uint8Array;
}

/** Leave the session at once: leases are released without grace. */
export interface Bye {
  type: "bye";
  reason?: string;
}

/** Report of a gateway that one behind it lost its connection: the grace period begins at once. */
export interface Disconnected {
  type: "disconnected";
  reason?: string;
}

/** Sign of life, sent at least every `Welcome.heartbeat_ns`. `worn` false: the headset is not worn. */
export interface Heartbeat {
  type: "heartbeat";
  worn?: boolean;
}

/**
 * Clock measurement. `t0_ns`: the client's own monotonic clock at sending. Answered by `ClockPong` from the
 * front.
 */
export interface ClockPing {
  type: "clock_ping";
  t0_ns: number;
}

/** Request for a `Snapshot`. `request_id` is repeated in it. */
export interface GetSnapshot {
  type: "get_snapshot";
  request_id?: number;
}

/**
 * One input message of one device.
 *
 * `capture_ns`: when it was sampled (session time by the client's clock estimate), not when it will be displayed.
 * `pose`: `T_tracking_device`. `twist`: (vx, vy, vz [m/s], wx, wy, wz [rad/s]) in the tracking frame.
 * `clutch`: true while the person wants the target to follow. `gripper`: 0 open to 1 closed.
 * `buttons`: bit mask (section 6). `hand_joints`: up to 26 poses `T_tracking_joint` flattened (x, y, z, qw, qx, qy,
 * qz): 25 in the order of WebXR (the wrist first), 26 in that of OpenXR (the palm first); not in every sample. `q`,
 * `qd`: a leader's joint positions [rad or m] and velocities. `emulated`: the position of `pose` is an estimate, not
 * a measurement (WebXR `emulatedPosition`; OpenXR: valid, but not tracked): it drives nothing.
 */
export interface Sample {
  type: "sample";
  device: Device;
  kind: SampleKind;
  seq: number;
  capture_ns: number;
  scene_epoch: number;
  tracking_epoch: number;
  alignment_version: number;
  targets?: Target[];
  tracked?: boolean;
  worn?: boolean;
  clutch?: boolean;
  gripper?: number | null;
  buttons?: number;
  pose?: Pose | null;
  twist?: [number, number, number, number, number, number] | null;
  hand_joints?: number[];
  q?: number[];
  qd?: number[];
  emulated?: boolean;
}

/**
 * Samples of several devices that were taken together, such as head and both controllers at a display frame.
 *
 * Each counts as if it had arrived alone; together they cost one message, one packet and one wake-up.
 */
export interface Samples {
  type: "samples";
  samples: Sample[];
}

/** Request for leases, all or none. No names: the assignment policy chooses one robot. `wait`: queue when held. */
export interface Acquire {
  type: "acquire";
  request_id: number;
  robots?: string[];
  objects?: string[];
  wait?: boolean;
  weight?: number;
}

/** Return leases. No targets: all of them and every place in a queue. */
export interface Release {
  type: "release";
  request_id?: number;
  targets?: Target[];
}

/**
 * Take back the `acquire` with this request id. It is denied (`withdrawn`, with its place in the queue and the
 * holder); if it was granted before, what it has granted is released.
 */
export interface Withdraw {
  type: "withdraw";
  request_id: number;
  acquire_request_id: number;
}

/** Answer of a holder or director to a `ConsentRequested` event (mode `request`). */
export interface Consent {
  type: "consent";
  request_id: number;
  consent_id: number;
  grant: boolean;
}

/** Assign robots to a participant (empty: free them), even if another one holds them. Directors only. */
export interface Assign {
  type: "assign";
  request_id: number;
  robots: string[];
  participant?: string;
}

/** Change the lease mode of a robot. Directors only. Blending weights (mode `shared`) come with each `Acquire`. */
export interface SetMode {
  type: "set_mode";
  request_id: number;
  robot: string;
  mode: LeaseMode;
}

/**
 * Set how far robots move as the hand moves: 1 as far, 0.1 a tenth. No names: all robots of the sender.
 *
 * For holders and directors. Translation is scaled (that of twists too); rotation, joints and device `target` are not.
 * The scale belongs to the present holder: the next one begins at 1. Changing it while engaged moves nothing by
 * itself.
 */
export interface SetScale {
  type: "set_scale";
  request_id: number;
  robots?: string[];
  scale?: number;
}

/** Take a free object with a hand, without a robot. The lease on the object comes back in the `Reply`. */
export interface Grasp {
  type: "grasp";
  request_id: number;
  object: string;
  device: Device;
}

/**
 * Observation of an anchor by a headset or camera: `T_tracking_anchor`.
 *
 * `kind`: `AnchorKind`. `size_m`: edge of the sheet as detected. `viewpoint_id`: observations with the same number
 * share their systematic error. `covariance`: 6x6 row-major (position, rotation), tracking axes, of kind `persistent`
 * those of the anchor, or empty. `quality`: 0 to 1.
 * `source`: `ObservationSource`, empty for that of `kind`: `qr_camera`, `holder` or `touch`.
 * `mark`: touched mark of the anchor (`AnchorInfo.marks`), empty for the origin of the anchor. `grip_poses`: of kind
 * `tip`, `T_tracking_grip` of `device` (section 5). `alternative`: of a flat sheet, the other `T_tracking_anchor` that
 * explains the picture. `residuals_px`: rms of both, in this order, or empty.
 */
export interface Observation {
  type: "observation";
  anchor_id: string;
  kind: AnchorKind;
  T_tracking_anchor: Pose;
  capture_ns: number;
  tracking_epoch: number;
  viewpoint_id?: number;
  size_m?: number;
  quality?: number;
  device?: Device;
  covariance?: number[];
  mark?: string;
  grip_poses?: Pose[];
  source?: ObservationSource;
  alternative?: Pose | null;
  residuals_px?: number[];
}

/** Align a participant by hand, or add an offset to a measured alignment (`offset` true). Directors only. */
export interface PlaceAlignment {
  type: "place_alignment";
  request_id: number;
  participant: string;
  T_world_tracking: Pose;
  offset?: boolean;
}

/**
 * Start or stop the alignment run of a participant (`AlignAction`); `participant` empty: the sender's own.
 *
 * A director may do so for everyone, others for themselves. The alignment in force stays until there is a better one.
 */
export interface Align {
  type: "align";
  request_id: number;
  action: AlignAction;
  participant?: string;
}

/**
 * Set where an anchor of the session is: the shared scene moves for everyone who is aligned to it. Directors only.
 *
 * `force`: also when it is further than 5 m from its old place, which is more often a wrong number than intended.
 */
export interface MoveAnchor {
  type: "move_anchor";
  request_id: number;
  anchor_id: string;
  T_world_anchor: Pose;
  force?: boolean;
}

/**
 * Report that the tracking frame jumped (recentre, lost tracking): every earlier alignment of this participant is
 * void.
 */
export interface TrackingEpoch {
  type: "tracking_epoch";
  tracking_epoch: number;
}

/**
 * Start, end or take over an episode (`EpisodeAction`). `countdown_ns`: of `start`, at most 60 s; None: that of the
 * session.
 */
export interface Episode {
  type: "episode";
  request_id: number;
  action: EpisodeAction;
  label?: string;
  countdown_ns?: number | null;
}

/** Stop everything. Any participant may do so. Latched. Not a safety-rated stop. */
export interface EStop {
  type: "estop";
  reason?: string;
}

/**
 * End the e-stop. Directors only. `stop_seq`: the newest stop that the sender has seen (`EStopChanged`); denied
 * when there is a newer one.
 */
export interface ClearEStop {
  type: "clear_estop";
  request_id: number;
  stop_seq?: number;
}

/**
 * Control the session, `ControlAction`: pause, resume, step (`ticks` physics ticks while paused), reset. Directors
 * only. When physics has diverged, both reset and resume begin anew from the initial state.
 */
export interface Control {
  type: "control";
  request_id: number;
  action: ControlAction;
  ticks?: number;
}

/** Put a note into the recording, at the session time of its receipt. */
export interface Marker {
  type: "marker";
  request_id: number;
  text: string;
}

/**
 * Request to put the key of this connection on the allow-list: the only message allowed from an unknown key.
 *
 * `proof`: shows that the sender knows a join code, without revealing it (`protocol.pairing`). `name`: under which the
 * key is listed. `identity`: behind a gateway, the 32 bytes of the web identity that is to be listed.
 */
export interface Pair {
  type: "pair";
  name: string;
  proof: Uint8Array;
  software?: string;
  identity?: Uint8Array;
}

/** End the participation of a participant. Directors only. `revoke`: its key is taken off the allow-list too. */
export interface RemoveParticipant {
  type: "remove_participant";
  request_id: number;
  participant: string;
  revoke?: boolean;
  reason?: string;
}

/** Give a participant another name: oneself, or as a director anyone. A name that another one has gets a number. */
export interface Rename {
  type: "rename";
  request_id: number;
  participant: string;
  name: string;
}

/**
 * Give a participant another role, one that its key may join in. Directors only.
 *
 * It keeps what it holds when it may drive in both roles as a person, or in both as an agent.
 */
export interface SetRole {
  type: "set_role";
  request_id: number;
  participant: string;
  role: Role;
}

/** Request for a `StatusReport`. */
export interface GetStatus {
  type: "get_status";
  request_id?: number;
}

/**
 * Delivery of state to the application of a client, once a second: for status, doctor and delivery budgets.
 *
 * Ages are from the end of the tick to the application, by the client's clock estimate [ms], over the last second.
 * `missed`: frames that were sent (by `state_seq`) and not delivered. `rtt_ms`: lowest recent round trip.
 * `media_bytes_per_s`, `media_age_ms` (median since capture): of the media channel. `display_hz`: frames drawn, 0 when
 * none are. `media_limit_mbit_per_s`: upper bound of media that the client asks for, 0 for no limit of its own.
 * `battery`: charge of the device, 0 to 1, -1 where it is not known. `thermal`: a `ThermalState`. `dropped_frames`:
 * frames that were not drawn in time, over the last second. `shown_age_ms`: of the picture that is shown, as
 * `age_ms_p50` and what interpolating and drawing add, 0 where it is not known.
 */
export interface ClientReport {
  type: "client_report";
  age_ms_p50: number;
  age_ms_p99: number;
  delivered: number;
  missed?: number;
  rtt_ms?: number;
  bytes_per_s?: number;
  media_bytes_per_s?: number;
  media_age_ms?: number;
  display_hz?: number;
  media_limit_mbit_per_s?: number;
  battery?: number;
  charging?: boolean;
  thermal?: string;
  dropped_frames?: number;
  shown_age_ms?: number;
}

/**
 * Answer to an accepted `hello`. `resume_token` is bound to the key and may be used once.
 *
 * `tick_period_ns`: of the present scene; another scene may have another (`SceneChanged`). `task_robots`: robots of
 * the task, whose holders start its episodes; empty: any robot.
 */
export interface Welcome {
  type: "welcome";
  session_id: string;
  session_name: string;
  kind: SessionKind;
  participant_id: string;
  connection_epoch: number;
  role: Role;
  resume_token: Uint8Array;
  resumed: boolean;
  session_time: number;
  heartbeat_ns: number;
  tick_period_ns: number;
  state_period_ns: number;
  endpoints: Endpoints;
  key_fingerprint?: string;
  task_robots?: string[];
}

/** A `hello` that the front refused (`RefusalCode`), or that the authority denied (`DenialReason`). */
export interface Refused {
  type: "refused";
  code: RefusalCode;
  message: string;
  advice?: string;
  supported_versions?: number[];
}

/**
 * A message that was rejected, or a change in the state of the session. `code`: `FaultCode`.
 *
 * `reason`: with `dropped` and `revoked`, why the session closed this connection: `replaced` (another connection
 * resumed this participant: joining again would take it back), `removed`, `revoked`, `expired`, ...
 */
export interface ProtocolFault {
  type: "protocol_fault";
  code: FaultCode;
  message: string;
  reason?: string;
}

/** `t0_ns` echoed; `t1_ns`, `t2_ns`: session time of receipt and of sending. */
export interface ClockPong {
  type: "clock_pong";
  t0_ns: number;
  t1_ns: number;
  t2_ns: number;
}

/** Answer to a request: leases as they are now, or a denial (then nothing has changed). */
export interface Reply {
  type: "reply";
  request_id: number;
  ok: boolean;
  denial?: Denial | null;
  leases?: Lease[];
}

/**
 * Feedback to the holder of a robot, for haptics and hints. Sent on change and at most at 20 Hz per robot.
 *
 * `state`: the command kind in force, `hold_reason` when it is `hold`. `limits`: joints or bounds that are active.
 * `rejected`: counts by `RejectReason` for this participant since it joined. `contact_n`: force on the gripper [N].
 */
export interface Feedback {
  type: "feedback";
  robot: string;
  state: CommandKind;
  hold_reason?: HoldReason;
  contact_n?: number;
  limits?: string[];
  rejected?: Record<string, number>;
}

/** One entry of the shared history. A gap in `event_seq`: request a new snapshot. */
export interface Event {
  type: "event";
  event_seq: number;
  step: number;
  session_time: number;
  body: EventKind;
}

/**
 * Everything a late joiner needs; events with `event_seq` at or below its own are to be discarded.
 *
 * In the step of a reset `tick` and `sim_time` are still those before it. `tick_period_ns`: of this scene; 0: that of
 * `Welcome`. `stop_seq`: of the newest stop (`EStopChanged`). `consent_timeout_ns`: time that a holder has to answer
 * `ConsentRequested`. `anchors`: as they are after its events. Bulk frame 1 (added by the front): float64 (n_bodies,
 * 7) world poses `x y z qw qx qy qz` of `bodies` at `state_seq`.
 */
export interface Snapshot {
  type: "snapshot";
  request_id: number;
  event_seq: number;
  scene_epoch: number;
  scene_revision: number;
  scene_hash: string;
  tick: number;
  sim_time: number;
  session_time: number;
  participants: ParticipantInfo[];
  leases: Lease[];
  robots?: RobotInfo[];
  bodies?: BodyInfo[];
  paused?: boolean;
  estop?: boolean;
  episode?: EpisodeChanged | null;
  state_seq?: number;
  tick_period_ns?: number;
  stop_seq?: number;
  consent_timeout_ns?: number;
  anchors?: AnchorInfo[];
}

/**
 * The key is on the allow-list. Connect anew to send `hello`: this connection stays that of an unknown key.
 *
 * `proof`: shows that the session knows the join code too, so it is the one that issued it. `roles`: those that this
 * key may join as; empty: any role.
 */
export interface Paired {
  type: "paired";
  proof: Uint8Array;
  roles?: Role[];
}

/**
 * Answer to `GetStatus`. Shares are of the last ten seconds unless their name has `total`.
 *
 * `late_causes`: late ticks by the part that took the time (`LateCause`), and `skipped` for those left out after a
 * long gap. `lateness`: of ticks, after their deadline. `step_to_publish`: end of tick to the state socket, of the
 * last five seconds; null below 25 states in them. `drops`: by reason, all messages dropped anywhere. `restarts`: of
 * front and recorder. `authority_silent_ns`: since the authority's last message to the front; its part (ticks, roster,
 * robots, recorder) is as old. -1: it has sent none yet. `cpu_share`: of one processor, by the authority's process;
 * `load`: of the machine, over a minute. `stops`: the e-stops in force, newest first, the newest of each participant.
 * `pause_reason`: why physics stands still until a reset, empty otherwise. `unverified`: pairs of headsets.
 * `paused_by`: name of who paused, empty while it runs, or where that was before a restart.
 */
export interface StatusReport {
  type: "status_report";
  request_id: number;
  session_id: string;
  session_name: string;
  session_time: number;
  tick?: number;
  tick_period_ns?: number;
  paused?: boolean;
  estop?: boolean;
  stalled?: boolean;
  scheduling?: string;
  late_share?: number;
  late_share_total?: number;
  lateness?: Quantiles | null;
  late_causes?: Record<string, number>;
  step_to_publish?: Quantiles | null;
  cpu_share?: number;
  load?: number;
  cpus?: number;
  memory_bytes?: number;
  participants?: ParticipantReport[];
  robots?: RobotReport[];
  recorder?: RecorderReport | null;
  drops?: Record<string, number>;
  restarts?: Record<string, number>;
  connections?: number;
  entries_per_s?: number;
  warnings?: string[];
  authority_silent_ns?: number;
  media?: MediaStreamReport[];
  anchors?: AnchorReport[];
  cross_checks?: CrossCheckReport[];
  assets?: AssetsReport | null;
  stops?: StopReport[];
  pause_reason?: string;
  unverified?: UnverifiedReport[];
  paused_by?: string;
}

/**
 * Media that this client gets from now on. Sent after `Welcome`, and whenever it changes.
 *
 * `budget_class`: the lowest class among the streams that it subscribed to. State and control are never cut.
 * `mbit_per_s`: bound of all media together, 0 for none. `reason`: why it is not everything. `streams`: every stream
 * of the session.
 */
export interface DeliveryBudget {
  type: "delivery_budget";
  budget_class: BudgetClass;
  mbit_per_s?: number;
  reason?: string;
  streams?: StreamBudget[];
}

/** A participant joined, or resumed after a disconnect. */
export interface ParticipantJoined {
  event: "participant_joined";
  participant: ParticipantInfo;
  resumed?: boolean;
}

/** The row of a participant in the roster changed. */
export interface ParticipantChanged {
  event: "participant_changed";
  participant: ParticipantInfo;
}

/** A participant left. `grace` true: it is disconnected, leases are kept until `Lease.expires_ns`. */
export interface ParticipantLeft {
  event: "participant_left";
  participant: string;
  reason: string;
  grace?: boolean;
}

/**
 * `cause`: acquired, released, expired, takeover, assigned, resumed, consent, priority, left, mode, queue, role (a
 * director gave the holder another one), scene_changed (another scene was loaded that has no such robot or object).
 */
export interface LeaseChanged {
  event: "lease_changed";
  lease: Lease;
  cause: string;
  previous_holder?: string;
}

/**
 * Several leases changed in one step for the same `cause`, as `LeaseChanged` for each, in this order.
 *
 * `previous_holders` has the length of `leases`.
 */
export interface LeasesChanged {
  event: "leases_changed";
  leases: Lease[];
  cause: string;
  previous_holders: string[];
}

/** `requester` asks `holder` for a robot (mode `request`); answered by `Consent` with this `consent_id`. */
export interface ConsentRequested {
  event: "consent_requested";
  consent_id: number;
  target: string;
  requester: string;
  holder: string;
}

/** Mode `priority`: a human overrides an agent (`active`), or the agent has the robot again. */
export interface Intervention {
  event: "intervention";
  robot: string;
  human: string;
  agent: string;
  active: boolean;
}

/** A participant's clutch engaged a robot, or the engagement ended for `reason` (`HoldReason`). */
export interface EngagementChanged {
  event: "engagement_changed";
  robot: string;
  participant: string;
  engaged: boolean;
  reason?: string;
}

/**
 * `participant` set the motion scaling of a robot for its holder. When a holder leaves, `LeaseChanged` has the
 * scale.
 */
export interface ScaleChanged {
  event: "scale_changed";
  robot: string;
  scale: number;
  participant: string;
}

/** Another alignment of a participant is in force. */
export interface AlignmentChanged {
  event: "alignment_changed";
  participant: string;
  alignment: Alignment;
}

/** The alignment run of a participant was started (`running`), or stopped. `run` counts the starts. */
export interface AlignmentRun {
  event: "alignment_run";
  participant: string;
  running: boolean;
  run: number;
  by?: string;
}

/**
 * The alignment of a participant was found wrong by `size_m` (`AlarmKind`); a `jump` has voided it. `beside`:
 * anchors that stayed in place meanwhile: then the anchor was moved, not the headset. `witnesses`: other participants
 * whose headsets see the same shift of the anchor: then it was moved too.
 */
export interface AlignmentAlarmed {
  event: "alignment_alarmed";
  participant: string;
  kind: AlarmKind;
  anchor_id: string;
  size_m: number;
  beside?: string[];
  witnesses?: string[];
}

/** A director moved an anchor: alignments to it follow. */
export interface AnchorMoved {
  event: "anchor_moved";
  anchor_id: string;
  T_world_anchor: Pose;
  by?: string;
}

/**
 * Answer to an observation of kind `tip`: the tip of a controller of a participant, or why it is unknown
 * (`refused`, `advice`).
 *
 * `p_grip_tip`: position of the tip in the grip frame of `device` [m]. `covariance`: of it, 3x3 row-major [m^2].
 * `error_m`: its stated p95. `residual_m`: scatter of the poses about the hole. `n_poses`: those that were used.
 */
export interface TipCalibrated {
  event: "tip_calibrated";
  participant: string;
  device: Device;
  p_grip_tip?: [number, number, number];
  covariance?: number[];
  error_m?: number;
  residual_m?: number;
  n_poses?: number;
  refused?: boolean;
  advice?: string;
}

/**
 * Cross-check: participants `a` and `b` observe one anchor (`anchor_id`, at `p_world`) `error_m` and `error_rad`
 * apart.
 *
 * `expected_p95_m`: 95 % of such pairs stay below it by their stated errors and the noise of these `n` observations.
 * `touched`: `anchor_id` is the name of a point that both have touched.
 */
export interface HeadsetsCompared {
  event: "headsets_compared";
  a: string;
  b: string;
  anchor_id: string;
  error_m: number;
  error_rad: number;
  expected_p95_m: number;
  p_world: [number, number, number];
  n: number;
  touched?: boolean;
}

/**
 * `cause`: reset, new_scene, patch, external (the user's loop went back in time).
 *
 * `scene_hash`: after a patch, the address of the scene's specification as it is now; fetch that. Else empty.
 * `tick_period_ns`: of the new scene; 0: as it was.
 */
export interface SceneChanged {
  event: "scene_changed";
  scene_epoch: number;
  scene_revision: number;
  cause: string;
  scene_hash?: string;
  tick_period_ns?: number;
}

/**
 * The session was stopped (`active`), also when it was stopped already, or the e-stop was cleared by `participant`.
 *
 * `stop_seq` counts the stops from 1; of a clear: the newest stop that it ended. `participant`: empty for a stop of a
 * connection that has not joined.
 */
export interface EStopChanged {
  event: "estop_changed";
  active: boolean;
  participant: string;
  reason?: string;
  stop_seq?: number;
}

/**
 * The session was paused or resumed by `participant`. `reason`: of a pause that only a reset ends (physics that
 * diverged).
 */
export interface PauseChanged {
  event: "pause_changed";
  paused: boolean;
  participant?: string;
  reason?: string;
}

/**
 * An episode is in another `EpisodeState`, by `participant`.
 *
 * `number` counts from 1, in a task also those of earlier sessions. `label`: free text that was given with it. `task`,
 * `instruction`, `wanted`: of the task, empty and 0 without one; `successes`: so many there are by now.
 * `started_by`, `started_by_name`: who started it; `led_by`: who leads it now. `started_ns`: session time from which
 * it is recorded, 0 before. `until_ns`: end of the countdown, of the question, or of the time to take it over or to
 * give the verdict; 0: none. `verdict`: while closing, empty until it is given. `robots`: that belong to it.
 */
export interface EpisodeChanged {
  event: "episode_changed";
  number: number;
  state: EpisodeState;
  label?: string;
  participant?: string;
  task?: string;
  instruction?: string;
  wanted?: number;
  successes?: number;
  started_by?: string;
  started_by_name?: string;
  led_by?: string;
  started_ns?: number;
  until_ns?: number;
  verdict?: EpisodeState;
  robots?: string[];
}

/** A hand took a free object (`grasped`), or released it. */
export interface ObjectGrasped {
  event: "object_grasped";
  object: string;
  participant: string;
  device: Device;
  grasped: boolean;
}

/** An object passed from one robot to another through contact alone. `duration_ns`: both grippers touched it. */
export interface Handover {
  event: "handover";
  object: string;
  giver: string;
  receiver: string;
  giver_participant: string;
  receiver_participant: string;
  duration_ns: number;
}

/** A note of a participant in the recording. */
export interface MarkerAdded {
  event: "marker_added";
  participant: string;
  text: string;
}

/** First rejection of a kind, then at most one per second and (participant, device, reason). */
export interface SamplesRejected {
  event: "samples_rejected";
  participant: string;
  device: Device;
  reason: RejectReason;
  count: number;
}

/** `kind`: `stalled` (no step for so long), `recording` (`rows` are lost), `resumed` (from an earlier recording). */
export interface Gap {
  event: "gap";
  kind: string;
  duration_ns: number;
  rows?: number;
}

/**
 * A text for an operator. `level`: info, warning, error. `participant`: whom it concerns. `reason`: the
 * `DenialReason` of a refusal that answers no request (of an alignment, or of a button).
 */
export interface Notice {
  event: "notice";
  level: string;
  text: string;
  participant?: string;
  reason?: string;
}

/**
 * An event that concerns security. `kind`: `AuditKind`. `subject`: fingerprint of a key, or a participant id.
 *
 * Repeated ones (wrong codes, unknown keys) come at most once a second and address, with their `count`.
 */
export interface Audited {
  event: "audited";
  kind: AuditKind;
  subject?: string;
  name?: string;
  address?: string;
  detail?: string;
  count?: number;
}

/**
 * One control-channel message from a client: `[version, connection_epoch, on_behalf_of, message]`.
 *
 * `connection_epoch`: from `Welcome`; 0 in `hello`. `on_behalf_of`: only role `gateway` may set it.
 */
export type ClientEnvelope = [
  version: number,
  connection_epoch: number,
  on_behalf_of: string,
  message: ClientMessage,
];

/** `[version, connection_epoch, message]`. `connection_epoch` is that of the connection it is meant for. */
export type ServerEnvelope = [
  version: number,
  connection_epoch: number,
  message: ServerMessage,
];

/**
 * First payload frame of a rigid-state message; topic frame before it, encoded poses after it.
 *
 * `session_time`: end of the tick that this state belongs to. `published_ns`: session time when handed to the socket.
 * `base_seq`: a client that holds any frame >= `base_seq` of this `scene_epoch` has every body within the bound after
 * this one; an older client asks for a snapshot. `ticks` are counted within the epoch.
 */
export type StateHeader = [
  scene_epoch: number,
  scene_revision: number,
  tick: number,
  sim_time: number,
  session_time: number,
  published_ns: number,
  state_seq: number,
  base_seq: number,
  applied?: Applied[],
];

/** A device of a participant in the world. Only of participants that are aligned. */
export type PresenceItem = [
  participant: string,
  device: Device,
  pose: Pose,
  capture_ns?: number,
];

/** Message on topic `presence`: heads and hands of everyone, latest value. */
export type Presence = [
  session_time: number,
  published_ns: number,
  items: PresenceItem[],
];

/**
 * Measured and commanded values of one robot after a tick.
 *
 * Attributes:
 *     robot: Its name.
 *     q: Joint positions [rad or m], in the order of `RobotInfo.joints`.
 *     qd: Joint velocities [rad/s or m/s], in the same order.
 *     tip: Measured `T_world_tip` of the end effector.
 *     gripper: Measured opening, 0 open to 1 closed, as in samples; beyond these where it is pressed there. `None`
 *         without a gripper that is controlled by position.
 *     contact_n: Sum of the normal contact forces on the gripper [N].
 *     target: `T_world_tip` that the session moves the end effector to; `None` while the robot holds or is driven by
 *         joints.
 *     ctrl: `ctrl` of its actuators in the last tick, in the order of the joints, then those of the gripper, in the
 *         units of the model.
 */
export type RobotState = [
  robot: string,
  q: number[],
  qd: number[],
  tip: Pose,
  gripper?: number | null,
  contact_n?: number,
  target?: Pose | null,
  ctrl?: number[],
];

/**
 * Message on topic `robots`: all robots, latest value. Sent from when a client names the capability
 * `robot_states`. Times and ticks are as in `StateHeader`.
 */
export type RobotStates = [
  scene_epoch: number,
  tick: number,
  sim_time: number,
  session_time: number,
  published_ns: number,
  robots: RobotState[],
];

/**
 * Second frame of a media message: topic before it, one bulk frame after it.
 *
 * `seq`: of the stream, as its source numbered it; at `half` and `quarter` some are left out. `capture_ns`: when it
 * was captured or computed, `published_ns`: when it was passed to the socket, both session time. `dropped`: frames of
 * this subscriber that its link did not take before newer ones were there, since it subscribed. `sent_ns`,
 * `received_ns`: when its source passed it to a socket and when the session received it, session time; 0: not known.
 */
export type MediaHeader = [
  stream: string,
  budget_class: BudgetClass,
  scene_epoch: number,
  seq: number,
  capture_ns: number,
  published_ns: number,
  encoding?: MediaEncoding,
  dropped?: number,
  sent_ns?: number,
  received_ns?: number,
];

/**
 * First frame of a source's message; a bulk frame for each of `classes` follows, in their order.
 *
 * `classes`: `full`, and any of `half` and `quarter` that the source has in a coarser form; none in a message that has
 * an `info` and no frame. `info`: of the stream, with its first frames, when it changes, and once a second; null: as
 * before. `sent_ns`: when the source passed the message to its socket, session time; 0: not known. `connection_epoch`:
 * of the sender's `Welcome`, by which the session knows whose stream it is; 0: not known.
 */
export type MediaPush = [
  stream: string,
  scene_epoch: number,
  capture_ns: number,
  classes?: BudgetClass[],
  encoding?: MediaEncoding,
  info?: StreamInfo | null,
  sent_ns?: number,
  connection_epoch?: number,
];

/**
 * Request for `length` bytes of an asset from `offset` on; the answer is shorter when the asset ends before.
 *
 * `connection_epoch`: of the sender's `Welcome`. `request_id`: any number; repeated in the answer. `address`: SHA-256
 * of the asset, 64 hexadecimal digits.
 */
export type AssetRequest = [
  version: number,
  connection_epoch: number,
  request_id: number,
  address: string,
  offset: number,
  length: number,
];

/** First of two frames; the second holds bytes `offset` and following of an asset that has `total` bytes. */
export type AssetChunk = [
  version: number,
  request_id: number,
  address: string,
  offset: number,
  total: number,
];

/** The only frame of an answer: no bytes come for this request. `request_id` 0: it could not be read. */
export type AssetRefused = [
  version: number,
  request_id: number,
  address: string,
  reason: AssetRefusal,
  advice?: string,
];

/** UDP discovery datagram, 5 Hz. Never needed: an address can be typed or scanned. */
export interface Beacon {
  protocol: number;
  session_id: string;
  session_name: string;
  kind: SessionKind;
  host: string;
  control: number;
  state: number;
  media: number;
  assets: number;
  web: number;
  key_fingerprint?: string;
}

/**
 * Introduction of a session, written to a TCP connection to control port - 1, which is then closed. Nothing is
 * read.
 *
 * `server_key`: the CURVE public key, Z85 (40 characters); empty: the session is not encrypted (loopback only).
 * `pairing`: a join code can be used now. `participants`: how many are connected.
 */
export interface Introduction {
  beacon: Beacon;
  server_key?: string;
  pairing?: boolean;
  participants?: number;
}

/**
 * A whole scene. `bodies`: parents before their children. `source`: its origin, for people.
 *
 * `groups_shown`: visuals, sites, tendons and deformables of other groups are hidden at first.
 */
export interface SceneSpec {
  version?: number;
  name?: string;
  source?: string;
  bodies?: Body[];
  visuals?: Visual[];
  materials?: Material[];
  textures?: Texture[];
  meshes?: Mesh[];
  hfields?: HeightField[];
  lights?: Light[];
  cameras?: Camera[];
  sites?: Site[];
  tendons?: Tendon[];
  deformables?: Deformable[];
  environment?: Environment;
  groups_shown?: number[];
  totals?: Totals;
}

/**
 * One rigid body. `id`: that of `BodyInfo` in the state stream; 0 is the world, which is not streamed.
 *
 * `T_parent_body`: rest pose in the parent's frame. `T_world_body`: rest pose in the world, of the initial state. A
 * body that is not `moving` stays there for good.
 */
export interface Body {
  id: number;
  name: string;
  parent: number;
  T_parent_body: Pose;
  T_world_body: Pose;
  moving: boolean;
}

/**
 * A shape on a body. `id`: the simulator's number of it (MuJoCo geom; of a site 1,048,576 more than its number).
 * `rgba` is the colour to draw: a colour of its own, or the material's; with alpha 0 it is not drawn. `group`: see
 * `SceneSpec.groups_shown`.
 */
export interface Visual {
  id: number;
  body: number;
  name: string;
  T_body_visual: Pose;
  group: number;
  geometry: Geometry;
  material: number;
  rgba: [number, number, number, number];
}

/**
 * A shape, centred in its own frame. `kind` of `GeometryKind`; draw unknown kinds as a box of `size`.
 *
 * `size` [m]: half lengths along x, y, z of the extent. plane: half lengths x, y, 0 is without end; its normal is +z,
 * z is the spacing of grid lines. sphere: radius three times. capsule, cylinder: radius, radius, half length along z,
 * of a capsule without its caps. hfield: half x, half y, height of elevation 1. mesh, sdf: the scale of generated
 * texture coordinates (see docs/scene.md); the vertices are in metres as they are.
 */
export interface Geometry {
  kind: GeometryKind;
  size: [number, number, number];
  mesh?: number;
  hfield?: number;
}

/**
 * Surface appearance, in MuJoCo's terms. `specular`, `shininess` (times 128: exponent), `reflectance`: 0..1.
 *
 * `emission`: light of its own, times the colour. `metallic`, `roughness`: -1 where the scene does not set them. The
 * texture's colour multiplies that of the visual. `repeat`: times that a 2d texture is laid over the shape, or over
 * one metre when `uniform` (docs/scene.md, texture coordinates).
 */
export interface Material {
  name: string;
  rgba: [number, number, number, number];
  emission?: number;
  specular?: number;
  shininess?: number;
  reflectance?: number;
  metallic?: number;
  roughness?: number;
  textures?: TextureUse[];
  repeat?: [number, number];
  uniform?: boolean;
}

/** A texture in one `TextureRole`. */
export interface TextureUse {
  role: TextureRole;
  texture: number;
}

/**
 * An image. `height` of cube and skybox is that of one face; their assets hold six, one below the other, in the
 * order right, left, up, down, front, back. Level 0 is the whole image, each further one has half its sides.
 */
export interface Texture {
  name: string;
  kind: TextureKind;
  width: number;
  height: number;
  channels: number;
  colorspace: ColorSpace;
  levels: TextureLevel[];
}

/** One size of a texture. `max_error`: largest difference of a channel to the exact pixels of this size, 0..255. */
export interface TextureLevel {
  address: string;
  bytes: number;
  encoding: AssetEncoding;
  width: number;
  height: number;
  max_error?: number;
}

/** Triangles. Level 0 is exact, each further one coarser. `low`, `high`: the box around it in its frame [m]. */
export interface Mesh {
  name: string;
  low: [number, number, number];
  high: [number, number, number];
  textured: boolean;
  levels: MeshLevel[];
}

/**
 * One level of detail. `max_error_m`: how far its points lie from the exact mesh at most [m], 0: exact. Parts of
 * the exact mesh that are smaller than this may be missing.
 */
export interface MeshLevel {
  address: string;
  bytes: number;
  encoding: AssetEncoding;
  vertices: number;
  triangles: number;
  max_error_m?: number;
}

/**
 * Elevations on a grid, rows along y, columns along x, in 0..1.
 *
 * `size` [m]: half length along x, along y, height of elevation 1, depth of the base below 0.
 */
export interface HeightField {
  name: string;
  rows: number;
  columns: number;
  size: [number, number, number, number];
  address: string;
  bytes: number;
  encoding?: AssetEncoding;
}

/**
 * A light on a body, shining along `direction`, a unit vector in the body's frame.
 *
 * `attenuation`: constant, linear [1/m], quadratic [1/m^2]. `cutoff`: half angle of a spot [deg], `exponent`: of the
 * cosine within it. `intensity` [cd]: 0 where the scene does not say. `range` [m]: 0 for no end.
 */
export interface Light {
  name: string;
  kind: LightKind;
  body: number;
  p_body: [number, number, number];
  direction_body: [number, number, number];
  ambient: [number, number, number];
  diffuse: [number, number, number];
  specular: [number, number, number];
  attenuation?: [number, number, number];
  cutoff?: number;
  exponent?: number;
  range?: number;
  intensity?: number;
  bulb_radius?: number;
  texture?: number;
  castshadow?: boolean;
  active?: boolean;
  follow?: Follow;
  target?: number;
}

/**
 * A camera on a body: looks along -z of its own frame, y is up.
 *
 * `fovy`: vertical field of view [deg], of an orthographic camera the height of what it sees [m]. `focal`,
 * `principal`: in pixels, `principal` from the centre of the picture, x right, y up; 0 where only `fovy` counts.
 * `resolution`: pixels, 1 x 1 where the scene does not say.
 */
export interface Camera {
  name: string;
  body: number;
  T_body_camera: Pose;
  fovy: number;
  orthographic?: boolean;
  focal?: [number, number];
  principal?: [number, number];
  resolution?: [number, number];
  follow?: Follow;
  target?: number;
}

/** A place on a body that a tendon runs through, drawn as a shape. Marked places of a MuJoCo model are visuals. */
export interface Site {
  id: number;
  body: number;
  name: string;
  T_body_site: Pose;
  group: number;
  geometry: Geometry;
  material: number;
  rgba: [number, number, number, number];
}

/**
 * A cable, drawn as straight pieces of radius `width` [m] through `sites`, ids. Tendons of a MuJoCo model, which go
 * around shapes, are deformables.
 */
export interface Tendon {
  name: string;
  group: number;
  width: number;
  sites: number[];
  material: number;
  rgba: [number, number, number, number];
}

/**
 * A mesh whose vertices move: ropes (`dim` 1), cloths (2), surfaces of soft bodies (3).
 *
 * The asset has the elements (edges for `dim` 1, triangles else), texture coordinates, and the vertices of the initial
 * state, in the world. `stream`: of the media channel, whose frames hold the vertices in the same order. `radius` [m]:
 * half the thickness. `flat`: one normal per triangle.
 */
export interface Deformable {
  name: string;
  dim: number;
  group: number;
  vertices: number;
  elements: number;
  radius: number;
  flat: boolean;
  material: number;
  rgba: [number, number, number, number];
  stream: string;
  address: string;
  bytes: number;
  encoding?: AssetEncoding;
}

/** Surroundings of the scene. `skybox`: a texture. Lengths [m]. Haze blends the skybox's horizon, fog all. */
export interface Environment {
  headlight?: Headlight;
  skybox?: number;
  haze_rgba?: [number, number, number, number];
  haze?: number;
  fog_rgba?: [number, number, number, number];
  fog_start?: number;
  fog_end?: number;
  znear?: number;
  zfar?: number;
  extent?: number;
  center?: [number, number, number];
}

/** A light without shadow at the viewer's head that shines where it looks. */
export interface Headlight {
  active?: boolean;
  ambient?: [number, number, number];
  diffuse?: [number, number, number];
  specular?: [number, number, number];
}

/**
 * Cost of the scene with everything exact: each asset once, triangles as often as they are drawn.
 *
 * `objects`, `triangles`: of the groups that are shown at first. `texture_memory`: bytes on a graphics card.
 */
export interface Totals {
  objects?: number;
  triangles?: number;
  mesh_bytes?: number;
  texture_bytes?: number;
  texture_memory?: number;
  asset_bytes?: number;
}

/**
 * The header of a container. `kind` of `ArrayKind`; `max_error`: stated bound on the values, in their unit, 0:
 * exact.
 */
export interface ArrayHeader {
  kind: ArrayKind;
  arrays: ArrayInfo[];
  max_error?: number;
}

/**
 * One array. `dtype`: `u1`, `i1`, `u2`, `u4`, `f4`, little-endian. `shape`: C order.
 *
 * `bytes`: of its compressed form. Values are `offset + scale * stored`, per entry of the last axis, where `scale`
 * is not empty.
 */
export interface ArrayInfo {
  name: ArrayName;
  dtype: string;
  shape: number[];
  bytes: number;
  filter?: ArrayFilter;
  codec?: ArrayCodec;
  scale?: number[];
  offset?: number[];
}

/** Change how a visual is drawn; fields that are null stay. `rgba` with alpha 0 hides it. */
export interface SetVisual {
  op: "set_visual";
  visual: number;
  rgba?: [number, number, number, number] | null;
  group?: number | null;
  material?: number | null;
  T_body_visual?: Pose | null;
}

/** Add decoration to a body (0: the world). Its `id` must be free. */
export interface AddVisual {
  op: "add_visual";
  visual: Visual;
}

/** Remove a visual. */
export interface RemoveVisual {
  op: "remove_visual";
  visual: number;
}

/** Append a mesh to the list, for visuals that come after it. */
export interface AddMesh {
  op: "add_mesh";
  mesh: Mesh;
}

/** Append a material to the list, for visuals that come after it. */
export interface AddMaterial {
  op: "add_material";
  material: Material;
}

export type ClientMessage =
  | Hello
  | Bye
  | Disconnected
  | Heartbeat
  | ClockPing
  | GetSnapshot
  | Sample
  | Samples
  | Acquire
  | Release
  | Withdraw
  | Consent
  | Assign
  | SetMode
  | SetScale
  | Grasp
  | Observation
  | PlaceAlignment
  | Align
  | MoveAnchor
  | TrackingEpoch
  | Episode
  | EStop
  | ClearEStop
  | Control
  | Marker
  | Pair
  | RemoveParticipant
  | Rename
  | SetRole
  | GetStatus
  | ClientReport;

export type ServerMessage =
  | Welcome
  | Refused
  | ProtocolFault
  | ClockPong
  | Reply
  | Feedback
  | Event
  | Snapshot
  | Paired
  | StatusReport
  | DeliveryBudget;

export type EventKind =
  | ParticipantJoined
  | ParticipantChanged
  | ParticipantLeft
  | LeaseChanged
  | LeasesChanged
  | ConsentRequested
  | Intervention
  | EngagementChanged
  | ScaleChanged
  | AlignmentChanged
  | AlignmentRun
  | AlignmentAlarmed
  | AnchorMoved
  | TipCalibrated
  | HeadsetsCompared
  | SceneChanged
  | EStopChanged
  | PauseChanged
  | EpisodeChanged
  | ObjectGrasped
  | Handover
  | MarkerAdded
  | SamplesRejected
  | Gap
  | Notice
  | Audited;

export type PatchOp =
  | SetVisual
  | AddVisual
  | RemoveVisual
  | AddMesh
  | AddMaterial;

/** Values of the fields that a message, event or operation may leave out, by its tag. */
export const DEFAULTS = {
  hello: { software: "", devices: [], capabilities: [], alignment: "measured", secret: new Uint8Array(), resume_token: new Uint8Array(), join_code: "", certificate_hash: new Uint8Array() },
  bye: { reason: "" },
  disconnected: { reason: "closed" },
  heartbeat: { worn: true },
  clock_ping: {},
  get_snapshot: { request_id: 0 },
  sample: { targets: [], tracked: true, worn: true, clutch: false, gripper: null, buttons: 0, pose: null, twist: null, hand_joints: [], q: [], qd: [], emulated: false },
  samples: {},
  acquire: { robots: [], objects: [], wait: false, weight: 1.0 },
  release: { request_id: 0, targets: [] },
  withdraw: {},
  consent: {},
  assign: { participant: "" },
  set_mode: {},
  set_scale: { robots: [], scale: 1.0 },
  grasp: {},
  observation: { viewpoint_id: 0, size_m: 0.0, quality: 1.0, device: "head", covariance: [], mark: "", grip_poses: [], source: "", alternative: null, residuals_px: [] },
  place_alignment: { offset: false },
  align: { participant: "" },
  move_anchor: { force: false },
  tracking_epoch: {},
  episode: { label: "", countdown_ns: null },
  estop: { reason: "" },
  clear_estop: { stop_seq: 0 },
  control: { ticks: 1 },
  marker: {},
  pair: { software: "", identity: new Uint8Array() },
  remove_participant: { revoke: false, reason: "" },
  rename: {},
  set_role: {},
  get_status: { request_id: 0 },
  client_report: { missed: 0, rtt_ms: 0.0, bytes_per_s: 0.0, media_bytes_per_s: 0.0, media_age_ms: 0.0, display_hz: 0.0, media_limit_mbit_per_s: 0.0, battery: -1.0, charging: false, thermal: "", dropped_frames: 0, shown_age_ms: 0.0 },
  welcome: { key_fingerprint: "", task_robots: [] },
  refused: { advice: "", supported_versions: [1] },
  protocol_fault: { reason: "" },
  clock_pong: {},
  reply: { denial: null, leases: [] },
  feedback: { hold_reason: "", contact_n: 0.0, limits: [], rejected: {} },
  event: {},
  snapshot: { robots: [], bodies: [], paused: false, estop: false, episode: null, state_seq: 0, tick_period_ns: 0, stop_seq: 0, consent_timeout_ns: 0, anchors: [] },
  paired: { roles: [] },
  status_report: { tick: 0, tick_period_ns: 0, paused: false, estop: false, stalled: false, scheduling: "", late_share: 0.0, late_share_total: 0.0, lateness: null, late_causes: {}, step_to_publish: null, cpu_share: 0.0, load: 0.0, cpus: 0, memory_bytes: 0, participants: [], robots: [], recorder: null, drops: {}, restarts: {}, connections: 0, entries_per_s: 0.0, warnings: [], authority_silent_ns: -1, media: [], anchors: [], cross_checks: [], assets: null, stops: [], pause_reason: "", unverified: [], paused_by: "" },
  delivery_budget: { mbit_per_s: 0.0, reason: "", streams: [] },
  participant_joined: { resumed: false },
  participant_changed: {},
  participant_left: { grace: false },
  lease_changed: { previous_holder: "" },
  leases_changed: {},
  consent_requested: {},
  intervention: {},
  engagement_changed: { reason: "" },
  scale_changed: {},
  alignment_changed: {},
  alignment_run: { by: "" },
  alignment_alarmed: { beside: [], witnesses: [] },
  anchor_moved: { by: "" },
  tip_calibrated: { p_grip_tip: [0.0, 0.0, 0.0], covariance: [], error_m: 0.0, residual_m: 0.0, n_poses: 0, refused: false, advice: "" },
  headsets_compared: { touched: false },
  scene_changed: { scene_hash: "", tick_period_ns: 0 },
  estop_changed: { reason: "", stop_seq: 0 },
  pause_changed: { participant: "", reason: "" },
  episode_changed: { label: "", participant: "", task: "", instruction: "", wanted: 0, successes: 0, started_by: "", started_by_name: "", led_by: "", started_ns: 0, until_ns: 0, verdict: "", robots: [] },
  object_grasped: {},
  handover: {},
  marker_added: {},
  samples_rejected: {},
  gap: { rows: 0 },
  notice: { participant: "", reason: "" },
  audited: { subject: "", name: "", address: "", detail: "", count: 1 },
  set_visual: { rgba: null, group: null, material: null, T_body_visual: null },
  add_visual: {},
  remove_visual: {},
  add_mesh: {},
  add_material: {},
} as const;

/** Values of the fields that other maps may leave out, by the name of their type. */
export const VALUE_DEFAULTS = {
  Lease: {
    expires_ns: 0,
    queue: [],
    sub_holders: [],
    weights: [],
    scale: 1.0,
  },
  Denial: {
    advice: "",
    target: "",
    holder: "",
    holder_name: "",
  },
  Alignment: {
    tracking_epoch: 0,
    covariance: [],
    error_at_anchor_m: 0.0,
    error_at_robot_m: 0.0,
    offset: false,
    pivot_world: [0.0, 0.0, 0.0],
  },
  Endpoints: {
    state: 0,
    media: 0,
    assets: 0,
    web: 0,
    media_ingest: 0,
  },
  ParticipantInfo: {
    devices: [],
    worn: true,
    tracking_epoch: 0,
    alignment: null,
  },
  RobotInfo: {
    actuators: [],
    kind: "arm",
  },
  AnchorInfo: {
    size_m: 0.0,
    error_m: 0.0,
    marks: [],
  },
  StreamCamera: {
    distortion: [],
    body: "",
    position: [0.0, 0.0, 0.0],
    orientation: [1.0, 0.0, 0.0, 0.0],
  },
  StreamInfo: {
    title: "",
    audience: "all",
    camera: null,
    hz: 0.0,
    fault: "",
    detail: "",
  },
  StreamBudget: {
    budget_class: "full",
    mbit_per_s: 0.0,
    encoding: "bytes",
    title: "",
    audience: "all",
    camera: null,
    fault: "",
    detail: "",
    stale: false,
    taken_by: "",
    hz: 0.0,
  },
  AlignmentReport: {
    version: 0,
    running: true,
    offset: false,
    error_at_anchor_m: 0.0,
    error_at_robot_m: 0.0,
    residual_tilt_rad: 0.0,
    observations: 0,
    viewpoints: 0,
    unusable: 0,
    pending_m: 0.0,
    pending_rad: 0.0,
    advice: "",
    alarm: "",
    alarm_size_m: 0.0,
    alarm_ns: -1,
    seen: [],
    doubt: "",
    confirmed_ns: -1,
  },
  CrossCheckReport: {
    n: 0,
    touched: false,
    outdated: false,
  },
  AnchorReport: {
    size_m: 0.0,
  },
  ParticipantReport: {
    address: "",
    software: "",
    worn: true,
    heard_ns: -1,
    alignment: "none",
    alignment_age_ns: -1,
    alignment_void_ns: -1,
    alignment_error_m: 0.0,
    tracking_epoch: 0,
    holds: [],
    waits_for: [],
    samples_per_s: 0.0,
    capture_to_receive: null,
    state_age: null,
    missed_share: 0.0,
    rtt_ms: 0.0,
    bytes_per_s: 0.0,
    budget_class: "",
    rejected: {},
    drops: 0,
    reported: false,
    lost: "",
    media: [],
    media_bytes_per_s: 0.0,
    media_drops: 0,
    alignment_report: null,
    display_hz: 0.0,
    battery: -1.0,
    charging: false,
    thermal: "",
    dropped_frames: 0,
    shown_age_ms: 0.0,
  },
  RobotReport: {
    holder: "",
    holder_name: "",
    state: "",
    hold_reason: "",
    receive_to_step: null,
    queue: [],
  },
  RecorderReport: {
    state: "off",
    path: "",
    bytes_written: 0,
    disk_free_bytes: 0,
    lost_rows: 0,
    spilled_bytes: 0,
    text: "",
    bytes_per_hour: 0,
  },
  MediaStreamReport: {
    hz: 0.0,
    mbit_per_s: 0.0,
    source: "",
    subscribers: 0,
    encoding: "bytes",
    age_ms: 0.0,
    title: "",
    audience: "all",
    fault: "",
    detail: "",
    stale: false,
  },
  AssetsReport: {
    served: 0,
    bytes_sent: 0,
    requests: 0,
    refusals: 0,
    waiting: 0,
  },
  Beacon: {
    key_fingerprint: "",
  },
  Introduction: {
    server_key: "",
    pairing: false,
    participants: 0,
  },
  SceneSpec: {
    version: 1,
    name: "",
    source: "",
    bodies: [],
    visuals: [],
    materials: [],
    textures: [],
    meshes: [],
    hfields: [],
    lights: [],
    cameras: [],
    sites: [],
    tendons: [],
    deformables: [],
    environment: {"headlight": {"active": true, "ambient": [0.1, 0.1, 0.1], "diffuse": [0.4, 0.4, 0.4], "specular": [0.5, 0.5, 0.5]}, "skybox": -1, "haze_rgba": [1.0, 1.0, 1.0, 1.0], "haze": 0.3, "fog_rgba": [0.0, 0.0, 0.0, 1.0], "fog_start": 0.0, "fog_end": 0.0, "znear": 0.01, "zfar": 50.0, "extent": 1.0, "center": [0.0, 0.0, 0.0]},
    groups_shown: [0, 1, 2],
    totals: {"objects": 0, "triangles": 0, "mesh_bytes": 0, "texture_bytes": 0, "texture_memory": 0, "asset_bytes": 0},
  },
  Geometry: {
    mesh: -1,
    hfield: -1,
  },
  Material: {
    emission: 0.0,
    specular: 0.5,
    shininess: 0.5,
    reflectance: 0.0,
    metallic: -1.0,
    roughness: -1.0,
    textures: [],
    repeat: [1.0, 1.0],
    uniform: false,
  },
  TextureLevel: {
    max_error: 0,
  },
  MeshLevel: {
    max_error_m: 0.0,
  },
  HeightField: {
    encoding: "arrays",
  },
  Light: {
    attenuation: [1.0, 0.0, 0.0],
    cutoff: 45.0,
    exponent: 10.0,
    range: 0.0,
    intensity: 0.0,
    bulb_radius: 0.0,
    texture: -1,
    castshadow: true,
    active: true,
    follow: "fixed",
    target: -1,
  },
  Camera: {
    orthographic: false,
    focal: [0.0, 0.0],
    principal: [0.0, 0.0],
    resolution: [1, 1],
    follow: "fixed",
    target: -1,
  },
  Deformable: {
    encoding: "arrays",
  },
  Environment: {
    headlight: {"active": true, "ambient": [0.1, 0.1, 0.1], "diffuse": [0.4, 0.4, 0.4], "specular": [0.5, 0.5, 0.5]},
    skybox: -1,
    haze_rgba: [1.0, 1.0, 1.0, 1.0],
    haze: 0.3,
    fog_rgba: [0.0, 0.0, 0.0, 1.0],
    fog_start: 0.0,
    fog_end: 0.0,
    znear: 0.01,
    zfar: 50.0,
    extent: 1.0,
    center: [0.0, 0.0, 0.0],
  },
  Headlight: {
    active: true,
    ambient: [0.1, 0.1, 0.1],
    diffuse: [0.4, 0.4, 0.4],
    specular: [0.5, 0.5, 0.5],
  },
  Totals: {
    objects: 0,
    triangles: 0,
    mesh_bytes: 0,
    texture_bytes: 0,
    texture_memory: 0,
    asset_bytes: 0,
  },
  ArrayHeader: {
    max_error: 0.0,
  },
  ArrayInfo: {
    filter: "none",
    codec: "none",
    scale: [],
    offset: [],
  },
} as const;
