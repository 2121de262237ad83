// Poses of the wire (X forward, Y left, Z up) in the axes of WebXR and three.js (X right, Y up, -Z forward), and back.

/** Write row `x y z qw qx qy qz` of `source` at `from` as `x y z qx qy qz qw` to `target` at `to`. */
export function toThree(source: ArrayLike<number>, target: { [i: number]: number }, from = 0, to = 0): void {
  const x = source[from] as number;
  const y = source[from + 1] as number;
  const z = source[from + 2] as number;
  const w = source[from + 3] as number;
  const i = source[from + 4] as number;
  const j = source[from + 5] as number;
  const k = source[from + 6] as number;
  target[to] = -y;
  target[to + 1] = z;
  target[to + 2] = -x;
  target[to + 3] = -j;
  target[to + 4] = k;
  target[to + 5] = -i;
  target[to + 6] = w;
}

/** The inverse of `toThree`: from `x y z qx qy qz qw` to `x y z qw qx qy qz`. */
export function fromThree(source: ArrayLike<number>, target: { [i: number]: number }, from = 0, to = 0): void {
  const x = source[from] as number;
  const y = source[from + 1] as number;
  const z = source[from + 2] as number;
  const i = source[from + 3] as number;
  const j = source[from + 4] as number;
  const k = source[from + 5] as number;
  const w = source[from + 6] as number;
  target[to] = -z;
  target[to + 1] = -x;
  target[to + 2] = y;
  target[to + 3] = w;
  target[to + 4] = -k;
  target[to + 5] = -i;
  target[to + 6] = j;
}
