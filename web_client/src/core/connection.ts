// Connection of one participant: bytes and times in, bytes and messages out, over any number of sockets.
//
//     idle --open()--> joining --welcome--> syncing --snapshot and clock--> ready
//     joining, syncing, ready --silence, disconnect, session_ended--> waiting (back-off, none at first) --> joining
//     joining --refused--> refused (`failure` holds the reason)          any --close()--> closed
//     joining --refused for now (too many at once)--> waiting (`retryableRefusal` holds the reason)
//
// The shell opens a fresh socket whenever `generation` changes, passes received frames to `receive`, calls `tick` at the
// latest at `nextDeadlineNs`, and sends what `peekOutgoing` shows. All `nowNs` are one monotonic clock. Nothing that a
// server sends throws here: what does not fit the protocol is counted.

import type * as wire from "../protocol/messages.g.ts";
import type { Filled, Phase, Reply, StatusReport } from "./api.ts";
import { ClockSync } from "./clock.ts";
import { decodeServer, encodeClient, type ServerMessage } from "./codec.ts";
import { NotConnectedError, RefusedError, WireError } from "./errors.ts";
import { type Event, isHeldBy, type MissedEvents, SessionMirror, type Snapshot } from "./mirror.ts";
import { ConnectionCounters, MAX_OUTGOING, Outbox, type Outgoing, PendingEStop, PendingRequests } from "./outbox.ts";
import { readKeyframe, StateStream } from "./state_stream.ts";

export type Welcome = Filled<wire.Welcome>;
export type Refused = Filled<wire.Refused>;
export type ProtocolFault = Filled<wire.ProtocolFault>;

/** Time to wait for the reply to hello, at first and at most: over a slow link the first attempts are too short. */
const HELLO_TIMEOUT_NS = 1_000_000_000;
const HELLO_TIMEOUT_MAX_NS = 4_000_000_000;
const BACKOFF_MIN_NS = 100_000_000;
const BACKOFF_MAX_NS = 2_000_000_000;
/** Longest pause while no gateway answers: it is back within seconds when it was restarted. */
const UNREACHABLE_NS = 500_000_000;
const STEADY_NS = 1_000_000_000;
const SNAPSHOT_RETRY_NS = 500_000_000;
/** Heartbeat periods that a session may ask for: with others a client would never rest, or never notice its end. */
const HEARTBEAT_MIN_NS = 20_000_000;
const HEARTBEAT_MAX_NS = 10_000_000_000;
/** Heartbeat periods without a message from the front: the connection is lost. */
const SILENT_HEARTBEATS = 4;
const MAX_INBOX = 1024;

/** Refusals that pass: a client that was joined before keeps trying (after `rate` every client does). */
const RETRYABLE_REFUSALS = ["rate", "full", "session_full"];
/** Reason of a drop after another connection resumed this one. Joining again would only take it back in turn. */
const REPLACED = "replaced";

/** Messages to the application, in order. Replies: denials of messages that expect no reply. */
export type InboxMessage = Event | MissedEvents | Filled<wire.Feedback> | ProtocolFault | Reply;

/** Secret and last resume token of a client. */
export interface IdentityStore {
  readonly secret: Uint8Array;
  /** Token of the last welcome, single use; empty: join as a new participant. */
  readonly resumeToken: Uint8Array;
  /** Set `resumeToken`. */
  remember(token: Uint8Array): void;
}

/** One participant's connection, over any number of sockets. */
export class ClientConnection {
  phase: Phase = "idle";
  generation = 0;
  welcome: Welcome | null = null;
  failure: RefusedError | null = null;
  /** The newest refusal that passes, until a session welcomes us. */
  retryableRefusal: Refused | null = null;
  /** The newest session that welcomed us said that it ends. */
  sessionEnded = false;
  stalled = false;
  worn = true;
  trackingEpoch = 0;
  /** Newest message of the kinds of which only the newest matters; taken by the shell. */
  status: StatusReport | null = null;
  budget: Filled<wire.DeliveryBudget> | null = null;
  inbox: InboxMessage[] = [];
  readonly mirror = new SessionMirror();
  readonly clock = new ClockSync();
  readonly stream = new StateStream();
  readonly counters = new ConnectionCounters();
  readonly requests = new PendingRequests(this.counters);
  readonly pendingEStop = new PendingEStop();
  private readonly outbox = new Outbox(this.counters);
  private backoffNs = BACKOFF_MIN_NS;
  private helloAt = 0;
  private helloWaitNs = HELLO_TIMEOUT_NS;
  private retryAt = 0;
  private heardAt = 0;
  private heartbeatAt = 0;
  private heartbeatNs = 0; // as the session asks for, bounded
  private snapshotAt = 0;
  private joinedAt = 0;
  private tickedAt = 0;

  constructor(
    public hello: wire.Hello,
    readonly identity: IdentityStore,
  ) {}

  // --- life -----------------------------------------------------------------------------------------------------------

  /** Start to join, also after a refusal. */
  open(nowNs: number): void {
    this.failure = this.retryableRefusal = null;
    this.backoffNs = BACKOFF_MIN_NS;
    this.helloWaitNs = HELLO_TIMEOUT_NS;
    this.sendHello(nowNs);
  }

  /**
   * Become a participant with another hello, such as one with other devices: the same one, which keeps its leases. A
   * connection is replaced by a fresh one; without one the next hello is this one.
   */
  rejoin(hello: wire.Hello, nowNs: number): void {
    this.hello = hello;
    if (this.isJoined || this.phase === "joining") this.sendHello(nowNs);
  }

  /** Queue a bye, which releases leases at once. Send what `peekOutgoing` still shows. */
  close(): void {
    if (this.welcome !== null) {
      this.queue({ type: "bye" });
      if (this.phase !== "refused") this.identity.remember(new Uint8Array());
    }
    this.phase = "closed";
  }

  /** Join again, at once if this connection was steady: the socket lost its peer, or the front forgot us. */
  handleDisconnect(nowNs: number): void {
    if (!this.isJoined) return;
    this.counters.reconnects += 1;
    this.helloWaitNs = HELLO_TIMEOUT_NS;
    if (nowNs - this.joinedAt < STEADY_NS) this.startBackoff(nowNs);
    else {
      this.backoffNs = BACKOFF_MIN_NS;
      this.sendHello(nowNs);
    }
  }

  /** Wait for the next session, and join that: this one has ended. */
  handleSessionEnd(nowNs: number): void {
    if (!this.isJoined) return;
    this.counters.reconnects += 1;
    this.sessionEnded = true;
    this.startBackoff(nowNs);
  }

  /**
   * Wait and join again: the socket could not be opened, was closed before the session answered, or was closed because this
   * client did too much (`later`).
   */
  handleUnreachable(nowNs: number, later = false): void {
    if (this.phase !== "joining" && !this.isJoined) return;
    if (this.isJoined) this.counters.reconnects += 1;
    this.helloWaitNs = HELLO_TIMEOUT_NS;
    this.startBackoff(nowNs);
    this.retryAt = later ? nowNs + BACKOFF_MAX_NS : Math.min(this.retryAt, nowNs + UNREACHABLE_NS);
  }

  /** True while the session has accepted us and the connection stands as far as we know. */
  get isJoined(): boolean {
    return this.phase === "syncing" || this.phase === "ready";
  }

  /** Our id in the session, empty before the first welcome. */
  get participantId(): string {
    return this.welcome?.participant_id ?? "";
  }

  /** Number of this connection in the session, 0 before the first welcome. */
  get connectionEpoch(): number {
    return this.welcome?.connection_epoch ?? 0;
  }

  /** Do everything that depends on time: hello, back-off, clock, heartbeat, snapshot, silence. */
  tick(nowNs: number): void {
    if (nowNs - this.tickedAt > STEADY_NS) this.heardAt = nowNs; // we stood still: messages of that time are still to be read
    this.tickedAt = nowNs;
    if (this.phase === "waiting" && nowNs >= this.retryAt) this.sendHello(nowNs);
    else if (this.phase === "joining" && nowNs >= this.helloAt + this.helloWaitNs) {
      this.helloWaitNs = Math.min(2 * this.helloWaitNs, HELLO_TIMEOUT_MAX_NS);
      this.startBackoff(nowNs);
    } else if (this.isJoined) this.sendPeriodic(nowNs);
  }

  /** Return the latest time at which `tick` must be called. */
  nextDeadlineNs(nowNs: number): number {
    if (this.phase === "waiting") return this.retryAt;
    if (this.phase === "joining") return this.helloAt + this.helloWaitNs;
    if (!this.isJoined) return nowNs + STEADY_NS;
    const due = Math.min(this.clock.nextPingNs, this.heartbeatAt, this.heardAt + this.silenceNs);
    return this.needsSnapshot ? Math.min(due, this.snapshotAt) : due;
  }

  /** Return one line for people: why there is no connection now. */
  describe(): string {
    if (this.phase === "waiting" || this.phase === "joining") {
      if (this.retryableRefusal !== null) return `not let in yet, trying again: ${this.retryableRefusal.message}`;
      if (this.sessionEnded) return "this page joins as soon as there is one again";
      return this.welcome === null ? "no session has answered yet" : "the connection was lost; joining again";
    }
    if (this.phase === "idle") return "not connected";
    if (this.phase === "closed") return "this client was closed";
    return this.failure === null ? "connected" : this.failure.message;
  }

  // --- sending --------------------------------------------------------------------------------------------------------

  /**
   * Queue a message that expects no reply.
   *
   * Samples are never kept: without a connection they are dropped and counted. An e-stop is kept until the session has it,
   * over any number of connections. Returns false when the message was dropped, or is an e-stop without a connection yet.
   * Throws `InvalidMessageError`, and `NotConnectedError` for messages other than those two.
   */
  send(message: wire.ClientMessage): boolean {
    const bytes = encodeClient(message, this.connectionEpoch);
    if (message.type === "estop" && (this.isJoined || this.phase === "joining" || this.phase === "waiting")) {
      this.pendingEStop.begin(message);
      return this.phase !== "waiting" && this.outbox.push(message.type, bytes);
    }
    if (!this.isJoined) {
      if (message.type === "sample" || message.type === "samples") {
        this.counters.samplesNotSent += 1;
        return false;
      }
      throw new NotConnectedError(this.describe());
    }
    return this.outbox.push(message.type, bytes);
  }

  /** Queue a request under a fresh `request_id`, which is returned; `requests.popReply` has the reply. */
  request(message: object & { type: wire.ClientMessage["type"] }): number {
    if (!this.isJoined) throw new NotConnectedError(this.describe());
    const requestId = this.requests.nextRequest;
    const bytes = encodeClient({ ...message, request_id: requestId } as wire.ClientMessage, this.connectionEpoch);
    if (!this.outbox.push(message.type, bytes)) {
      throw new NotConnectedError(`send queue full (${MAX_OUTGOING} messages): the session is not reading`);
    }
    if (message.type === "clear_estop") this.pendingEStop.withdraw();
    this.requests.addPending();
    return requestId;
  }

  /** Queue `get_status`; the report appears in `status`. Works while joining too. False: there is no socket by now. */
  requestStatus(): boolean {
    return (this.isJoined || this.phase === "joining") && this.queue({ type: "get_status" });
  }

  /** Return the next message to send. */
  peekOutgoing(): Outgoing | null {
    return this.outbox.peek();
  }

  /** Remove the message of `peekOutgoing`, which was sent or is dropped. */
  popOutgoing(sent: boolean): void {
    this.outbox.pop(sent);
  }

  /** Return our fencing token for `target`, by events or by a reply that came before its event. */
  leaseVersion(target: string): number | null {
    const granted = this.requests.grantedLease(target);
    const known = this.mirror.leases.get(target);
    if (granted !== null && (known === undefined || granted.lease_version > known.lease_version)) {
      return isHeldBy(granted, this.participantId) ? granted.lease_version : null;
    }
    return this.mirror.findLeaseVersion(target, this.participantId);
  }

  // --- receiving ------------------------------------------------------------------------------------------------------

  /** Process one message of the control channel: envelope, then bulk frames. */
  receive(frames: readonly Uint8Array[], nowNs: number): void {
    let message: ServerMessage;
    let epoch: number;
    try {
      [, epoch, message] = decodeServer(frames[0] ?? new Uint8Array());
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      this.counters.malformed += 1;
      return;
    }
    this.counters.received += 1;
    this.heardAt = nowNs;
    if (message.type === "welcome") this.processWelcome(message, nowNs);
    else if (message.type === "refused") this.processRefusal(message, nowNs);
    else if (message.type === "protocol_fault") this.processFault(message, nowNs);
    else if (message.type === "status_report") this.status = message; // also while a session that stands still welcomes no client
    else if (!this.isJoined || epoch !== this.connectionEpoch) this.counters.otherConnection += 1;
    else this.process(message, frames, nowNs);
  }

  private process(message: ServerMessage, frames: readonly Uint8Array[], nowNs: number): void {
    switch (message.type) {
      case "clock_pong":
        this.clock.processPong(message.t0_ns, message.t1_ns, message.t2_ns, nowNs);
        this.pendingEStop.onPong(message.t0_ns, this.mirror.synced && this.mirror.estop);
        this.updateReady();
        break;
      case "reply":
        if (!this.requests.processReply(message)) {
          this.counters.unaskedDenials += 1;
          this.deliver(message);
        }
        break;
      case "event":
        this.processEvent(message, nowNs);
        break;
      case "snapshot":
        this.processSnapshot(message, frames[1]);
        break;
      case "feedback":
        this.deliver(message);
        break;
      case "delivery_budget":
        this.budget = message;
        break;
    }
  }

  private processWelcome(welcome: Welcome, nowNs: number): void {
    if (this.phase !== "joining") {
      this.counters.otherConnection += 1;
      return;
    }
    if (this.welcome === null || welcome.session_id !== this.welcome.session_id) {
      this.mirror.reset();
      this.clock.reset();
      this.stream.reset(); // else state continues: a restarted front numbers its frames above the old one's
    }
    this.clock.restart(); // this machine may have slept
    this.stream.restart();
    this.mirror.synced = false;
    this.welcome = welcome;
    this.retryableRefusal = null;
    this.sessionEnded = false;
    this.identity.remember(welcome.resume_token);
    this.phase = "syncing";
    this.joinedAt = nowNs;
    this.heartbeatNs = Math.min(Math.max(welcome.heartbeat_ns, HEARTBEAT_MIN_NS), HEARTBEAT_MAX_NS);
    this.heartbeatAt = nowNs + Math.floor(this.heartbeatNs / 2);
    this.snapshotAt = nowNs;
    if (this.pendingEStop.message !== null) {
      this.pendingEStop.begin(this.pendingEStop.message);
      this.queue(this.pendingEStop.message);
    }
    if (this.trackingEpoch > 0) this.queue({ type: "tracking_epoch", tracking_epoch: this.trackingEpoch });
    this.sendPeriodic(nowNs);
  }

  private processRefusal(refused: Refused, nowNs: number): void {
    if (this.phase !== "joining") return;
    if (refused.code === "resume_token" && this.identity.resumeToken.length > 0) {
      this.identity.remember(new Uint8Array()); // used up or removed: join as a new participant
      this.sendHello(nowNs);
    } else if (refused.code === "rate" || (RETRYABLE_REFUSALS.includes(refused.code) && this.welcome !== null)) {
      this.retryableRefusal = refused;
      this.startBackoff(nowNs);
    } else {
      this.phase = "refused";
      this.failure = new RefusedError(refused);
    }
  }

  private processFault(fault: ProtocolFault, nowNs: number): void {
    this.counters.countFault(fault.code);
    this.deliver(fault);
    const refused = findFinalRefusal(fault);
    if (fault.code === "stalled" || fault.code === "recovered") this.stalled = fault.code === "stalled";
    else if (refused !== null) {
      this.failure = new RefusedError(refused);
      this.phase = "refused";
    } else if (fault.code === "session_ended") this.handleSessionEnd(nowNs);
    else if (fault.code === "dropped" || fault.code === "hello") this.handleDisconnect(nowNs);
  }

  private processEvent(event: Event, nowNs: number): void {
    if (!this.mirror.applyEvent(event)) return;
    this.stream.sceneEpoch = this.mirror.bodiesUntil;
    // Another scene: its bodies are requested at once, however lately others were.
    if (!this.mirror.synced) this.snapshotAt = Math.min(this.snapshotAt, nowNs);
    const { body } = event;
    if (body.event === "estop_changed" && body.active && body.participant === this.participantId) this.pendingEStop.withdraw();
    this.deliver(event);
  }

  private processSnapshot(snapshot: Snapshot, bulk: Uint8Array | undefined): void {
    const poses = readKeyframe(bulk ?? new Uint8Array(), snapshot.bodies.length);
    if (poses === null) {
      this.counters.malformed += 1;
      return;
    }
    this.counters.snapshots += 1;
    for (const message of this.mirror.applySnapshot(snapshot)) this.deliver(message);
    this.stream.sceneEpoch = this.mirror.bodiesUntil;
    this.stream.retainPresence(this.mirror.connected);
    this.stream.loadKeyframe(snapshot.state_seq, poses);
    this.updateReady();
  }

  private updateReady(): void {
    if (this.phase === "syncing" && this.mirror.synced && this.clock.settled) this.phase = "ready";
  }

  private deliver(message: InboxMessage): void {
    if (message.type === "event" && message.body.event === "participant_left") this.stream.removePresence(message.body.participant);
    if (this.inbox.length >= MAX_INBOX) this.makeInboxRoom();
    this.inbox.push(message);
  }

  /** Drop the oldest messages of a full inbox; one `MissedEvents` at its front names the events among them. */
  private makeInboxRoom(): void {
    let missed: MissedEvents | null = null;
    while (this.inbox.length >= MAX_INBOX - (missed === null ? 0 : 1)) {
      const dropped = this.inbox.shift() as InboxMessage;
      if (dropped.type !== "missed") this.counters.inboxDropped += 1;
      if (dropped.type !== "missed" && dropped.type !== "event") continue;
      const [first, last] = dropped.type === "missed" ? [dropped.first, dropped.last] : [dropped.event_seq, dropped.event_seq];
      missed = { type: "missed", first: missed === null ? first : (missed as MissedEvents).first, last };
    }
    if (missed !== null) this.inbox.unshift(missed);
  }

  // --- timers ---------------------------------------------------------------------------------------------------------

  private get silenceNs(): number {
    return SILENT_HEARTBEATS * Math.max(this.heartbeatNs, 500_000_000);
  }

  private get needsSnapshot(): boolean {
    return !this.mirror.synced || this.stream.wantsSnapshot;
  }

  private sendPeriodic(nowNs: number): void {
    if (nowNs - this.heardAt >= this.silenceNs) {
      this.handleDisconnect(nowNs);
      return;
    }
    if (this.clock.pollPing(nowNs)) {
      this.queue({ type: "clock_ping", t0_ns: nowNs });
      this.pendingEStop.onPing(nowNs);
    }
    if (nowNs >= this.heartbeatAt) {
      this.heartbeatAt = nowNs + Math.floor(this.heartbeatNs / 2);
      this.queue({ type: "heartbeat", worn: this.worn });
    }
    if (this.needsSnapshot && nowNs >= this.snapshotAt) {
      this.snapshotAt = nowNs + SNAPSHOT_RETRY_NS;
      this.queue({ type: "get_snapshot" });
    }
  }

  /** Begin a fresh socket with a hello: no message of an earlier connection can reach the session. */
  private sendHello(nowNs: number): void {
    this.generation += 1;
    this.phase = "joining";
    this.stalled = false;
    this.helloAt = nowNs;
    this.heardAt = nowNs;
    this.outbox.clear();
    this.requests.clear();
    const { secret, resumeToken } = this.identity;
    const hello: wire.Hello = { ...this.hello, secret, resume_token: resumeToken };
    this.outbox.push("hello", encodeClient(hello));
    if (this.pendingEStop.message !== null) this.outbox.push("estop", encodeClient(this.pendingEStop.message)); // every client may stop, however early
  }

  private startBackoff(nowNs: number): void {
    this.phase = "waiting";
    this.outbox.clear();
    this.retryAt = nowNs + this.backoffNs;
    this.backoffNs = Math.min(2 * this.backoffNs, BACKOFF_MAX_NS);
  }

  private queue(message: wire.ClientMessage): boolean {
    return this.outbox.push(message.type, encodeClient(message, this.connectionEpoch));
  }
}

/** Return the refusal that a fault amounts to when the client must not join again by itself, else null. */
function findFinalRefusal(fault: ProtocolFault): Refused | null {
  const refused = { type: "refused" as const, supported_versions: [] };
  if (fault.code === "dropped" && fault.reason === REPLACED) {
    const advice = "use another browser profile for a second participant";
    return { ...refused, code: REPLACED, message: "another window or device took over with this identity", advice };
  }
  if (fault.code === "revoked") return { ...refused, code: fault.code, message: fault.message, advice: "ask the owner of the session" };
  return null;
}
