// Fetches assets over HTTPS, in the order and window of `AssetLoader`, into the store of the browser. Every asset is
// hashed: bytes that do not have their address are fetched once more, then given up.

import { bytesToHex } from "@noble/hashes/utils.js";

import { AssetRefusal } from "../protocol/messages.g.ts";
import { AssetLoader, type ChunkRequest } from "./asset_loader.ts";
import type { Store } from "./storage.ts";

/** Connections that a browser makes to one host at once, without HTTP/2. */
const PARALLEL = 6;
const MS_NS = 1_000_000;

/** What of the environment is needed. */
export interface FetchEnvironment {
  nowNs(): number;
  fetch(url: string, init: RequestInit): Promise<Response>;
  setTimer(ms: number, callback: () => void): () => void;
}

/** Where what was wanted goes. `progress`: after every chunk. */
export interface FetchListener {
  complete(address: string, bytes: Uint8Array<ArrayBuffer>): void;
  failed(address: string, text: string): void;
  progress(): void;
}

/** Answer to one request: bytes, a refusal, or no answer at all. */
type Answer =
  | { kind: "chunk"; offset: number; total: number; bytes: Uint8Array<ArrayBuffer> }
  | { kind: "refused"; reason: string; advice: string }
  | { kind: "lost" };

/** Fetches assets of one gateway. */
export class AssetFetcher {
  private loader = new AssetLoader(PARALLEL);
  private parts = new Map<string, Uint8Array<ArrayBuffer>[]>();
  private baseUrl = "";
  private ticket = "";
  /** Answers are processed in the order of their requests. */
  private order: Promise<void> = Promise.resolve();
  private aborter = new AbortController();
  private cancelTimer: (() => void) | null = null;

  constructor(
    private readonly environment: FetchEnvironment,
    private readonly store: Store,
    private readonly listener: FetchListener,
  ) {}

  /** Reason for which the session postpones requests, in its words. */
  get refusal(): string {
    return this.loader.refusal;
  }

  /** Set where assets come from. Without a ticket only the store is searched. */
  setLink(baseUrl: string, ticket: string): void {
    this.baseUrl = baseUrl;
    this.ticket = ticket;
    this.pump();
  }

  /** Want an asset of `bytes` bytes. */
  want(address: string, bytes: number): void {
    this.loader.add(address, bytes);
    this.pump();
  }

  /** Want an asset no more. */
  cancel(address: string): void {
    this.loader.remove(address);
    this.parts.delete(address);
    this.pump();
  }

  /** Want nothing, and let go of the link. */
  reset(): void {
    this.closeLink();
    this.loader = new AssetLoader(PARALLEL);
    this.parts.clear();
    this.ticket = "";
  }

  private pump(): void {
    for (const address of this.loader.takeLookups()) void this.lookUp(address);
    if (this.ticket === "") return;
    const nowNs = this.environment.nowNs();
    for (const request of this.loader.takeRequests(nowNs)) this.start(request);
    if (this.loader.isPaused(nowNs) && this.cancelTimer === null) {
      this.cancelTimer = this.environment.setTimer((this.loader.pausedUntil - nowNs) / MS_NS + 1, () => {
        this.cancelTimer = null;
        this.pump();
      });
    }
  }

  private async lookUp(address: string): Promise<void> {
    const { loader } = this;
    const bytes = await this.store.getAsset(address);
    const found = bytes !== null && (await hasAddress(bytes, address));
    if (loader !== this.loader) return;
    if (found) {
      loader.remove(address);
      this.listener.complete(address, bytes);
    } else {
      loader.onMissing(address, 0);
      this.parts.set(address, []);
    }
    this.pump();
  }

  private start(request: ChunkRequest): void {
    const { aborter } = this;
    const answer = this.requestChunk(request, aborter.signal);
    this.order = this.order.then(async () => {
      const came = await answer;
      if (aborter === this.aborter) await this.process(request, came);
    });
  }

  private async requestChunk({ address, offset, length }: ChunkRequest, signal: AbortSignal): Promise<Answer> {
    const headers = { "X-Iris-Ticket": this.ticket, Range: `bytes=${offset}-${offset + length - 1}` };
    try {
      const response = await this.environment.fetch(`${this.baseUrl}/v1/asset/${address}`, { headers, signal, cache: "no-store" });
      if (response.status === 206 || response.status === 200) {
        const bytes = new Uint8Array(await response.arrayBuffer());
        return response.status === 200 ? { kind: "chunk", offset: 0, total: bytes.length, bytes } : readRange(response, bytes);
      }
      const advice = (await response.text()).trim().slice(0, 512);
      const empty = response.status === 416 && response.headers.get("Content-Range") === "bytes */0";
      if (empty) return { kind: "chunk", offset: 0, total: 0, bytes: new Uint8Array() };
      return { kind: "refused", reason: REASONS[response.status] ?? AssetRefusal.BUSY, advice };
    } catch {
      return { kind: "lost" };
    }
  }

  private async process(request: ChunkRequest, answer: Answer): Promise<void> {
    const { loader, environment } = this;
    const nowNs = environment.nowNs();
    if (answer.kind === "lost") {
      this.closeLink();
      loader.onLinkLost(nowNs);
    } else if (answer.kind === "refused") {
      const outcome = loader.processRefusal(request.requestId, answer.reason, answer.advice, nowNs);
      if (typeof outcome === "string") {
        this.parts.set(outcome, []);
        loader.onMissing(outcome, 0);
      } else if (outcome !== null) this.fail(outcome.address, outcome.text);
    } else await this.processChunk(request, answer.offset, answer.total, answer.bytes, nowNs);
    this.listener.progress();
    this.pump();
  }

  private async processChunk(request: ChunkRequest, offset: number, total: number, bytes: Uint8Array<ArrayBuffer>, nowNs: number): Promise<void> {
    const { loader } = this;
    const { address } = request;
    const outcome = loader.processChunk(request.requestId, address, offset, total, bytes.length, nowNs);
    if (typeof outcome === "object") this.fail(address, outcome.text);
    else if (outcome === "unasked") this.fail(address, `the session sent another part of asset ${address} than was requested`);
    if (outcome !== "store") return;
    this.parts.get(address)?.push(bytes);
    loader.onStored(bytes.length);
    if (!loader.isComplete(address)) return;
    const whole = join(this.parts.get(address) ?? []);
    const matches = await hasAddress(whole, address);
    if (loader !== this.loader) return;
    if (matches) {
      loader.remove(address);
      this.parts.delete(address);
      void this.store.putAsset(address, whole); // it copies before it returns
      this.listener.complete(address, whole);
    } else if (loader.restartAsset(address)) this.parts.set(address, []);
    else this.fail(address, `the bytes of asset ${address} have another hash, twice`);
  }

  private fail(address: string, text: string): void {
    this.loader.remove(address);
    this.parts.delete(address);
    this.listener.failed(address, text);
  }

  private closeLink(): void {
    this.aborter.abort();
    this.aborter = new AbortController();
    this.order = Promise.resolve();
    this.cancelTimer?.();
    this.cancelTimer = null;
  }
}

/** Reasons of refusals by HTTP status. After all but the first two the same may be requested again. */
const REASONS: Readonly<Record<number, string>> = {
  404: AssetRefusal.UNKNOWN,
  416: AssetRefusal.BAD_RANGE,
  401: AssetRefusal.NOT_ALLOWED,
  403: AssetRefusal.NOT_ALLOWED,
  429: AssetRefusal.TOO_MANY,
};

function readRange(response: Response, bytes: Uint8Array<ArrayBuffer>): Answer {
  const range = /^bytes (\d{1,15})-(\d{1,15})\/(\d{1,15})$/.exec(response.headers.get("Content-Range") ?? "");
  const [offset, last, total] = (range ?? []).slice(1).map(Number);
  if (offset === undefined || last === undefined || total === undefined || last - offset + 1 !== bytes.length || last >= total) return { kind: "lost" };
  return { kind: "chunk", offset, total, bytes };
}

async function hasAddress(bytes: Uint8Array<ArrayBuffer>, address: string): Promise<boolean> {
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  return bytesToHex(digest) === address;
}

function join(parts: readonly Uint8Array[]): Uint8Array<ArrayBuffer> {
  const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}
