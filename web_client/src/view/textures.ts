// Textures of three.js from decoded pixels: 2d images, and cubes and skies from six faces one below another.

import {
  CubeTexture,
  DataTexture,
  LinearFilter,
  LinearMipmapLinearFilter,
  NoColorSpace,
  RepeatWrapping,
  RGBAFormat,
  SRGBColorSpace,
  UnsignedByteType,
  type Texture,
} from "three";

import type { Pixels } from "./arrays.ts";

const FACES = 6;

/** Return a 2d texture. Row 0 of the image is at v = 0, as in docs/scene.md. */
export function makeTexture(image: Pixels, isSrgb: boolean, anisotropy: number): DataTexture {
  const texture = new DataTexture(toRgba(image), image.width, image.height, RGBAFormat, UnsignedByteType);
  texture.wrapS = texture.wrapT = RepeatWrapping;
  texture.anisotropy = anisotropy;
  return finish(texture, isSrgb);
}

/** Return a cube texture. Throws for an image that is not six squares one below another. */
export function makeCubeTexture(image: Pixels, isSrgb: boolean): CubeTexture {
  const { width, height, channels } = image;
  if (width === 0 || height !== FACES * width) {
    throw new Error(`a cube texture of ${width} x ${height} pixels: expected six squares one below another`);
  }
  const faceBytes = width * width * channels;
  const faces = Array.from({ length: FACES }, (_, face) => {
    const pixels = image.pixels.subarray(face * faceBytes, (face + 1) * faceBytes);
    const rgba = toRgba({ width, height: width, channels, pixels });
    return new DataTexture(rgba, width, width, RGBAFormat, UnsignedByteType);
  });
  const texture = new CubeTexture(faces as never[]);
  texture.format = RGBAFormat;
  texture.type = UnsignedByteType;
  return finish(texture, isSrgb);
}

function finish<T extends Texture>(texture: T, isSrgb: boolean): T {
  texture.colorSpace = isSrgb ? SRGBColorSpace : NoColorSpace;
  texture.magFilter = LinearFilter;
  texture.minFilter = LinearMipmapLinearFilter;
  texture.generateMipmaps = true;
  texture.flipY = false;
  texture.needsUpdate = true;
  return texture;
}

function toRgba({ width, height, channels, pixels }: Pixels): Uint8Array<ArrayBuffer> {
  const n = width * height;
  if (channels === 4) return new Uint8Array(pixels);
  const rgba = new Uint8Array(4 * n);
  const step = channels >= 3 ? 1 : 0;
  for (let i = 0; i < n; i++) {
    const from = i * channels;
    rgba[4 * i] = pixels[from]!;
    rgba[4 * i + 1] = pixels[from + step]!;
    rgba[4 * i + 2] = pixels[from + 2 * step]!;
    rgba[4 * i + 3] = 255;
  }
  return rgba;
}
