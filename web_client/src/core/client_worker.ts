// What the worker does: sockets, decoding and assets of one session, behind the messages of `api.ts`. `worker.ts` gives it a
// real environment, tests another one.

import type * as wire from "../protocol/messages.g.ts";
import { PROTOCOL_VERSION } from "../protocol/messages.g.ts";
import type { BodyInfo, ConnectOptions, FromWorker, ObservationInput, RequestMessage, SampleInput, ToWorker } from "./api.ts";
import { ArrivalMeter, makeReport } from "./arrival_meter.ts";
import { SceneAssets } from "./scene_assets.ts";
import { ClientConnection } from "./connection.ts";
import { ClientError, PairingError, WireError } from "./errors.ts";
import { BrowserIdentity, loadSecret } from "./identity.ts";
import { MediaLink } from "./media_link.ts";
import { computeFingerprint, decodeKey, hashSecret } from "./pairing.ts";
import { pair, type SocketLike } from "./pairing_client.ts";
import { SampleBuilder } from "./samples.ts";
import { readHeader, type SceneState } from "./state_stream.ts";
import type { Store } from "./storage.ts";
import { Channel, CloseCode, decodeGatewayMessage, packMessage, SUBPROTOCOL, unpackMessage } from "./wire.ts";

/** What the worker runs in. */
export interface Environment {
  post(update: FromWorker, transfer: Transferable[]): void;
  /** Monotonic clock: whole nanoseconds. */
  nowNs(): number;
  /** Shared clock minus `nowNs` [ms]. */
  sharedOriginMs: number;
  openSocket(url: string, protocol: string): SocketLike;
  fetch(url: string, init: RequestInit): Promise<Response>;
  /** Call back after `ms`; returns a function that cancels. */
  setTimer(ms: number, callback: () => void): () => void;
  /** Decode a JPEG image to this width [pixels]; rejects for one that is damaged. */
  decodeImage(bytes: Uint8Array, width: number): Promise<ImageBitmap>;
  store: Store;
  /** Number of this tab among those of the browser, empty for none. */
  slot: string;
  /** Names this run of the page: after a reload the tracking frame is another one. */
  run: string;
}

const MS_NS = 1_000_000;
const OPEN = 1;
/** Bytes that may wait in the socket: above, samples are dropped and other messages wait. */
const MAX_BUFFERED = 64 << 10;
const FULL_PAUSE_MS = 10;
/** Frames that the page may hold, once it has given one back. */
const MAX_FRAMES_OUT = 64;
const CLOCK_PERIOD_NS = 250 * MS_NS;
const SOFTWARE = "iris-session web";

const RELOAD = "this page and the session are of different versions: reload the page, or update the session";

/** What the page knows. */
interface Posted {
  phase: string;
  session: string;
  welcome: ClientConnection["welcome"];
  clockNs: number;
}

const NOTHING: Posted = { phase: "", session: "", welcome: null, clockNs: Number.NEGATIVE_INFINITY };

/** Serves one page. Nothing that it receives makes it throw. */
export class ClientWorker {
  private options: ConnectOptions | null = null;
  private connection: ClientConnection | null = null;
  private samples: SampleBuilder | null = null;
  private socket: SocketLike | null = null;
  private socketGeneration = 0;
  private closeCode = 0;
  private cancelTimer: (() => void) | null = null;
  private attempt = 0;
  /** Tracking frames before this one. */
  private runs = 0;
  /** Requests of the page that wait for a reply: number on the wire -> number of the page. */
  private waiting = new Map<number, number>();
  private readonly meter = new ArrivalMeter();
  private readonly assets: SceneAssets;
  private readonly media: MediaLink;
  private bodies: readonly BodyInfo[] | null = null;
  private bodiesVersion = 0;
  private posted: Posted = { ...NOTHING };
  private framesOut = 0;
  private recycles = false;
  private readonly buffers: Float32Array<ArrayBuffer>[] = [];

  constructor(private readonly environment: Environment) {
    this.assets = new SceneAssets(environment);
    const getSessionNs = (): number => this.connection?.clock.sessionNs(environment.nowNs()) ?? 0;
    this.media = new MediaLink(environment, this.assets, this.meter, getSessionNs);
  }

  /** Process a command of the page. */
  receive(command: ToWorker): void {
    try {
      this.dispatch(command);
    } catch (error) {
      if (!(error instanceof ClientError || error instanceof WireError)) throw error;
      this.environment.post({ type: "notice", level: "warning", text: error.message }, []);
    }
    this.pump();
  }

  /** Send an e-stop, and say so when it is not on its way. */
  private sendEStop(reason: string): void {
    let text = "The e-stop is not sent: this browser is not in the session. Use the stop at the robot.";
    try {
      if (this.connection?.send({ type: "estop", reason })) return;
      if (this.connection) text = "Not connected: the e-stop is sent when the connection is back. Use the stop at the robot.";
    } catch (error) {
      if (!(error instanceof ClientError)) throw error;
    }
    this.environment.post({ type: "notice", level: "error", text }, []);
  }

  private dispatch(command: ToWorker): void {
    const { connection } = this;
    switch (command.type) {
      case "connect":
        void this.connect(command);
        break;
      case "disconnect":
        this.disconnect();
        break;
      case "rejoin":
        this.rejoin(command.devices, command.alignment);
        break;
      case "set_name":
        this.setName(command.name);
        break;
      case "pair":
        void this.pair(command);
        break;
      case "request":
        this.request(command.id, command.message);
        break;
      case "send":
        connection?.send(command.message);
        break;
      case "estop":
        this.sendEStop(command.reason);
        break;
      case "samples":
        this.sendSamples(command.samples);
        break;
      case "observation":
        this.sendObservation(command.observation);
        break;
      case "worn":
        if (connection !== null) connection.worn = command.worn;
        break;
      case "tracking_jump":
        this.onTrackingJump();
        break;
      case "get_status":
        connection?.requestStatus();
        break;
      case "want_streams":
        this.media.setWishes(command.streams);
        break;
      case "taken":
        this.media.onTaken(command.stream);
        break;
      case "want_assets":
        for (const wish of command.assets) this.assets.want(wish);
        break;
      case "cancel_assets":
        for (const address of command.addresses) this.assets.cancel(address);
        break;
      case "drawn":
        this.meter.recordDrawn(command.frames, command.age_ms);
        this.media.onDrawn(command.frames);
        break;
      case "recycle":
        this.recycle(command.poses);
        break;
      case "recycle_surface":
        this.media.recycleSurface(command.stream, command.surface);
        break;
    }
  }

  // --- connection -----------------------------------------------------------------------------------------------------

  private async connect(options: ConnectOptions): Promise<void> {
    this.disconnect();
    this.options = options;
    const attempt = ++this.attempt;
    const { environment } = this;
    const [identity, info] = await Promise.all([BrowserIdentity.load(environment.store, options.base_url, environment.slot), this.fetchInfo(options.base_url)]);
    if (attempt !== this.attempt) return;
    environment.post({ type: "identity", fingerprint: computeFingerprint(await hashSecret(identity.secret)) }, []);
    if (attempt !== this.attempt) return;
    if (info !== null && !info.versions.includes(PROTOCOL_VERSION)) {
      this.postFailure("version", info.text);
      return;
    }
    this.connection = new ClientConnection(this.makeHello(this.options), identity); // a rejoin may have changed them
    this.samples = new SampleBuilder(this.connection);
    try {
      this.connection.open(environment.nowNs());
    } catch (error) {
      this.connection = null;
      this.postFailure("malformed", error instanceof Error ? error.message : String(error));
      return;
    }
    this.pump();
  }

  private makeHello(options: ConnectOptions): wire.Hello {
    return {
      type: "hello",
      role: options.role,
      name: options.name,
      software: options.software ?? SOFTWARE,
      devices: options.devices ?? [],
      capabilities: [...(options.capabilities ?? []), `run:${this.environment.run}${this.runs > 0 ? `-${this.runs}` : ""}`],
      alignment: options.alignment ?? "measured",
    };
  }

  /** Say hello with other devices. The tracking frame is another one from now on. */
  private rejoin(devices: wire.Device[], alignment: wire.AlignmentKind): void {
    if (this.options === null) return;
    this.runs += 1;
    this.options = { ...this.options, devices, alignment };
    this.connection?.rejoin(this.makeHello(this.options), this.environment.nowNs());
  }

  private setName(name: string): void {
    if (this.options === null) return;
    this.options = { ...this.options, name };
    if (this.connection) this.connection.hello = this.makeHello(this.options);
  }

  private disconnect(): void {
    const { connection } = this;
    this.attempt += 1;
    if (connection !== null) {
      connection.close();
      this.flush(true);
      this.postPhase();
    }
    this.dropSocket();
    this.connection = this.samples = null;
    this.socketGeneration = 0;
    this.posted = { ...NOTHING };
    this.bodies = null;
    this.failRequests("left the session");
    this.media.close();
    this.assets.setLink("", "");
    this.meter.restart();
  }

  /** Return what `GET /v1/info` says, and post it; null when there is no answer, which a connection will find out too. */
  private async fetchInfo(baseUrl: string): Promise<Extract<FromWorker, { type: "info" }> | null> {
    try {
      const response = await this.environment.fetch(`${baseUrl}/v1/info`, { cache: "no-store" });
      if (!response.ok) return null;
      const value: unknown = await response.json();
      const read = (typeof value === "object" && value !== null ? value : {}) as Record<string, unknown>;
      const text = (name: string): string => (typeof read[name] === "string" ? read[name] : "");
      const versions = Array.isArray(read["versions"]) ? read["versions"].filter((version) => typeof version === "number") : [];
      const info = {
        type: "info" as const,
        versions,
        session_name: text("session_name"),
        session_id: text("session_id"),
        key: text("key"),
        pairing: read["pairing"] === true,
        software: text("software"),
        text: versions.includes(PROTOCOL_VERSION) ? "" : RELOAD,
      };
      this.environment.post(info, []);
      return info;
    } catch {
      return null;
    }
  }

  private async pair(command: Extract<ToWorker, { type: "pair" }>): Promise<void> {
    const { environment } = this;
    try {
      const info = await this.fetchInfo(command.base_url);
      if (info === null) throw new PairingError("the session does not answer: is it running, and is this device in its network?");
      const roles = await pair(environment, {
        url: toSocketUrl(command.base_url, "/v1/session"),
        code: command.code,
        certificateHash: decodeKey(info.key),
        secret: await loadSecret(environment.store),
        name: command.name,
        software: command.software ?? SOFTWARE,
      });
      environment.post({ type: "paired", ok: true, roles, code: "", text: "" }, []);
    } catch (error) {
      const code = error instanceof PairingError ? error.code : "";
      environment.post({ type: "paired", ok: false, roles: [], code, text: error instanceof Error ? error.message : String(error) }, []);
    }
  }

  /** Bring the socket, the timer and the page up to date with the connection. */
  private pump(): void {
    const { connection } = this;
    if (connection === null) return;
    if (connection.generation !== this.socketGeneration) this.openSocket(connection);
    const waits = this.flush(false);
    this.postChanges(connection);
    this.cancelTimer?.();
    this.cancelTimer = null;
    if (connection.phase === "refused" || connection.phase === "closed") {
      this.dropSocket();
      return;
    }
    const nowNs = this.environment.nowNs();
    const ms = Math.max(0, (connection.nextDeadlineNs(nowNs) - nowNs) / MS_NS);
    this.cancelTimer = this.environment.setTimer(waits ? Math.min(ms, FULL_PAUSE_MS) : ms, () => this.tick(connection));
  }

  private tick(connection: ClientConnection): void {
    if (connection !== this.connection) return;
    connection.tick(this.environment.nowNs());
    this.pump();
  }

  private openSocket(connection: ClientConnection): void {
    this.dropSocket();
    this.media.close(); // the ticket ends with the socket of the session
    this.socketGeneration = connection.generation;
    this.failRequests("the connection was lost before the session answered");
    const url = toSocketUrl(this.options?.base_url ?? "", "/v1/session");
    const socket = this.environment.openSocket(url, SUBPROTOCOL);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => this.pump();
    socket.onmessage = (event) => this.onMessage(connection, event.data);
    socket.onclose = (event) => this.onClose(connection, event.code, event.reason);
  }

  private dropSocket(): void {
    const { socket } = this;
    this.socket = null;
    this.cancelTimer?.();
    this.cancelTimer = null;
    if (socket === null) return;
    socket.onopen = socket.onmessage = socket.onclose = socket.onerror = null;
    socket.close();
  }

  /** Send what waits. Returns whether something has to wait. `all`: however full the socket is. */
  private flush(all: boolean): boolean {
    const { connection, socket } = this;
    if (connection === null || socket === null || socket.readyState !== OPEN) return false;
    for (let item = connection.peekOutgoing(); item !== null; item = connection.peekOutgoing()) {
      const full = !all && socket.bufferedAmount > MAX_BUFFERED;
      if (full && !item.droppable) return true;
      if (!full) socket.send(packMessage(Channel.CONTROL, [item.bytes]));
      connection.popOutgoing(!full);
    }
    return false;
  }

  private onMessage(connection: ClientConnection, data: unknown): void {
    const nowNs = this.environment.nowNs();
    try {
      if (!(data instanceof ArrayBuffer)) throw new WireError("a text message");
      const { channel, frames } = unpackMessage(new Uint8Array(data));
      if (channel === Channel.STATE) this.onState(connection, frames, nowNs);
      else if (channel === Channel.CONTROL) connection.receive(frames, nowNs);
      else if (channel === Channel.GATEWAY) this.onGatewayMessage(frames[0] ?? new Uint8Array());
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      connection.counters.malformed += 1;
    }
    this.pump();
  }

  private onGatewayMessage(frame: Uint8Array): void {
    const message = decodeGatewayMessage(frame);
    const baseUrl = this.options?.base_url ?? "";
    if (message.type === "ticket") {
      this.assets.setLink(baseUrl, message.ticket);
      this.media.setLink(toSocketUrl(baseUrl, "/v1/media"), message.ticket);
    } else if (message.type === "notice") this.environment.post({ type: "notice", level: "info", text: message.text }, []);
  }

  private onClose(connection: ClientConnection, code: number, reason: string): void {
    this.closeCode = code;
    this.dropSocket();
    if (code === CloseCode.VERSION || code === CloseCode.NOT_ALLOWED) {
      connection.close();
      this.connection = null;
      this.postFailure(code === CloseCode.VERSION ? "version" : "identity", code === CloseCode.VERSION ? RELOAD : reason || "the session does not allow this page");
      return;
    }
    const nowNs = this.environment.nowNs();
    if (code === CloseCode.SESSION_ENDED && connection.isJoined) connection.handleSessionEnd(nowNs);
    else if (code === CloseCode.FLOOD) connection.handleUnreachable(nowNs, true);
    else if (connection.isJoined) connection.handleDisconnect(nowNs);
    else connection.handleUnreachable(nowNs);
    this.pump();
  }

  // --- commands -------------------------------------------------------------------------------------------------------

  private request(id: number, message: RequestMessage): void {
    try {
      if (this.connection === null) throw new ClientError("not connected");
      this.waiting.set(this.connection.request(message), id);
    } catch (error) {
      if (!(error instanceof ClientError)) throw error;
      this.environment.post({ type: "reply", id, reply: null, error: error.message }, []);
    }
  }

  private sendSamples(inputs: readonly SampleInput[]): void {
    const { connection, samples } = this;
    if (connection === null || samples === null || inputs.length === 0) return;
    const built = inputs.map(({ capture_ms, ...input }) => samples.makeSample(input, this.toSessionNs(connection, capture_ms)));
    connection.send(built.length === 1 ? (built[0] as wire.Sample) : { type: "samples", samples: built });
  }

  private sendObservation({ capture_ms, ...observation }: ObservationInput): void {
    const { connection } = this;
    if (connection === null) return;
    connection.send({ type: "observation", ...observation, capture_ns: this.toSessionNs(connection, capture_ms), tracking_epoch: connection.trackingEpoch });
  }

  private toSessionNs({ clock }: ClientConnection, shared_ms: number): number {
    return Math.round(clock.sessionNs(Math.round((shared_ms - this.environment.sharedOriginMs) * MS_NS)));
  }

  private onTrackingJump(): void {
    const { connection } = this;
    if (connection === null) return;
    connection.trackingEpoch += 1;
    if (connection.isJoined) connection.send({ type: "tracking_epoch", tracking_epoch: connection.trackingEpoch });
  }

  private recycle(poses: Float32Array): void {
    this.recycles = true;
    this.framesOut = Math.max(0, this.framesOut - 1);
    if (this.buffers.length < 4) this.buffers.push(poses as Float32Array<ArrayBuffer>);
  }

  private failRequests(error: string): void {
    for (const id of this.waiting.values()) this.environment.post({ type: "reply", id, reply: null, error }, []);
    this.waiting.clear();
  }

  // --- updates --------------------------------------------------------------------------------------------------------

  private onState(connection: ClientConnection, frames: readonly Uint8Array[], nowNs: number): void {
    const { stream, clock } = connection;
    const state = stream.drain([frames], clock.sessionNs(nowNs), nowNs);
    if (state !== null) {
      this.meter.recordState(state);
      this.postFrame(connection, state);
    }
    const items = stream.takePresence();
    if (items !== null) this.environment.post({ type: "presence", items }, []);
  }

  private postFrame(connection: ClientConnection, state: SceneState): void {
    this.postBodies(connection);
    if (state.sceneEpoch < connection.mirror.bodiesSince || !connection.clock.synced) return;
    if (this.recycles && this.framesOut >= MAX_FRAMES_OUT) return; // the page stands still
    this.framesOut += 1;
    const kept = this.buffers.pop();
    const poses = kept?.length === state.poses.length ? kept : new Float32Array(state.poses.length);
    poses.set(state.poses);
    const header = readHeader(state.header);
    this.environment.post(
      {
        type: "frame",
        poses,
        bodies_version: this.bodiesVersion,
        scene_epoch: header.sceneEpoch,
        scene_revision: header.sceneRevision,
        state_seq: header.stateSeq,
        tick: header.tick,
        sim_time: header.simTime,
        session_ms: header.sessionTime / MS_NS,
        age_ms: state.ageNs / MS_NS,
      },
      [poses.buffer],
    );
  }

  private postChanges(connection: ClientConnection): void {
    const { environment, posted } = this;
    const { mirror } = connection;
    this.postPhase();
    if (connection.welcome !== posted.welcome && connection.welcome !== null) {
      posted.welcome = connection.welcome; // another session may number its connections alike
      this.meter.restart();
      environment.post({ type: "welcome", welcome: connection.welcome }, []);
    }
    const session = `${connection.participantId} ${mirror.synced} ${mirror.eventSeq} ${connection.counters.snapshots}`;
    if (session !== posted.session) {
      posted.session = session;
      this.postBodies(connection);
      this.postSession(connection);
      this.assets.followScene(mirror);
    }
    if (connection.inbox.length > 0) {
      environment.post({ type: "inbox", messages: connection.inbox }, []);
      connection.inbox = [];
    }
    this.postReplies(connection);
    if (connection.status !== null) environment.post({ type: "status", status: connection.status }, []);
    if (connection.budget !== null) {
      environment.post({ type: "budget", budget: connection.budget }, []);
      this.media.onBudget(connection.connectionEpoch);
    }
    connection.status = connection.budget = null;
    this.postTimes(connection);
  }

  private postPhase(): void {
    const { connection, posted } = this;
    if (connection === null) return;
    const text = connection.describe();
    const key = `${connection.phase} ${text} ${connection.stalled} ${connection.failure?.code ?? ""}`;
    if (key === posted.phase) return;
    posted.phase = key;
    const { phase, failure, stalled } = connection;
    const reason = phase === "closed" ? null : (failure ?? connection.retryableRefusal);
    const advice = reason?.advice ?? "";
    const refusal = reason?.code ?? "";
    if (connection.isJoined) this.closeCode = 0;
    this.environment.post({ type: "phase", phase, text, refusal, advice, close_code: this.closeCode, stalled, ended: connection.sessionEnded }, []);
  }

  /** Post a failure that is not of the session. */
  private postFailure(refusal: string, text: string): void {
    this.environment.post({ type: "phase", phase: "refused", text, refusal, advice: "", close_code: this.closeCode, stalled: false, ended: false }, []);
  }

  private postBodies({ mirror }: ClientConnection): void {
    if (this.bodies === mirror.bodies || !mirror.synced) return;
    const same = this.bodies !== null && JSON.stringify(this.bodies) === JSON.stringify(mirror.bodies);
    this.bodies = mirror.bodies;
    if (same) return;
    this.bodiesVersion += 1;
    this.environment.post({ type: "bodies", version: this.bodiesVersion, scene_epoch: mirror.sceneEpoch, bodies: mirror.bodies }, []);
  }

  private postSession(connection: ClientConnection): void {
    const { mirror } = connection;
    this.environment.post(
      {
        type: "session",
        synced: mirror.synced,
        participant_id: connection.participantId,
        event_seq: mirror.eventSeq,
        scene_epoch: mirror.sceneEpoch,
        scene_revision: mirror.sceneRevision,
        scene_hash: mirror.sceneHash,
        tick_period_ns: mirror.tickPeriodNs || (connection.welcome?.tick_period_ns ?? 0),
        paused: mirror.paused,
        estop: mirror.estop,
        stop_seq: mirror.stopSeq,
        consent_timeout_ns: mirror.consentTimeoutNs,
        episode: mirror.episode,
        participants: [...mirror.participants.values()],
        leases: [...mirror.leases.values()],
        robots: [...mirror.robots.values()],
        anchors: [...mirror.anchors.values()].map(({ id, ...place }) => ({ anchor_id: id, ...place })),
      },
      [],
    );
  }

  private postReplies(connection: ClientConnection): void {
    for (const [requestId, id] of this.waiting) {
      const reply = connection.requests.popReply(requestId);
      if (reply === null && connection.requests.isPending(requestId)) continue;
      this.waiting.delete(requestId);
      this.environment.post({ type: "reply", id, reply, error: reply === null ? "too many requests wait for an answer" : "" }, []);
    }
  }

  private postTimes(connection: ClientConnection): void {
    const { environment, posted } = this;
    const nowNs = environment.nowNs();
    const { clock, stream, counters } = connection;
    if (clock.synced && nowNs - posted.clockNs >= CLOCK_PERIOD_NS) {
      posted.clockNs = nowNs;
      const session_offset_ms = (clock.sessionNs(nowNs) - nowNs) / MS_NS - environment.sharedOriginMs;
      environment.post({ type: "clock", session_offset_ms, error_ms: clock.errorBoundNs(nowNs) / MS_NS, rtt_ms: clock.rttNs / MS_NS, settled: clock.settled }, []);
    }
    if (!connection.isJoined) return;
    const arrivals = this.meter.poll(stream.counters.bytesReceived, nowNs);
    if (arrivals === null) return;
    connection.send(makeReport(arrivals, clock.rttNs));
    this.flush(false);
    const { faults, ...numbers } = counters;
    const state = Object.entries(stream.counters).map(([name, count]) => [`state ${name}`, count]);
    const byCode = [...faults].map(([code, count]) => [`fault ${code}`, count]);
    environment.post(
      {
        type: "stats",
        state_hz: arrivals.delivered,
        age_ms_p50: arrivals.ageMsP50,
        age_ms_p99: arrivals.ageMsP99,
        rtt_ms: clock.rttNs / MS_NS,
        bytes_per_s: arrivals.bytesPerS,
        media_bytes_per_s: arrivals.mediaBytesPerS,
        missed: arrivals.missed,
        reconnects: counters.reconnects,
        counters: {
          ...numbers,
          ...Object.fromEntries([...state, ...byCode]),
          "media malformed": this.media.malformed,
          "media not taken": this.media.notTaken,
        },
        media: Object.fromEntries([...this.media.counters].map(([stream, counts]) => [stream, { ...counts }])),
      },
      [],
    );
  }
}

/** Return the address of a WebSocket of the gateway. */
export function toSocketUrl(baseUrl: string, path: string): string {
  return baseUrl.replace(/^http/, "ws") + path;
}

