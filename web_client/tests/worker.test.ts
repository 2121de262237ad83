// The worker with a session in memory: sockets, clock, timers and assets are those of the test.

import { createHash } from "node:crypto";
import { beforeEach, describe, expect, test } from "vitest";
import type { FromWorker, ToWorker } from "../src/core/api.ts";
import { ClientWorker } from "../src/core/client_worker.ts";
import { decodeClient, encodeStruct } from "../src/core/codec.ts";
import { decodeTopology } from "../src/core/deformable.ts";
import { decodeValue, encodeValue } from "../src/core/msgpack.ts";
import { hashSecret, makeProof, stretchCode } from "../src/core/pairing.ts";
import type { SocketLike } from "../src/core/pairing_client.ts";
import { MemoryStore } from "../src/core/storage.ts";
import { unpackMessage } from "../src/core/wire.ts";
import { fromHex, readGolden } from "./golden.ts";
import { makeJpeg } from "./jpegs.ts";

const MS = 1_000_000;
const OFFSET_NS = 5_000 * MS;
const BASE = "https://robot:7725";
const S = Uint8Array.from({ length: 32 }, (_, i) => i);
const BODIES = [[1, "hand", true], [2, "cup", true, true]];

type Message = Record<string, unknown> & { type: string };

/** A WebSocket whose other end is the test. */
class FakeSocket implements SocketLike {
  binaryType: BinaryType = "blob";
  readyState = 0;
  bufferedAmount = 0;
  onopen: SocketLike["onopen"] = null;
  onmessage: SocketLike["onmessage"] = null;
  onclose: SocketLike["onclose"] = null;
  onerror: SocketLike["onerror"] = null;
  sent: { channel: number; frames: Uint8Array[] }[] = [];

  constructor(readonly url: string) {}

  send(data: Uint8Array<ArrayBuffer>): void {
    this.sent.push(unpackMessage(data.slice()));
  }

  close(): void {
    this.readyState = 3;
  }

  open(): void {
    this.readyState = 1;
    this.onopen?.(new Event("open"));
  }

  /** The gateway closes it. */
  end(code: number, reason = ""): void {
    this.readyState = 3;
    this.onclose?.({ code, reason } as CloseEvent);
  }

  deliver(channel: number, ...frames: Uint8Array[]): void {
    const head = new Uint8Array(2 + 4 * frames.length);
    head[0] = channel;
    head[1] = frames.length;
    for (const [i, frame] of frames.entries()) new DataView(head.buffer).setUint32(2 + 4 * i, frame.length, true);
    const whole = new Uint8Array(Buffer.concat([head, ...frames]));
    this.onmessage?.({ data: whole.buffer } as MessageEvent);
  }

  /** Messages of the control channel. */
  messages(): Message[] {
    return this.sent.filter(({ channel }) => channel === 1).map(({ frames }) => decodeClient(frames[0] as Uint8Array)[3] as unknown as Message);
  }

  find(type: string): Message[] {
    return this.messages().filter((message) => message.type === type);
  }
}

type FakeImage = ArrayBuffer & { isClosed: boolean };

/** Everything around a worker. */
class Bench {
  now = 0;
  updates: FromWorker[] = [];
  sockets: FakeSocket[] = [];
  timers = new Map<number, { at: number; callback: () => void }>();
  assets = new Map<string, Uint8Array>();
  requests: { url: string; headers: Record<string, string> }[] = [];
  store = new MemoryStore();
  info: object | null = { versions: [1], session_name: "lab", session_id: "s1", key: Buffer.from(S).toString("base64url"), pairing: true, software: "x" };
  status = 206;
  /** Images that are being decoded. Buffers stand for decoded ones. */
  decoding: { bytes: Uint8Array; width: number; finish: () => FakeImage; fail: () => void }[] = [];
  worker: ClientWorker;
  private nextTimer = 1;

  constructor() {
    this.worker = new ClientWorker({
      post: (update, transfer) => this.updates.push(structuredClone(update, { transfer })),
      nowNs: () => this.now,
      sharedOriginMs: 1000,
      openSocket: (url) => {
        const socket = new FakeSocket(url);
        this.sockets.push(socket);
        return socket;
      },
      fetch: async (url, init) => this.respond(url, init),
      setTimer: (ms, callback) => {
        const id = this.nextTimer++;
        this.timers.set(id, { at: this.now + ms * MS, callback });
        return () => this.timers.delete(id);
      },
      decodeImage: (bytes, width) => this.decodeImage(bytes, width),
      store: this.store,
      slot: "0",
      run: "0011223344556677",
    });
  }

  decodeImage(bytes: Uint8Array, width: number): Promise<ImageBitmap> {
    return new Promise((resolve, reject) => {
      const finish = (): FakeImage => {
        const image = Object.assign(new ArrayBuffer(4), { isClosed: false, close: () => void (image.isClosed = true) });
        resolve(image as unknown as ImageBitmap);
        return image;
      };
      this.decoding.push({ bytes, width, finish, fail: () => reject(new Error("damaged")) });
    });
  }

  async respond(url: string, init: RequestInit): Promise<Response> {
    if (url.endsWith("/v1/info")) {
      if (this.info === null) throw new TypeError("unreachable");
      return Response.json(this.info);
    }
    const headers = init.headers as Record<string, string>;
    this.requests.push({ url, headers });
    const address = url.slice(-64);
    const bytes = this.assets.get(address);
    if (bytes === undefined) return new Response("unknown", { status: 404 });
    if (this.status !== 206) return new Response("later", { status: this.status });
    const [, first, last] = /bytes=(\d+)-(\d+)/.exec(headers["Range"] ?? "") ?? [];
    const end = Math.min(Number(last) + 1, bytes.length);
    const part = bytes.slice(Number(first), end);
    return new Response(part, { status: 206, headers: { "Content-Range": `bytes ${first}-${end - 1}/${bytes.length}` } });
  }

  get socket(): FakeSocket {
    return this.sockets.at(-1) as FakeSocket;
  }

  post(command: ToWorker): void {
    this.worker.receive(command);
  }

  /** Let promises settle. */
  async settle(): Promise<void> {
    for (let i = 0; i < 5; i++) await new Promise((resolve) => setTimeout(resolve, 2));
  }

  /** Let promises settle until something holds. */
  async until(holds: () => boolean): Promise<void> {
    for (let i = 0; i < 500 && !holds(); i++) await this.settle();
    expect(holds()).toBe(true);
  }

  /** Pass time, timer by timer. */
  pass(ms: number): void {
    const end = this.now + ms * MS;
    for (;;) {
      const due = [...this.timers].filter(([, timer]) => timer.at <= end).sort((a, b) => a[1].at - b[1].at)[0];
      if (due === undefined) break;
      this.timers.delete(due[0]);
      this.now = Math.max(this.now, Math.ceil(due[1].at));
      due[1].callback();
      this.answerPings();
    }
    this.now = end;
  }

  answerPings(): void {
    for (const socket of this.sockets.filter(({ readyState, url }) => readyState === 1 && url.endsWith("session"))) {
      const pings = socket.sent.filter(({ channel, frames }) => channel === 1 && (decodeClient(frames[0] as Uint8Array)[3] as Message).type === "clock_ping");
      socket.sent = socket.sent.filter((message) => !pings.includes(message));
      for (const { frames } of pings) {
        const [, epoch, , message] = decodeClient(frames[0] as Uint8Array);
        const { t0_ns } = message as unknown as { t0_ns: number };
        const at = this.now + OFFSET_NS;
        this.now += MS;
        this.say({ type: "clock_pong", t0_ns, t1_ns: at, t2_ns: at }, epoch, [], socket);
      }
    }
  }

  say(message: object, epoch = 1, bulk: Uint8Array[] = [], socket = this.socket): void {
    socket.deliver(1, encodeStruct("ServerEnvelope", [1, epoch, message]), ...bulk);
  }

  of<K extends FromWorker["type"]>(type: K): Extract<FromWorker, { type: K }>[] {
    return this.updates.filter((update) => update.type === type) as Extract<FromWorker, { type: K }>[];
  }

  last<K extends FromWorker["type"]>(type: K): Extract<FromWorker, { type: K }> {
    return this.of(type).at(-1) as Extract<FromWorker, { type: K }>;
  }

  async connect(): Promise<void> {
    const before = this.sockets.length;
    this.post({ type: "connect", base_url: BASE, role: "operator", name: "ann", devices: ["desktop"], alignment: "not_needed" });
    await this.until(() => this.sockets.length > before);
    this.socket.open();
  }

  welcome(epoch = 1, resumed = false, session_id = "s1"): void {
    const times = { session_time: this.now + OFFSET_NS, heartbeat_ns: 1000 * MS, tick_period_ns: 2 * MS, state_period_ns: 16 * MS };
    const who = { session_id, session_name: "lab", kind: "live", participant_id: "p1", role: "operator" };
    this.say({ type: "welcome", ...who, ...times, connection_epoch: epoch, resume_token: new Uint8Array([epoch]), resumed, endpoints: {} }, epoch);
  }

  snapshot(sceneHash: string, epoch = 1, fields: object = {}): void {
    const seqs = { request_id: 0, event_seq: 3, scene_epoch: 1, scene_revision: 0, scene_hash: sceneHash, tick: 1, sim_time: 0, session_time: 0, state_seq: 10 };
    const ann = { id: "p1", name: "ann", role: "operator", connected: true };
    const lease = { target: "left", kind: "robot", mode: "exclusive", holder: "p1", lease_version: 4 };
    const robot = { name: "left", joints: ["j1"], base_body: 1, site_body: 1, T_body_site: [[0, 0, 0], [1, 0, 0, 0]], gripper: true };
    const anchor = { id: "desk", T_world_anchor: [[1, 0, 0], [1, 0, 0, 0]], size_m: 0.2 };
    const bulk = new Float64Array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 0, 0, 0]);
    this.say({ type: "snapshot", ...seqs, participants: [ann], leases: [lease], robots: [robot], bodies: BODIES, anchors: [anchor], ...fields }, epoch, [new Uint8Array(bulk.buffer)]);
  }

  async join(sceneHash = "none"): Promise<void> {
    await this.connect();
    this.welcome();
    this.snapshot(sceneHash);
    this.pass(60);
  }

  state(seq: number): void {
    const time = this.now + OFFSET_NS;
    const header = encodeStruct("StateHeader", [1, 0, 100 + seq, 0.2, time - 2 * MS, time - MS, seq, 0, []]);
    this.socket.deliver(2, new TextEncoder().encode("rigid"), header, fromHex("02000200020000000008000000400000000000000000fc7f0000fc7f0000fc7f0040fc7f0000fc7f0000fc7f"));
  }
}

let bench: Bench;
beforeEach(() => {
  bench = new Bench();
});

describe("joining", () => {
  test("from hello to the first frame", async () => {
    await bench.connect();
    expect(bench.socket.url).toBe("wss://robot:7725/v1/session");
    const [hello] = bench.socket.find("hello");
    expect(hello).toMatchObject({ name: "ann", role: "operator", capabilities: ["run:0011223344556677"], devices: ["desktop"] });
    expect((hello?.["secret"] as Uint8Array).length).toBe(32);
    expect(bench.last("phase")).toMatchObject({ phase: "joining" });
    bench.welcome();
    bench.snapshot("none");
    bench.pass(60);
    expect(bench.last("phase")).toMatchObject({ phase: "ready", text: "connected" });
    expect(bench.last("session")).toMatchObject({ participant_id: "p1", tick_period_ns: 2 * MS, anchors: [{ anchor_id: "desk", size_m: 0.2, error_m: 0 }] });
    expect(bench.last("bodies")).toMatchObject({ version: 1, bodies: [[1, "hand", true, false], [2, "cup", true, true]] });
    bench.pass(300);
    expect(Math.abs(bench.last("clock").session_offset_ms - (OFFSET_NS / MS - 1000))).toBeLessThan(bench.last("clock").error_ms);
    bench.state(11);
    expect(bench.last("frame")).toMatchObject({ bodies_version: 1, state_seq: 11, scene_epoch: 1 });
    expect([...bench.last("frame").poses.subarray(0, 4)]).toEqual([0.125, 1, 0, 1]);
    expect(bench.last("identity").fingerprint).toMatch(/^[a-z2-7]{26}$/);
  });

  test("the secret is kept, and the token resumes after a reload", async () => {
    await bench.join();
    const again = new Bench();
    again.store = bench.store;
    again.worker = new ClientWorker({ ...(again.worker as unknown as { environment: ConstructorParameters<typeof ClientWorker>[0] }).environment, store: bench.store });
    await again.connect();
    const [before] = bench.socket.find("hello");
    const [after] = again.socket.find("hello");
    expect(after?.["secret"]).toEqual(before?.["secret"]);
    expect(after?.["resume_token"]).toEqual(new Uint8Array([1]));
  });

  test("another version is a refusal in words", async () => {
    bench.info = { versions: [2] };
    bench.post({ type: "connect", base_url: BASE, role: "observer", name: "ann" });
    await bench.settle();
    expect(bench.sockets).toEqual([]);
    expect(bench.last("phase")).toMatchObject({ phase: "refused", refusal: "version" });
    expect(bench.last("phase").text).toMatch(/reload/);
  });

  test("a gateway that is not there is tried again at least twice a second", async () => {
    bench.info = null;
    bench.post({ type: "connect", base_url: BASE, role: "observer", name: "ann" });
    await bench.until(() => bench.sockets.length > 0);
    for (let i = 0; i < 8; i++) {
      expect(bench.sockets).toHaveLength(i + 1);
      bench.socket.end(1006);
      bench.pass(501);
    }
  });

  test("an identity that is not listed is refused", async () => {
    await bench.connect();
    bench.say({ type: "refused", code: "unpaired", message: "not on the list", advice: "pair first" }, 0);
    expect(bench.last("phase")).toMatchObject({ phase: "refused", refusal: "unpaired", advice: "pair first" });
    expect(bench.socket.readyState).toBe(3);
    bench.post({ type: "disconnect" });
    expect(bench.last("phase")).toMatchObject({ phase: "closed", refusal: "" });
  });

  test.each([[4001, "version"], [4003, "identity"]])("close code %i is final", async (code, refusal) => {
    await bench.connect();
    bench.socket.end(code, "why");
    expect(bench.last("phase")).toMatchObject({ phase: "refused", refusal, close_code: code });
    bench.pass(5000);
    expect(bench.sockets).toHaveLength(1);
  });

  test("a name that does not fit is a refusal, not a crash", async () => {
    bench.post({ type: "connect", base_url: BASE, role: "observer", name: "x".repeat(65) });
    await bench.until(() => bench.of("phase").length > 0);
    expect(bench.last("phase")).toMatchObject({ phase: "refused", refusal: "malformed" });
    expect(bench.last("phase").text).toMatch(/name/);
  });
});

describe("joined", () => {
  test("a request gets its reply, or a reason why there is none", async () => {
    bench.post({ type: "request", id: 1, message: { type: "acquire", robots: ["left"] } });
    expect(bench.last("reply")).toMatchObject({ id: 1, reply: null, error: "not connected" });
    await bench.join();
    bench.post({ type: "request", id: 2, message: { type: "acquire", robots: ["left"] } });
    const [acquire] = bench.socket.find("acquire");
    expect(acquire).toMatchObject({ request_id: 1, robots: ["left"] });
    bench.say({ type: "reply", request_id: 1, ok: true });
    expect(bench.last("reply")).toMatchObject({ id: 2, reply: { ok: true, denial: null } });
    bench.post({ type: "request", id: 3, message: { type: "marker", text: "x".repeat(600) } });
    expect(bench.last("reply").error).toMatch(/text/);
    bench.post({ type: "request", id: 4, message: { type: "marker", text: "x" } });
    bench.socket.end(1006);
    bench.pass(600);
    expect(bench.last("reply")).toMatchObject({ id: 4, reply: null });
    expect(bench.last("reply").error).toMatch(/lost/);
  });

  test("going into a headset and out of it resumes the participant, each time with another run", async () => {
    await bench.join();
    bench.post({ type: "rejoin", devices: ["head", "controller/left"], alignment: "measured" });
    expect(bench.sockets.filter(({ url }) => url.endsWith("session"))).toHaveLength(2);
    bench.socket.open();
    const [hello] = bench.socket.find("hello");
    expect(hello).toMatchObject({ name: "ann", devices: ["head", "controller/left"], alignment: "measured", capabilities: ["run:0011223344556677-1"] });
    expect(hello?.["resume_token"]).toEqual(new Uint8Array([1]));
    expect(bench.sockets[0]?.find("bye")).toEqual([]); // which would release its leases
    bench.welcome(2, true);
    bench.snapshot("none", 2);
    bench.pass(1500);
    expect(bench.last("phase")).toMatchObject({ phase: "ready" });
    bench.socket.end(1006);
    bench.socket.open();
    expect(bench.socket.find("hello")[0]).toMatchObject({ alignment: "measured", capabilities: ["run:0011223344556677-1"] }); // the same frame
    bench.post({ type: "rejoin", devices: ["desktop"], alignment: "not_needed" });
    bench.socket.open();
    expect(bench.socket.find("hello")[0]).toMatchObject({ alignment: "not_needed", capabilities: ["run:0011223344556677-2"] });
  });

  test("going into a headset before the first socket is there counts", async () => {
    bench.post({ type: "connect", base_url: BASE, role: "operator", name: "ann", devices: ["desktop"], alignment: "not_needed" });
    bench.post({ type: "rejoin", devices: ["head", "controller/left"], alignment: "measured" });
    await bench.until(() => bench.sockets.length > 0);
    bench.socket.open();
    expect(bench.socket.find("hello")[0]).toMatchObject({ devices: ["head", "controller/left"], alignment: "measured" });
  });

  test("a lost socket is replaced at once, with the token, and resumes", async () => {
    await bench.join();
    bench.pass(1500);
    const before = bench.socket;
    before.end(1012);
    expect(bench.socket).not.toBe(before);
    bench.socket.open();
    expect(bench.socket.find("hello")[0]?.["resume_token"]).toEqual(new Uint8Array([1]));
    bench.welcome(2, true);
    bench.snapshot("none", 2);
    bench.pass(60);
    expect(bench.last("welcome").welcome).toMatchObject({ resumed: true, connection_epoch: 2 });
    expect(bench.of("bodies")).toHaveLength(1);
    expect(bench.last("phase").phase).toBe("ready");
  });

  test.each([1001, 4000])("after its end a session is named as ended, until the next one welcomes (%i)", async (code) => {
    await bench.join();
    expect(bench.last("phase").ended).toBe(false);
    bench.pass(1500);
    if (code !== 4000) bench.say({ type: "protocol_fault", code: "session_ended", message: "the session has ended", reason: "" }, 1);
    bench.socket.end(code);
    expect(bench.last("phase")).toMatchObject({ ended: true });
    for (let i = 0; i < 8; i++) {
      bench.pass(2000);
      bench.socket.end(1006);
    }
    expect(bench.last("phase")).toMatchObject({ phase: "waiting", ended: true });
    bench.pass(2000);
    bench.socket.open();
    bench.welcome(2);
    bench.snapshot("none", 2);
    bench.pass(60);
    expect(bench.last("phase")).toMatchObject({ phase: "ready", ended: false });
  });

  test("another session is said to be another one, though it numbers its connections as the one before", async () => {
    await bench.join();
    bench.say({ type: "protocol_fault", code: "session_ended", message: "the session has ended", reason: "" }, 1);
    bench.pass(2000);
    bench.socket.open();
    bench.welcome(1, false, "s2");
    expect(bench.of("welcome").map(({ welcome }) => welcome.session_id)).toEqual(["s1", "s2"]);
  });

  test("another name is said at the next hello, which resumes the participant", async () => {
    await bench.join();
    const begin = bench.socket;
    bench.post({ type: "set_name", name: "eve" });
    expect(bench.socket).toBe(begin);
    bench.pass(1500);
    bench.socket.end(1006);
    bench.socket.open();
    expect(begin.find("bye")).toEqual([]); // which would release its leases
    expect(bench.socket.find("hello")[0]).toMatchObject({ name: "eve", resume_token: new Uint8Array([1]), capabilities: ["run:0011223344556677"] });
  });

  test("a client that did too much joins again later", async () => {
    await bench.join();
    bench.pass(1500);
    bench.socket.end(4009);
    expect(bench.last("phase").phase).toBe("waiting");
    bench.pass(1900);
    expect(bench.sockets).toHaveLength(1);
    bench.pass(200);
    expect(bench.sockets).toHaveLength(2);
  });

  test("an e-stop is sent, also with the next hello", async () => {
    await bench.join();
    bench.post({ type: "estop", reason: "button" });
    expect(bench.socket.find("estop")).toHaveLength(1);
    bench.pass(1500);
    bench.socket.end(1006);
    bench.socket.open();
    expect(bench.socket.messages().map(({ type }) => type)).toEqual(["hello", "estop"]);
  });

  test("an e-stop that is not on its way is told at once", async () => {
    bench.post({ type: "estop", reason: "button" });
    expect(bench.last("notice").text).toMatch(/not sent/);
    await bench.join();
    bench.pass(1500);
    bench.socket.end(1006);
    bench.socket.end(1006);
    expect(bench.last("phase").phase).toBe("waiting");
    bench.post({ type: "estop", reason: "button" });
    expect(bench.last("notice").text).toMatch(/when the connection is back/);
  });

  test("samples carry fencing numbers and session time", async () => {
    await bench.join();
    const capture_ms = 1000 + bench.now / MS;
    bench.post({ type: "samples", samples: [{ device: "desktop", pose: [[0, 0, 1], [1, 0, 0, 0]], capture_ms, robots: ["left"], clutch: true }] });
    const [sample] = bench.socket.find("sample");
    expect(sample).toMatchObject({ seq: 1, scene_epoch: 1, targets: [["left", 4, "robot"]], clutch: true, kind: "pose" });
    expect(Math.abs((sample?.["capture_ns"] as number) - bench.now - OFFSET_NS)).toBeLessThan(2 * MS);
    bench.post({ type: "samples", samples: [{ device: "desktop", pose: null, capture_ms, robots: ["nobody"] }] });
    expect(bench.last("notice").text).toMatch(/no robot "nobody"/);
    bench.post({ type: "tracking_jump" });
    expect(bench.socket.find("tracking_epoch")[0]).toMatchObject({ tracking_epoch: 1 });
  });

  test("observations carry the tracking frame and session time", async () => {
    await bench.join();
    bench.post({ type: "tracking_jump" });
    bench.post({ type: "observation", observation: { anchor_id: "desk", kind: "touch", mark: "1", T_tracking_anchor: [[0, 0, 1], [1, 0, 0, 0]], capture_ms: 1000 + bench.now / MS } });
    const [found] = bench.socket.find("observation");
    expect(found).toMatchObject({ anchor_id: "desk", kind: "touch", mark: "1", tracking_epoch: 1 });
    expect(Math.abs((found?.["capture_ns"] as number) - bench.now - OFFSET_NS)).toBeLessThan(2 * MS);
  });

  test("a full socket drops samples and keeps requests", async () => {
    await bench.join();
    bench.socket.bufferedAmount = 1 << 20;
    bench.post({ type: "samples", samples: [{ device: "desktop", pose: null, capture_ms: 1000 }] });
    bench.post({ type: "request", id: 1, message: { type: "marker", text: "x" } });
    expect(bench.socket.find("marker")).toHaveLength(0);
    bench.socket.bufferedAmount = 0;
    bench.pass(20);
    expect(bench.socket.find("marker")).toHaveLength(1);
    expect(bench.socket.find("sample")).toHaveLength(0);
  });

  test("events, presence, budget and status reach the page", async () => {
    await bench.join();
    bench.say({ type: "event", event_seq: 4, step: 1, session_time: 1, body: { event: "anchor_moved", anchor_id: "desk", T_world_anchor: [[2, 0, 0], [1, 0, 0, 0]] } });
    expect(bench.last("inbox").messages).toMatchObject([{ event_seq: 4 }]);
    expect(bench.last("session").anchors).toMatchObject([{ anchor_id: "desk", T_world_anchor: [[2, 0, 0], [1, 0, 0, 0]], size_m: 0.2 }]);
    bench.socket.deliver(2, new TextEncoder().encode("presence"), encodeStruct("Presence", [1, 2, [["p2", "head", [[0, 0, 1], [1, 0, 0, 0]], 3]]]));
    expect(bench.last("presence").items).toEqual([["p2", "head", [[0, 0, 1], [1, 0, 0, 0]], 3]]);
    bench.post({ type: "get_status" });
    expect(bench.socket.find("get_status")).toHaveLength(1);
    bench.say({ type: "status_report", request_id: 0, session_id: "s1", session_name: "lab", session_time: 1 });
    expect(bench.last("status").status.session_name).toBe("lab");
    bench.pass(1100);
    expect(bench.socket.find("client_report").length).toBeGreaterThan(0);
    expect(bench.last("stats").counters).toHaveProperty("malformed", 0);
  });

  test("malformed bytes are counted, and the connection stays", async () => {
    await bench.join();
    bench.socket.onmessage?.({ data: "text" } as MessageEvent);
    bench.socket.onmessage?.({ data: new Uint8Array([1, 9]).buffer } as MessageEvent);
    bench.socket.deliver(1, new Uint8Array([0xc1]));
    bench.socket.deliver(5, new Uint8Array([0xc1]));
    bench.socket.deliver(9, new Uint8Array([0xc1]));
    bench.pass(1100);
    bench.pass(1100);
    expect(bench.last("stats").counters).toHaveProperty("malformed", 4);
    expect(bench.last("phase").phase).toBe("ready");
  });

  test("frames are held back while the page stands still", async () => {
    await bench.join();
    bench.state(11);
    bench.post({ type: "recycle", poses: bench.last("frame").poses });
    for (let seq = 12; seq < 200; seq++) bench.state(seq);
    expect(bench.of("frame").length).toBe(65);
    bench.post({ type: "recycle", poses: bench.last("frame").poses });
    bench.state(200);
    expect(bench.last("frame").state_seq).toBe(200);
  });

  test("leaving says bye and closes the socket", async () => {
    await bench.join();
    bench.post({ type: "disconnect" });
    expect(bench.socket.find("bye")).toHaveLength(1);
    expect(bench.socket.readyState).toBe(3);
    expect(bench.last("phase").phase).toBe("closed");
    bench.pass(5000);
    expect(bench.sockets).toHaveLength(1);
  });
});

describe("assets and media", () => {
  const golden = readGolden<{ scenes: { hex: string; address: string }[] }>("scene");
  const mesh = readGolden<{ assets: { name: string; hex: string }[] }>("arrays").assets.find(({ name }) => name === "a mesh, exact") as { hex: string };
  const cloth = readGolden<{ meshes: { topology: string; frames: { hex: string }[] }[] }>("deformable").meshes[0] as { topology: string; frames: { hex: string }[] };
  const ticket = (text: string): Uint8Array => encodeValue({ type: "ticket", ticket: text, expires_s: 600 });

  const addAsset = (bytes: Uint8Array): string => {
    const address = createHash("sha256").update(bytes).digest("hex");
    bench.assets.set(address, bytes);
    return address;
  };

  /** A scene with a cloth, and its asset. */
  const addCloth = (elements = Uint32Array.from(decodeTopology(fromHex(cloth.topology)).faces)): string => {
    const plan = fromHex(cloth.topology);
    const infos = [
      { name: "plan", dtype: "u1", shape: [plan.length], bytes: plan.length },
      { name: "elements", dtype: "u4", shape: [elements.length / 3, 3], bytes: elements.byteLength },
      { name: "uv", dtype: "f4", shape: [elements.length / 3, 3, 2], bytes: 2 * elements.byteLength },
    ];
    const uv = new Uint8Array(2 * elements.byteLength);
    const header = encodeStruct("ArrayHeader", { kind: "deformable", arrays: infos });
    const prefix = new Uint8Array(8);
    prefix.set(new TextEncoder().encode("IRA1"));
    new DataView(prefix.buffer).setUint32(4, header.length, true);
    const asset = new Uint8Array(Buffer.concat([prefix, header, plan, new Uint8Array(elements.buffer), uv]));
    const look = { name: "cloth", dim: 2, group: 0, vertices: 30, elements: 40, radius: 0.001, flat: false, material: -1, rgba: [1, 1, 1, 1] };
    const address = addAsset(asset);
    return addAsset(encodeStruct("SceneSpec", { deformables: [{ ...look, stream: "cloth", address, bytes: asset.length }] }));
  };

  test("the scene is fetched with the ticket", async () => {
    const scene = golden.scenes[0] as { hex: string; address: string };
    bench.assets.set(scene.address, fromHex(scene.hex));
    await bench.join(scene.address);
    expect(bench.requests).toEqual([]);
    bench.socket.deliver(5, ticket("t1"));
    await bench.until(() => bench.of("scene").length > 0);
    expect(bench.last("scene")).toMatchObject({ address: scene.address, spec: { name: "every kind of thing" } });
    expect(bench.requests[0]).toMatchObject({ url: `${BASE}/v1/asset/${scene.address}`, headers: { "X-Iris-Ticket": "t1" } });
  });

  test("assets come decoded, once each, and failures in words", async () => {
    const address = addAsset(fromHex(mesh.hex));
    const picture = addAsset(new Uint8Array(3_000_000).fill(7));
    const wrong = "0".repeat(64);
    bench.assets.set(wrong, new Uint8Array(10));
    await bench.join();
    bench.socket.deliver(5, ticket("t1"));
    const assets = [
      { address, bytes: mesh.hex.length / 2, encoding: "arrays" },
      { address: picture, bytes: 3_000_000, encoding: "png" },
      { address: wrong, bytes: 10, encoding: "png" },
      { address: "1".repeat(64), bytes: 10, encoding: "png" },
      { address: "../info", bytes: 10, encoding: "png" },
    ];
    bench.post({ type: "want_assets", assets });
    await bench.until(() => bench.of("asset").length === 2 && bench.of("asset_failed").length === 3);
    expect(bench.of("asset").map((update) => update.address).sort()).toEqual([address, picture].sort());
    expect(bench.of("asset").find((update) => update.address === address)?.arrays?.["position"]?.data).toBeInstanceOf(Float32Array);
    expect(bench.of("asset").find((update) => update.address === picture)?.bytes).toHaveLength(3_000_000);
    const failed = new Map(bench.of("asset_failed").map((update) => [update.address, update.text]));
    expect(failed.get(wrong)).toMatch(/another hash, twice/);
    expect(failed.get("1".repeat(64))).toMatch(/unknown_asset/);
    expect(failed.get("../info")).toMatch(/no address/);
    expect(bench.last("asset_progress")).toMatchObject({ wanted: 4, done: 4 });
    expect(bench.requests.filter(({ url }) => url.endsWith(picture)).length).toBeGreaterThan(2);
  });

  test("a refusal for now is tried again after a pause", async () => {
    const address = addAsset(new Uint8Array(10));
    bench.status = 503;
    await bench.join();
    bench.socket.deliver(5, ticket("t1"));
    bench.post({ type: "want_assets", assets: [{ address, bytes: 10, encoding: "png" }] });
    await bench.until(() => bench.of("asset_progress").length > 0);
    expect(bench.last("asset_progress").refusal).toBe("busy: later");
    bench.status = 206;
    bench.pass(60);
    await bench.until(() => bench.of("asset").length > 0);
  });

  test("media are opened with the ticket after the budget, and a cloth is decoded", async () => {
    await bench.join(addCloth());
    bench.socket.deliver(5, ticket("t1"));
    await bench.until(() => bench.of("scene").length > 0);
    expect(bench.last("scene").spec.deformables).toHaveLength(1);
    bench.post({ type: "want_streams", streams: ["cloth"] });
    expect(bench.sockets).toHaveLength(1);
    bench.say({ type: "delivery_budget", budget_class: "full" });
    expect(bench.sockets).toHaveLength(2);
    const media = bench.socket;
    media.open();
    expect(media.url).toBe("wss://robot:7725/v1/media");
    expect(media.sent.map(({ channel, frames }) => [channel, decodeValue(frames[0] as Uint8Array)])).toEqual([
      [5, { type: "ticket", ticket: "t1" }],
      [4, ["cloth"]],
    ]);
    const header = encodeStruct("MediaHeader", ["cloth", "full", 1, 7, bench.now + OFFSET_NS, bench.now + OFFSET_NS, "deformable", 0]);
    await bench.until(() => {
      media.deliver(3, new TextEncoder().encode("media/1/cloth/full"), header, fromHex((cloth.frames[0] as { hex: string }).hex));
      return bench.of("deformable").length > 0; // once its topology has come
    });
    expect(bench.last("deformable")).toMatchObject({ stream: "cloth", seq: 7, scene_epoch: 1 });
    expect(bench.last("deformable").vertices).toHaveLength(90);
    const { position, normal } = bench.last("deformable").surface!;
    expect(position.length).toBe(normal.length);
    expect(position.length).toBeGreaterThan(2 * 90); // both sides, and the rim
    expect([...position, ...normal].every(Number.isFinite)).toBe(true);
    media.deliver(3, new Uint8Array(), encodeStruct("MediaHeader", ["cloud", "full", 1, 7, 1, 2]), new Uint8Array([1, 2]));
    expect(bench.last("media").bytes).toEqual(new Uint8Array([1, 2]));
    media.deliver(3, new Uint8Array(), header, new Uint8Array([1, 2]));
    media.end(1006);
    bench.pass(300);
    expect(bench.sockets).toHaveLength(3);
    bench.socket.end(4003);
    bench.pass(6000);
    expect(bench.sockets).toHaveLength(3);
    (bench.sockets[0] as FakeSocket).deliver(5, ticket("t2"));
    expect(bench.sockets).toHaveLength(4);
    bench.post({ type: "want_streams", streams: [] });
    expect(bench.socket.readyState).toBe(3);
  });

  test("a deformable whose triangles have no vertices is refused in words", async () => {
    await bench.join(addCloth(Uint32Array.of(0, 1, 30)));
    bench.socket.deliver(5, ticket("t1"));
    await bench.until(() => bench.of("notice").length > 0);
    expect(bench.last("notice").text).toContain("the deformable cloth cannot be shown");
  });

  test("a page that stands still gets no more frames of a deformable than it gives back", async () => {
    await bench.join(addCloth());
    bench.socket.deliver(5, ticket("t1"));
    await bench.until(() => bench.of("scene").length > 0);
    bench.post({ type: "want_streams", streams: ["cloth"] });
    bench.say({ type: "delivery_budget", budget_class: "full" });
    const media = bench.socket;
    media.open();
    const send = (): void => {
      const header = encodeStruct("MediaHeader", ["cloth", "full", 1, 7, bench.now, bench.now, "deformable", 0]);
      media.deliver(3, new Uint8Array(), header, fromHex((cloth.frames[0] as { hex: string }).hex));
    };
    bench.post({ type: "drawn", frames: 1 });
    send();
    expect(bench.last("deformable")).toMatchObject({ surface: null }); // it builds the few itself
    bench.post({ type: "drawn", frames: 60 });
    for (let i = 0; i < 100; i++) send();
    const held = bench.of("deformable").length;
    expect(held).toBeLessThan(100);
    const { surface } = bench.last("deformable");
    bench.post({ type: "recycle_surface", stream: "cloth", surface });
    send();
    send();
    expect(bench.of("deformable")).toHaveLength(held + 1);
    bench.pass(1100);
    await bench.until(() => bench.of("stats").length > 0);
    expect(bench.last("stats").counters["media not taken"]).toBe(103 - held - 1);
  });

  test("a page reports how old its picture is", async () => {
    await bench.join();
    bench.pass(100);
    for (let i = 0; i < 12; i++) {
      bench.post({ type: "drawn", frames: 6, age_ms: 70 });
      bench.pass(100);
    }
    const [report] = bench.socket.find("client_report").slice(-1);
    expect(report?.["display_hz"]).toBeGreaterThan(50);
    expect(report?.["shown_age_ms"]).toBeGreaterThan(80); // of the state, and a period of 60 Hz
    expect(report?.["shown_age_ms"]).toBeLessThan(95);
    bench.pass(2100);
    const [still] = bench.socket.find("client_report").slice(-1);
    expect(still?.["shown_age_ms"]).toBe(0); // nothing is drawn
  });

  describe("a ticket", () => {
    const sentTicket = (): unknown => (decodeValue(bench.socket.sent[0]!.frames[0] as Uint8Array) as Message)["ticket"];
    const say = (name: string): void => (bench.sockets[0] as FakeSocket).deliver(5, ticket(name));

    beforeEach(async () => {
      await bench.join();
      say("t1");
      bench.post({ type: "want_streams", streams: ["cloth"] });
      bench.say({ type: "delivery_budget", budget_class: "full" });
      bench.socket.open();
    });

    test("that comes before the one before it is refused is used at once", () => {
      say("t2");
      expect(bench.sockets).toHaveLength(2);
      bench.socket.end(4003);
      expect(bench.sockets).toHaveLength(3);
      bench.socket.open();
      expect(sentTicket()).toBe("t2");
      bench.socket.end(4003);
      bench.pass(6000);
      expect(bench.sockets).toHaveLength(3);
    });

    test("that comes too late for the gateway is sent again after a pause", () => {
      bench.socket.end(1013);
      expect(bench.sockets).toHaveLength(2);
      bench.pass(200);
      expect(bench.sockets).toHaveLength(3);
      bench.socket.open();
      expect(sentTicket()).toBe("t1");
      bench.socket.end(1013);
      bench.pass(200);
      expect(bench.sockets).toHaveLength(3);
      bench.pass(200);
      expect(bench.sockets).toHaveLength(4);
    });

    test.each(["a lost connection", "entering a headset"])("of the connection before is not used after %s", (reason) => {
      if (reason === "a lost connection") (bench.sockets[0] as FakeSocket).end(1006);
      else bench.post({ type: "rejoin", devices: ["head"], alignment: "measured" });
      bench.pass(500);
      const session = bench.socket;
      expect(session.url).toMatch(/session$/);
      session.open();
      bench.welcome(2);
      bench.snapshot("none", 2);
      bench.say({ type: "delivery_budget", budget_class: "full" }, 2);
      expect(bench.socket.url).toBe(session.url);
      session.deliver(5, ticket("t2"));
      expect(bench.socket.url).toMatch(/media$/);
      bench.socket.open();
      expect(sentTicket()).toBe("t2");
    });
  });
});

describe("clouds and pictures", () => {
  const header = (stream: string, encoding: string, captureMs = 0): Uint8Array =>
    encodeStruct("MediaHeader", [stream, "full", 1, 7, captureMs * MS, captureMs * MS, encoding]);
  const send = (stream: string, encoding: string, bytes: Uint8Array, captureMs = 0): void =>
    bench.socket.deliver(3, new Uint8Array(), header(stream, encoding, captureMs), bytes);
  const wantStreams = (...streams: string[]): void => bench.post({ type: "want_streams", streams });
  const readCounters = async (): Promise<object> => {
    bench.pass(1100);
    await bench.settle();
    return bench.last("stats").media;
  };

  beforeEach(async () => {
    await bench.join();
    bench.socket.deliver(5, encodeValue({ type: "ticket", ticket: "t1", expires_s: 600 }));
    wantStreams("front", "room");
    bench.say({ type: "delivery_budget", budget_class: "full" });
    bench.socket.open();
  });

  test("one picture of a stream is decoded at a time, and the newest that came meanwhile is next", async () => {
    for (const captureMs of [1, 2, 3]) send("front", "jpeg", makeJpeg(64, 48), captureMs);
    expect(bench.decoding).toHaveLength(1);
    bench.decoding[0]!.finish();
    await bench.until(() => bench.of("picture").length === 1);
    expect(bench.last("picture")).toMatchObject({ stream: "front", capture_ms: 1 });
    expect(bench.decoding).toHaveLength(1); // the page has not taken it yet
    bench.post({ type: "taken", stream: "front" });
    expect(bench.decoding).toHaveLength(2);
    bench.decoding[1]!.finish();
    await bench.until(() => bench.of("picture").length === 2);
    expect(bench.last("picture").capture_ms).toBe(3);
    expect(await readCounters()).toEqual({ front: { received: 3, superseded: 1, refused: 0 } });
  });

  test("what is no picture, too large or damaged is refused and counted, and the next one is shown", async () => {
    for (const bytes of [new Uint8Array(), Uint8Array.of(0xff, 0xd8), new Uint8Array(500).fill(0xff), makeJpeg(4097, 8)]) send("front", "jpeg", bytes);
    expect(bench.decoding).toHaveLength(0);
    send("front", "jpeg", makeJpeg(4096, 4096));
    bench.decoding[0]!.fail();
    await bench.settle();
    send("front", "jpeg", makeJpeg(8, 8), 9);
    bench.decoding[1]!.finish();
    await bench.until(() => bench.of("picture").length === 1);
    expect(bench.last("picture").capture_ms).toBe(9);
    expect(await readCounters()).toEqual({ front: { received: 6, superseded: 0, refused: 5 } });
    expect(bench.last("stats").counters["media malformed"]).toBe(5);
  });

  test("pictures that are larger than any panel are decoded smaller", async () => {
    const sizes = [[640, 480], [1920, 1080], [1080, 1920], [2, 4096]] as const;
    for (const [width, height] of sizes) {
      send("front", "jpeg", makeJpeg(width, height));
      bench.decoding.at(-1)!.fail();
      await bench.settle();
    }
    expect(bench.decoding.map(({ width }) => width)).toEqual([640, 1024, 576, 1]);
  });

  test("a page that stands still gets the newest cloud when it runs again", async () => {
    const cloud = fromHex(readGolden<{ frames: { hex: string }[] }>("cloud").frames[0]!.hex);
    for (const captureMs of [1, 2, 3, 4]) send("room", "cloud", cloud, captureMs);
    expect(bench.of("cloud").map(({ capture_ms }) => capture_ms)).toEqual([1]);
    bench.post({ type: "taken", stream: "room" });
    bench.post({ type: "taken", stream: "room" });
    bench.post({ type: "taken", stream: "room" });
    expect(bench.of("cloud").map(({ capture_ms }) => capture_ms)).toEqual([1, 4]);
    send("room", "cloud", cloud.subarray(1), 5);
    await bench.settle();
    send("room", "cloud", cloud, 6);
    expect(bench.last("cloud").capture_ms).toBe(6);
    expect(await readCounters()).toEqual({ room: { received: 6, superseded: 2, refused: 1 } });
  });

  test("a picture that is not wanted any more is not decoded, or thrown away when it is", async () => {
    send("front", "jpeg", makeJpeg(8, 8), 1);
    send("front", "jpeg", makeJpeg(8, 8), 2);
    wantStreams("room");
    send("front", "jpeg", makeJpeg(8, 8), 3);
    const image = bench.decoding[0]!.finish();
    await bench.until(() => image.isClosed);
    expect(bench.of("picture")).toHaveLength(0);
    expect(bench.decoding).toHaveLength(1);
    expect(await readCounters()).toEqual({});
    wantStreams("front", "room");
    send("front", "jpeg", makeJpeg(8, 8), 4);
    expect(bench.decoding).toHaveLength(2);
  });
});

describe("pairing", () => {
  const start = async (): Promise<{ identity: Uint8Array; stretched: Uint8Array<ArrayBuffer>; message: Message }> => {
    bench.post({ type: "pair", base_url: BASE, code: "7KQ2-M4XD-9PTR", name: "tablet" });
    await bench.until(() => bench.sockets.length > 0);
    bench.socket.open();
    const [message] = bench.socket.find("pair");
    const secret = (await bench.store.getValue("secret")) as Uint8Array<ArrayBuffer>;
    return { identity: await hashSecret(secret), stretched: await stretchCode("7KQ2-M4XD-9PTR", S), message: message as Message };
  };

  test("both sides prove that they know the code", async () => {
    const { identity, stretched, message } = await start();
    expect(message).toMatchObject({ name: "tablet", identity, proof: await makeProof(stretched, "client", S, identity) });
    bench.say({ type: "paired", proof: await makeProof(stretched, "server", S, identity), roles: ["observer"] }, 0);
    await bench.until(() => bench.of("paired").length > 0);
    expect(bench.last("paired")).toMatchObject({ ok: true, roles: ["observer"] });
    expect(bench.socket.readyState).toBe(3);
  });

  test("a session that does not know it is not trusted", async () => {
    await start();
    bench.say({ type: "paired", proof: new Uint8Array(32) }, 0);
    await bench.until(() => bench.of("paired").length > 0);
    expect(bench.last("paired")).toMatchObject({ ok: false });
    expect(bench.last("paired").text).toMatch(/could not prove/);
  });

  test("a wrong code is told by the session", async () => {
    await start();
    bench.say({ type: "refused", code: "code", message: "no such code" }, 0);
    await bench.until(() => bench.of("paired").length > 0);
    expect(bench.last("paired")).toMatchObject({ ok: false, code: "code", text: "no such code" });
  });

  test("a code of another form is not sent, and silence ends", async () => {
    bench.post({ type: "pair", base_url: BASE, code: "nonsense", name: "tablet" });
    await bench.settle();
    expect(bench.last("paired")).toMatchObject({ ok: false, code: "code" });
    expect(bench.sockets).toEqual([]);
    await start();
    bench.pass(5001);
    await bench.until(() => bench.of("paired").length > 1);
    expect(bench.last("paired").text).toMatch(/five seconds/);
  });
});
