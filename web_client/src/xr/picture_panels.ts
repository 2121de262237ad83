// Pictures of real cameras in a headset: panels at the side of the person, and a menu to choose them. Which streams are
// subscribed to follows from the same choices as with a screen.

import { Group, LinearFilter, Mesh, MeshBasicMaterial, PlaneGeometry, Texture } from "three";

import type { PictureUpdate } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import { describePicture, expectAspect, listPictures } from "../ui/pictures.ts";
import type { PageState } from "../ui/state.ts";
import { MAX_PANELS, type Stream, type StreamChoices } from "../ui/stream_choices.ts";
import { Label } from "../view/labels.ts";
import { findRow, fitPicture, followHead, type MenuItem, placePanel, placeRow, type Stand } from "./picture_places.ts";
import { moveTo } from "./props.ts";
import { type FrameReading, type Side, toRow } from "./reading.ts";
import { wrap } from "./words.ts";

/** An item that a hand points at. */
export interface MenuAim {
  side: Side;
  target: MenuItem;
  /** Along the ray [m]. */
  distance: number;
}

/** Time between two updates of what panels say [ms]: digits that change faster are not read. */
const WORDS_MS = 500;
const COLOR = "#35d0ba";
const BAD_COLOR = "#e0a33a";
/** What pictures are multiplied with: the second while they do not show things as they are now. Without a picture: the third. */
const [CLEAR, DIMMED, EMPTY] = [0xffffff, 0x666666, 0x20252e];
/** Space between a picture and its words [m]. */
const GAP_M = 0.01;
/** Characters of a title in the menu. */
const MAX_TITLE = 26;
const SLOTS = Array.from({ length: MAX_PANELS }, (_, slot) => slot);
const NO_AIMS: readonly MenuAim[] = [];

/** The panels of one immersive session, and their menu. */
export class PicturePanels {
  /** In the tracking frame. */
  readonly group = new Group();
  /** The newest place of the person, null: not known yet. */
  stand: Stand | null = null;
  /** Items of the menu from the top; none in a session without pictures. */
  items: readonly MenuItem[] = [];
  private isMenuOpen = false;
  private readonly rows: Label[] = [];
  /** By stream, the oldest first. */
  private readonly panels = new Map<string, PicturePanel>();
  private aims = NO_AIMS;
  private words_ms = Number.NEGATIVE_INFINITY;
  private readonly endListening: () => void;

  constructor(
    private readonly state: PageState,
    private readonly choices: StreamChoices,
    client: WorkerClient,
  ) {
    this.group.name = "pictures";
    this.endListening = client.on("picture", (picture) => this.show(picture));
  }

  /** Take a frame. Returns what hands point at. */
  move({ head, inputs }: FrameReading): readonly MenuAim[] {
    if (this.items.length === 0 || !head) return (this.aims = NO_AIMS);
    const stand = followHead(head, this.stand);
    if (stand !== null && stand !== this.stand) this.place(stand);
    if (stand === null) return (this.aims = NO_AIMS);
    this.aims = inputs.flatMap(({ side, ray, tracked }): MenuAim[] => {
      const found = ray && tracked ? findRow(ray, stand, this.items.length) : null;
      return found ? [{ side, target: this.items[found.row]!, distance: found.distance }] : [];
    });
    return this.aims;
  }

  /** Do what an item of the menu says. */
  press(item: MenuItem): void {
    const { state, choices } = this;
    const offered = listPictures(state);
    const one = offered.find(({ stream }) => item === `picture ${stream}`);
    if (item === "menu") this.isMenuOpen = !this.isMenuOpen;
    if (one) {
      const isOpening = !this.panels.has(one.stream);
      const oldest = offered.find(({ stream }) => stream === [...this.panels.keys()][0]);
      if (isOpening && oldest && this.panels.size >= MAX_PANELS) choices.choose(oldest, false, state.mode);
      choices.choose(one, isOpening, state.mode);
    }
    state.touch();
    this.update();
  }

  /** Take what the session says and what was chosen: several times a second. */
  update(): void {
    const { state, choices, panels } = this;
    const offered = listPictures(state);
    const shown = choices.listPanels(offered, state.mode);
    for (const [stream, panel] of panels) {
      if (shown.some((one) => one.stream === stream)) continue;
      panel.dispose();
      panels.delete(stream);
    }
    const isNew = shown.map((one) => this.add(one)).some(Boolean);
    this.items = offered.length === 0 ? [] : ["menu", ...(this.isMenuOpen ? offered.map(({ stream }) => `picture ${stream}` as const) : [])];
    this.drawMenu(offered);
    if (isNew && this.stand) this.place(this.stand);
    const now = performance.now();
    if (!isNew && now - this.words_ms < WORDS_MS) return;
    this.words_ms = now;
    for (const one of shown) panels.get(one.stream)?.describe(one, state);
  }

  dispose(): void {
    this.endListening();
    for (const label of this.rows) label.dispose();
    for (const panel of this.panels.values()) panel.dispose();
    this.group.removeFromParent();
  }

  private show({ stream, bitmap }: PictureUpdate): void {
    if (!this.panels.has(stream)) this.update(); // it came before the panel that it was subscribed to for
    const panel = this.panels.get(stream);
    if (panel) panel.show(bitmap);
    else bitmap.close();
  }

  /** Add a panel at the first place that is free. Returns false for one that is there. */
  private add(one: Stream): boolean {
    if (this.panels.has(one.stream)) return false;
    const taken = [...this.panels.values()].map(({ slot }) => slot);
    const panel = new PicturePanel(SLOTS.find((slot) => !taken.includes(slot)) ?? 0, expectAspect(one));
    this.panels.set(one.stream, panel);
    this.group.add(panel.object);
    return true;
  }

  private place(stand: Stand): void {
    this.stand = stand;
    for (const panel of this.panels.values()) panel.place(stand);
    this.rows.forEach(({ sprite }, row) => moveTo(sprite, placeRow(stand, row)));
  }

  private drawMenu(offered: readonly Stream[]): void {
    while (this.rows.length < this.items.length) this.addRow();
    this.rows.forEach((label, row) => {
      const item = this.items[row];
      const one = item === "menu" ? undefined : offered[row - 1];
      const isAimed = this.aims.some(({ target }) => target === item);
      const text = one ? this.describeItem(one, isAimed) : this.isMenuOpen ? "Close this list" : "Cameras";
      label.setText(item && this.stand ? [`${isAimed ? "▶ " : ""}${text}`] : [], COLOR);
    });
  }

  private describeItem({ stream, title }: Stream, isAimed: boolean): string {
    const isShown = this.panels.has(stream);
    const name = title || stream;
    const text = name.length > MAX_TITLE ? `${name.slice(0, MAX_TITLE - 1)}…` : name;
    return isAimed ? `${isShown ? "Close" : "Show"}: ${text}` : `${isShown ? "▮" : "▯"} ${text}`;
  }

  private addRow(): void {
    const label = new Label(0.03);
    const { sprite } = label;
    sprite.center.set(0, 0.5);
    sprite.material.depthTest = false; // what can be pressed is seen
    sprite.renderOrder = 20;
    if (this.stand) moveTo(sprite, placeRow(this.stand, this.rows.length));
    this.rows.push(label);
    this.group.add(sprite);
  }
}

/** The panel of a stream. */
class PicturePanel {
  readonly object = new Group();
  private readonly texture = new Texture<ImageBitmap>();
  private readonly material = new MeshBasicMaterial({ color: EMPTY });
  private readonly plane = new Mesh(new PlaneGeometry(1, 1), this.material);
  private readonly label = new Label(0.024);

  constructor(
    readonly slot: number,
    aspect: number,
  ) {
    const { texture, label } = this;
    texture.generateMipmaps = false;
    texture.minFilter = texture.magFilter = LinearFilter;
    // The first row of an image is at v = 0: browsers do not flip bitmaps.
    texture.flipY = false;
    texture.repeat.y = -1;
    texture.offset.y = 1;
    label.sprite.center.set(0.5, 1);
    this.object.add(this.plane, label.sprite);
    this.fit(aspect);
  }

  /** Show a picture instead of the one before. Its memory on the graphics card is taken again if it has the same size. */
  show(bitmap: ImageBitmap): void {
    const { texture, material } = this;
    const before = texture.image as ImageBitmap | null;
    if (before?.width !== bitmap.width || before.height !== bitmap.height) {
      texture.dispose();
      this.fit(bitmap.width / bitmap.height);
    }
    before?.close();
    texture.image = bitmap;
    texture.needsUpdate = true;
    if (before) return;
    material.map = texture;
    material.color.set(CLEAR);
    material.needsUpdate = true;
  }

  /** Say what is shown, how old it is and what is wrong with it. */
  describe(one: Stream, state: PageState): void {
    const hasPicture = this.material.map !== null;
    const { age, text, isBad } = describePicture(one, state, hasPicture);
    const lines = [...wrap(one.title || one.stream), age, ...wrap(text)];
    this.label.setText(lines.filter((line) => line !== ""), isBad ? BAD_COLOR : COLOR);
    if (hasPicture) this.material.color.set(isBad ? DIMMED : CLEAR);
  }

  place(stand: Stand): void {
    const [x, y, z, qx, qy, qz, qw] = toRow(placePanel(stand, this.slot)) as [number, number, number, number, number, number, number];
    this.object.position.set(x, y, z);
    this.object.quaternion.set(qx, qy, qz, qw);
  }

  dispose(): void {
    (this.texture.image as ImageBitmap | null)?.close();
    this.texture.dispose();
    this.material.dispose();
    this.plane.geometry.dispose();
    this.label.dispose();
    this.object.removeFromParent();
  }

  private fit(aspect: number): void {
    const [width, height] = fitPicture(aspect);
    this.plane.scale.set(width, height, 1);
    this.label.sprite.position.y = -height / 2 - GAP_M;
  }
}
