// Anchors as an overlay: where the session believes its printed sheets to be, with the stated error.

import { AxesHelper, BufferGeometry, Float32BufferAttribute, Group, LineLoop, LineBasicMaterial } from "three";

import type { AnchorPlace, ParticipantInfo } from "../core/api.ts";
import { AlignmentKind } from "../protocol/messages.g.ts";
import { setPose } from "./axes.ts";
import { Label } from "./labels.ts";

/** Edge that is drawn for an anchor of unknown size [m]. */
const UNKNOWN_SIZE_M = 0.15;
const COLOR = "#35d0ba";

/** The sheet of a session that has none configured: `DEFAULT_ANCHORS` in iris_session/session/config.py. */
const DEFAULT_SHEET = JSON.stringify(["table", [[0, -0.45, 0], [1, 0, 0, 0]], 0]);

/** Alignments that come from a sheet. */
const BY_SHEETS: readonly AlignmentKind[] = [AlignmentKind.MEASURED, AlignmentKind.FINGERTIP, AlignmentKind.PERSISTENT];

/** Return the anchors to draw: the default sheet only while a participant is aligned by a sheet. */
export function listDrawn(anchors: readonly AnchorPlace[], people: readonly ParticipantInfo[]): AnchorPlace[] {
  const isAligned = people.some(({ alignment }) => BY_SHEETS.includes(alignment?.kind ?? AlignmentKind.NONE));
  const isDefault = ({ anchor_id, T_world_anchor, error_m }: AnchorPlace): boolean =>
    JSON.stringify([anchor_id, T_world_anchor, error_m]) === DEFAULT_SHEET;
  return anchors.filter((anchor) => isAligned || !isDefault(anchor));
}

/** All anchors. Add `group` to the session's world. */
export class AnchorOverlay {
  readonly group = new Group();
  private readonly labels: Label[] = [];
  private shown = "";

  constructor() {
    this.group.name = "anchors";
  }

  /** Draw the anchors anew when they changed. Returns whether they did. */
  setAnchors(anchors: readonly AnchorPlace[]): boolean {
    const key = JSON.stringify(anchors);
    if (key === this.shown) return false;
    this.shown = key;
    this.group.clear();
    for (const label of this.labels.splice(0)) label.dispose();
    for (const anchor of anchors) this.addAnchor(anchor);
    return true;
  }

  private addAnchor({ anchor_id, T_world_anchor, size_m, error_m }: AnchorPlace): void {
    const half = (size_m > 0 ? size_m : UNKNOWN_SIZE_M) / 2;
    const geometry = new BufferGeometry();
    const corners = [-half, -half, 0, half, -half, 0, half, half, 0, -half, half, 0];
    geometry.setAttribute("position", new Float32BufferAttribute(corners, 3));
    const place = new Group();
    setPose(place, T_world_anchor);
    const axes = new AxesHelper(half * 1.2);
    place.add(new LineLoop(geometry, new LineBasicMaterial({ color: COLOR })), axes);
    for (const object of place.children) object.renderOrder = 5;
    const label = new Label(0.035);
    label.setText(error_m > 0 ? [anchor_id, `± ${(1000 * error_m).toFixed(1)} mm`] : [anchor_id], COLOR);
    label.sprite.position.set(...T_world_anchor[0]).z += 0.06;
    this.labels.push(label);
    this.group.add(place, label.sprite);
  }
}
