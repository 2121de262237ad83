// The page's end of the worker.

import { expect, test } from "vitest";
import type { FromWorker, Reply, ToWorker } from "../src/core/api.ts";
import { RequestError, WorkerClient, type WorkerPort } from "../src/core/page_client.ts";

class FakePort implements WorkerPort {
  posted: ToWorker[] = [];
  onmessage: WorkerPort["onmessage"] = null;

  postMessage(message: ToWorker): void {
    this.posted.push(message);
  }

  say(update: FromWorker): void {
    this.onmessage?.({ data: update } as MessageEvent<FromWorker>);
  }
}

test("listeners get the updates of their type until they end", () => {
  const port = new FakePort();
  const client = new WorkerClient(port);
  const texts: string[] = [];
  const end = client.on("notice", ({ text }) => texts.push(text));
  client.on("stats", () => texts.push("stats"));
  port.say({ type: "notice", level: "info", text: "one" });
  end();
  port.say({ type: "notice", level: "info", text: "two" });
  expect(texts).toEqual(["one"]);
});

test("requests are promises", async () => {
  const port = new FakePort();
  const client = new WorkerClient(port);
  const first = client.request({ type: "marker", text: "a" });
  const second = client.request({ type: "marker", text: "b" });
  expect(port.posted).toMatchObject([{ type: "request", id: 1, message: { text: "a" } }, { type: "request", id: 2 }]);
  const reply: Reply = { type: "reply", request_id: 7, ok: true, denial: null, leases: [] };
  port.say({ type: "reply", id: 2, reply, error: "" });
  port.say({ type: "reply", id: 1, reply: null, error: "the connection was lost" });
  port.say({ type: "reply", id: 99, reply: null, error: "of another" });
  await expect(second).resolves.toEqual(reply);
  await expect(first).rejects.toThrow(RequestError);
});

test("buffers of frames go back", () => {
  const port = new FakePort();
  new WorkerClient(port).recycle(new Float32Array(7));
  expect(port.posted[0]).toMatchObject({ type: "recycle" });
});

test("a cloud or a picture that came is taken, so that the worker passes on the next one", () => {
  const port = new FakePort();
  const client = new WorkerClient(port);
  client.on("picture", () => undefined);
  port.say({ type: "picture", stream: "front", bitmap: {} as ImageBitmap, capture_ms: 1, received_ms: 1 });
  port.say({ type: "deformable", stream: "cloth", vertices: new Float32Array(), surface: null, session_ms: 1, scene_epoch: 1, seq: 1, bound_m: 0 });
  expect(port.posted).toEqual([{ type: "taken", stream: "front" }]);
});
