// The WebSocket for media: opened while streams are wanted, with the ticket of the session. Deformables are decoded here.

import type { FromWorker } from "./api.ts";
import type { ArrivalMeter } from "./arrival_meter.ts";
import { decodeCloud } from "./cloud.ts";
import { decodeMediaHeader } from "./codec.ts";
import { MalformedError, WireError } from "./errors.ts";
import type { SocketLike } from "./pairing_client.ts";
import type { SceneAssets } from "./scene_assets.ts";
import { Channel, CloseCode, encodeTicket, encodeWishes, SUBPROTOCOL, unpackMessage } from "./wire.ts";

/** What of the environment is needed. */
export interface MediaEnvironment {
  post(update: FromWorker, transfer: Transferable[]): void;
  openSocket(url: string, protocol: string): SocketLike;
  setTimer(ms: number, callback: () => void): () => void;
}

const MS_NS = 1_000_000;
const OPEN = 1;
/** Streams that a session has at most. */
const MAX_STREAMS = 16;
const FIRST_PAUSE_MS = 200;
const LONGEST_PAUSE_MS = 5_000;

/** Streams of media for the page. */
export class MediaLink {
  malformed = 0;
  private wishes: string[] = [];
  private url = "";
  private ticket = "";
  private epoch = 0;
  private socket: SocketLike | null = null;
  private cancelTimer: (() => void) | null = null;
  private pauseMs = FIRST_PAUSE_MS;

  constructor(
    private readonly environment: MediaEnvironment,
    private readonly assets: SceneAssets,
    private readonly meter: ArrivalMeter,
    private readonly getSessionNs: () => number,
  ) {}

  /** Set the streams that are wanted. */
  setWishes(streams: readonly string[]): void {
    this.wishes = streams.slice(0, MAX_STREAMS);
    if (this.socket?.readyState === OPEN) this.socket.send(encodeWishes(this.wishes));
    this.update();
  }

  /** Set where media come from. */
  setLink(url: string, ticket: string): void {
    this.url = url;
    this.ticket = ticket;
    this.update();
  }

  /** Note that the session decides what this connection gets: before, it takes no subscription. */
  onBudget(connectionEpoch: number): void {
    if (connectionEpoch === this.epoch) return;
    this.epoch = connectionEpoch;
    this.closeSocket(); // it belongs to the connection before
    this.update();
  }

  /** Close the socket and forget ticket and wishes. */
  close(): void {
    this.closeSocket();
    this.ticket = "";
    this.epoch = 0;
  }

  private update(): void {
    const wanted = this.wishes.length > 0 && this.ticket !== "" && this.epoch > 0;
    if (!wanted) this.closeSocket();
    else if (this.socket === null && this.cancelTimer === null) this.open();
  }

  private open(): void {
    const socket = this.environment.openSocket(this.url, SUBPROTOCOL);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      socket.send(encodeTicket(this.ticket));
      socket.send(encodeWishes(this.wishes));
    };
    socket.onmessage = (event) => this.onMessage(event.data);
    socket.onclose = ({ code }) => {
      this.closeSocket();
      if (code === CloseCode.NOT_ALLOWED) {
        this.ticket = ""; // the next one comes with the next welcome, or before this one expires
        return;
      }
      this.cancelTimer = this.environment.setTimer(this.pauseMs, () => {
        this.cancelTimer = null;
        this.update();
      });
      this.pauseMs = Math.min(2 * this.pauseMs, LONGEST_PAUSE_MS);
    };
  }

  private closeSocket(): void {
    const { socket } = this;
    this.socket = null;
    this.cancelTimer?.();
    this.cancelTimer = null;
    if (socket === null) return;
    socket.onopen = socket.onmessage = socket.onclose = socket.onerror = null;
    socket.close();
  }

  private onMessage(data: unknown): void {
    try {
      if (!(data instanceof ArrayBuffer)) throw new MalformedError("a text message");
      const { channel, frames } = unpackMessage(new Uint8Array(data));
      const [, head, bytes] = frames;
      if (channel !== Channel.MEDIA || head === undefined || bytes === undefined) return;
      this.pauseMs = FIRST_PAUSE_MS;
      this.process(head, bytes);
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      this.malformed += 1;
    }
  }

  private process(head: Uint8Array, bytes: Uint8Array): void {
    const header = decodeMediaHeader(head);
    const [stream, , scene_epoch, seq, captureNs, , encoding] = header;
    this.meter.recordMedia(head.length + bytes.length, Math.max(0, this.getSessionNs() - captureNs));
    if (encoding === "deformable") {
      const decoder = this.assets.findDecoder(stream);
      if (decoder === undefined) return;
      const vertices = decoder.decode(bytes);
      const session_ms = captureNs / MS_NS;
      this.environment.post({ type: "deformable", stream, vertices, session_ms, scene_epoch, seq, bound_m: decoder.boundM }, [vertices.buffer]);
      return;
    }
    if (encoding === "cloud") {
      const cloud = decodeCloud(bytes);
      this.environment.post({ type: "cloud", stream, cloud }, [cloud.points.buffer]);
      return;
    }
    const copy = bytes.slice();
    this.environment.post({ type: "media", header, bytes: copy }, [copy.buffer]);
  }
}
