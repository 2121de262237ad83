// From frames of WebXR to readings: poses of head, controllers and hands in the tracking frame.
//
// Time of capture is that at which the frame's callback begins. WebXR predicts poses for the time of display and tells
// neither that time nor when the sensors were read; the callback lies between them, and the session wants the time of
// capture, never that of display.

import { nowMs } from "../core/api.ts";
import type * as wire from "../protocol/messages.g.ts";
import { type FrameReading, type InputReading, packButtons, readGesture, type Side, toPose, toRay, type Vec3 } from "./reading.ts";

/** Reads frames of one session. Keeps the last known poses: a lost device is reported where it was, as not tracked. */
export class FrameReader {
  private head: wire.Pose | null = null;
  private readonly poses = new Map<string, wire.Pose>();

  constructor(private readonly session: XRSession) {}

  /** Read a frame. `space`: the tracking frame. */
  read(frame: XRFrame, space: XRReferenceSpace): FrameReading {
    const capture_ms = nowMs();
    const viewer = frame.getViewerPose(space);
    if (viewer) this.head = toPose(viewer.transform.position, viewer.transform.orientation);
    const inputs: InputReading[] = [];
    for (const source of this.session.inputSources) {
      const { handedness: side } = source;
      if (side === "none" || inputs.some((input) => input.side === side)) continue;
      inputs.push(this.readInput(frame, space, source, side));
    }
    return { capture_ms, head: this.head, headTracked: isTracked(viewer), inputs };
  }

  private readInput(frame: XRFrame, space: XRReferenceSpace, source: XRInputSource, side: Side): InputReading {
    const kind = source.hand ? "hand" : "controller";
    const aim = frame.getPose(source.targetRaySpace, space);
    const ray = aim ? toRay(toPose(aim.transform.position, aim.transform.orientation)) : null;
    const key = `${kind}/${side}`;
    if (source.hand) return { side, kind, ray, buttons: 0, ...this.readHand(frame, space, source.hand, key) };
    // Where it is held, looking to where it points: one rigid frame of the controller, whose x axis others see as a ray.
    const held = source.gripSpace ? (frame.getPose(source.gripSpace, space) ?? null) : null;
    const at = held ?? aim;
    if (at && aim) this.poses.set(key, toPose(at.transform.position, aim.transform.orientation));
    const buttons = source.gamepad?.buttons ?? [];
    return {
      side,
      kind,
      ray,
      pose: this.poses.get(key) ?? null,
      tracked: isTracked(at) && isTracked(aim),
      trigger: buttons[0]?.value ?? 0,
      squeeze: buttons[1]?.value ?? 0,
      buttons: packButtons(buttons.map(({ pressed }) => pressed)),
    };
  }

  /** Read a hand: its pose is that of the wrist. */
  private readHand(frame: XRFrame, space: XRReferenceSpace, hand: XRHand, key: string): Pick<InputReading, "pose" | "tracked" | "trigger" | "squeeze"> {
    const find = (name: XRHandJoint): XRJointPose | undefined => {
      const joint = hand.get(name);
      return joint && frame.getJointPose?.(joint, space);
    };
    const wrist = find("wrist");
    if (wrist) this.poses.set(key, toPose(wrist.transform.position, wrist.transform.orientation));
    const tips = [find("thumb-tip"), find("index-finger-tip"), find("middle-finger-tip"), find("middle-finger-phalanx-proximal"), wrist];
    const [thumb, index, middle, knuckle, at] = tips.map((joint) => joint && toVec3(joint.transform.position));
    const isWhole = thumb && index && middle && knuckle && at;
    const gesture = isWhole ? readGesture({ thumb, index, middle, knuckle, wrist: at }) : { trigger: 0, squeeze: 0 };
    return { pose: this.poses.get(key) ?? null, tracked: Boolean(isWhole) && isTracked(wrist), ...gesture };
  }
}

/** Return whether a pose was measured: there is one, and its position is not a guess. */
function isTracked(pose: XRPose | XRViewerPose | null | undefined): boolean {
  return pose !== null && pose !== undefined && !pose.emulatedPosition;
}

function toVec3({ x, y, z }: DOMPointReadOnly): Vec3 {
  return [x, y, z];
}
