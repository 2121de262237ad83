// Samples with the numbers that fence them: epochs, versions, fencing tokens and `seq`.

import type * as wire from "../protocol/messages.g.ts";
import type { SampleInput } from "./api.ts";
import type { ClientConnection } from "./connection.ts";
import { InvalidMessageError } from "./errors.ts";

/** Makes samples of one connection. `seq` counts per device, over all connections. */
export class SampleBuilder {
  private readonly seq = new Map<string, number>();

  constructor(private readonly connection: ClientConnection) {}

  /**
   * Make a sample that was taken at session time `captureNs`.
   *
   * Robots and objects that are not ours are left out and counted. Throws `InvalidMessageError` for those that the session
   * does not have.
   */
  makeSample(input: Omit<SampleInput, "capture_ms">, captureNs: number): wire.Sample {
    const { connection } = this;
    const { robots = [], objects = [], device, kind, ...fields } = input;
    const targets = [...this.findHeld(robots, "robot"), ...this.findHeld(objects, "object")];
    const seq = (this.seq.get(device) ?? 0) + 1;
    this.seq.set(device, seq);
    return {
      type: "sample",
      device,
      kind: kind ?? ((input.q?.length ?? 0) > 0 ? "joints" : input.twist ? "twist" : "pose"),
      seq,
      capture_ns: captureNs,
      scene_epoch: connection.mirror.sceneEpoch,
      tracking_epoch: connection.trackingEpoch,
      alignment_version: connection.mirror.findAlignment(connection.participantId)?.version ?? 0,
      worn: connection.worn,
      ...fields,
      targets,
    };
  }

  private findHeld(names: readonly string[], kind: wire.TargetKind): wire.Target[] {
    const targets: wire.Target[] = [];
    for (const name of names) {
      const token = this.connection.leaseVersion(name);
      if (token !== null) {
        targets.push([name, token, kind]);
        continue;
      }
      const known = this.listKnown(kind);
      if (known.size > 0 && !known.has(name)) {
        throw new InvalidMessageError(`no ${kind} ${JSON.stringify(name)} in this session, it has: ${[...known].join(", ")}`);
      }
      this.connection.counters.samplesWithoutLease += 1;
    }
    return targets;
  }

  /** Return the names of the session's robots or objects; none before the first snapshot. */
  private listKnown(kind: wire.TargetKind): Set<string> {
    const { mirror } = this.connection;
    if (kind === "robot") return new Set(mirror.robots.keys());
    const leased = [...mirror.leases.values()].filter((lease) => lease.kind === kind).map((lease) => lease.target);
    return new Set([...leased, ...mirror.bodies.filter(([, , , object]) => object).map(([, name]) => name)]);
  }
}
