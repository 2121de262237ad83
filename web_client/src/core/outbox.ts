// Messages that a client sends: the bounded queue, requests that wait for replies, and the e-stop.

import type * as wire from "../protocol/messages.g.ts";
import type { Lease, Reply } from "./api.ts";

/** Messages that may wait for the socket. */
export const MAX_OUTGOING = 256;
const MAX_PENDING = 64;
/** Targets named in replies. */
const MAX_GRANTED = 4096;
const MAX_CODES = 64;

/** Counters of the control channel, since the client was made. */
export class ConnectionCounters {
  sent = 0;
  received = 0;
  /** No connection, or the socket was full: late samples are worthless, they are not kept. */
  samplesNotSent = 0;
  /** Named a robot or object that is not ours: sent as mere presence, without it. */
  samplesWithoutLease = 0;
  outgoingDropped = 0;
  malformed = 0;
  /** Addressed to an earlier connection of ours. */
  otherConnection = 0;
  unexpectedReplies = 0;
  unaskedDenials = 0;
  inboxDropped = 0;
  snapshots = 0;
  reconnects = 0;
  /** By `ProtocolFault.code`, beyond `MAX_CODES` as `other`. */
  readonly faults = new Map<string, number>();

  /** Count a `ProtocolFault`. */
  countFault(code: string): void {
    const name = this.faults.has(code) || this.faults.size < MAX_CODES ? code : "other";
    this.faults.set(name, (this.faults.get(name) ?? 0) + 1);
  }
}

/** A message that waits: a sample may be dropped when the socket is full. */
export interface Outgoing {
  droppable: boolean;
  bytes: Uint8Array<ArrayBuffer>;
}

/**
 * Bounded queue. Drops are counted.
 *
 * An e-stop passes everything but a hello. A release passes samples only: it may refer to an acquire before it.
 */
export class Outbox {
  private queue: Outgoing[] = [];
  private hasHello = false; // always as the first

  constructor(private readonly counters: ConnectionCounters) {}

  /** Queue `bytes`, which are the message `type`. False: the queue is full, and the message is not urgent. */
  push(type: wire.ClientMessage["type"], bytes: Uint8Array<ArrayBuffer>): boolean {
    const droppable = type === "sample" || type === "samples";
    if (this.queue.length >= MAX_OUTGOING) {
      if (type !== "estop" && type !== "release" && type !== "bye") {
        this.countDrop(droppable);
        return false;
      }
      this.makeRoom();
    }
    if (type === "estop") this.queue.splice(this.hasHello ? 1 : 0, 0, { droppable: false, bytes });
    else if (type === "release") this.queue.splice(this.indexBeforeSamples(), 0, { droppable: false, bytes });
    else {
      this.hasHello ||= type === "hello";
      this.queue.push({ droppable, bytes });
    }
    return true;
  }

  /** Return the next message to send, null when the queue is empty. */
  peek(): Outgoing | null {
    return this.queue[0] ?? null;
  }

  /** Remove the message of `peek`, which was sent or is dropped. */
  pop(sent: boolean): void {
    this.queue.shift();
    this.hasHello = false;
    if (sent) this.counters.sent += 1;
    else this.counters.samplesNotSent += 1;
  }

  /** Empty the queue: its messages are not for the next connection. */
  clear(): void {
    this.queue = [];
    this.hasHello = false;
  }

  private indexBeforeSamples(): number {
    let at = this.queue.length;
    while (at > 0 && this.queue[at - 1]?.droppable === true) at -= 1;
    return at;
  }

  /** Drop the newest sample; without any, the newest message. */
  private makeRoom(): void {
    const sample = this.queue.findLastIndex((item) => item.droppable);
    const at = sample < 0 ? this.queue.length - 1 : sample;
    this.countDrop(this.queue[at]?.droppable === true);
    this.queue.splice(at, 1);
  }

  private countDrop(sample: boolean): void {
    if (sample) this.counters.samplesNotSent += 1;
    else this.counters.outgoingDropped += 1;
  }
}

/**
 * Requests that wait for replies, replies to be fetched, and leases that replies granted. Bounded.
 *
 * Of one connection: `clear` for the next one. Request numbers continue.
 */
export class PendingRequests {
  nextRequest = 1;
  private readonly pending = new Set<number>();
  private readonly replies = new Map<number, Reply>();
  private readonly granted = new Map<string, Lease>();

  constructor(private readonly counters: ConnectionCounters) {}

  /** Remove everything: requests of another connection get no reply. */
  clear(): void {
    this.granted.clear();
    this.pending.clear();
    this.replies.clear();
  }

  /** Count the request `nextRequest` as sent. Beyond `MAX_PENDING` the oldest one is dropped. */
  addPending(): void {
    if (this.pending.size >= MAX_PENDING) this.pending.delete(Math.min(...this.pending));
    this.pending.add(this.nextRequest);
    this.nextRequest += 1;
  }

  /** Return whether a request still waits for its reply. */
  isPending(requestId: number): boolean {
    return this.pending.has(requestId);
  }

  /** Return the reply to a request once, null while there is none. */
  popReply(requestId: number): Reply | null {
    const reply = this.replies.get(requestId) ?? null;
    this.replies.delete(requestId);
    return reply;
  }

  /** Store a reply. False: it is a denial of a message that expects no reply, to be passed on otherwise. */
  processReply(reply: Reply): boolean {
    for (const lease of reply.leases) this.granted.set(lease.target, lease);
    dropOldest(this.granted, MAX_GRANTED);
    if (this.pending.delete(reply.request_id)) {
      this.replies.set(reply.request_id, reply);
      this.counters.inboxDropped += dropOldest(this.replies, MAX_PENDING);
      return true;
    }
    if (reply.request_id !== 0) {
      this.counters.unexpectedReplies += 1;
      return true;
    }
    return reply.denial === null;
  }

  /** Return the lease in the newest reply that names `target`: it may be ahead of the event. */
  grantedLease(target: string): Lease | null {
    return this.granted.get(target) ?? null;
  }
}

/** Remove the oldest entries above `most`. Returns their number. */
function dropOldest<K>(map: Map<K, unknown>, most: number): number {
  let dropped = 0;
  for (const key of map.keys()) {
    if (map.size <= most) break;
    map.delete(key);
    dropped += 1;
  }
  return dropped;
}

/**
 * An e-stop of ours until the session is known to have it: a connection may end with it on the way.
 *
 * The session has it when it reports a stop of ours; the stop of another is no proof, as it may be cleared before ours
 * arrives. When the report was missed, the pong of a ping that was sent after the e-stop proves it too, if the session
 * is stopped.
 */
export class PendingEStop {
  /** To be sent again on the next connection, null when there is none or the session has it. */
  message: wire.EStop | null = null;
  private proofNs: number | null = null;

  /** Keep an e-stop that is sent now, for the first time or again. */
  begin(message: wire.EStop): void {
    this.message = message;
    this.proofNs = null;
  }

  /** Forget the e-stop: the user clears it, or the session has it. */
  withdraw(): void {
    this.message = null;
  }

  /** Note a ping that was queued. */
  onPing(t0Ns: number): void {
    if (this.message !== null) this.proofNs ??= t0Ns;
  }

  /** Note the pong of a ping, while the session is `stopped` as far as we know. */
  onPong(t0Ns: number, stopped: boolean): void {
    if (stopped && this.proofNs !== null && t0Ns >= this.proofNs) this.message = null;
  }
}
