// From frames of WebXR to readings: poses of head, controllers and hands in the tracking frame.
//
// Time of capture is that at which the frame's callback begins. WebXR predicts poses for the time of display and tells
// neither that time nor when the sensors were read; the callback lies between them, and the session wants the time of
// capture, never that of display.
//
// `emulatedPosition` is true of a pose whose position is not actively tracked: an estimate, or the last known one (WebXR Device
// API, "populate the pose"). A ray has a fixed place on its controller, so it is measured when the grip is.

import { nowMs } from "../core/api.ts";
import type * as wire from "../protocol/messages.g.ts";
import { type FrameReading, type InputReading, packButtons, readGesture, type Side, STOP_BUTTONS, toPose, toRay } from "./reading.ts";

/** Least time between two readings of all joints of the hands [ms]: 50 poses are 3 kB. */
const JOINTS_PERIOD_MS = 33;
const LOST = { tracked: false, emulated: false };

/** Reads frames of one session. Keeps the last known poses: a lost device is reported where it was, as not tracked. */
export class FrameReader {
  private head: wire.Pose | null = null;
  private readonly poses = new Map<string, wire.Pose>();
  private joints_ms = Number.NEGATIVE_INFINITY;

  constructor(private readonly session: XRSession) {}

  /** Read a frame. `space`: the tracking frame. */
  read(frame: XRFrame, space: XRReferenceSpace): FrameReading {
    const capture_ms = nowMs();
    const viewer = frame.getViewerPose(space);
    if (viewer) this.head = toPose(viewer.transform.position, viewer.transform.orientation);
    const inputs: InputReading[] = [];
    const wantsJoints = capture_ms - this.joints_ms >= JOINTS_PERIOD_MS;
    if (wantsJoints) this.joints_ms = capture_ms;
    for (const source of this.session.inputSources) {
      const { handedness: side } = source;
      if (side === "none" || inputs.some((input) => input.side === side)) continue;
      inputs.push(this.readInput(frame, space, source, side, wantsJoints));
    }
    const stops = [...this.session.inputSources].filter(isStopPressed);
    const { tracked: headTracked, emulated: headEmulated } = judgePoses(viewer);
    return { capture_ms, head: this.head, headTracked, headEmulated, inputs, stops };
  }

  private readInput(frame: XRFrame, space: XRReferenceSpace, source: XRInputSource, side: Side, wantsJoints: boolean): InputReading {
    const kind = source.hand ? "hand" : "controller";
    const aim = frame.getPose(source.targetRaySpace, space);
    const ray = aim ? toRay(toPose(aim.transform.position, aim.transform.orientation)) : null;
    const key = `${kind}/${side}`;
    if (source.hand) {
      const joints = wantsJoints ? readJoints(frame, space, source.hand) : [];
      return { side, kind, ray, buttons: 0, joints, ...this.readHand(frame, space, source.hand, key) };
    }
    // Where it is held, looking to where it points: one rigid frame of the controller, whose x axis others see as a ray.
    // One that is lost is nowhere: the origin of its ray is 6 cm from the grip, and a robot would follow that jump.
    const at = source.gripSpace ? frame.getPose(source.gripSpace, space) : aim;
    if (at && aim) this.poses.set(key, toPose(at.transform.position, aim.transform.orientation));
    const buttons = source.gamepad?.buttons ?? [];
    return {
      side,
      kind,
      ray,
      pose: this.poses.get(key) ?? null,
      ...judgePoses(at, aim),
      trigger: buttons[0]?.value ?? 0,
      squeeze: buttons[1]?.value ?? 0,
      buttons: packButtons(buttons.map(({ pressed }) => pressed)),
      tip: null,
      joints: [],
    };
  }

  /** Read a hand: its pose is that of the wrist. */
  private readHand(frame: XRFrame, space: XRReferenceSpace, hand: XRHand, key: string): Pick<InputReading, "pose" | "tracked" | "emulated" | "trigger" | "squeeze" | "tip"> {
    const find = (name: XRHandJoint): XRJointPose | undefined => {
      const joint = hand.get(name);
      return joint && frame.getJointPose?.(joint, space);
    };
    const wrist = find("wrist");
    if (wrist) this.poses.set(key, toPose(wrist.transform.position, wrist.transform.orientation));
    const tips = [find("thumb-tip"), find("index-finger-tip"), find("middle-finger-tip"), find("middle-finger-phalanx-proximal"), wrist];
    const [thumb, index, middle, knuckle, at] = tips.map((joint) => joint && toPose(joint.transform.position, joint.transform.orientation)[0]);
    const isWhole = thumb && index && middle && knuckle && at;
    const gesture = isWhole ? readGesture({ thumb, index, middle, knuckle, wrist: at }) : { trigger: 0, squeeze: 0 };
    const { tracked, emulated } = isWhole ? judgePoses(wrist) : LOST;
    return { pose: this.poses.get(key) ?? null, tracked, emulated, tip: (tracked && index) || null, ...gesture };
  }
}

/** Return whether a button of the e-stop is pressed: of any device, tracked or not. */
function isStopPressed({ gamepad }: XRInputSource): boolean {
  return (packButtons((gamepad?.buttons ?? []).map(({ pressed }) => pressed)) & STOP_BUTTONS) !== 0;
}

/** Return whether what has these poses is measured, or its position is an estimate. Neither: it is lost. */
function judgePoses(...poses: readonly (XRPose | null | undefined)[]): typeof LOST {
  if (poses.some((pose) => !pose)) return LOST;
  const emulated = poses.some((pose) => pose?.emulatedPosition);
  return { tracked: !emulated, emulated };
}

/** Return the poses of a hand's joints, as in `Sample.hand_joints`; none unless all are known. */
function readJoints(frame: XRFrame, space: XRReferenceSpace, hand: XRHand): number[] {
  const poses = [...hand.values()].map((joint) => frame.getJointPose?.(joint, space));
  if (!poses.every((pose) => pose !== undefined && pose !== null)) return [];
  return poses.flatMap(({ transform }) => toPose(transform.position, transform.orientation).flat());
}
