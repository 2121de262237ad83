// A scene of three.js from a `SceneSpec`: bodies as groups, visuals on them, lights, sky. It shows what is loaded and
// fills in the rest as it comes, coarse levels first.

import {
  BackSide,
  BufferAttribute,
  BufferGeometry,
  type CubeTexture,
  DoubleSide,
  FrontSide,
  Group,
  InstancedMesh,
  Matrix4,
  Mesh,
  type ShaderMaterial,
  type Texture,
  Vector3,
} from "three";
import { mergeVertices } from "three/examples/jsm/utils/BufferGeometryUtils.js";

import type { AssetSource, MeshArrays } from "./arrays.ts";
import { makeWorldRoot, setPose } from "./axes.ts";
import { type Budget, chooseLevels, type LevelChoice } from "./budget.ts";
import { type DeformableView, makeDeformable, spanPiece } from "./deformables.ts";
import { instanceMeshes, type Instances } from "./instancing.ts";
import { Lighting } from "./lighting.ts";
import { mergeMeshes } from "./merging.ts";
import { addTextureCoordinates, buildHeightField, buildPrimitive, cubeDirections, ENDLESS_M } from "./shapes.ts";
import { makeSky } from "./sky.ts";
import type { Geometry, Material, Rgba, SceneSpec, Visual } from "./spec.ts";
import { type Look, makeSurface } from "./surface.ts";
import { makeCubeTexture, makeTexture } from "./textures.ts";

export interface SceneOptions {
  budget: Budget;
  anisotropy: number;
  /** Called with one line for people when something of the scene cannot be shown. */
  onProblem: (text: string) => void;
}

/** Share of its alpha with which a plane is seen from behind. */
const BEHIND_ALPHA = 0.3;
/** Roles of the texture that gives a surface its colour. */
const COLOR_ROLES = ["rgb", "rgba"];

/** One scene. `world` holds it, in the session's axes; `sky` belongs beside it. */
export class SceneView {
  readonly world: Group = makeWorldRoot();
  readonly bodies = new Map<number, Group>();
  /** Poses in which the bodies begin. */
  readonly rest = new Map<number, Matrix4>();
  readonly deformables: DeformableView[] = [];
  readonly lighting: Lighting;
  sky: Mesh | null = null;
  /** Equal shapes: they are not in the groups of their bodies. */
  private instances: Instances[] = [];
  /** Resolves when everything that can be shown is shown. */
  readonly complete: Promise<void>;

  private readonly choice: LevelChoice;
  private readonly geometries = new Map<string, Promise<BufferGeometry>>();
  private readonly textures = new Map<string, Promise<Texture>>();
  private readonly materials = new Map<string, ShaderMaterial>();
  private readonly owned = new Set<{ dispose(): void }>();
  private isDisposed = false;

  constructor(
    readonly spec: SceneSpec,
    private readonly assets: AssetSource,
    private readonly options: SceneOptions,
  ) {
    this.choice = chooseLevels(spec, options.budget);
    for (const body of spec.bodies) {
      const group = new Group();
      group.name = body.name;
      setPose(group, body.T_world_body);
      group.updateMatrix();
      group.matrixAutoUpdate = false; // it is updated when the body is moved
      this.bodies.set(body.id, group);
      this.rest.set(body.id, new Matrix4().compose(group.position, group.quaternion, new Vector3(1, 1, 1)));
      this.world.add(group);
    }
    this.lighting = new Lighting(this, this.world, options.budget);
    this.lighting.update(this.rest);
    this.complete = this.build();
  }

  /** Release what is on the graphics card. The view must not be drawn any more. */
  dispose(): void {
    this.isDisposed = true;
    this.lighting.dispose();
    for (const item of this.owned) item.dispose();
    for (const material of this.materials.values()) material.dispose();
    this.world.removeFromParent();
    this.sky?.removeFromParent();
  }

  /** Move instances to where their bodies are. Call it after the poses of bodies were set. */
  placeInstances(): void {
    for (const instances of this.instances) instances.place();
  }

  private async build(): Promise<void> {
    const { spec } = this;
    const shown = spec.visuals.filter(
      (v) => v.rgba[3] > 0 && spec.groups_shown.includes(v.group) && !this.choice.hidden.has(v.id),
    );
    const jobs: Promise<void>[] = shown.map((visual) => this.attempt(visual.name, () => this.addVisual(visual)));
    const sites = spec.sites.filter((site) => site.rgba[3] > 0 && spec.groups_shown.includes(site.group));
    for (const site of sites) {
      const visual: Visual = { ...site, T_body_visual: site.T_body_site };
      jobs.push(this.attempt(site.name, () => this.addVisual(visual, false)));
    }
    this.addTendons();
    for (const part of spec.deformables) {
      if (part.rgba[3] <= 0 || !spec.groups_shown.includes(part.group)) continue;
      jobs.push(
        this.attempt(part.name, async () => {
          const wish = { address: part.address, bytes: part.bytes, encoding: part.encoding };
          const [arrays, material] = await Promise.all([
            this.assets.loadDeformable(wish),
            this.makeMaterial(part.material, part.rgba, { isDoubleSided: part.dim === 2, isInterpolated: part.dim > 1 }),
          ]);
          if (this.isDisposed) return;
          const view = makeDeformable(part, arrays, material);
          this.owned.add(view);
          this.deformables.push(view);
          this.world.add(view.object);
        }),
      );
    }
    if (spec.environment.skybox >= 0) {
      jobs.push(
        this.attempt("skybox", async () => {
          const texture = (await this.loadTexture(spec.environment.skybox)) as CubeTexture;
          if (this.isDisposed) return;
          this.sky = makeSky(texture);
          this.owned.add(this.sky.geometry).add(this.sky.material as ShaderMaterial);
        }),
      );
    }
    await Promise.all(jobs);
    if (!this.isDisposed) this.merge();
  }

  /** Draw what is equal at once, merge what looks the same on each body, and release what is not drawn any more. */
  private merge(): void {
    const makeTinted = (look: Look): ShaderMaterial => {
      const material = makeSurface({ ...look, rgba: [1, 1, 1, 1], isTinted: true }, this.lighting);
      this.owned.add(material);
      return material;
    };
    // Corners that are equal are computed once: there may be a million of them.
    const makeUnit = (unit: Geometry): BufferGeometry => mergeVertices(toBufferGeometry(buildPrimitive(unit), unit, "", null, this.spec));
    const moving = new Set(this.spec.bodies.filter((body) => body.moving).map(({ id }) => id));
    const { instances, made } = instanceMeshes(this.bodies, moving, makeTinted, makeUnit);
    for (const item of made) this.owned.add(item);
    for (const { object } of instances) this.world.add(object);
    this.instances = instances;
    for (const body of this.bodies.values()) {
      for (const merged of mergeMeshes(body)) this.owned.add(merged);
      if (body.children.length === 0) body.removeFromParent(); // three.js looks at every object of every frame
    }
    const drawn = new Set<unknown>();
    this.world.traverse((object) => drawn.add((object as Partial<Mesh>).geometry));
    const release = (geometry: BufferGeometry): void => {
      if (drawn.has(geometry)) return;
      geometry.dispose();
      this.owned.delete(geometry);
    };
    for (const loading of this.geometries.values()) loading.then(release, () => undefined); // what failed was reported
    this.geometries.clear();
  }

  /** Run a part of the building; what fails is left out and reported. */
  private async attempt(name: string, job: () => Promise<void>): Promise<void> {
    try {
      await job();
    } catch (error) {
      if (this.isDisposed) return;
      this.options.onProblem(`${name || "a part"} of the scene is not shown: ${(error as Error).message}`);
    }
  }

  // --- visuals ------------------------------------------------------------------------------------------------------

  private async addVisual(visual: Visual, castShadow = true): Promise<void> {
    const mesh = this.spec.meshes[visual.geometry.mesh];
    const level = mesh ? this.choice.meshLevels[visual.geometry.mesh]! : 0;
    const levels = mesh && mesh.levels.length > level + 1 ? [mesh.levels.length - 1, level] : [level];
    let shown: Mesh | null = null;
    for (const [k, detail] of levels.entries()) {
      const loading = this.loadVisual(visual, detail);
      const made = k + 1 < levels.length ? await loading.catch(() => null) : await loading;
      if (this.isDisposed) return;
      if (!made) continue;
      if (shown) this.bodies.get(visual.body)?.remove(shown);
      shown = made;
      setPose(made, visual.T_body_visual);
      made.updateMatrix();
      made.matrixAutoUpdate = false;
      made.name = visual.name;
      const isPlane = visual.geometry.kind === "plane";
      made.castShadow = castShadow && !isPlane && visual.rgba[3] >= 1;
      made.receiveShadow = true;
      made.userData.isPlane = isPlane;
      made.userData.geometry = visual.geometry;
      this.bodies.get(visual.body)?.add(made);
      if (isPlane) made.add(await this.makeBackOf(visual, made.geometry));
    }
  }

  private async loadVisual(visual: Visual, level: number): Promise<Mesh> {
    const isEndless = visual.geometry.kind === "plane" && visual.geometry.size.slice(0, 2).includes(0);
    const [geometry, material] = await Promise.all([
      this.loadGeometry(visual.geometry, visual.material, level),
      this.makeMaterial(visual.material, visual.rgba, { geometry: visual.geometry, fadeAt: isEndless ? ENDLESS_M : 0 }),
    ]);
    return new Mesh(geometry, material);
  }

  /** Return the back of a plane, which is seen with a part of its alpha. */
  private async makeBackOf(visual: Visual, geometry: BufferGeometry): Promise<Mesh> {
    const [r, g, b, alpha] = visual.rgba;
    const rgba: Rgba = [r, g, b, alpha * BEHIND_ALPHA];
    const material = await this.makeMaterial(visual.material, rgba, { geometry: visual.geometry, isBack: true });
    const back = new Mesh(geometry, material);
    back.userData.isPlane = true;
    return back;
  }

  private loadGeometry(geometry: Geometry, materialIndex: number, level: number): Promise<BufferGeometry> {
    const material = this.spec.materials[materialIndex];
    const texture = this.findColorTexture(material);
    const isTextured = this.spec.meshes[geometry.mesh]?.textured ?? false;
    const mapping = texture < 0 ? "" : this.spec.textures[texture]!.kind === "2d" ? "map" : isTextured ? "" : "cube";
    const key = JSON.stringify([geometry, level, mapping, mapping && [material!.repeat, material!.uniform]]);
    let loading = this.geometries.get(key);
    if (!loading) {
      loading = this.readArrays(geometry, level).then((arrays) => {
        const made = toBufferGeometry(arrays, geometry, mapping, material ?? null, this.spec);
        this.owned.add(made);
        return made;
      });
      this.geometries.set(key, loading);
    }
    return loading;
  }

  private async readArrays(geometry: Geometry, level: number): Promise<MeshArrays> {
    const mesh = this.spec.meshes[geometry.mesh];
    const found = mesh?.levels[level];
    if (found) return this.assets.loadMesh(found);
    const field = this.spec.hfields[geometry.hfield];
    if (field) return buildHeightField(field, await this.assets.loadElevation(field));
    return buildPrimitive(geometry);
  }

  private addTendons(): void {
    const { spec } = this;
    const placed = new Map(spec.sites.map((site) => [site.id, site]));
    for (const tendon of spec.tendons) {
      if (tendon.rgba[3] <= 0 || !spec.groups_shown.includes(tendon.group)) continue;
      const sites = tendon.sites.map((id) => placed.get(id)).filter((site) => site !== undefined);
      if (sites.length < 2) continue;
      const arrays = buildPrimitive({ kind: "cylinder", size: [1, 1, 0.5], mesh: -1, hfield: -1 });
      const geometry = toBufferGeometry(arrays, null, "", null, spec);
      this.owned.add(geometry);
      void this.makeMaterial(tendon.material, tendon.rgba, {}).then((material) => {
        const pieces = new InstancedMesh(geometry, material, sites.length - 1);
        pieces.frustumCulled = false;
        pieces.onBeforeRender = () => {
          const ends = sites.map((site) => {
            const body = this.bodies.get(site.body);
            const end = new Vector3(...site.T_body_site[0]);
            return body ? end.applyQuaternion(body.quaternion).add(body.position) : end;
          });
          for (let i = 0; i + 1 < ends.length; i++) {
            pieces.setMatrixAt(i, spanPiece(ends[i]!, ends[i + 1]!, tendon.width));
          }
          pieces.instanceMatrix.needsUpdate = true;
        };
        if (!this.isDisposed) this.world.add(pieces);
      });
    }
  }

  // --- appearance ---------------------------------------------------------------------------------------------------

  private findColorTexture(material: Material | undefined): number {
    return material?.textures.find((use) => COLOR_ROLES.includes(use.role) && this.spec.textures[use.texture])?.texture ?? -1;
  }

  private async makeMaterial(
    index: number,
    rgba: Rgba,
    use: { geometry?: Geometry; isDoubleSided?: boolean; isInterpolated?: boolean; isBack?: boolean; fadeAt?: number },
  ): Promise<ShaderMaterial> {
    const material = this.spec.materials[index];
    const source = this.findColorTexture(material);
    const mesh = use.geometry ? this.spec.meshes[use.geometry.mesh] : undefined;
    const kind = source < 0 ? "" : this.spec.textures[source]!.kind;
    // MuJoCo draws no cube on meshes with texture coordinates, nor on deformables.
    const isDrawn = source >= 0 && (kind === "2d" || (use.geometry !== undefined && !(mesh?.textured ?? false)));
    const texture = isDrawn ? await this.loadTexture(source) : null;
    const hasVertexColors = mesh ? await this.hasVertexColors(use.geometry!) : false;
    const key = JSON.stringify([index, rgba, isDrawn, hasVertexColors, use.isDoubleSided, use.isInterpolated, use.isBack, use.fadeAt]);
    let made = this.materials.get(key);
    if (!made) {
      made = makeSurface(
        {
          rgba,
          material: material ?? null,
          map: kind === "2d" ? texture : null,
          cube: kind !== "2d" ? texture : null,
          isBlended: hasVertexColors || (texture !== null && this.spec.textures[source]!.channels === 4),
          hasVertexColors,
          side: use.isDoubleSided ? DoubleSide : use.isBack ? BackSide : FrontSide,
          isInterpolated: use.isInterpolated ?? false,
          fadeAt: use.fadeAt ?? 0,
          isTinted: false,
        },
        this.lighting,
      );
      this.materials.set(key, made);
    }
    return made;
  }

  private async hasVertexColors(geometry: Geometry): Promise<boolean> {
    const level = this.spec.meshes[geometry.mesh]?.levels[0];
    if (!level || this.spec.meshes[geometry.mesh]!.levels.length > 1) return false; // those with colours have one level
    return (await this.assets.loadMesh(level)).color !== undefined;
  }

  private loadTexture(index: number): Promise<Texture> {
    const texture = this.spec.textures[index]!;
    const from = this.choice.textureLevels[index] ?? 0;
    const level = texture.levels.slice(from).find((one) => one.encoding !== "opaque");
    if (!level) return Promise.reject(new Error(`the texture ${texture.name} is in a form that browsers cannot read`));
    const isSrgb = texture.colorspace === "srgb";
    const key = `${level.address} ${texture.kind} ${isSrgb}`;
    let loading = this.textures.get(key);
    if (!loading) {
      loading = this.assets.loadPixels(level).then((pixels) => {
        const made =
          texture.kind === "2d" ? makeTexture(pixels, isSrgb, this.options.anisotropy) : makeCubeTexture(pixels, isSrgb);
        this.owned.add(made);
        return made;
      });
      this.textures.set(key, loading);
    }
    return loading;
  }
}

/** Return a geometry of three.js. `mapping`: which texture it has, `map`, `cube` or none. */
function toBufferGeometry(
  arrays: MeshArrays,
  geometry: Geometry | null,
  mapping: string,
  material: Material | null,
  spec: SceneSpec,
): BufferGeometry {
  const made = new BufferGeometry();
  let mesh = arrays;
  if (mapping === "map" && geometry && material) mesh = addTextureCoordinates(arrays, geometry, material);
  if (mapping === "cube" && geometry && material) {
    const found = cubeDirections(arrays, geometry, material, spec.hfields[geometry.hfield]);
    mesh = found.mesh;
    made.setAttribute("cubeDirection", new BufferAttribute(found.direction, 3));
  }
  made.setAttribute("position", new BufferAttribute(mesh.position, 3));
  made.setAttribute("normal", new BufferAttribute(mesh.normal, 3));
  if (mesh.uv && mapping === "map") made.setAttribute("uv", new BufferAttribute(mesh.uv, 2));
  if (mesh.color) made.setAttribute("vertexColor", new BufferAttribute(mesh.color, 4, true));
  made.setIndex(new BufferAttribute(mesh.index, 1));
  return made;
}
