// docs/protocol/conversations.json: the core behaves as the file states.

import { describe, expect, test } from "vitest";
import { AssetLoader } from "../src/core/asset_loader.ts";
import { decodeStruct, encodeStruct } from "../src/core/codec.ts";
import { ClientConnection, type InboxMessage } from "../src/core/connection.ts";
import { SampleBuilder } from "../src/core/samples.ts";
import type { SceneState } from "../src/core/state_stream.ts";
import { fromHex, readGolden, toHex, toJson } from "./golden.ts";

/** A step: JSON of many forms. */
type Step = any;
interface Conversation {
  name: string;
  core: string;
  secret: string;
  resume_token: string;
  steps: Step[];
}

const { conversations } = readGolden<{ conversations: Conversation[] }>("conversations");
const OUTCOMES = ["sent", "inbox", "replies", "state", "outcome", "idle"];

/** A client core that takes steps of a conversation. */
class ConversationPlayer {
  private readonly identity;
  private readonly connection;
  private readonly samples;
  private state: SceneState | null = null;
  private sessionId = "";

  constructor(secret: string, resumeToken: string) {
    const identity = {
      secret: fromHex(secret),
      resumeToken: fromHex(resumeToken) as Uint8Array,
      remember: (token: Uint8Array) => {
        identity.resumeToken = token;
      },
    };
    this.identity = identity;
    const hello = { type: "hello", role: "operator", name: "ann", software: "conversation", devices: ["right"], capabilities: ["run:0011223344556677"] } as const;
    this.connection = new ClientConnection({ ...hello, devices: [...hello.devices], capabilities: [...hello.capabilities] }, identity);
    this.samples = new SampleBuilder(this.connection);
  }

  playStep(step: Step): Step {
    const { connection } = this;
    const nowNs: number = step.at_ns;
    const replies: unknown[] = [];
    switch (step.do) {
      case "open":
        connection.open(nowNs);
        break;
      case "close":
        connection.close();
        break;
      case "tick":
        connection.tick(nowNs);
        break;
      case "disconnect":
        connection.handleDisconnect(nowNs);
        break;
      case "receive":
        connection.receive(step.frames.map(fromHex), nowNs);
        if (connection.welcome !== null && connection.welcome.session_id !== this.sessionId) {
          this.sessionId = connection.welcome.session_id;
          this.state = null;
        }
        break;
      case "receive_state":
        this.state = connection.stream.drain(step.messages.map((frames: string[]) => frames.map(fromHex)), connection.clock.sessionNs(nowNs), nowNs) ?? this.state;
        break;
      case "request":
        connection.request({ type: step.message, ...step.fields });
        break;
      case "reply":
        replies.push(connection.requests.popReply(step.request_id));
        break;
      case "estop":
        connection.send({ type: "estop", reason: step.reason });
        break;
      case "sample":
        connection.send(this.samples.makeSample({ device: step.device, pose: [step.p, step.q], robots: step.robots, clutch: step.clutch }, step.capture_ns));
        break;
      default:
        throw new Error(`step ${step.do} is not of a conversation`);
    }
    const outcome = { sent: this.takeSent(), inbox: this.takeInbox(), state: this.describe(nowNs) };
    return toJson(replies.length > 0 ? { ...outcome, replies } : outcome);
  }

  private takeSent(): string[] {
    const sent: string[] = [];
    for (let item = this.connection.peekOutgoing(); item !== null; item = this.connection.peekOutgoing()) {
      this.connection.popOutgoing(true);
      sent.push(toHex(item.bytes));
    }
    return sent;
  }

  private takeInbox(): InboxMessage[] {
    const { inbox } = this.connection;
    this.connection.inbox = [];
    return inbox;
  }

  private describe(nowNs: number): Step {
    const { connection } = this;
    const { mirror, counters, clock } = connection;
    const waits = connection.isJoined || connection.phase === "joining" || connection.phase === "waiting";
    const shown = this.state !== null && this.state.sceneEpoch >= mirror.bodiesSince ? this.state.poses : null;
    const poses = [...mirror.bodyIndex].map(([name, i]) => {
      const row = shown !== null && 7 * i < shown.length ? [...shown.subarray(7 * i, 7 * i + 7)] : null;
      return [name, row === null ? null : row.map((v) => Math.round(v * 1e6) / 1e6 + 0)];
    });
    return {
      phase: connection.phase,
      generation: connection.generation,
      participant_id: connection.participantId,
      connection_epoch: connection.connectionEpoch,
      resume_token: toHex(this.identity.resumeToken),
      failure: connection.failure?.code ?? "",
      retryable_refusal: connection.retryableRefusal?.code ?? "",
      next_deadline_ns: waits ? connection.nextDeadlineNs(nowNs) : null,
      session_ns: clock.synced ? clock.sessionNs(nowNs) : null,
      rtt_ns: clock.rttNs,
      synced: mirror.synced,
      event_seq: mirror.eventSeq,
      scene: [mirror.sceneEpoch, mirror.sceneRevision, mirror.sceneHash],
      mirror_hash: mirror.synced ? mirror.hash() : null,
      leases: Object.fromEntries([...mirror.leases.keys()].map((name) => [name, connection.leaseVersion(name)])),
      body_poses: Object.fromEntries(poses),
      malformed: counters.malformed,
      other_connection: counters.otherConnection,
      reconnects: counters.reconnects,
    };
  }
}

/** An asset loader that takes steps of a conversation, with the assets in memory. */
class AssetPlayer {
  private readonly loader = new AssetLoader();
  private readonly bytes = new Map<string, number[]>();

  async playStep(step: Step): Promise<Step> {
    const { loader } = this;
    let outcome = "";
    switch (step.do) {
      case "want":
        loader.add(step.address, step.size);
        for (const address of loader.takeLookups()) {
          this.bytes.set(address, []);
          loader.onMissing(address, 0);
        }
        break;
      case "receive":
        outcome = await this.processChunk(fromHex(step.frames[0]), fromHex(step.frames[1]), step.at_ns);
        break;
      case "link_lost":
        loader.onLinkLost(step.at_ns);
        break;
    }
    const sent = loader.takeRequests(step.at_ns).map(({ requestId, address, offset, length }) => toHex(encodeStruct("AssetRequest", [1, 1, requestId, address, offset, length])));
    return { outcome, sent, idle: loader.idle };
  }

  private async processChunk(head: Uint8Array, data: Uint8Array<ArrayBuffer>, nowNs: number): Promise<string> {
    const [, requestId, address, offset, total] = decodeStruct("AssetChunk", head) as [number, number, string, number, number];
    const accepted = this.loader.processChunk(requestId, address, offset, total, data.length, nowNs);
    if (typeof accepted === "object") return `failed: ${accepted.reason}`;
    if (accepted !== "store") return accepted;
    this.bytes.get(address)?.push(...data);
    this.loader.onStored(data.length);
    if (!this.loader.isComplete(address)) return "stored";
    const digest = await crypto.subtle.digest("SHA-256", new Uint8Array(this.bytes.get(address) ?? []));
    if (toHex(new Uint8Array(digest)) === address) {
      this.loader.remove(address);
      return "complete";
    }
    this.bytes.set(address, []);
    return this.loader.restartAsset(address) ? "hash mismatch, again" : "failed: hash";
  }
}

describe("the core plays", () => {
  test.each(conversations)("$name", async (conversation) => {
    const player = conversation.core === "asset loader" ? new AssetPlayer() : new ConversationPlayer(conversation.secret, conversation.resume_token);
    for (const [number, step] of conversation.steps.entries()) {
      const expected = Object.fromEntries(Object.entries(step).filter(([name]) => OUTCOMES.includes(name)));
      expect(await player.playStep(step), `step ${number}: ${step.do}`).toEqual(expected);
    }
  });

  test("conversations of both cores", () => {
    expect(new Set(conversations.map(({ core }) => core))).toEqual(new Set(["connection", "asset loader"]));
  });
});
