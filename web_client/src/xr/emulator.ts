// A headset without hardware: an emulated Quest 3 (iwer, licence MIT) that mouse and keys move. Loaded when it is asked for.

import { metaQuest3, XRDevice } from "iwer";
import { Euler, Quaternion, Vector3 } from "three";

import { h } from "../ui/dom.ts";

const HELP = [
  "Emulated headset: Esc leaves it, Space is the e-stop.",
  "The mouse points with the right controller; its left button is the trigger.",
  "Shift squeezes: the hand follows the mouse, and the wheel nearer and farther.",
  "Right button and mouse, or arrows, look around. W A S D walk, R and F go up and down. 1 is A, 2 is B.",
];
/** Metres and radians per second of a key, and per pixel of the mouse; metres per unit of the wheel. */
const [WALK, TURN] = [0.8, 1.2];
const [HAND_PER_PIXEL, LOOK_PER_PIXEL, HAND_PER_WHEEL] = [0.001, 0.003, 0.0004];
/** Places of the hands before the head, and how far away the mouse points [m]. */
const [RIGHT, LEFT, FAR] = [new Vector3(0.16, -0.22, -0.4), new Vector3(-0.2, -0.3, -0.35), 2];
/** Measured poses are never the same twice: these move by less than 0.1 mm. */
const TREMBLE_M = 5e-5;
const WALKS: Readonly<Record<string, readonly [number, number, number]>> = {
  KeyW: [0, 0, -1], KeyS: [0, 0, 1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyR: [0, 1, 0], KeyF: [0, -1, 0],
};
const TURNS: Readonly<Record<string, readonly [number, number]>> = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** Replace the WebXR of this browser by an emulated headset. Sessions begin as with any other one. */
export function installEmulator(): void {
  const device = new XRDevice(metaQuest3, { visibilityMask: null });
  device.installRuntime({ forceInstall: true });
  // It says of every pose that it is an estimate; headsets say so of devices that their cameras do not see.
  Object.defineProperty(XRPose.prototype, "emulatedPosition", { get: () => false });
  new Person(device).live();
}

/** Who wears it. */
class Person {
  private readonly pressed = new Set<string>();
  /** Let go since the last frame: a short press counts for one, too. */
  private readonly released = new Set<string>();
  private readonly head = new Vector3(0, 1.6, 0);
  private readonly look = new Euler(-0.25, 0, 0, "YXZ");
  /** Place of the right hand in the frame of the head, and where it points: fixed while it squeezes. */
  private readonly hand = RIGHT.clone();
  private readonly aim = new Quaternion();
  /** Where the mouse is in the picture, from -1 to 1. */
  private readonly mouse = { x: 0, y: 0 };
  private readonly help = h("div", { class: "emulator-help" }, ...HELP.map((line) => h("p", {}, line)));
  private beat = 0;
  private last_ms = 0;

  constructor(private readonly device: XRDevice) {
    const listen = <K extends keyof WindowEventMap>(type: K, take: (event: WindowEventMap[K]) => void): void =>
      window.addEventListener(
        type,
        (event) => {
          if (!this.device.activeSession) return;
          take(event);
          if (event.cancelable && !(event instanceof KeyboardEvent)) event.preventDefault();
          if (!(event instanceof KeyboardEvent && event.code === "Space")) event.stopPropagation(); // the page has keys of its own
        },
        { capture: true, passive: false },
      );
    listen("keydown", (event) => this.press(event));
    listen("keyup", ({ code }) => this.released.add(code));
    listen("pointerdown", ({ button }) => this.pressed.add(`mouse ${button}`));
    listen("pointerup", ({ button }) => this.released.add(`mouse ${button}`));
    listen("pointermove", (event) => this.moveMouse(event));
    listen("wheel", ({ deltaY }) => this.isSqueezing && this.hand.setZ(this.hand.z + HAND_PER_WHEEL * deltaY));
    listen("contextmenu", () => undefined);
    window.addEventListener("blur", () => this.pressed.clear());
  }

  /** Move with every frame of the screen. */
  live(): void {
    requestAnimationFrame((now_ms) => {
      const seconds = Math.min(0.1, (now_ms - this.last_ms) / 1000);
      this.last_ms = now_ms;
      const isInside = this.device.activeSession !== undefined;
      if (isInside !== this.help.isConnected) this.changePage(isInside);
      if (isInside) this.move(seconds);
      this.live();
    });
  }

  /** The emulator takes the picture out of the page, and puts it back above the bar that lies over it. */
  private changePage(isInside: boolean): void {
    this.pressed.clear();
    if (isInside) return document.body.append(this.help);
    this.help.remove();
    const picture = document.querySelector("#scene");
    picture?.parentElement?.prepend(picture);
  }

  private get isSqueezing(): boolean {
    return this.pressed.has("ShiftLeft") || this.pressed.has("ShiftRight");
  }

  private press({ code }: KeyboardEvent): void {
    if (code === "Escape") void this.device.activeSession?.end();
    else this.pressed.add(code);
  }

  private moveMouse({ clientX, clientY, movementX, movementY }: PointerEvent): void {
    if (this.pressed.has("mouse 2")) {
      this.look.y -= LOOK_PER_PIXEL * movementX;
      this.look.x -= LOOK_PER_PIXEL * movementY;
    }
    if (this.isSqueezing) {
      this.hand.x += HAND_PER_PIXEL * movementX;
      this.hand.y -= HAND_PER_PIXEL * movementY;
    }
    this.mouse.x = (2 * clientX) / innerWidth - 1;
    this.mouse.y = 1 - (2 * clientY) / innerHeight;
  }

  private move(seconds: number): void {
    const { device, head, look } = this;
    for (const key of this.pressed) {
      const [yaw, pitch] = TURNS[key] ?? [0, 0];
      look.y += TURN * seconds * yaw;
      look.x = Math.min(1.4, Math.max(-1.4, look.x + TURN * seconds * pitch));
      const walk = new Vector3(...(WALKS[key] ?? [0, 0, 0])).multiplyScalar(WALK * seconds);
      head.add(walk.applyAxisAngle(new Vector3(0, 1, 0), look.y));
    }
    const turn = new Quaternion().setFromEuler(look);
    const right = this.hand.clone().applyQuaternion(turn).add(head);
    if (!this.isSqueezing) {
      const high = FAR * Math.tan(device.fovy / 2);
      const target = new Vector3(((high * innerWidth) / innerHeight) * this.mouse.x, high * this.mouse.y, -FAR);
      const way = target.applyQuaternion(turn).add(head).sub(right).normalize();
      this.aim.setFromUnitVectors(new Vector3(0, 0, -1), way);
    }
    const shift = TREMBLE_M * Math.cos(this.beat++);
    const place = (at: { position: XRDevice["position"]; quaternion: XRDevice["quaternion"] } | undefined, p: Vector3, q: Quaternion): void => {
      at?.position.set(p.x + shift, p.y, p.z);
      at?.quaternion.set(q.x, q.y, q.z, q.w);
    };
    place(device, head, turn);
    place(device.controllers.right, right, this.aim);
    place(device.controllers.left, LEFT.clone().applyQuaternion(turn).add(head), turn);
    const buttons: [string, boolean][] = [
      ["trigger", this.pressed.has("mouse 0")], ["squeeze", this.isSqueezing],
      ["a-button", this.pressed.has("Digit1")], ["b-button", this.pressed.has("Digit2")],
    ];
    for (const [name, isPressed] of buttons) device.controllers.right?.updateButtonValue(name, isPressed ? 1 : 0);
    for (const key of this.released) this.pressed.delete(key);
    this.released.clear();
  }
}
