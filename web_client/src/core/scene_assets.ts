// Assets for the page, and those that the worker needs itself: the scene's specification, and the topologies of its
// deformables.

import type { AssetWish, FromWorker, SceneSpec } from "./api.ts";
import { decodeArrays, requireArray } from "./arrays.ts";
import { AssetFetcher, type FetchEnvironment } from "./asset_fetcher.ts";
import { DeformableDecoder, decodeTopology, MAX_FACES } from "./deformable.ts";
import { MalformedError, WireError } from "./errors.ts";
import type { SessionMirror } from "./mirror.ts";
import { decodeScene } from "./scene.ts";
import { type SheetArrays, SheetBuilder, type SheetLook, type Surface } from "./sheet.ts";
import type { Store } from "./storage.ts";

/** What of the environment is needed. */
export interface AssetEnvironment extends FetchEnvironment {
  post(update: FromWorker, transfer: Transferable[]): void;
  store: Store;
}

type Use = (bytes: Uint8Array<ArrayBuffer>) => void;

const ADDRESS = /^[0-9a-f]{64}$/;
/** Decoded arrays of one asset at most [bytes]. */
const MAX_DECODED_BYTES = 512 << 20;
/** Time until a specification that could not be fetched is requested again. */
const RETRY_MS = 1_000;

/** Decodes the frames of one deformable and builds what is drawn of them. Throws `WireError` for a malformed asset. */
export class DeformableStream {
  readonly decoder: DeformableDecoder;
  private readonly arrays: SheetArrays;
  private readonly vertexCount: number;
  private look: SheetLook = { dim: 1, radius: 0, flat: false };
  private builder: SheetBuilder | null = null;

  constructor(readonly address: string, asset: Uint8Array<ArrayBuffer>, look: SheetLook) {
    const { arrays } = decodeArrays(asset, MAX_DECODED_BYTES);
    const topology = decodeTopology(requireArray(arrays, "plan", [Uint8Array], [null]).data);
    this.decoder = new DeformableDecoder(topology);
    this.vertexCount = topology.vertexCount;
    const corners = look.dim === 1 ? 2 : 3;
    const elements = requireArray<Uint16Array | Uint32Array>(arrays, "elements", [Uint16Array, Uint32Array], [null, corners]);
    const count = elements.shape[0] as number;
    if (count > MAX_FACES) throw new MalformedError(`${count} elements, at most ${MAX_FACES} are possible`);
    const beyond = elements.data.find((vertex) => vertex >= this.vertexCount);
    if (beyond !== undefined) throw new MalformedError(`an element names vertex ${beyond} of ${this.vertexCount}`);
    const uv = arrays.uv && requireArray(arrays, "uv", [Float32Array], [count, corners, 2]).data;
    this.arrays = { elements: elements.data, uv };
    this.setLook(look);
  }

  /** The scene has changed: the deformable may be drawn otherwise. */
  setLook(look: SheetLook): void {
    if (look.dim === this.look.dim && look.radius === this.look.radius && look.flat === this.look.flat) return;
    this.look = { dim: look.dim, radius: look.radius, flat: look.flat };
    this.builder = look.dim > 1 ? new SheetBuilder(look, this.vertexCount, this.arrays) : null;
  }

  /** Return the surface of vertices, null for a rope. `spare`: as in `SheetBuilder.build`. */
  buildSurface(vertices: Float32Array, spare?: Surface): Surface | null {
    return this.builder?.build(vertices, spare) ?? null;
  }
}

/** Fetches, decodes and posts assets. */
export class SceneAssets {
  private readonly fetcher: AssetFetcher;
  private readonly wishes = new Map<string, AssetWish>();
  private readonly uses = new Map<string, Use[]>();
  /** By stream. */
  private readonly deformables = new Map<string, DeformableStream>();
  private sceneHash = "";
  private shown = "";
  private progress = { wanted: 0, done: 0, bytes: 0, bytes_done: 0 };

  constructor(private readonly environment: AssetEnvironment) {
    this.fetcher = new AssetFetcher(environment, environment.store, {
      complete: (address, bytes) => this.onComplete(address, bytes),
      failed: (address, text) => this.onFailed(address, text),
      progress: () => this.postProgress(),
    });
  }

  /** Set where assets come from. An empty ticket: nowhere. */
  setLink(baseUrl: string, ticket: string): void {
    if (ticket === "") {
      this.fetcher.reset();
      this.wishes.clear();
      this.uses.clear();
      this.deformables.clear();
      this.sceneHash = this.shown = "";
      this.progress = { wanted: 0, done: 0, bytes: 0, bytes_done: 0 };
    } else this.fetcher.setLink(baseUrl, ticket);
  }

  /** Fetch an asset for the page. */
  want(wish: AssetWish): void {
    if (!ADDRESS.test(wish.address)) {
      this.environment.post({ type: "asset_failed", address: wish.address, text: "this is no address of an asset" }, []);
      return;
    }
    if (this.wishes.has(wish.address)) return;
    this.wishes.set(wish.address, wish);
    this.count(wish.bytes);
    this.fetcher.want(wish.address, wish.bytes);
  }

  /** The page wants an asset no more. */
  cancel(address: string): void {
    const wish = this.wishes.get(address);
    if (wish === undefined) return;
    this.wishes.delete(address);
    this.progress.wanted -= 1;
    this.progress.bytes -= wish.bytes;
    if (!this.uses.has(address)) this.fetcher.cancel(address);
  }

  /** Fetch the scene that the session has now. */
  followScene({ synced, sceneHash, sceneEpoch, sceneRevision }: SessionMirror): void {
    if (!synced || !ADDRESS.test(sceneHash) || sceneHash === this.sceneHash) return;
    this.sceneHash = sceneHash;
    this.fetchScene(sceneHash, sceneEpoch, sceneRevision);
  }

  /** Return what decodes a stream, undefined while its topology is not there. */
  findDeformable(stream: string): DeformableStream | undefined {
    return this.deformables.get(stream);
  }

  private fetchScene(address: string, sceneEpoch: number, sceneRevision: number): void {
    this.use(address, -1, (bytes) => {
      if (address !== this.sceneHash) return;
      try {
        const spec = decodeScene(bytes);
        this.shown = address;
        this.environment.post({ type: "scene", address, scene_epoch: sceneEpoch, scene_revision: sceneRevision, spec }, []);
        this.fetchTopologies(spec);
      } catch (error) {
        this.notify(`the scene cannot be shown: ${describeWireError(error)}`);
      }
    });
  }

  private fetchTopologies(spec: SceneSpec): void {
    const addresses = new Map(spec.deformables.map(({ stream, address }) => [stream, address]));
    for (const [stream, { address }] of this.deformables) if (addresses.get(stream) !== address) this.deformables.delete(stream);
    for (const part of spec.deformables) {
      const { stream, address, bytes, name } = part;
      const known = this.deformables.get(stream);
      if (known !== undefined) {
        known.setLook(part);
        continue;
      }
      this.use(address, bytes, (asset) => {
        try {
          this.deformables.set(stream, new DeformableStream(address, asset, part));
        } catch (error) {
          this.notify(`the deformable ${name} cannot be shown: ${describeWireError(error)}`);
        }
      });
    }
  }

  private use(address: string, bytes: number, use: Use): void {
    const uses = this.uses.get(address) ?? [];
    this.uses.set(address, [...uses, use]);
    this.fetcher.want(address, bytes);
  }

  private onComplete(address: string, bytes: Uint8Array<ArrayBuffer>): void {
    const uses = this.uses.get(address) ?? [];
    this.uses.delete(address);
    for (const use of uses) use(bytes);
    const wish = this.wishes.get(address);
    if (wish === undefined) return;
    this.wishes.delete(address);
    this.postAsset(wish, bytes);
    this.progress.done += 1;
    this.progress.bytes_done += wish.bytes;
    this.postProgress();
  }

  private postAsset({ address, encoding }: AssetWish, bytes: Uint8Array<ArrayBuffer>): void {
    if (encoding !== "arrays") {
      this.environment.post({ type: "asset", address, encoding, kind: "", max_error: 0, arrays: null, bytes }, [bytes.buffer]);
      return;
    }
    try {
      const { kind, maxError, arrays } = decodeArrays(bytes, MAX_DECODED_BYTES);
      const buffers = Object.values(arrays).map((array) => array.data.buffer as ArrayBuffer);
      this.environment.post({ type: "asset", address, encoding, kind, max_error: maxError, arrays, bytes: null }, buffers);
    } catch (error) {
      this.environment.post({ type: "asset_failed", address, text: describeWireError(error) }, []);
    }
  }

  private onFailed(address: string, text: string): void {
    this.uses.delete(address);
    const wish = this.wishes.get(address);
    if (wish !== undefined) {
      this.wishes.delete(address);
      this.progress.done += 1;
      this.progress.bytes_done += wish.bytes;
      this.environment.post({ type: "asset_failed", address, text }, []);
    }
    if (address !== this.sceneHash || this.shown === address) return;
    this.sceneHash = ""; // a newer one may be announced meanwhile
    this.environment.setTimer(RETRY_MS, () => {
      if (this.sceneHash !== "") return;
      this.sceneHash = address;
      this.fetchScene(address, 0, 0);
    });
  }

  private count(bytes: number): void {
    if (this.progress.wanted === this.progress.done) this.progress = { wanted: 0, done: 0, bytes: 0, bytes_done: 0 };
    this.progress.wanted += 1;
    this.progress.bytes += bytes;
  }

  private postProgress(): void {
    this.environment.post({ type: "asset_progress", ...this.progress, refusal: this.fetcher.refusal }, []);
  }

  private notify(text: string): void {
    this.environment.post({ type: "notice", level: "error", text }, []);
  }
}

function describeWireError(error: unknown): string {
  if (!(error instanceof WireError)) throw error;
  return error.message;
}
