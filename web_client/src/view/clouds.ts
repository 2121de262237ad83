// Point clouds: the points of a frame go to the graphics card as they came, and are placed and coloured there.

import {
  Box3,
  BufferGeometry,
  DynamicDrawUsage,
  InterleavedBuffer,
  InterleavedBufferAttribute,
  Points,
  ShaderMaterial,
  Vector3,
  Vector4,
} from "three";

import type { CloudFrame } from "../core/cloud.ts";
import { makeWorldRoot } from "./axes.ts";

/** Edge of a point that stands for itself [m]. */
const POINT_M = 0.005;
/** Room for more points than a frame has, so that not every larger one needs a new buffer. */
const SPARE = 1.25;

const VERTEX = /* glsl */ `
attribute float packed;
uniform float edge;
uniform float pixels;
uniform float dimmed;
varying vec3 vColor;
void main() {
  vec4 seen = viewMatrix * modelMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * seen;
  gl_PointSize = clamp(edge * projectionMatrix[1][1] * pixels / gl_Position.w, 1.0, 64.0);
  vColor = vec3(floor(packed / 2048.0), floor(mod(packed, 2048.0) / 32.0), mod(packed, 32.0)) / vec3(31.0, 63.0, 31.0);
  float gray = dot(vColor, vec3(0.3, 0.59, 0.11));
  vColor = mix(vColor, 0.45 * mix(vec3(gray), vColor, 0.3), dimmed);
}`;

const FRAGMENT = /* glsl */ `
varying vec3 vColor;
void main() {
  gl_FragColor = vec4(vColor, 1.0);
}`;

/** The points of one stream. */
class Cloud {
  readonly object: Points<BufferGeometry, ShaderMaterial>;
  drawn = 0;
  points = 0;
  private buffer = new InterleavedBuffer(new Uint16Array(0), 4);
  /** The newest one, all of its points: another number of them may be drawn before the next one comes. */
  private frame: CloudFrame | null = null;

  constructor(name: string) {
    const material = new ShaderMaterial({
      uniforms: { edge: { value: POINT_M }, pixels: { value: 1 }, dimmed: { value: 0 } },
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
    });
    this.object = new Points(new BufferGeometry(), material);
    this.object.name = name;
    this.object.frustumCulled = false; // its points are nowhere but on the graphics card
    const viewport = new Vector4();
    this.object.onBeforeRender = (renderer) => {
      renderer.getCurrentViewport(viewport);
      material.uniforms.pixels!.value = viewport.w / 2;
    };
  }

  /** Show a frame: as many of its points as may be drawn, which are a fair sample of all. */
  show(frame: CloudFrame, maxPoints: number): void {
    const { points, origin, step_m, voxel_m } = frame;
    this.frame = frame;
    const count = Math.min(points.length / 4, maxPoints);
    const { object } = this;
    if (this.buffer.array.length < 4 * count) this.grow(Math.ceil(SPARE * count));
    this.buffer.array.set(points.subarray(0, 4 * count));
    this.buffer.clearUpdateRanges();
    this.buffer.addUpdateRange(0, 4 * count);
    this.buffer.needsUpdate = true;
    object.geometry.setDrawRange(0, count);
    object.scale.setScalar(step_m);
    object.position.set(...origin).multiplyScalar(step_m);
    // Points of surfaces: of fewer, each has more of the area.
    object.material.uniforms.edge!.value = (voxel_m || POINT_M) * Math.sqrt(points.length / 4 / Math.max(count, 1));
    this.drawn = count;
    this.points = points.length / 4;
  }

  /** Show as many points of the same frame as may be drawn now. */
  limit(maxPoints: number): void {
    if (this.frame && this.drawn !== Math.min(this.points, maxPoints)) this.show(this.frame, maxPoints);
  }

  /** Make a box hold every point that is drawn, in the session's world. */
  expand(box: Box3): void {
    if (!this.frame) return;
    const { points, origin, step_m } = this.frame;
    const [first, point] = [new Vector3(...origin), new Vector3()];
    for (let i = 0; i < 4 * this.drawn; i += 4) {
      box.expandByPoint(point.fromArray(points, i).add(first).multiplyScalar(step_m));
    }
  }

  /** Draw darker and greyer, as what shows what was or what is wrong. Returns whether that is new. */
  setDimmed(isDimmed: boolean): boolean {
    const { dimmed } = this.object.material.uniforms;
    const isNew = dimmed!.value !== Number(isDimmed);
    dimmed!.value = Number(isDimmed);
    return isNew;
  }

  dispose(): void {
    this.object.removeFromParent();
    this.object.geometry.dispose();
    this.object.material.dispose();
  }

  private grow(points: number): void {
    const { object } = this;
    object.geometry.dispose();
    this.buffer = new InterleavedBuffer(new Uint16Array(4 * points), 4).setUsage(DynamicDrawUsage);
    object.geometry = new BufferGeometry();
    object.geometry.setAttribute("position", new InterleavedBufferAttribute(this.buffer, 3, 0));
    object.geometry.setAttribute("packed", new InterleavedBufferAttribute(this.buffer, 1, 3));
  }
}

/** The point clouds of a session. `group` holds them, in the session's axes. */
export class CloudViews {
  readonly group = makeWorldRoot();
  private readonly clouds = new Map<string, Cloud>();
  private wanted: readonly string[] = [];
  private doubtful: readonly string[] = [];
  private isChanged = false;

  /** `maxPoints`: as many as this device draws, of all clouds together. */
  constructor(private readonly maxPoints: number) {
    this.group.name = "clouds";
  }

  /** Points drawn, by stream. */
  get drawn(): Map<string, number> {
    return new Map([...this.clouds].map(([name, cloud]) => [name, cloud.drawn] as const));
  }

  /** Return how many points the newest frame of a stream has and how many of them are drawn; undefined: it is not drawn. */
  getPoints(stream: string): { drawn: number; points: number } | undefined {
    return this.clouds.get(stream);
  }

  /** Return the box around all points that are drawn [m], in the session's world; empty without any. */
  getBounds(): Box3 {
    const box = new Box3();
    for (const cloud of this.clouds.values()) cloud.expand(box);
    return box;
  }

  /** Show a frame of a stream instead of the one before. One that is not wanted was on its way. */
  show(stream: string, frame: CloudFrame): void {
    if (!this.wanted.includes(stream)) return;
    let cloud = this.clouds.get(stream);
    if (!cloud) {
      cloud = new Cloud(stream);
      this.clouds.set(stream, cloud);
      this.group.add(cloud.object);
      this.share();
    }
    cloud.setDimmed(this.doubtful.includes(stream));
    cloud.show(frame, this.maxShare);
    this.isChanged = true;
  }

  /**
   * Set the streams whose clouds are shown, and remove the others. `doubtful`: streams whose newest frame shows what was,
   * or what is wrong; they are dimmed.
   */
  setWanted(streams: readonly string[], doubtful: readonly string[] = []): void {
    this.wanted = streams;
    this.doubtful = doubtful;
    for (const [name, cloud] of this.clouds) {
      if (cloud.setDimmed(doubtful.includes(name))) this.isChanged = true;
      if (streams.includes(name)) continue;
      cloud.dispose();
      this.clouds.delete(name);
      this.isChanged = true;
    }
    this.share();
  }

  /** Return whether something changed since the last call. */
  popChanged(): boolean {
    const { isChanged } = this;
    this.isChanged = false;
    return isChanged;
  }

  /** Points of each cloud that this device draws now. */
  private get maxShare(): number {
    return Math.floor(this.maxPoints / this.clouds.size);
  }

  /** Share the points among the clouds that there are now. */
  private share(): void {
    for (const cloud of this.clouds.values()) cloud.limit(this.maxShare);
  }
}
