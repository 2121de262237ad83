// The skybox: a sphere around the camera, sampled by (x, z, -y) of the direction in the session's world.

import { BackSide, type CubeTexture, Mesh, ShaderMaterial, SphereGeometry } from "three";

// Directions in three.js are (-y, z, -x) of the session's: (x, z, -y) of that is (-Z, Y, X) here.
const VERTEX = /* glsl */ `
varying vec3 vDirection;
void main() {
  vDirection = vec3(-position.z, position.y, position.x);
  vec4 clip = projectionMatrix * vec4(mat3(viewMatrix) * position, 1.0);
  gl_Position = clip.xyww;
}`;

const FRAGMENT = /* glsl */ `
uniform samplerCube sky;
varying vec3 vDirection;
void main() {
  gl_FragColor = vec4(textureCube(sky, vDirection).rgb, 1.0);
  #include <colorspace_fragment>
}`;

/** Return the sky; add it to the scene of three.js, outside of the session's world. */
export function makeSky(texture: CubeTexture): Mesh {
  const material = new ShaderMaterial({
    uniforms: { sky: { value: texture } },
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    side: BackSide,
    depthWrite: false,
  });
  const sky = new Mesh(new SphereGeometry(1, 32, 16), material);
  sky.name = "sky";
  sky.frustumCulled = false;
  sky.renderOrder = -1;
  return sky;
}
