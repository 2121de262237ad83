// Decoded assets by address, as promises: what the worker posts, in the shapes that the view draws.

import type { AssetUpdate, AssetWish, DecodedArray } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import type { AssetSource, DeformableArrays, MeshArrays, Pixels } from "./arrays.ts";

interface Waiting {
  resolve: (update: AssetUpdate) => void;
  reject: (error: Error) => void;
}

/** Loads assets through the worker. An address is wanted once, for any number of callers. */
export class WorkerAssets implements AssetSource {
  private readonly waiting = new Map<string, Waiting>();
  private readonly loaded = new Map<string, Promise<AssetUpdate>>();
  private wishes: AssetWish[] = [];

  constructor(private readonly client: WorkerClient) {
    client.on("asset", (update) => this.settle(update.address, (waiting) => waiting.resolve(update)));
    client.on("asset_failed", ({ address, text }) => {
      this.settle(address, (waiting) => waiting.reject(new Error(text)));
      this.loaded.delete(address);
    });
  }

  /** Forget everything but `addresses`; what of the rest is still under way is not fetched. */
  keepOnly(addresses: ReadonlySet<string>): void {
    const dropped = [...this.loaded.keys()].filter((address) => !addresses.has(address));
    for (const address of dropped) this.loaded.delete(address);
    const cancelled = dropped.filter((address) => this.waiting.has(address));
    for (const address of cancelled) {
      this.settle(address, (waiting) => waiting.reject(new Error("the scene has changed")));
    }
    if (cancelled.length > 0) this.client.post({ type: "cancel_assets", addresses: cancelled });
  }

  async loadMesh(wish: AssetWish): Promise<MeshArrays> {
    const arrays = await this.loadArrays(wish);
    return {
      position: floats(arrays, "position"),
      normal: floats(arrays, "normal"),
      index: indices(arrays, "index"),
      uv: arrays.uv ? floats(arrays, "uv") : undefined,
      color: arrays.color ? (arrays.color.data as Uint8Array) : undefined,
    };
  }

  async loadPixels(wish: AssetWish): Promise<Pixels> {
    const update = await this.load(wish);
    if (update.bytes) return decodePicture(update.bytes, wish.encoding);
    const array = update.arrays?.pixels;
    if (!array) throw new Error("an image without pixels");
    const [height = 0, width = 0, channels = 0] = array.shape;
    return { width, height, channels, pixels: array.data as Uint8Array };
  }

  async loadElevation(wish: AssetWish): Promise<Float32Array> {
    return floats(await this.loadArrays(wish), "elevation");
  }

  async loadDeformable(wish: AssetWish): Promise<DeformableArrays> {
    const arrays = await this.loadArrays(wish);
    return {
      position: floats(arrays, "position"),
      elements: indices(arrays, "elements"),
      uv: arrays.uv ? floats(arrays, "uv") : undefined,
    };
  }

  private async loadArrays(wish: AssetWish): Promise<Record<string, DecodedArray>> {
    const { arrays } = await this.load(wish);
    if (!arrays) throw new Error(`an asset of encoding ${wish.encoding} where arrays are needed`);
    return arrays;
  }

  private load(wish: AssetWish): Promise<AssetUpdate> {
    const known = this.loaded.get(wish.address);
    if (known) return known;
    const promise = new Promise<AssetUpdate>((resolve, reject) => this.waiting.set(wish.address, { resolve, reject }));
    this.loaded.set(wish.address, promise);
    if (this.wishes.length === 0) queueMicrotask(() => this.flush());
    this.wishes.push(wish);
    return promise;
  }

  private flush(): void {
    this.client.post({ type: "want_assets", assets: this.wishes });
    this.wishes = [];
  }

  private settle(address: string, end: (waiting: Waiting) => void): void {
    const waiting = this.waiting.get(address);
    this.waiting.delete(address);
    if (waiting) end(waiting);
  }
}

function floats(arrays: Record<string, DecodedArray>, name: string): Float32Array {
  const data = arrays[name]?.data;
  if (!(data instanceof Float32Array)) throw new Error(`an asset without the array ${name}`);
  return data;
}

function indices(arrays: Record<string, DecodedArray>, name: string): Uint16Array | Uint32Array {
  const data = arrays[name]?.data;
  if (!(data instanceof Uint16Array || data instanceof Uint32Array)) {
    throw new Error(`an asset without the array ${name}`);
  }
  return data;
}

/** Decode a PNG or JPEG picture as it is, without colour management. */
async function decodePicture(bytes: Uint8Array, encoding: string): Promise<Pixels> {
  const blob = new Blob([bytes as Uint8Array<ArrayBuffer>], { type: `image/${encoding}` });
  const bitmap = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (!context) throw new Error("this browser has no 2d canvas to decode pictures");
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  const { data, width, height } = context.getImageData(0, 0, canvas.width, canvas.height);
  return { width, height, channels: 4, pixels: new Uint8Array(data.buffer) };
}
