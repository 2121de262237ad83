// Short texts in the scene, always facing the viewer. Text is drawn on a canvas, never parsed.

import { CanvasTexture, LinearFilter, Sprite, SpriteMaterial } from "three";

const FONT_PX = 44;
const PADDING_PX = 18;
const LINE_PX = 54;
const MAX_CHARACTERS = 48;

/** A label of one or two lines. `height_m`: of a line in the scene. */
export class Label {
  readonly sprite: Sprite;
  private readonly canvas = document.createElement("canvas");
  private shown = "";

  constructor(private height_m: number) {
    this.sprite = new Sprite(new SpriteMaterial({ transparent: true, depthWrite: false, toneMapped: false }));
    this.sprite.renderOrder = 10;
    this.sprite.visible = false;
  }

  /** Show lines of text; `color` is that of a stripe at the left. */
  setText(lines: readonly string[], color: string): void {
    const key = JSON.stringify([lines, color]);
    if (key === this.shown) return;
    this.shown = key;
    this.sprite.visible = lines.length > 0;
    const context = this.canvas.getContext("2d");
    if (!context || lines.length === 0) return;
    const texts = lines.map((line) => (line.length > MAX_CHARACTERS ? `${line.slice(0, MAX_CHARACTERS - 1)}…` : line));
    const font = (line: number): string => `${line === 0 ? 600 : 400} ${FONT_PX}px system-ui, "DejaVu Sans", sans-serif`;
    const widths = texts.map((text, line) => {
      context.font = font(line);
      return context.measureText(text).width;
    });
    this.canvas.width = Math.ceil(Math.max(...widths) + 2 * PADDING_PX + 10);
    this.canvas.height = LINE_PX * texts.length + PADDING_PX;
    context.fillStyle = "rgba(15, 18, 24, 0.82)";
    context.beginPath();
    context.roundRect(0, 0, this.canvas.width, this.canvas.height, 14);
    context.fill();
    context.fillStyle = color;
    context.fillRect(0, 10, 8, this.canvas.height - 20);
    context.textBaseline = "middle";
    texts.forEach((text, line) => {
      context.font = font(line);
      context.fillStyle = line === 0 ? "#ffffff" : "#c9d2e0";
      context.fillText(text, PADDING_PX + 6, PADDING_PX / 2 + LINE_PX * (line + 0.5));
    });
    const texture = new CanvasTexture(this.canvas);
    texture.minFilter = texture.magFilter = LinearFilter;
    texture.generateMipmaps = false;
    this.sprite.material.map?.dispose();
    this.sprite.material.map = texture;
    this.sprite.material.needsUpdate = true;
    this.setHeight(this.height_m);
  }

  /** Set the height of a line in the scene [m]. */
  setHeight(height_m: number): void {
    this.height_m = height_m;
    const scale = height_m / LINE_PX;
    this.sprite.scale.set(this.canvas.width * scale, this.canvas.height * scale, 1);
  }

  dispose(): void {
    this.sprite.material.map?.dispose();
    this.sprite.material.dispose();
    this.sprite.removeFromParent();
  }
}
