// State channel of a client: from frames to the newest scene. Pure: bytes and times are passed in.
//
// Bounded staleness: the caller passes all messages that came together; only the newest rigid frame is decoded. After a
// silence (this client or its link stood still) frames have waited in queues: they are dropped until a fresh one comes, so
// the first frame handed out is fresh. On a link where every frame is old, the newest one counts as fresh.

import { TOPIC_PRESENCE, TOPIC_RIGID } from "../protocol/messages.g.ts";
import type { PresenceItem } from "./api.ts";
import { decodePresence, decodeStateHeader, type StateHeader } from "./codec.ts";
import { WireError } from "./errors.ts";
import { type Poses, RigidDecoder } from "./rigid.ts";

/** No frame for this long: the next frames may have waited in queues. */
const STALLED_NS = 50_000_000;
/** A frame published this long ago waited in a queue ... */
const QUEUED_NS = 60_000_000;
/** ... but after this long without a fresher one it is the newest there is (slow link). */
const FLUSH_NS = 150_000_000;
/** Frames over which the usual age of frames on this link is averaged. */
const USUAL = 8;
/** Presence messages that may wait to be decoded. */
const PRESENCE_WAITING = 8;

/** The newest decoded state. `poses`: rows of 7 in the order of `Snapshot.bodies`, read only. Times: session time. */
export interface SceneState {
  header: StateHeader;
  sceneEpoch: number;
  sessionTime: number;
  poses: Poses;
  receivedNs: number;
  ageNs: number;
}

/** Fields of a `StateHeader` by name. */
export function readHeader(header: StateHeader): {
  sceneEpoch: number;
  sceneRevision: number;
  tick: number;
  simTime: number;
  sessionTime: number;
  publishedNs: number;
  stateSeq: number;
  baseSeq: number;
} {
  const [sceneEpoch, sceneRevision, tick, simTime, sessionTime, publishedNs, stateSeq, baseSeq] = header;
  return { sceneEpoch, sceneRevision, tick, simTime, sessionTime, publishedNs, stateSeq, baseSeq };
}

/** Counters of state frames. Every frame that came is either `delivered` or counted in exactly one other field. */
export interface StateCounters {
  delivered: number;
  superseded: number;
  queuedOld: number;
  outOfOrder: number;
  beforeSnapshot: number;
  otherEpoch: number;
  undecodable: number;
  malformed: number;
  unknownTopic: number;
  bytesReceived: number;
  presence: number;
}

const topicRigid = new TextEncoder().encode(TOPIC_RIGID);
const topicPresence = new TextEncoder().encode(TOPIC_PRESENCE);

/**
 * Decoder of the newest frame of each drain. `wantsSnapshot` becomes true when the deltas have lost their base.
 *
 * `sceneEpoch`: the newest epoch whose bodies the application knows, by events or snapshot. Frames of other epochs are
 * decoded and counted, but not handed out, because their bodies may differ.
 */
export class StateStream {
  readonly counters: StateCounters = {
    delivered: 0,
    superseded: 0,
    queuedOld: 0,
    outOfOrder: 0,
    beforeSnapshot: 0,
    otherEpoch: 0,
    undecodable: 0,
    malformed: 0,
    unknownTopic: 0,
    bytesReceived: 0,
    presence: 0,
  };
  sceneEpoch = 0;
  wantsSnapshot = false;
  private decoder: RigidDecoder | null = null;
  /** By participant, then by device. */
  private present = new Map<string, Map<string, PresenceItem>>();
  private presenceNs = 0;
  private presenceWaiting: Uint8Array[] = [];
  private presenceTaken = 0;
  private cameNs = -1;
  private flushUntil = 0;
  private usualAge = 0;

  /** Clear all frames for another session: its frames may be numbered from the beginning. */
  reset(): void {
    this.decoder = null;
    this.present = new Map();
    this.presenceNs = 0;
    this.presenceWaiting = [];
    this.wantsSnapshot = false;
    this.restart();
  }

  /** Prepare for frames by another route: its queues are still empty, and the usual age may differ. */
  restart(): void {
    this.cameNs = -1;
    this.flushUntil = 0;
    this.usualAge = 0;
  }

  /** Take the poses of a snapshot; poses of newer frames are kept. */
  loadKeyframe(stateSeq: number, poses: Float64Array): void {
    if (this.decoder === null || 7 * this.decoder.bodyCount !== poses.length) this.decoder = new RigidDecoder(poses.length / 7);
    this.decoder.loadKeyframe(stateSeq, poses);
    this.wantsSnapshot = false;
  }

  /** Process all received messages, oldest first; return the newest scene if there is one. `nowNs`: session time. */
  drain(messages: readonly (readonly Uint8Array[])[], nowNs: number, localNs: number): SceneState | null {
    let newest: [StateHeader, Uint8Array] | null = null;
    for (const frames of messages) {
      for (const frame of frames) this.counters.bytesReceived += frame.length;
      const [topic, head, payload] = frames;
      if (topic !== undefined && isSame(topic, topicPresence) && frames.length === 2) this.presenceWaiting.push(head as Uint8Array);
      else if (topic !== undefined && isSame(topic, topicRigid) && frames.length === 3) {
        const header = this.decodeHeader(head as Uint8Array);
        if (header === null) continue;
        if (newest !== null) this.counters.superseded += 1;
        newest = [header, payload as Uint8Array];
      } else if (topic !== undefined && (isSame(topic, topicRigid) || isSame(topic, topicPresence))) this.counters.malformed += 1;
      else this.counters.unknownTopic += 1;
    }
    const state = newest === null ? null : this.decode(newest[0], newest[1], nowNs, localNs);
    if (this.presenceWaiting.length >= PRESENCE_WAITING) this.decodeWaiting();
    return state;
  }

  /** Heads and hands of all participants. Decoded on access: the scene has priority. */
  listPresence(): PresenceItem[] {
    this.decodeWaiting();
    return [...this.present.values()].flatMap((devices) => [...devices.values()]);
  }

  /** Return `listPresence()` if presence has come since the last call, else null. */
  takePresence(): PresenceItem[] | null {
    const before = this.presenceTaken;
    this.decodeWaiting();
    this.presenceTaken = this.counters.presence;
    return this.presenceTaken === before ? null : this.listPresence();
  }

  /** Remove all participants but these: presence that they sent before leaving may arrive late. */
  retainPresence(participants: ReadonlySet<string>): void {
    this.decodeWaiting();
    for (const participant of this.present.keys()) if (!participants.has(participant)) this.present.delete(participant);
  }

  /** Remove a participant that left. */
  removePresence(participant: string): void {
    this.decodeWaiting();
    this.present.delete(participant);
  }

  private decodeHeader(bytes: Uint8Array): StateHeader | null {
    try {
      return decodeStateHeader(bytes);
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      this.counters.malformed += 1;
      return null;
    }
  }

  private decode(header: StateHeader, payload: Uint8Array, nowNs: number, localNs: number): SceneState | null {
    const { sceneEpoch, sessionTime, publishedNs, stateSeq, baseSeq } = readHeader(header);
    if (this.isFromQueue(nowNs - publishedNs, localNs)) {
      this.counters.queuedOld += 1;
      return null;
    }
    const { decoder } = this;
    if (decoder === null) {
      this.counters.beforeSnapshot += 1;
      return null;
    }
    if (stateSeq <= decoder.stateSeq) {
      this.counters.outOfOrder += 1;
      return null;
    }
    let complete: boolean;
    try {
      complete = decoder.apply(stateSeq, baseSeq, payload);
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      this.counters.malformed += 1;
      this.wantsSnapshot = true; // perhaps the bodies changed
      return null;
    }
    if (sceneEpoch !== this.sceneEpoch) {
      this.counters.otherEpoch += 1;
      return null;
    }
    if (!complete) {
      this.counters.undecodable += 1;
      this.wantsSnapshot = true;
      return null;
    }
    this.counters.delivered += 1;
    return { header, sceneEpoch, sessionTime, poses: decoder.poses, receivedNs: nowNs, ageNs: nowNs - sessionTime };
  }

  /** Return whether a frame that comes now is to be dropped, because fresher ones must be right behind it. */
  private isFromQueue(ageNs: number, localNs: number): boolean {
    const stoodStill = this.cameNs >= 0 && localNs - this.cameNs > STALLED_NS;
    this.cameNs = localNs;
    const old = ageNs > Math.max(QUEUED_NS, 2 * this.usualAge);
    if (old && stoodStill && this.flushUntil === 0) this.flushUntil = localNs + FLUSH_NS;
    if (old && localNs < this.flushUntil) return true;
    // No fresher frame came in time, so this is the usual age of frames on this link from now on.
    const weight = (old && this.flushUntil > 0) || this.usualAge === 0 ? 1 : USUAL;
    this.usualAge += Math.floor((ageNs - this.usualAge) / weight);
    this.flushUntil = 0;
    return false;
  }

  private decodeWaiting(): void {
    const waiting = this.presenceWaiting;
    this.presenceWaiting = [];
    for (const bytes of waiting) {
      try {
        const [sessionTime, , items] = decodePresence(bytes);
        if (sessionTime < this.presenceNs) {
          this.counters.outOfOrder += 1;
          continue;
        }
        this.counters.presence += 1;
        this.presenceNs = sessionTime;
        for (const item of items) {
          const devices = this.present.get(item[0]) ?? new Map<string, PresenceItem>();
          devices.set(item[1], item);
          this.present.set(item[0], devices);
        }
      } catch (error) {
        if (!(error instanceof WireError)) throw error;
        this.counters.malformed += 1;
      }
    }
  }
}

/** Return the bulk frame of a snapshot, or null when its size is wrong. */
export function readKeyframe(bytes: Uint8Array, bodyCount: number): Poses | null {
  if (bytes.length !== bodyCount * 56) return null;
  return new Float64Array(bytes.slice().buffer);
}

function isSame(a: Uint8Array, b: Uint8Array): boolean {
  return a.length === b.length && a.every((byte, i) => byte === b[i]);
}
