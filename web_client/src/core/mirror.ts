// The shared session state, rebuilt from one snapshot and the events after it. Pure.
//
// `SessionMirror` never guesses: after a gap in `event_seq` it is not `synced`, and until a new snapshot comes it keeps
// the newer events aside (bounded). Two mirrors with equal `eventSeq` have equal `hash()`, whenever they started.

import { blake2b } from "@noble/hashes/blake2.js";
import { bytesToHex } from "@noble/hashes/utils.js";

import type * as wire from "../protocol/messages.g.ts";
import type { BodyInfo, Filled, Lease, ParticipantInfo, RobotInfo } from "./api.ts";
import { writeStruct } from "./codec.ts";
import { Writer } from "./msgpack.ts";

export type Event = Filled<wire.Event>;
export type Snapshot = Filled<wire.Snapshot>;
export type Alignment = Filled<wire.Alignment>;
export type AnchorInfo = Filled<wire.AnchorInfo>;

/** Events `first` to `last` that will not be delivered: a snapshot has their effects, not the events. */
export interface MissedEvents {
  type: "missed";
  first: number;
  last: number;
}

/** Held while a snapshot is on its way; the next snapshot covers any further ones. */
const MAX_HELD_EVENTS = 256;
/** Causes of `scene_changed` that leave robots and bodies as they are; after any other a new snapshot lists them. */
const SAME_BODIES = ["reset", "patch", "external"];

/**
 * Roster, leases, alignments, robots, anchors and bodies of the session.
 *
 * `bodyIndex` and `indexOfId` give the row of a body in state frames, by name and by id. `synced` is false before the
 * first snapshot and after a gap; the other attributes then show the last known state. `bodies` are those of the epochs
 * from `bodiesSince` to `bodiesUntil`, as far as is known.
 */
export class SessionMirror {
  gaps = 0;
  discarded = 0;
  heldOverflow = 0;
  synced = false;
  eventSeq = 0;
  sceneEpoch = 0;
  sceneRevision = 0;
  sceneHash = "";
  tickPeriodNs = 0;
  paused = false;
  estop = false;
  stopSeq = 0;
  consentTimeoutNs = 0;
  episode: Filled<wire.EpisodeChanged> | null = null;
  participants = new Map<string, ParticipantInfo>();
  leases = new Map<string, Lease>();
  robots = new Map<string, RobotInfo>();
  anchors = new Map<string, AnchorInfo>();
  bodies: BodyInfo[] = [];
  bodiesSince = 0;
  bodiesUntil = 0;
  bodyIndex = new Map<string, number>();
  indexOfId = new Map<number, number>();
  private hasSnapshot = false;
  private held: Event[] = [];

  /** Clear the session, keep the counters. */
  reset(): void {
    const { gaps, discarded, heldOverflow } = this;
    Object.assign(this, new SessionMirror(), { gaps, discarded, heldOverflow });
  }

  /**
   * Apply a snapshot and the held events after it.
   *
   * Returns, in order, the events since the last one that was applied: each one that arrived, and `MissedEvents` for
   * those that did not. Events before the first snapshot are neither. An older snapshot than the known state is discarded
   * unless a gap is open.
   */
  applySnapshot(snapshot: Snapshot): (Event | MissedEvents)[] {
    if (this.synced && snapshot.event_seq < this.eventSeq) {
      this.discarded += 1;
      return [];
    }
    const held = new Map(this.held.map((event) => [event.event_seq, event]));
    this.held = [];
    const covered = this.hasSnapshot ? this.listCoveredEvents(held, snapshot.event_seq) : [];
    this.eventSeq = snapshot.event_seq;
    this.sceneEpoch = snapshot.scene_epoch;
    this.sceneRevision = snapshot.scene_revision;
    this.sceneHash = snapshot.scene_hash;
    this.tickPeriodNs = snapshot.tick_period_ns;
    this.paused = snapshot.paused;
    this.estop = snapshot.estop;
    this.stopSeq = snapshot.stop_seq;
    this.consentTimeoutNs = snapshot.consent_timeout_ns;
    this.episode = snapshot.episode;
    this.participants = new Map(snapshot.participants.map((info) => [info.id, info]));
    this.leases = new Map(snapshot.leases.map((lease) => [lease.target, lease]));
    this.robots = new Map(snapshot.robots.map((robot) => [robot.name, robot]));
    this.anchors = new Map(snapshot.anchors.map((anchor) => [anchor.id, anchor]));
    this.takeBodies(snapshot);
    this.synced = this.hasSnapshot = true;
    const seqs = [...held.keys()].sort((a, b) => a - b);
    if (covered.length === 0) this.discarded += seqs.filter((seq) => seq <= snapshot.event_seq).length;
    const after = seqs.filter((seq) => seq > snapshot.event_seq).map((seq) => held.get(seq) as Event);
    return [...covered, ...after.filter((event) => this.applyEvent(event))];
  }

  /** Apply the next event. Returns false when it was discarded, or held until a snapshot comes. */
  applyEvent(event: Event): boolean {
    if (!this.synced) {
      this.holdEvent(event);
      return false;
    }
    if (event.event_seq <= this.eventSeq) {
      this.discarded += 1;
      return false;
    }
    if (event.event_seq !== this.eventSeq + 1) {
      this.gaps += 1;
      this.synced = false;
      this.holdEvent(event);
      return false;
    }
    this.eventSeq = event.event_seq;
    this.applyBody(event.body);
    return true;
  }

  /** Ids of the participants that are connected now. */
  get connected(): Set<string> {
    return new Set([...this.participants.values()].filter((info) => info.connected).map((info) => info.id));
  }

  /** Return the alignment of one participant, null while it has none. */
  findAlignment(participant: string): Alignment | null {
    return this.participants.get(participant)?.alignment ?? null;
  }

  /** Return the fencing token of `target` when `participant` holds it (alone or with others), else null. */
  findLeaseVersion(target: string, participant: string): number | null {
    const lease = this.leases.get(target);
    return lease !== undefined && isHeldBy(lease, participant) ? lease.lease_version : null;
  }

  /**
   * Return the digest (32 hex digits) of everything shared, independent of when and how this mirror received it. Poses of
   * anchors are part of it when there are any.
   */
  hash(): string {
    const writer = new Writer();
    const hasAnchors = this.anchors.size > 0;
    writer.writeArrayHead(hasAnchors ? 14 : 13);
    for (const number of [this.eventSeq, this.sceneEpoch, this.sceneRevision]) writer.writeInt(number);
    writer.writeString(this.sceneHash);
    writer.writeInt(this.tickPeriodNs);
    writer.writeBool(this.paused);
    writer.writeBool(this.estop);
    writer.writeInt(this.stopSeq);
    if (this.episode === null) writer.writeNull();
    else writeStruct(writer, "EpisodeChanged", this.episode);
    writeList(writer, "ParticipantInfo", sortedValues(this.participants));
    writeList(writer, "Lease", sortedValues(this.leases));
    writeList(writer, "RobotInfo", sortedValues(this.robots));
    writeList(writer, "BodyInfo", this.bodies);
    if (hasAnchors) writeAnchorPoses(writer, sortedValues(this.anchors));
    return bytesToHex(blake2b(writer.finish(), { dkLen: 16 }));
  }

  private takeBodies(snapshot: Snapshot): void {
    if (!areSameBodies(snapshot.bodies, this.bodies)) this.bodiesSince = snapshot.scene_epoch;
    this.bodies = snapshot.bodies;
    this.bodiesUntil = snapshot.scene_epoch;
    this.bodyIndex = new Map(snapshot.bodies.map(([, name], i) => [name, i]));
    this.indexOfId = new Map(snapshot.bodies.map(([id], i) => [id, i]));
  }

  /** Return the events up to `last`, which a snapshot contains, with `MissedEvents` for those that did not arrive. */
  private listCoveredEvents(held: Map<number, Event>, last: number): (Event | MissedEvents)[] {
    const covered: (Event | MissedEvents)[] = [];
    let next = this.eventSeq + 1;
    for (const seq of [...held.keys()].filter((seq) => seq >= next && seq <= last).sort((a, b) => a - b)) {
      if (seq > next) covered.push({ type: "missed", first: next, last: seq - 1 });
      covered.push(held.get(seq) as Event);
      next = seq + 1;
    }
    if (next <= last) covered.push({ type: "missed", first: next, last });
    return covered;
  }

  private holdEvent(event: Event): void {
    this.held.push(event);
    if (this.held.length > MAX_HELD_EVENTS) {
      this.held.shift();
      this.heldOverflow += 1;
    }
  }

  private applyBody(body: Event["body"]): void {
    switch (body.event) {
      case "participant_joined":
      case "participant_changed":
        this.participants.set(body.participant.id, body.participant);
        break;
      case "participant_left":
        this.applyLeft(body.participant, body.grace);
        break;
      case "lease_changed":
        this.leases.set(body.lease.target, body.lease);
        break;
      case "leases_changed":
        for (const lease of body.leases) this.leases.set(lease.target, lease);
        break;
      case "scale_changed": {
        const lease = this.leases.get(body.robot);
        if (lease !== undefined) this.leases.set(body.robot, { ...lease, scale: body.scale });
        break;
      }
      case "alignment_changed": {
        const info = this.participants.get(body.participant);
        if (info !== undefined) this.participants.set(body.participant, { ...info, alignment: body.alignment });
        break;
      }
      case "anchor_moved": {
        const anchor = this.anchors.get(body.anchor_id) ?? { id: body.anchor_id, size_m: 0, error_m: 0, marks: [] };
        this.anchors.set(body.anchor_id, { ...anchor, T_world_anchor: body.T_world_anchor });
        break;
      }
      case "scene_changed":
        this.sceneEpoch = body.scene_epoch;
        this.sceneRevision = body.scene_revision;
        this.sceneHash = body.scene_hash || this.sceneHash;
        this.tickPeriodNs = body.tick_period_ns || this.tickPeriodNs;
        this.synced = SAME_BODIES.includes(body.cause);
        if (this.synced) this.bodiesUntil = body.scene_epoch;
        break;
      case "estop_changed":
        this.estop = body.active;
        this.stopSeq = body.stop_seq;
        break;
      case "pause_changed":
        this.paused = body.paused;
        break;
      case "episode_changed":
        this.episode = body;
        break;
    } // others are history only: nothing of them is in a snapshot
  }

  private applyLeft(participant: string, grace: boolean): void {
    const info = this.participants.get(participant);
    if (info === undefined) return;
    if (grace) this.participants.set(participant, { ...info, connected: false });
    else this.participants.delete(participant);
  }
}

/** Return whether a participant holds a lease, alone or with others. */
export function isHeldBy(lease: Lease, participant: string): boolean {
  return lease.holder === participant || lease.sub_holders.includes(participant);
}

function areSameBodies(a: readonly BodyInfo[], b: readonly BodyInfo[]): boolean {
  return a.length === b.length && a.every((body, i) => body.every((field, k) => field === b[i]?.[k]));
}

function sortedValues<T>(map: ReadonlyMap<string, T>): T[] {
  return [...map.keys()].sort(compareCodePoints).map((key) => map.get(key) as T);
}

/** Compare by code points, as Python does; JavaScript compares UTF-16. */
function compareCodePoints(a: string, b: string): number {
  const left = [...a];
  const right = [...b];
  for (let i = 0; i < Math.min(left.length, right.length); i++) {
    const difference = ((left[i] as string).codePointAt(0) as number) - ((right[i] as string).codePointAt(0) as number);
    if (difference !== 0) return difference;
  }
  return left.length - right.length;
}

function writeList(writer: Writer, struct: string, items: readonly unknown[]): void {
  writer.writeArrayHead(items.length);
  for (const item of items) writeStruct(writer, struct, item);
}

function writeAnchorPoses(writer: Writer, anchors: readonly AnchorInfo[]): void {
  writer.writeArrayHead(anchors.length);
  for (const anchor of anchors) {
    writer.writeArrayHead(2);
    writer.writeString(anchor.id);
    writeStruct(writer, "Pose", anchor.T_world_anchor);
  }
}
