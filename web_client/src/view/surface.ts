// The material of everything in the scene: OpenGL's fixed pipeline as MuJoCo uses it, computed per pixel. Colours are
// blended as they are, without colour management (docs/scene.md).

import { DoubleSide, FrontSide, ShaderMaterial, type Side, type Texture, UniformsLib, UniformsUtils, Vector3 } from "three";

import type { Lighting } from "./lighting.ts";
import type { Material, Rgba } from "./spec.ts";

/** How a surface looks. `cube`: sampled by the attribute `cubeDirection`; `map`: by `uv`. */
export interface Look {
  rgba: Rgba;
  material: Material | null;
  map: Texture | null;
  cube: Texture | null;
  /** The texture, or colours of vertices, may be transparent. */
  isBlended: boolean;
  hasVertexColors: boolean;
  side: Side;
  /** Attributes `nextPosition` and `nextNormal` are those of the next frame; the uniform `share` says how much of it. */
  isInterpolated: boolean;
  /** Fades out at a distance: a plane without end [m], 0 for no fading. */
  fadeAt: number;
  /** The attribute `tint` of each instance multiplies the colour. */
  isTinted: boolean;
}

/** MuJoCo's values of a shape without a material. */
export const PLAIN = { emission: 0, specular: 0.5, shininess: 0.5, metallic: -1, roughness: -1 };

const VERTEX = /* glsl */ `
#include <common>
#include <shadowmap_pars_vertex>
varying vec3 vPosition;
varying vec3 vNormal;
#ifdef HAS_MAP
  varying vec2 vMapUv;
#endif
#ifdef HAS_CUBE
  attribute vec3 cubeDirection;
  varying vec3 vCube;
#endif
#ifdef IS_INTERPOLATED
  attribute vec3 nextPosition;
  attribute vec3 nextNormal;
  uniform float share;
#endif
#ifdef HAS_VERTEX_COLORS
  attribute vec4 vertexColor;
  varying vec4 vVertexColor;
#endif
#ifdef IS_TINTED
  attribute vec3 tint;
  varying vec3 vTint;
#endif
void main() {
  #include <beginnormal_vertex>
  #include <begin_vertex>
  #ifdef IS_INTERPOLATED
    if (share > 0.0) { // else the next frame may be one of long ago
      objectNormal = mix(objectNormal, nextNormal, share);
      transformed = mix(transformed, nextPosition, share);
    }
  #endif
  #include <worldpos_vertex>
  // Setting a matrix for every object takes time: normalMatrix is used for shadows only, and modelViewMatrix nowhere.
  #if defined(USE_SHADOWMAP) || NUM_SPOT_LIGHT_COORDS > 0
    #include <defaultnormal_vertex>
    #include <shadowmap_vertex>
  #endif
  vec4 local = vec4(transformed, 1.0);
  vec3 localNormal = objectNormal;
  #ifdef USE_INSTANCING
    local = instanceMatrix * local;
    mat3 turn = mat3(instanceMatrix); // and a scale along its axes, by which normals are divided
    localNormal = turn * (localNormal / vec3(dot(turn[0], turn[0]), dot(turn[1], turn[1]), dot(turn[2], turn[2])));
  #endif
  vec4 world = modelMatrix * local;
  vPosition = world.xyz;
  gl_Position = projectionMatrix * (viewMatrix * world);
  vNormal = mat3(modelMatrix) * localNormal;
  #ifdef HAS_MAP
    vMapUv = uv;
  #endif
  #ifdef HAS_CUBE
    vCube = cubeDirection;
  #endif
  #ifdef HAS_VERTEX_COLORS
    vVertexColor = vertexColor;
  #endif
  #ifdef IS_TINTED
    vTint = tint;
  #endif
}`;

const FRAGMENT_HEAD = /* glsl */ `
#include <common>
#include <lights_pars_begin>
#include <shadowmap_pars_fragment>
struct SceneLight {
  vec3 position; vec3 direction; vec3 ambient; vec3 diffuse; vec3 specular; vec3 attenuation;
  float cutoff; float exponent; float directional;
};
struct Headlight { vec3 ambient; vec3 diffuse; vec3 specular; };
#if LIGHTS > 0
  uniform SceneLight lights[LIGHTS];
#endif
uniform Headlight headlight;
uniform vec3 color;
uniform float opacity;
uniform float emission;
uniform vec3 specular;
uniform float shininess;
varying vec3 vPosition;
varying vec3 vNormal;
#ifdef HAS_MAP
  uniform sampler2D map;
  varying vec2 vMapUv;
#endif
#ifdef HAS_CUBE
  uniform samplerCube cube;
  varying vec3 vCube;
#endif
#ifdef HAS_VERTEX_COLORS
  varying vec4 vVertexColor;
#endif
#ifdef IS_TINTED
  varying vec3 vTint;
#endif

float highlight(vec3 normal, vec3 toLight, vec3 toEye) {
  return pow(max(dot(normal, normalize(toLight + toEye)), 1e-4), shininess);
}

vec3 shine(SceneLight light, vec3 normal, vec3 toEye, vec3 base, float shadow) {
  vec3 toLight = -light.direction;
  float share = 1.0;
  if (light.directional < 0.5) {
    vec3 way = light.position - vPosition;
    float distanceToLight = max(length(way), 1e-6);
    toLight = way / distanceToLight;
    share = 1.0 / max(dot(light.attenuation, vec3(1.0, distanceToLight, distanceToLight * distanceToLight)), 1e-6);
    if (light.cutoff > -1.5) {
      float along = dot(-toLight, light.direction);
      share *= along < light.cutoff ? 0.0 : pow(max(along, 1e-4), light.exponent);
    }
  }
  float facing = max(dot(normal, toLight), 0.0);
  vec3 direct = light.diffuse * base * facing;
  if (facing > 0.0) direct += light.specular * specular * highlight(normal, toLight, toEye);
  return share * (light.ambient * base + shadow * direct);
}

void main() {
  vec4 base = vec4(color, opacity);
  #ifdef HAS_VERTEX_COLORS
    base *= vVertexColor;
  #endif
  #ifdef IS_TINTED
    base.rgb *= vTint;
  #endif
  vec3 normal = normalize(vNormal);
  #ifdef DOUBLE_SIDED
    normal = gl_FrontFacing ? normal : -normal;
  #endif
  vec3 forward = -vec3(viewMatrix[0][2], viewMatrix[1][2], viewMatrix[2][2]);
  vec3 toEye = isOrthographic ? -forward : normalize(cameraPosition - vPosition);
  vec3 lit = emission * base.rgb + headlight.ambient * base.rgb;
  float facing = max(dot(normal, -forward), 0.0);
  lit += headlight.diffuse * base.rgb * facing;
  if (facing > 0.0) lit += headlight.specular * specular * highlight(normal, -forward, toEye);
`;

const FRAGMENT_TAIL = /* glsl */ `
  #ifdef FADE_AT
    base.a *= 1.0 - smoothstep(0.35, 1.0, distance(cameraPosition, vPosition) / FADE_AT);
  #endif
  // As in the fixed pipeline, a texture multiplies what the lights gave, highlights too, after that was clamped.
  vec4 seen = vec4(min(lit, 1.0), base.a);
  #ifdef HAS_MAP
    seen *= texture2D(map, vMapUv);
  #endif
  #ifdef HAS_CUBE
    seen *= textureCube(cube, vCube);
  #endif
  gl_FragColor = seen;
  #include <colorspace_fragment>
}`;

/** Return the material of a look. It shares its lights with all others of `lighting`. */
export function makeSurface(look: Look, lighting: Lighting): ShaderMaterial {
  const { emission, specular, shininess, metallic, roughness } = look.material ?? PLAIN;
  const [r, g, b, alpha] = look.rgba;
  // The scene's own specular term is grey; a metal's has its colour.
  const grey = Math.min(Math.max(specular, 0), 1);
  const metal = Math.min(Math.max(metallic, 0), 1);
  const tint = [r, g, b].map((part) => grey * (1 - metal) + Math.max(grey, 0.6) * metal * part);
  const defines: Record<string, string | number> = { LIGHTS: lighting.layout.shadows.length };
  if (look.map) defines.HAS_MAP = "";
  if (look.cube) defines.HAS_CUBE = "";
  if (look.hasVertexColors) defines.HAS_VERTEX_COLORS = "";
  if (look.side === DoubleSide) defines.DOUBLE_SIDED = "";
  if (look.isInterpolated) defines.IS_INTERPOLATED = "";
  if (look.isTinted) defines.IS_TINTED = "";
  if (look.fadeAt > 0) defines.FADE_AT = look.fadeAt.toFixed(3);
  const material = new ShaderMaterial({
    defines,
    lights: true,
    uniforms: {
      ...UniformsUtils.clone(UniformsLib.lights),
      lights: lighting.uniforms.lights,
      headlight: lighting.uniforms.headlight,
      color: { value: new Vector3(r, g, b) },
      opacity: { value: Math.min(Math.max(alpha, 0), 1) },
      emission: { value: Math.max(emission, 0) },
      specular: { value: new Vector3(...tint) },
      shininess: { value: 128 * Math.min(Math.max(roughness >= 0 ? 1 - roughness : shininess, 0), 1) },
      map: { value: look.map },
      cube: { value: look.cube },
      ...(look.isInterpolated ? { share: { value: 0 } } : {}),
    },
    vertexShader: VERTEX,
    fragmentShader: `${FRAGMENT_HEAD}${writeLights(lighting)}${FRAGMENT_TAIL}`,
    side: look.side,
    shadowSide: look.side === DoubleSide ? DoubleSide : FrontSide,
    transparent: alpha < 1 || look.isBlended || look.fadeAt > 0,
  });
  material.userData.look = look;
  return material;
}

/** Return the sum over the lights. Shadow maps of one kind are numbered in the order of their lights. */
function writeLights(lighting: Lighting): string {
  const counts = { directional: 0, spot: 0 };
  const sum = lighting.layout.shadows
    .map((kind, i) => {
      if (kind === "") return `  lit += shine(lights[${i}], normal, toEye, base.rgb, 1.0);\n`;
      const k = counts[kind]++;
      const coordinate = kind === "spot" ? "vSpotLightCoord" : "vDirectionalShadowCoord";
      const [structs, count] =
        kind === "spot"
          ? ["spotLightShadows", "NUM_SPOT_LIGHT_SHADOWS"]
          : ["directionalLightShadows", "NUM_DIR_LIGHT_SHADOWS"];
      const s = `${structs}[${k}]`;
      const lookUp = `getShadow(${kind}ShadowMap[${k}], ${s}.shadowMapSize, ${s}.shadowIntensity, ${s}.shadowBias, ${s}.shadowRadius, ${coordinate}[${k}])`;
      return (
        `#if defined(USE_SHADOWMAP) && ${count} > ${k}\n` +
        `  lit += shine(lights[${i}], normal, toEye, base.rgb, receiveShadow ? ${lookUp} : 1.0);\n` +
        `#else\n  lit += shine(lights[${i}], normal, toEye, base.rgb, 1.0);\n#endif\n`
      );
    })
    .join("");
  return sum + (lighting.layout.isShaded ? SHADE : "");
}

/** What is below something is darker. */
const SHADE = /* glsl */ `
#if defined(USE_SHADOWMAP) && NUM_DIR_LIGHT_SHADOWS > 0
  if (receiveShadow) {
    DirectionalLightShadow s = directionalLightShadows[0];
    lit *= mix(0.6, 1.0, getShadow(directionalShadowMap[0], s.shadowMapSize, s.shadowIntensity, s.shadowBias, s.shadowRadius, vDirectionalShadowCoord[0]));
  }
#endif
`;
