// Decoded assets as the view takes them, and where it gets them from.

import type { AssetWish } from "../core/api.ts";

/** Triangles. `color`: one per vertex, RGBA in bytes, which multiplies that of the visual. */
export interface MeshArrays {
  position: Float32Array;
  normal: Float32Array;
  index: Uint16Array | Uint32Array;
  uv?: Float32Array | undefined;
  color?: Uint8Array | undefined;
}

/** An image of 1, 3 or 4 channels, top row first; cubes and skies have six faces one below another. */
export interface Pixels {
  width: number;
  height: number;
  channels: number;
  pixels: Uint8Array;
}

/** Topology and first vertices of a deformable. `uv`: per corner of each element. */
export interface DeformableArrays {
  position: Float32Array;
  elements: Uint16Array | Uint32Array;
  uv?: Float32Array | undefined;
}

/** Decoded assets by their address. A rejected promise leaves out what needs the asset; its message is for people. */
export interface AssetSource {
  loadMesh(wish: AssetWish): Promise<MeshArrays>;
  loadPixels(wish: AssetWish): Promise<Pixels>;
  loadElevation(wish: AssetWish): Promise<Float32Array>;
  loadDeformable(wish: AssetWish): Promise<DeformableArrays>;
}
