// The WebSocket for media: opened while streams are wanted, with the ticket of the session. Deformables, clouds and pictures
// are decoded here.

import { type DeformableUpdate, type FromWorker, MAX_KEPT_FRAMES, type MediaCounters } from "./api.ts";
import type { ArrivalMeter } from "./arrival_meter.ts";
import { decodeCloud } from "./cloud.ts";
import { decodeMediaHeader } from "./codec.ts";
import { MalformedError, WireError } from "./errors.ts";
import { readJpegSize } from "./jpeg.ts";
import { NewestFrames } from "./newest_frames.ts";
import type { SocketLike } from "./pairing_client.ts";
import type { DeformableStream, SceneAssets } from "./scene_assets.ts";
import type { Surface } from "./sheet.ts";
import { Channel, CloseCode, encodeTicket, encodeWishes, SUBPROTOCOL, unpackMessage } from "./wire.ts";

/** What of the environment is needed. */
export interface MediaEnvironment {
  post(update: FromWorker, transfer: Transferable[]): void;
  openSocket(url: string, protocol: string): SocketLike;
  setTimer(ms: number, callback: () => void): () => void;
  /** Decode a JPEG image to this width [pixels]; rejects for one that is damaged. */
  decodeImage(bytes: Uint8Array, width: number): Promise<ImageBitmap>;
}

/** `frames`: those of a deformable that the page has. `spare`: surfaces that it has given back. */
interface LentFrames {
  frames: number;
  spare: Surface[];
}

/** A cloud or a picture, not decoded yet. */
interface Frame {
  encoding: string;
  bytes: Uint8Array;
  /** Of a picture, as it is decoded [pixels]. */
  width: number;
  capture_ms: number;
  received_ms: number;
}

const MS_NS = 1_000_000;
const OPEN = 1;
/** Streams that a session has at most. */
const MAX_STREAMS = 16;
/**
 * Larger pictures are decoded to this width or height [pixels]: no panel shows more, and one of 4096 x 4096 would cost a
 * headset several frames on its way to the graphics card.
 */
const MAX_SHOWN = 1024;
/** Frames of a deformable that the page has at most: those that it keeps, and some on their way. */
const MAX_LENT = 2 * MAX_KEPT_FRAMES;
/** Pictures per second below which the page itself builds the few surfaces that it draws. */
const LEAST_DRAWN_HZ = 10;
const FIRST_PAUSE_MS = 200;
const LONGEST_PAUSE_MS = 5_000;

/** Streams of media for the page. */
export class MediaLink {
  malformed = 0;
  /** Frames of deformables that a page that does not keep up was not sent. */
  notTaken = 0;
  /** By stream: of clouds and pictures that are wanted now. */
  readonly counters = new Map<string, MediaCounters>();
  private readonly frames = new NewestFrames<Frame>((stream, frame) => this.begin(stream, frame));
  private readonly lent = new Map<string, LentFrames>();
  private wishes: string[] = [];
  private url = "";
  private ticket = "";
  private epoch = 0;
  /** Pictures that the page drew in the last second. */
  private drawnHz = LEAST_DRAWN_HZ;
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
    this.frames.keepOnly(this.wishes);
    for (const stream of this.counters.keys()) if (!this.wishes.includes(stream)) this.counters.delete(stream);
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

  /** Note that the page has taken the newest cloud or picture of a stream: another one may come. */
  onTaken(stream: string): void {
    this.frames.finish(stream);
  }

  /** Note how many pictures the page drew in the last second. */
  onDrawn(pictures: number): void {
    this.drawnHz = pictures;
  }

  /** Take the surface of a frame of a deformable that the page does not need any more, null where it had none. */
  recycleSurface(stream: string, surface: Surface | null): void {
    const lent = this.lent.get(stream);
    if (lent === undefined) return;
    lent.frames -= 1;
    if (surface !== null && lent.spare.length < 2) lent.spare.push(surface);
  }

  /** Close the socket and forget the ticket: they belong to a connection that is gone. */
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
    const { ticket } = this;
    const socket = this.environment.openSocket(this.url, SUBPROTOCOL);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      socket.send(encodeTicket(ticket));
      socket.send(encodeWishes(this.wishes));
    };
    socket.onmessage = (event) => this.onMessage(event.data);
    socket.onclose = ({ code }) => {
      this.closeSocket();
      if (code === CloseCode.NOT_ALLOWED) {
        if (this.ticket === ticket) this.ticket = ""; // the next one comes with the next welcome, or before this one expires
        this.update();
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
    const [stream, , scene_epoch, seq, captureNs, , encoding, , , receivedNs] = header;
    this.meter.recordMedia(head.length + bytes.length, Math.max(0, this.getSessionNs() - captureNs));
    if (encoding === "deformable") {
      const deformable = this.assets.findDeformable(stream);
      if (deformable !== undefined) this.postDeformable(deformable, bytes, { stream, session_ms: captureNs / MS_NS, scene_epoch, seq });
      return;
    }
    if (encoding === "cloud" || encoding === "jpeg") {
      const frame = { encoding, bytes, width: 0, capture_ms: captureNs / MS_NS, received_ms: receivedNs / MS_NS };
      if (this.wishes.includes(stream)) this.takeNewest(stream, frame);
      return;
    }
    const copy = bytes.slice();
    this.environment.post({ type: "media", header, bytes: copy }, [copy.buffer]);
  }

  private postDeformable(
    deformable: DeformableStream,
    bytes: Uint8Array,
    head: Pick<DeformableUpdate, "stream" | "session_ms" | "scene_epoch" | "seq">,
  ): void {
    const lent = this.lent.get(head.stream) ?? { frames: 0, spare: [] };
    this.lent.set(head.stream, lent);
    if (lent.frames >= MAX_LENT) {
      this.notTaken += 1;
      return;
    }
    const vertices = deformable.decoder.decode(bytes);
    const surface = this.drawnHz >= LEAST_DRAWN_HZ ? deformable.buildSurface(vertices, lent.spare.pop()) : null;
    lent.frames += 1;
    const buffers = surface === null ? [] : [surface.position.buffer, surface.normal.buffer];
    const { boundM } = deformable.decoder;
    this.environment.post({ type: "deformable", ...head, vertices, surface, bound_m: boundM }, [vertices.buffer, ...buffers]);
  }

  /** Take a cloud or a picture: a page that stands still gets the newest one when it runs again, not all of them. */
  private takeNewest(stream: string, frame: Frame): void {
    const counters = this.count(stream);
    counters.received += 1;
    try {
      if (frame.encoding === "jpeg") frame.width = fitWidth(readJpegSize(frame.bytes));
    } catch (error) {
      counters.refused += 1;
      throw error;
    }
    if (!this.frames.push(stream, frame)) counters.superseded += 1;
  }

  private begin(stream: string, frame: Frame): void {
    void this.decode(stream, frame).catch(() => {
      // A damaged image, with a reason in the words of the browser, or a malformed cloud.
      this.malformed += 1;
      this.count(stream).refused += 1;
      this.frames.finish(stream);
    });
  }

  /** Decode and post a frame. The page answers with `taken`. */
  private async decode(stream: string, { encoding, bytes, width, ...times }: Frame): Promise<void> {
    if (encoding === "cloud") {
      const cloud = decodeCloud(bytes);
      this.environment.post({ type: "cloud", stream, cloud, ...times }, [cloud.points.buffer]);
      return;
    }
    const bitmap = await this.environment.decodeImage(bytes, width);
    if (this.wishes.includes(stream)) {
      this.environment.post({ type: "picture", stream, bitmap, ...times }, [bitmap]);
      return;
    }
    bitmap.close();
    this.frames.finish(stream);
  }

  private count(stream: string): MediaCounters {
    const counters = this.counters.get(stream) ?? { received: 0, superseded: 0, refused: 0 };
    if (this.wishes.includes(stream)) this.counters.set(stream, counters);
    return counters;
  }
}

function fitWidth({ width, height }: { width: number; height: number }): number {
  return Math.max(1, Math.round(width * Math.min(1, MAX_SHOWN / Math.max(width, height))));
}
