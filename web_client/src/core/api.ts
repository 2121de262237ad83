// Messages between the page and its worker (`worker.ts`): the border between sockets and decoding on one side, drawing
// and the user interface on the other. Types only; `page_client.ts` wraps them for the page.
//
// Times. `*_ms` of this file are milliseconds of the clock that page and worker share, `nowMs()` =
// `performance.timeOrigin + performance.now()`. Fields of the wire (`*_ns`, `session_time`) are session time in
// nanoseconds. `ClockUpdate.session_offset_ms` maps one to the other.
//
// Poses are world-frame, right-handed, Z up: rows of seven numbers `x y z qw qx qy qz`.

import type { CloudFrame } from "./cloud.ts";
import type { Surface } from "./sheet.ts";
import type * as wire from "../protocol/messages.g.ts";

/** A value of the wire with all defaults filled in: what the worker posts has every field. */
export type Filled<T> = T extends Uint8Array | string | number | boolean | null
  ? T
  : T extends object
    ? { [K in keyof T]-?: Filled<Exclude<T[K], undefined>> }
    : T;

export type SceneSpec = Filled<wire.SceneSpec>;
export type ParticipantInfo = Filled<wire.ParticipantInfo>;
export type Lease = Filled<wire.Lease>;
export type RobotInfo = Filled<wire.RobotInfo>;
export type BodyInfo = Filled<wire.BodyInfo>;
export type PresenceItem = Filled<wire.PresenceItem>;
export type Reply = Filled<wire.Reply>;
export type StatusReport = Filled<wire.StatusReport>;

/** A message of the wire that has a reply. The worker fills in `request_id`. */
export type RequestMessage = {
  [K in wire.ClientMessage["type"]]: Extract<wire.ClientMessage, { type: K }> extends { request_id: number }
    ? Omit<Extract<wire.ClientMessage, { type: K }>, "request_id">
    : never;
}[wire.ClientMessage["type"]];

/** Messages without a reply that the page may send by itself. */
export type PlainMessage = wire.Release | wire.Bye;

/** An observation of an anchor, a mark, or a tip. The worker adds the tracking frame and session time. */
export type ObservationInput = Omit<wire.Observation, "type" | "capture_ns" | "tracking_epoch"> & {
  /** When it was observed, on the shared clock. */
  capture_ms: number;
};

/** One tracked device at one moment. The worker adds epochs, versions, fencing tokens, `seq` and session time. */
export interface SampleInput {
  device: wire.Device;
  /** `T_tracking_device`, in the axes of the wire. Null: nothing of this kind. */
  pose: wire.Pose | null;
  /** When the pose was sampled, on the shared clock. */
  capture_ms: number;
  robots?: string[];
  objects?: string[];
  kind?: wire.SampleKind;
  tracked?: boolean;
  emulated?: boolean;
  clutch?: boolean;
  gripper?: number | null;
  buttons?: number;
  twist?: [number, number, number, number, number, number] | null;
  hand_joints?: number[];
  q?: number[];
  qd?: number[];
}

export interface ConnectOptions {
  /** Origin of the gateway, such as `https://192.168.0.10:7725`. */
  base_url: string;
  role: wire.Role;
  name: string;
  devices?: wire.Device[];
  alignment?: wire.AlignmentKind;
  capabilities?: string[];
  software?: string;
}

/** What the page asks of the worker. */
export type ToWorker =
  | ({ type: "connect" } & ConnectOptions)
  /** Leave: leases are released at once. */
  | { type: "disconnect" }
  /**
   * Become a participant with other devices, without leaving: leases stay. What it tracks begins anew, so its alignment is
   * void.
   */
  | { type: "rejoin"; devices: wire.Device[]; alignment: wire.AlignmentKind }
  /** Have another name at every hello from now on. */
  | { type: "set_name"; name: string }
  /** Put this browser on the allow-list with a join code. Answered by `paired`. */
  | { type: "pair"; base_url: string; code: string; name: string; software?: string }
  /** A request of the wire. Answered by one `reply` with the same `id`. */
  | { type: "request"; id: number; message: RequestMessage }
  | { type: "send"; message: PlainMessage }
  | { type: "estop"; reason: string }
  | { type: "samples"; samples: SampleInput[] }
  | { type: "observation"; observation: ObservationInput }
  | { type: "worn"; worn: boolean }
  /** The tracking frame jumped: all alignments are void. */
  | { type: "tracking_jump" }
  /** A `StatusReport` is wanted. It comes as `status`. */
  | { type: "get_status" }
  /** Media streams wanted: replaces the last list. */
  | { type: "want_streams"; streams: string[] }
  /** The page has the `cloud` or `picture` of a stream: the next one may come. `WorkerClient` answers so by itself. */
  | { type: "taken"; stream: string }
  /** Assets wanted, the first first. Each comes once as `asset` or `asset_failed`. */
  | { type: "want_assets"; assets: AssetWish[] }
  /** Assets that are wanted no more. */
  | { type: "cancel_assets"; addresses: string[] }
  /** Frames drawn since the last such message: `display_hz` of the client's report. */
  | { type: "drawn"; frames: number; age_ms?: number }
  /** A buffer of `frame` that the page has done with. */
  | { type: "recycle"; poses: Float32Array }
  /** The surface of a frame of `deformable` that the page has done with, null for a frame without. */
  | { type: "recycle_surface"; stream: string; surface: Surface | null };

export interface AssetWish {
  address: string;
  /** Size of the whole as the scene states it. */
  bytes: number;
  encoding: wire.AssetEncoding;
}

/** Phases of the connection, as drawn in `connection.ts`. */
export type Phase = "idle" | "joining" | "syncing" | "ready" | "waiting" | "refused" | "closed";

/** What the worker tells the page. */
export type FromWorker =
  | PhaseUpdate
  | ClockUpdate
  | SessionUpdate
  | BodiesUpdate
  | SceneUpdate
  | FrameUpdate
  | PresenceUpdate
  | InboxUpdate
  | ReplyUpdate
  | BudgetUpdate
  | StatusUpdate
  | DeformableUpdate
  | CloudUpdate
  | PictureUpdate
  | MediaUpdate
  | AssetUpdate
  | AssetFailedUpdate
  | AssetProgress
  | StatsUpdate
  | IdentityUpdate
  | InfoUpdate
  | PairedUpdate
  | NoticeUpdate
  | WelcomeUpdate;

export interface PhaseUpdate {
  type: "phase";
  phase: Phase;
  /** One line for people: why there is no connection now. */
  text: string;
  /** `unpaired`: show the form for the join code. Empty without a refusal. */
  refusal: wire.RefusalCode;
  advice: string;
  /** Close code of the last WebSocket, 0 for none. */
  close_code: number;
  /** True while the session reports that it does not step. */
  stalled: boolean;
  /** True after the session has said that it ends, until one welcomes this page. */
  ended: boolean;
}

export interface WelcomeUpdate {
  type: "welcome";
  welcome: Filled<wire.Welcome>;
}

/** session time [ms] = shared clock + `session_offset_ms`, within `error_ms`. */
export interface ClockUpdate {
  type: "clock";
  session_offset_ms: number;
  error_ms: number;
  rtt_ms: number;
  settled: boolean;
}

/** Everything shared but the bodies. Posted after every change, at most once per message of the wire. */
export interface SessionUpdate {
  type: "session";
  synced: boolean;
  participant_id: string;
  event_seq: number;
  scene_epoch: number;
  scene_revision: number;
  scene_hash: string;
  tick_period_ns: number;
  paused: boolean;
  estop: boolean;
  stop_seq: number;
  consent_timeout_ns: number;
  episode: Filled<wire.EpisodeChanged> | null;
  participants: ParticipantInfo[];
  leases: Lease[];
  robots: RobotInfo[];
  anchors: AnchorPlace[];
}

/** An anchor of the session in the world. `size_m` 0: not known. `error_m`: stated error, 0 for none. `marks`: `AnchorInfo`. */
export interface AnchorPlace {
  anchor_id: string;
  T_world_anchor: wire.Pose;
  size_m: number;
  error_m: number;
  marks: Filled<wire.AnchorMark>[];
}

/** Row i of a frame is the pose of `bodies[i]`. `version` grows with every change. */
export interface BodiesUpdate {
  type: "bodies";
  version: number;
  scene_epoch: number;
  bodies: BodyInfo[];
}

/** The description of the present scene. Comes again after a patch or another scene, with another `address`. */
export interface SceneUpdate {
  type: "scene";
  address: string;
  scene_epoch: number;
  scene_revision: number;
  spec: SceneSpec;
}

/** The newest state. `poses`: 7 numbers per body, transferred; give it back with `recycle`. */
export interface FrameUpdate {
  type: "frame";
  poses: Float32Array;
  /** `BodiesUpdate.version` that the rows belong to. */
  bodies_version: number;
  scene_epoch: number;
  scene_revision: number;
  state_seq: number;
  tick: number;
  sim_time: number;
  /** End of the tick that the poses belong to [ms of session time]. */
  session_ms: number;
  /** From there until the worker had decoded it. */
  age_ms: number;
}

/** Heads and hands of all aligned participants: the newest of each. */
export interface PresenceUpdate {
  type: "presence";
  items: PresenceItem[];
}

/** Events and other messages for people and programs, in order. */
export interface InboxUpdate {
  type: "inbox";
  messages: InboxMessage[];
}
export type InboxMessage =
  | Filled<wire.Event>
  | Filled<wire.Feedback>
  | Filled<wire.ProtocolFault>
  | Reply
  | { type: "missed"; first: number; last: number };

/** Answer to `request`. `reply` null: it was not sent or its connection was lost, and `error` says why. */
export interface ReplyUpdate {
  type: "reply";
  id: number;
  reply: Reply | null;
  error: string;
}

export interface BudgetUpdate {
  type: "budget";
  budget: Filled<wire.DeliveryBudget>;
}

export interface StatusUpdate {
  type: "status";
  status: StatusReport;
}

/** Frames of a stream that the page keeps to interpolate: enough for the longest delay at 120 Hz. */
export const MAX_KEPT_FRAMES = 32;

/**
 * The vertices of a deformable stream: 3 numbers each, world frame, transferred. `surface`: what is drawn of them, null
 * for ropes, and for a page that draws little, which builds it itself. Give it back with `recycleSurface`, also null.
 */
export interface DeformableUpdate {
  type: "deformable";
  stream: string;
  vertices: Float32Array;
  surface: Surface | null;
  /** Session time of the vertices [ms]. */
  session_ms: number;
  scene_epoch: number;
  seq: number;
  bound_m: number;
}

/** A frame of a point cloud. Its points are transferred. */
export interface CloudUpdate {
  type: "cloud";
  stream: string;
  cloud: CloudFrame;
  /** Session time of the points, and when the session received them, 0 where that is not known [ms]. */
  capture_ms: number;
  received_ms: number;
}

/** A camera's picture, decoded. It is transferred: `close` it, or give it to a canvas. */
export interface PictureUpdate {
  type: "picture";
  stream: string;
  bitmap: ImageBitmap;
  /** As of a cloud. */
  capture_ms: number;
  received_ms: number;
}

/** Clouds or pictures of one stream since it was wanted. */
export interface MediaCounters {
  received: number;
  /** Not decoded, because a newer one came before this device could take them. */
  superseded: number;
  /** Malformed, damaged, or too large. */
  refused: number;
}

/** A frame of any other media stream, as it came. */
export interface MediaUpdate {
  type: "media";
  header: Filled<wire.MediaHeader>;
  bytes: Uint8Array;
}

export type AnyArray = Uint8Array | Int8Array | Uint16Array | Uint32Array | Float32Array;

/** One array of an asset, decoded. `shape`: C order. */
export interface DecodedArray {
  shape: number[];
  data: AnyArray;
}

/** An asset. `arrays` of the encoding `arrays`, `bytes` of all others; the other one is null. Buffers are transferred. */
export interface AssetUpdate {
  type: "asset";
  address: string;
  encoding: wire.AssetEncoding;
  kind: wire.ArrayKind;
  /** Stated bound on the values, in their unit, 0: exact. */
  max_error: number;
  arrays: Record<string, DecodedArray> | null;
  bytes: Uint8Array | null;
}

export interface AssetFailedUpdate {
  type: "asset_failed";
  address: string;
  text: string;
}

/** Assets that were wanted since nothing was wanted: for a progress bar. */
export interface AssetProgress {
  type: "asset_progress";
  wanted: number;
  done: number;
  bytes: number;
  bytes_done: number;
  /** Why the session postpones requests, in its words; empty while bytes come. */
  refusal: string;
}

/** Once a second, for the badge and the dashboard. */
export interface StatsUpdate {
  type: "stats";
  state_hz: number;
  age_ms_p50: number;
  age_ms_p99: number;
  rtt_ms: number;
  bytes_per_s: number;
  media_bytes_per_s: number;
  missed: number;
  reconnects: number;
  /** Counters of control and state channel by name, since the worker began. */
  counters: Record<string, number>;
  /** By stream: clouds and pictures that are wanted. */
  media: Record<string, MediaCounters>;
}

/** Who this browser is, for every gateway: the fingerprint on the allow-list. */
export interface IdentityUpdate {
  type: "identity";
  fingerprint: string;
}

/** Answer of `GET /v1/info`. `text`: what is wrong and what to do, empty if nothing. */
export interface InfoUpdate {
  type: "info";
  versions: number[];
  session_name: string;
  session_id: string;
  key: string;
  pairing: boolean;
  software: string;
  text: string;
}

/** End of `pair`. `ok` false: `text` says why, `code` is the refusal. */
export interface PairedUpdate {
  type: "paired";
  ok: boolean;
  roles: wire.Role[];
  code: wire.RefusalCode;
  text: string;
}

/** Words for the person, from the gateway or the worker. */
export interface NoticeUpdate {
  type: "notice";
  level: "info" | "warning" | "error";
  text: string;
}

/** Return the time of the clock that page and worker share [ms]. */
export function nowMs(): number {
  return performance.timeOrigin + performance.now();
}
