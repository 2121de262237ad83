// The picture of the page: takes what the worker posts, draws it on the shared clock.

import {
  BasicShadowMap,
  Color,
  ColorManagement,
  DoubleSide,
  LinearSRGBColorSpace,
  MeshBasicMaterial,
  type Object3D,
  PCFShadowMap,
  type PerspectiveCamera,
  Scene,
  WebGLRenderer,
} from "three";

import { type DeformableUpdate, type FrameUpdate, nowMs, type SceneSpec } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import { AnchorOverlay } from "./anchors.ts";
import { WorkerAssets } from "./assets.ts";
import { Avatars } from "./avatars.ts";
import { makeWorldRoot } from "./axes.ts";
import { type Budget, DESKTOP, HEADSET, SOFTWARE } from "./budget.ts";
import { Viewpoint } from "./camera.ts";
import { CloudViews } from "./clouds.ts";
import { CameraPictures } from "./pictures.ts";
import type { DeformableFrame } from "./deformables.ts";
import { findFirstSight, findWholeBox, FIRST_AZIMUTH } from "./framing.ts";
import { type Between, DelayEstimator, FrameBuffer, interpolatePoses, interpolateValues, POSE_FLOATS } from "./interpolation.ts";
import { SceneView } from "./scene_view.ts";
import { Shadows } from "./shadows.ts";

// Colours are blended as they are (docs/scene.md).
ColorManagement.enabled = false;

const BACKGROUND = 0x1b1f27;
/** Background without a sky is brighter than the page, so that dark robots are seen. */
const NO_SKY = 0x2a303b;
/** Frames that are drawn after the last change, because textures arrive between frames. */
const FRAMES_AFTER_CHANGE = 3;
/** Differences of poses that cannot be seen: two steps of the lattice of positions [m], and of quaternions. */
const SAME = 1.3e-4;
/** Place for the label of a robot and the arrow at its gripper [pixels], and what is left free above what is shown at most, as a share of the picture. */
const [LABEL_PX, MAX_ABOVE] = [30, 0.3];
/** Longest time without a drawn frame [ms]: what changes silently is seen then. */
const IDLE_MS = 1000;

/** What this device can draw. */
export interface Device {
  budget: Budget;
  pixelRatio: number;
  /** Shortest time between two frames [ms]: the processor that draws has other work, too. */
  framePeriod_ms: number;
  renderer: string;
}

export interface ViewEvents {
  /** The scene was replaced: its cameras may be others. */
  onScene: (spec: SceneSpec) => void;
  onProblem: (text: string) => void;
  /** Height of what lies over the upper edge of the picture [pixels]. */
  measureTop: () => number;
}

/** What a headset adds to the scene, and what it does at each of its frames. */
export interface HeadsetStage {
  /** The tracking frame, in the axes of three.js. Holds the camera. */
  readonly rig: Object3D;
  readonly camera: PerspectiveCamera;
  /** Objects in the session's world. */
  readonly panels: Object3D;
  /** The room is seen through: no sky, no floor. */
  readonly isTransparent: boolean;
  /** False: the scene has no place yet. */
  readonly showsScene: boolean;
  onFrame(frame: XRFrame, space: XRReferenceSpace): void;
  /** The tracking frame jumped. */
  onReset(): void;
}

/** A stream of a deformable. `found`: what is drawn of it; `scene`: number of the scene of its newest frame. */
interface Stream {
  buffer: FrameBuffer<DeformableFrame>;
  found: Between<DeformableFrame> | null;
  scene: number;
}

/** Draws the session on a canvas. Throws `Error` with advice when the browser has no WebGL. */
export class View {
  readonly avatars = new Avatars();
  readonly anchors = new AnchorOverlay();
  readonly viewpoint: Viewpoint;
  readonly device: Device;
  readonly pictures: CameraPictures;
  readonly clouds: CloudViews;
  /** What is in the picture. */
  scene: SceneView | null = null;
  /** Called before each drawn frame, when everything else is where it is drawn. */
  onDraw?: () => void;
  /** Frames drawn since the page began, and those of the display: as many could have been drawn. */
  drawn = 0;
  displayed = 0;
  /** Age of what is drawn: delay of the interpolation behind session time [ms]. */
  get delay_ms(): number {
    return this.delay.delay_ms;
  }

  private readonly renderer: WebGLRenderer;
  private readonly root = new Scene();
  private readonly overlay = makeWorldRoot();
  private readonly shadows: Shadows;
  private readonly assets: WorkerAssets;
  private readonly delay = new DelayEstimator();
  private readonly frames: FrameBuffer;
  private readonly streams = new Map<string, Stream>();
  private poses = new Float32Array(0);
  private drawnPoses = new Float32Array(0);
  private bodyIds: number[] = [];
  /** Bodies at the feet of the robots, by id. */
  private bases: number[] = [];
  private bodiesVersion = -1;
  private sessionOffset_ms = Number.NaN;
  private framesToDraw = FRAMES_AFTER_CHANGE;
  private lastDrawn_ms = 0;
  private lastTried_ms = 0;
  private lastFrame_ms = 0;
  private drawnSinceReport = 0;
  private sceneCount = 0;
  /** Newest number of `DeformableFrame.content`. */
  private contentCount = 0;
  /** A changed scene that is not in the picture yet. */
  private next: SceneView | null = null;
  private headset: HeadsetStage | null = null;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly client: WorkerClient,
    private readonly events: ViewEvents,
  ) {
    this.renderer = makeRenderer(canvas);
    this.device = inspectDevice(this.renderer);
    this.renderer.setPixelRatio(this.device.pixelRatio);
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = this.device.budget === SOFTWARE ? BasicShadowMap : PCFShadowMap;
    this.shadows = new Shadows(this.renderer.shadowMap, this.device.budget.shadowPeriod_ms);
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.root.background = new Color(BACKGROUND);
    this.root.matrixAutoUpdate = false; // else three.js computes all that is below anew in every frame
    this.pictures = new CameraPictures(this.renderer, this.device.budget === SOFTWARE);
    this.clouds = new CloudViews(this.device.budget.points);
    this.overlay.add(this.avatars.group, this.anchors.group);
    this.root.add(this.overlay, this.clouds.group);
    this.assets = new WorkerAssets(client);
    this.viewpoint = new Viewpoint(canvas);
    this.frames = new FrameBuffer(({ values }) => client.recycle(values));
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    this.listen();
    this.renderer.setAnimationLoop((_time, frame?: XRFrame) => this.draw(frame));
    setInterval(() => this.reportDrawn(), 1000);
  }

  /** Draw again: something changed that the view does not see by itself. */
  touch(): void {
    this.framesToDraw = FRAMES_AFTER_CHANGE;
    this.pictures.markOutdated();
  }

  /** Draw again: something changed that pictures of cameras do not show. */
  touchOverlay(): void {
    this.framesToDraw = FRAMES_AFTER_CHANGE;
  }

  /** Add something to the session's world that pictures of cameras do not show. */
  addToWorld(object: Object3D): void {
    this.overlay.add(object);
  }

  /** Draw in a headset until its session ends. Rejects when the session cannot be drawn. */
  async present(session: XRSession, stage: HeadsetStage): Promise<void> {
    const { xr } = this.renderer;
    const leave = (): void => {
      xr.removeEventListener("sessionend", leave);
      this.leaveHeadset();
    };
    xr.addEventListener("sessionend", leave);
    this.headset = stage;
    this.root.add(stage.rig);
    this.overlay.add(stage.panels);
    xr.enabled = true;
    xr.setReferenceSpaceType("local-floor");
    await xr.setSession(session);
    xr.getReferenceSpace()?.addEventListener("reset", () => stage.onReset());
  }

  /** What is drawn now: poses, 7 numbers per body of `bodies`, and vertices of deformables by stream. */
  get shown(): { bodies: number[]; poses: Float32Array; vertices: Map<string, Float32Array> } {
    const vertices = new Map<string, Float32Array>();
    for (const [name, { found }] of this.streams) {
      if (!found) continue;
      const values = new Float32Array(found.before.values.length);
      interpolateValues(found.before.values, found.after.values, found.share, values);
      vertices.set(name, values);
    }
    return { bodies: this.bodyIds, poses: this.drawnPoses, vertices };
  }

  /**
   * Draw the scene once in another size, without people, anchors, clouds and shadows, and return the picture as a data URL.
   * `silhouette`: white on black, without planes and sky; deformables in motion as in the frame before. For tests and for masks.
   */
  capture(width: number, height: number, silhouette: boolean): string {
    const { scene, root } = this;
    const hidden: { visible: boolean }[] = [this.overlay, this.clouds.group];
    if (silhouette) {
      if (scene?.sky) hidden.push(scene.sky);
      scene?.world.traverse((object) => {
        if (object.userData.isPlane) hidden.push(object);
      });
    }
    const changed = hidden.filter((object) => object.visible);
    const { background } = root;
    const white = new MeshBasicMaterial({ color: 0xffffff, side: DoubleSide });
    for (const object of changed) object.visible = false;
    if (silhouette) {
      root.background = new Color(0);
      root.overrideMaterial = white;
    }
    scene?.lighting.showShadows(false);
    this.renderer.setPixelRatio(1);
    this.renderer.setSize(width, height, false);
    this.viewpoint.setAspect(width / height);
    this.viewpoint.update(scene);
    scene?.lighting.update(scene.rest);
    this.renderer.render(root, this.viewpoint.camera);
    const picture = this.canvas.toDataURL("image/png");
    root.overrideMaterial = null;
    root.background = background;
    for (const object of changed) object.visible = true;
    white.dispose();
    scene?.lighting.showShadows(true);
    this.renderer.setPixelRatio(this.device.pixelRatio);
    this.resize();
    return picture;
  }

  private listen(): void {
    const { client } = this;
    client.on("clock", ({ session_offset_ms }) => (this.sessionOffset_ms = session_offset_ms));
    client.on("bodies", ({ version, bodies }) => {
      this.bodiesVersion = version;
      this.bodyIds = bodies.map(([id]) => id);
      this.frames.clear();
      this.poses = new Float32Array(0);
    });
    client.on("session", ({ robots }) => (this.bases = robots.map(({ base_body }) => base_body)));
    client.on("scene", ({ spec }) => this.setScene(spec));
    client.on("cloud", ({ stream, cloud }) => this.clouds.show(stream, cloud));
    client.on("frame", (frame) => this.takeFrame(frame));
    client.on("presence", ({ items }) => this.avatars.setPresence(items, this.sessionTime()));
    client.on("deformable", (update) => this.takeDeformable(update));
  }

  private setScene(spec: SceneSpec): void {
    const shown = this.scene;
    const scene = new SceneView(spec, this.assets, {
      budget: this.device.budget,
      anisotropy: Math.min(8, this.renderer.capabilities.getMaxAnisotropy()),
      onProblem: this.events.onProblem,
    });
    this.next?.dispose();
    this.next = scene;
    this.sceneCount += 1;
    this.assets.keepOnly(listAddresses(spec));
    const isSameRoom = shown !== null && shown.spec.name === spec.name && shown.spec.bodies.length === spec.bodies.length;
    // A changed scene appears when it is complete; the first one as it comes.
    if (!isSameRoom) {
      this.showFirst(scene);
      this.showNext(scene);
    }
    void scene.complete.then(() => {
      if (this.next === scene) this.showNext(scene);
      if (this.scene !== scene) return;
      if (scene.sky) this.root.add(scene.sky);
      this.root.background = new Color(scene.sky ? BACKGROUND : NO_SKY);
      this.shadows.markOld();
      this.touch();
    });
  }

  /** Show all of the scene, with the clouds that are drawn. */
  showWhole(): void {
    const { scene } = this;
    if (!scene) return;
    const box = findWholeBox(scene, this.clouds.getBounds());
    this.viewpoint.frame({ box, azimuth: FIRST_AZIMUTH }, box, scene.spec.environment.zfar, this.measureAbove());
  }

  /** Show a scene for the first time: its robots, if there are any. */
  private showFirst(scene: SceneView): void {
    const clouds = this.clouds.getBounds();
    const sight = findFirstSight(scene, this.bases, clouds);
    this.viewpoint.frame(sight, findWholeBox(scene, clouds), scene.spec.environment.zfar, this.measureAbove());
  }

  /** Return the share of the picture that lies behind the bar, and the labels and arrows below that. */
  private measureAbove(): number {
    return Math.min(MAX_ABOVE, (this.events.measureTop() + LABEL_PX) / Math.max(1, this.canvas.clientHeight));
  }

  /** Replace the scene in the picture by the next one. */
  private showNext(scene: SceneView): void {
    this.scene?.dispose();
    this.scene = scene;
    this.next = null;
    this.keepStreams(new Set(scene.spec.deformables.map((part) => part.stream)));
    this.poses = new Float32Array(0); // its bodies lie as they did at first, until they are moved
    this.root.add(scene.world);
    this.shadows.markOld();
    this.touch();
    this.events.onScene(scene.spec);
  }

  private takeFrame(frame: FrameUpdate): void {
    if (frame.bodies_version !== this.bodiesVersion || frame.poses.length !== POSE_FLOATS * this.bodyIds.length) {
      this.client.recycle(frame.poses);
      return;
    }
    const period = frame.session_ms - this.lastFrame_ms;
    this.lastFrame_ms = frame.session_ms;
    if (period > 0 && period < 500) this.delay.add(frame.age_ms, period, nowMs());
    this.frames.push({ session_ms: frame.session_ms, values: frame.poses });
  }

  private takeDeformable({ stream, vertices, surface, session_ms }: DeformableUpdate): void {
    const target = this.streams.get(stream) ?? this.addStream(stream);
    const { newest } = target.buffer;
    const isSame = newest !== undefined && target.scene === this.sceneCount && isEqual(newest.values, vertices);
    target.scene = this.sceneCount;
    const content = isSame ? newest.content : ++this.contentCount;
    target.buffer.push({ session_ms, values: vertices, surface, content });
  }

  private addStream(name: string): Stream {
    const release = (frame: DeformableFrame): void => this.client.recycleSurface(name, frame.surface);
    const stream: Stream = { buffer: new FrameBuffer(release), found: null, scene: this.sceneCount };
    this.streams.set(name, stream);
    return stream;
  }

  /** Forget the frames of deformables that are in no scene any more. */
  private keepStreams(names: ReadonlySet<string>): void {
    for (const [name, stream] of this.streams) {
      if (names.has(name)) continue;
      stream.buffer.clear();
      this.streams.delete(name);
    }
  }

  private sessionTime(): number {
    return nowMs() + (Number.isNaN(this.sessionOffset_ms) ? 0 : this.sessionOffset_ms);
  }

  private draw(frame?: XRFrame): void {
    this.displayed += 1;
    const { headset } = this;
    const space = this.renderer.xr.getReferenceSpace();
    const isPresenting = headset !== null && frame !== undefined && space !== null;
    if (isPresenting) headset.onFrame(frame, space);
    else if (nowMs() - this.lastTried_ms < this.device.framePeriod_ms) return;
    this.lastTried_ms = nowMs();
    const session_ms = this.sessionTime() - this.delay.delay_ms;
    const isMoved = [this.moveBodies(session_ms), this.moveDeformables(session_ms)].some(Boolean);
    const isChanged = [
      isMoved,
      this.avatars.update(session_ms),
      this.viewpoint.update(this.scene),
    ].some(Boolean);
    const now = nowMs();
    const isIdle = now - this.lastDrawn_ms > IDLE_MS;
    if (isMoved || isIdle) this.shadows.markOld();
    if (this.shadows.renew(now)) this.framesToDraw = Math.max(1, this.framesToDraw);
    if (this.clouds.popChanged()) this.touchOverlay(); // pictures are without them
    if (isChanged) this.touch();
    const isOnScreen = !this.renderer.xr.isPresenting;
    const hidden = [this.overlay, this.clouds.group];
    if (isOnScreen && this.pictures.drawDue(this.root, hidden, this.scene, now)) this.framesToDraw = Math.max(1, this.framesToDraw);
    const isLoading = this.scene !== null && this.sceneCount > 0 && isIdle;
    if (this.framesToDraw <= 0 && !isLoading && !isPresenting) return;
    this.framesToDraw -= 1;
    this.lastDrawn_ms = now;
    this.scene?.lighting.update(this.scene.rest);
    this.onDraw?.();
    if (isPresenting) this.showFor(headset.showsScene, headset.isTransparent);
    this.renderer.render(this.root, isPresenting ? headset.camera : this.viewpoint.camera);
    if (isOnScreen) this.pictures.show();
    this.drawn += 1;
    this.drawnSinceReport += 1;
  }

  private moveBodies(session_ms: number): boolean {
    const found = this.frames.around(session_ms);
    if (!found || !this.scene) return false;
    const { length } = found.before.values;
    const isNew = this.poses.length !== length;
    if (isNew) this.poses = new Float32Array(length);
    interpolatePoses(found.before.values, found.after.values, found.share, this.poses);
    if (this.drawnPoses.length !== length) this.drawnPoses = new Float32Array(length);
    let isMoved = isNew;
    for (let row = 0; row < this.bodyIds.length; row++) {
      const at = POSE_FLOATS * row;
      if (!isNew && !isVisiblyDifferent(this.poses, this.drawnPoses, at)) continue;
      isMoved = true;
      for (let i = at; i < at + POSE_FLOATS; i++) this.drawnPoses[i] = this.poses[i]!;
      const group = this.scene.bodies.get(this.bodyIds[row]!);
      if (!group) continue;
      const x = this.poses[at]!;
      const y = this.poses[at + 1]!;
      const z = this.poses[at + 2]!;
      group.visible = Number.isFinite(x + y + z + this.poses[at + 3]!); // a body that diverged is not drawn
      if (!group.visible) continue;
      group.position.set(x, y, z);
      group.quaternion.set(this.poses[at + 4]!, this.poses[at + 5]!, this.poses[at + 6]!, this.poses[at + 3]!);
      group.updateMatrix();
    }
    if (isMoved) this.scene.placeInstances();
    return isMoved;
  }

  private moveDeformables(session_ms: number): boolean {
    let isMoved = false;
    for (const part of this.scene?.deformables ?? []) {
      const stream = this.streams.get(part.stream);
      const found = stream?.buffer.around(session_ms);
      if (!stream || !found) continue;
      stream.found = found;
      if (part.show(found)) isMoved = true;
    }
    return isMoved;
  }

  /** Show or hide the scene, and what would cover the room: sky and planes. */
  private showFor(showsScene: boolean, isTransparent: boolean): void {
    const { scene } = this;
    this.overlay.visible = showsScene;
    this.clouds.group.visible = showsScene;
    if (!scene) return;
    scene.world.visible = showsScene;
    if (scene.sky) scene.sky.visible = !isTransparent;
    scene.world.traverse((object) => {
      if (object.userData.isPlane) object.visible = !isTransparent;
    });
  }

  private leaveHeadset(): void {
    this.headset = null;
    this.showFor(true, false);
    this.renderer.xr.enabled = false;
    this.resize();
  }

  private resize(): void {
    if (this.headset) return;
    const { clientWidth, clientHeight } = this.canvas;
    if (clientWidth === 0 || clientHeight === 0) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.viewpoint.setAspect(clientWidth / clientHeight);
    this.touch();
  }

  private reportDrawn(): void {
    this.client.post({ type: "drawn", frames: this.drawnSinceReport, age_ms: this.delay_ms });
    this.drawnSinceReport = 0;
  }
}

/** Return whether two poses at a place of their arrays differ by more than the bound of the stream. */
function isVisiblyDifferent(a: Float32Array, b: Float32Array, at: number): boolean {
  for (let i = at; i < at + POSE_FLOATS; i++) if (!(Math.abs(a[i]! - b[i]!) <= SAME)) return true;
  return false;
}

function makeRenderer(canvas: HTMLCanvasElement): WebGLRenderer {
  try {
    return new WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
  } catch {
    throw new Error("This browser cannot draw in 3D: switch on WebGL 2, or use another browser. The dashboard works.");
  }
}

/** Choose what to draw by what draws it. */
function inspectDevice(renderer: WebGLRenderer): Device {
  const gl = renderer.getContext();
  const extension = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(extension ? extension.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  const isSoftware = /swiftshader|llvmpipe|software|basic render/i.test(name);
  const isMobile = matchMedia("(pointer: coarse)").matches || /quest|oculus/i.test(navigator.userAgent);
  return {
    budget: isSoftware ? SOFTWARE : isMobile ? HEADSET : DESKTOP,
    framePeriod_ms: isSoftware ? 30 : 0,
    pixelRatio: isSoftware ? 1 : Math.min(devicePixelRatio, 2),
    renderer: name,
  };
}

function isEqual(a: Float32Array, b: Float32Array): boolean {
  if (a.length !== b.length) return false;
  for (let i = 0; i < a.length; i++) if (a[i] !== b[i]) return false;
  return true;
}

function listAddresses(spec: SceneSpec): Set<string> {
  const levels = [...spec.meshes, ...spec.textures].flatMap((item) => item.levels.map((level) => level.address));
  return new Set([...levels, ...spec.hfields.map((f) => f.address), ...spec.deformables.map((d) => d.address)]);
}
