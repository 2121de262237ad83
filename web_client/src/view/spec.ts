// Types of a scene with all defaults filled in, as the worker posts them.

import type { Filled } from "../core/api.ts";
import type * as wire from "../protocol/messages.g.ts";

export type { SceneSpec } from "../core/api.ts";
export type Body = Filled<wire.Body>;
export type Camera = Filled<wire.Camera>;
export type Deformable = Filled<wire.Deformable>;
export type Environment = Filled<wire.Environment>;
export type Geometry = Filled<wire.Geometry>;
export type HeightField = Filled<wire.HeightField>;
export type Light = Filled<wire.Light>;
export type Material = Filled<wire.Material>;
export type Mesh = Filled<wire.Mesh>;
export type Pose = wire.Pose;
export type Site = Filled<wire.Site>;
export type Tendon = Filled<wire.Tendon>;
export type Texture = Filled<wire.Texture>;
export type Visual = Filled<wire.Visual>;
export type Rgba = [number, number, number, number];
