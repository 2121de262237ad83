// Requests of the dashboard. A denial, or no answer, is shown in words; nothing is repeated by itself.

import type { Reply, RequestMessage } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import type * as wire from "../protocol/messages.g.ts";
import type { EventLevel } from "./words.ts";
import { denialWords } from "./words.ts";

export class Actions {
  constructor(
    private readonly client: WorkerClient,
    private readonly show: (text: string, level: EventLevel) => void,
  ) {}

  /** Send a request. Returns whether it was granted; shows why not. */
  async request(message: RequestMessage, done = ""): Promise<boolean> {
    let reply: Reply;
    try {
      reply = await this.client.request(message);
    } catch (error) {
      this.show(`Not sent: ${(error as Error).message}`, "error");
      return false;
    }
    if (reply.ok) {
      if (done) this.show(done, "info");
      return true;
    }
    this.show(reply.denial ? denialWords(reply.denial) : "The session refused without a reason.", "warning");
    return false;
  }

  release(targets: wire.Target[]): void {
    this.client.post({ type: "send", message: { type: "release", targets } });
  }

  estop(reason: string): void {
    this.client.post({ type: "estop", reason });
  }
}
