// What a browser keeps between visits so that a headset is aligned again: the place of a sheet, by a persistent anchor of
// WebXR, and the tips of controllers, which are those of one participant of one session.

import type { ObservationInput } from "../core/api.ts";
import type { Store } from "../core/storage.ts";
import type * as wire from "../protocol/messages.g.ts";
import { toPose, toRow } from "./reading.ts";
import type { Tip } from "./touching.ts";

/** A sheet at the pose of a persistent anchor. `covariance`: of the alignment at the sheet, 6x6, axes of the anchor. */
interface KeptPlace {
  anchor_id: string;
  handle: string;
  covariance: number[];
}

const TIPS_KEY = "tips";

/** Keep the tips of a participant, in place of those before. `owner`: session and participant. */
export function keepTips(store: Store, owner: string, tips: ReadonlyMap<string, Tip>): void {
  void store.putValue(TIPS_KEY, encode({ owner, tips: [...tips] }));
}

/** Return the tips that were kept for this owner. */
export async function recallTips(store: Store, owner: string): Promise<[string, Tip][]> {
  const kept = decode<{ owner: string; tips: [string, Tip][] }>(await store.getValue(TIPS_KEY));
  if (kept?.owner !== owner || !Array.isArray(kept.tips)) return [];
  return kept.tips.filter((entry) => typeof entry?.[0] === "string" && isNumbers(entry[1]?.p, 3) && isNumbers(entry[1].covariance, 9));
}

/** The place that this browser keeps for sessions of one name. */
export class PlaceKeeper {
  private kept: KeptPlace | null = null;
  private anchor: XRAnchor | null = null;
  private readonly key: string;

  constructor(
    private readonly session: XRSession,
    private readonly store: Store,
    sessionName: string,
  ) {
    this.key = `place ${sessionName}`;
  }

  /** Ask the headset for the place that was kept. Nothing happens where there is none. */
  async restore(): Promise<void> {
    const kept = decode<KeptPlace>(await this.store.getValue(this.key));
    if (typeof kept?.anchor_id !== "string" || typeof kept.handle !== "string" || !isNumbers(kept.covariance, 36)) return;
    this.kept = kept;
    try {
      this.anchor = (await this.session.restorePersistentAnchor?.(this.kept.handle)) ?? null;
    } catch {
      this.kept = null; // the headset has forgotten it
    }
  }

  /** Return the observation of the kept place, null while the headset does not see where it is. */
  observe(frame: XRFrame, space: XRReferenceSpace, capture_ms: number): ObservationInput | null {
    const { kept, anchor } = this;
    if (!kept || !anchor || !frame.trackedAnchors?.has(anchor)) return null;
    const found = frame.getPose(anchor.anchorSpace, space);
    if (!found) return null;
    const pose = toPose(found.transform.position, found.transform.orientation);
    return { anchor_id: kept.anchor_id, kind: "persistent", T_tracking_anchor: pose, covariance: kept.covariance, capture_ms };
  }

  /**
   * Keep the place of a sheet, instead of the last one. Returns whether the browser does.
   *
   * `covariance`: of the alignment at the sheet, in the axes of the sheet. Call it while the frame is drawn.
   */
  async keep(frame: XRFrame, space: XRReferenceSpace, anchor_id: string, T_tracking_anchor: wire.Pose, covariance: number[]): Promise<boolean> {
    const [x, y, z, qx, qy, qz, qw] = toRow(T_tracking_anchor);
    let anchor: XRAnchor | undefined;
    try {
      const pose = new XRRigidTransform({ x: x!, y: y!, z: z! }, { x: qx!, y: qy!, z: qz!, w: qw! });
      anchor = await frame.createAnchor?.(pose, space);
      const handle = await anchor?.requestPersistentHandle?.();
      const kept = handle === undefined ? null : { anchor_id, handle, covariance };
      if (!anchor || !kept || !(await this.store.putValue(this.key, encode(kept)))) {
        if (handle !== undefined) await this.session.deletePersistentAnchor?.(handle); // nothing would restore it
        anchor?.delete();
        return false;
      }
      const former = this.kept?.handle;
      [this.kept, this.anchor] = [kept, anchor];
      // Headsets keep few anchors of a site. One that they have forgotten already is no loss.
      if (former !== undefined) await this.session.deletePersistentAnchor?.(former).catch(() => undefined);
      return true;
    } catch {
      anchor?.delete();
      return false;
    }
  }
}

function isNumbers(values: unknown, count: number): boolean {
  return Array.isArray(values) && values.length === count && values.every(Number.isFinite);
}

function encode(value: object): Uint8Array {
  return new TextEncoder().encode(JSON.stringify(value));
}

function decode<T>(bytes: Uint8Array | null): T | null {
  try {
    return bytes && (JSON.parse(new TextDecoder().decode(bytes)) as T);
  } catch {
    return null;
  }
}
