// Which sheets are drawn.

import { expect, test } from "vitest";

import type { AnchorPlace, ParticipantInfo } from "../../src/core/api.ts";
import { listDrawn } from "../../src/view/anchors.ts";

const makeAnchor = (anchor_id: string, y: number): AnchorPlace => ({ anchor_id, T_world_anchor: [[0, y, 0], [1, 0, 0, 0]], size_m: 0.15, error_m: 0, marks: [] });
const makePerson = (kind: string): ParticipantInfo => ({ alignment: { kind } }) as ParticipantInfo;

test("the default sheet is drawn only while a participant is aligned by a sheet, a configured one always", () => {
  const [byDefault, moved, other] = [makeAnchor("table", -0.45), makeAnchor("table", -0.5), makeAnchor("wall", -0.45)];
  const all = [byDefault, moved, other];
  expect(listDrawn(all, [makePerson("not_needed"), makePerson("placed")])).toEqual([moved, other]);
  expect(listDrawn(all, [makePerson("measured")])).toEqual(all);
});
