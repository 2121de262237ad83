// Order and window of chunk requests for wanted assets. Pure: no socket, database, clock or thread.
//
//     wanted --takeLookups--> searched in the cache --onMissing(offset)--> requested in chunks --complete--> hashed
//        `--remove (found)                                                                  again, remove <--'
//
// Answers come in the order of the requests, so the bytes of one asset come in order too, and a request whose successor is
// answered was lost with its connection, and is made again. A chunk that does not continue its asset is ignored. A window
// bounds the bytes that were requested and are not stored yet. The chunk size adapts to the speed of the link.

import { AssetRefusal } from "../protocol/messages.g.ts";
import { MAX_ASSET_BYTES, MAX_ASSET_CHUNK_BYTES, MAX_ASSET_REQUESTS } from "../protocol/schema.g.ts";

const CHUNK_BYTES = 512 << 10;
/** Chunks double when one takes less than `FAST_NS`, and halve when it takes longer than `SLOW_NS`. */
const MIN_CHUNK_BYTES = 64 << 10;
const FAST_NS = 100_000_000;
const SLOW_NS = 2_000_000_000;
/** Window [bytes]: enough for 400 Mbit/s and 100 ms. */
const WINDOW_BYTES = 6 << 20;
/** Assets in progress at once: small ones must not wait for each other's round trips. */
const AT_ONCE = 32;
/** Pauses after a temporary refusal and after a disconnect; doubled each time, until a chunk comes. */
const FIRST_PAUSE_NS = 50_000_000;
const LONGEST_PAUSE_NS = 2_000_000_000;
const PASSING: readonly string[] = [AssetRefusal.TOO_MANY, AssetRefusal.NOT_ALLOWED, AssetRefusal.RATE, AssetRefusal.BUSY];

/** One request to be sent. */
export interface ChunkRequest {
  requestId: number;
  address: string;
  offset: number;
  length: number;
}

/** An asset that cannot be fetched. */
export interface FailedAsset {
  address: string;
  reason: string;
  text: string;
}

/** Outcome of a chunk: `store` the bytes (then call `onStored`), or they are of no use, or were not requested. */
export type ChunkOutcome = "store" | "ignored" | "unasked" | FailedAsset;

/** One asset. `got`: bytes that came; `asked`: bytes that came or were asked for; `total` -1: not known yet. */
class Item {
  asked: number;
  total = -1;
  anew = false;

  constructor(
    readonly address: string,
    public got: number,
    private readonly sizeHint: number,
  ) {
    this.asked = got;
  }

  nextBytes(most: number): number {
    if (this.total >= 0) return Math.min(most, this.total - this.asked);
    return this.sizeHint > this.asked ? Math.min(most, this.sizeHint - this.asked) : most;
  }

  /** True when there is more to request now: of an unknown size only a first chunk. */
  get open(): boolean {
    return this.total < 0 ? this.asked === this.got : this.asked < this.total;
  }
}

/** Scheduler of chunk requests. All `nowNs` are of one monotonic clock. */
export class AssetLoader {
  /** Reason for which the session postpones requests, in its words; empty while bytes come. */
  refusal = "";
  private readonly wanted = new Map<string, number>(); // not looked up yet; sizes as in `add`
  private readonly busy = new Map<string, number>(); // looked up, or removed to start again
  private readonly items = new Map<string, Item>(); // missing bytes, in the order of the assets
  private readonly anew = new Set<string>(); // removed once because the session has fewer bytes
  private readonly asked = new Map<number, [ask: ChunkRequest, askedNs: number]>();
  private chunkBytes = CHUNK_BYTES;
  private unstored = 0;
  private nextId = 0;
  private pauseNs = 0;
  private pausedUntilNs = 0;

  /** `mostRequests`: how many may wait for their answers. */
  constructor(private readonly mostRequests = MAX_ASSET_REQUESTS / 2) {}

  /** True when nothing is wanted. */
  get idle(): boolean {
    return this.wanted.size === 0 && this.busy.size === 0 && this.items.size === 0;
  }

  /** Add an asset at the end of the order; `size` [bytes] if it is known. Returns false when it is in progress already. */
  add(address: string, size = -1): boolean {
    if (this.wanted.has(address) || this.busy.has(address) || this.items.has(address)) return false;
    this.wanted.set(address, size);
    return true;
  }

  /** Return assets to be looked up in the cache now. */
  takeLookups(): string[] {
    const found: string[] = [];
    for (const [address, size] of this.wanted) {
      if (this.busy.size + this.items.size >= AT_ONCE) break;
      this.wanted.delete(address);
      this.busy.set(address, size);
      found.push(address);
    }
    return found;
  }

  /** Note that an asset is not in the cache, but its first `offset` bytes are. */
  onMissing(address: string, offset: number): void {
    const size = this.busy.get(address);
    if (size === undefined) return;
    this.busy.delete(address);
    const item = new Item(address, offset, size);
    item.anew = this.anew.has(address);
    this.items.set(address, item);
  }

  /** Start an asset again whose bytes had another hash. Returns false when that was the second time. */
  restartAsset(address: string): boolean {
    const item = this.items.get(address);
    if (item === undefined) return true;
    if (item.anew) {
      this.remove(address);
      return false;
    }
    const fresh = new Item(address, 0, -1);
    fresh.anew = true;
    this.items.set(address, fresh);
    return true;
  }

  /** Remove an asset that is complete, failed or wanted no more. */
  remove(address: string): void {
    for (const table of [this.wanted, this.busy, this.items]) table.delete(address);
    this.anew.delete(address);
  }

  /** Return requests to send now, in the order of the assets. They count as sent. */
  takeRequests(nowNs: number): ChunkRequest[] {
    const requests: ChunkRequest[] = [];
    if (this.isPaused(nowNs)) return requests;
    for (const item of this.items.values()) {
      while (item.open) {
        const length = item.nextBytes(this.chunkBytes);
        if (this.asked.size >= this.mostRequests || this.outstanding + length > WINDOW_BYTES) return requests;
        this.nextId += 1;
        const ask = { requestId: this.nextId, address: item.address, offset: item.asked, length };
        this.asked.set(this.nextId, [ask, nowNs]);
        item.asked += length;
        requests.push(ask);
      }
    }
    return requests;
  }

  private get outstanding(): number {
    let bytes = this.unstored;
    for (const [ask] of this.asked.values()) bytes += ask.length;
    return bytes;
  }

  /** Process a chunk of `size` bytes from `offset` on, of an asset of `total`. */
  processChunk(requestId: number, address: string, offset: number, total: number, size: number, nowNs: number): ChunkOutcome {
    const [ask, askedNs] = this.asked.get(requestId) ?? [null, 0];
    this.asked.delete(requestId);
    if (ask === null || ask.offset !== offset || ask.address !== address) return "unasked";
    this.restoreLostRequests(ask.requestId);
    this.pauseNs = 0;
    this.refusal = "";
    this.adaptChunkSize(ask, size, nowNs - askedNs);
    const item = this.items.get(address);
    if (item === undefined || offset !== item.got) return "ignored";
    const expected = Math.min(ask.length, total - offset);
    if ((item.total !== -1 && item.total !== total) || size > ask.length || (size === 0 && expected !== 0)) {
      this.remove(address);
      return { address, reason: "protocol", text: `the session contradicts itself about asset ${address}` };
    }
    if (total > MAX_ASSET_BYTES) {
      this.remove(address);
      return { address, reason: "protocol", text: `asset ${address} has ${total} bytes: at most ${MAX_ASSET_BYTES} are fetched` };
    }
    item.total = total;
    item.got += size;
    if (size < expected) item.asked = item.got;
    item.asked = Math.max(item.got, Math.min(item.asked, item.total));
    this.unstored += size;
    return "store";
  }

  /** Request again what was requested before `requestId`: after this answer those will not be answered. */
  private restoreLostRequests(requestId: number): void {
    for (const [earlier, [ask]] of this.asked) {
      if (earlier >= requestId) continue;
      this.asked.delete(earlier);
      this.takeBack(ask);
    }
  }

  private takeBack(ask: ChunkRequest): void {
    const item = this.items.get(ask.address);
    if (item !== undefined) item.asked = Math.max(item.got, Math.min(item.asked, ask.offset));
  }

  /** Use larger chunks on a fast link, smaller ones on a slow one, by the times of whole chunks. */
  private adaptChunkSize(ask: ChunkRequest, size: number, tookNs: number): void {
    if (size !== this.chunkBytes || size !== ask.length) return;
    if (tookNs < FAST_NS) this.chunkBytes = Math.min(2 * size, MAX_ASSET_CHUNK_BYTES);
    else if (tookNs > SLOW_NS) this.chunkBytes = Math.max(size >> 1, MIN_CHUNK_BYTES);
  }

  /** Return whether all bytes of an asset came. */
  isComplete(address: string): boolean {
    const item = this.items.get(address);
    return item !== undefined && item.got === item.total;
  }

  /** Note that bytes are in the cache, or dropped: they leave the window. */
  onStored(size: number): void {
    this.unstored -= size;
  }

  /**
   * Process a refusal. Returns a `FailedAsset` for a final one; an address when the asset must start again after its bytes
   * were removed (then call `onMissing` with 0); else null: it is requested again after a pause.
   */
  processRefusal(requestId: number, reason: string, advice: string, nowNs: number): FailedAsset | string | null {
    const [ask] = this.asked.get(requestId) ?? [null];
    this.asked.delete(requestId);
    if (ask === null) return null;
    this.restoreLostRequests(ask.requestId);
    const item = this.items.get(ask.address);
    if (item === undefined) return null;
    if (PASSING.includes(reason)) {
      this.refusal = `${reason}: ${advice}`;
      this.pause(nowNs, this.pauseNs);
      this.takeBack(ask);
      return null;
    }
    this.remove(ask.address);
    if (reason === AssetRefusal.BAD_RANGE && item.got > 0 && !item.anew) {
      this.busy.set(ask.address, -1); // more bytes are stored than the asset has: they belong to another one
      this.anew.add(ask.address);
      return ask.address;
    }
    return { address: ask.address, reason, text: `asset ${ask.address} was refused (${reason}): ${advice}` };
  }

  /** Return whether nothing is to be requested now. */
  isPaused(nowNs: number): boolean {
    return nowNs < this.pausedUntilNs;
  }

  /** Time at which requests go on after a pause. */
  get pausedUntil(): number {
    return this.pausedUntilNs;
  }

  /** Note that the connection ended, but not by us: the next one is made after a pause. */
  onLinkLost(nowNs: number): void {
    const beforeNs = this.pauseNs;
    this.onLinkClosed();
    this.pause(nowNs, beforeNs);
  }

  private pause(nowNs: number, beforeNs: number): void {
    this.pauseNs = Math.min(Math.max(FIRST_PAUSE_NS, 2 * beforeNs), LONGEST_PAUSE_NS);
    this.pausedUntilNs = nowNs + this.pauseNs;
  }

  /** Note that we closed the connection: pending requests are lost, received bytes stay. */
  onLinkClosed(): void {
    this.asked.clear();
    this.pauseNs = this.pausedUntilNs = 0;
    for (const item of this.items.values()) item.asked = item.got;
  }
}
