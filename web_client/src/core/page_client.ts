// The page's end of the worker: requests as promises, updates to listeners by type. Decodes nothing.

import type { FromWorker, Reply, RequestMessage, ToWorker } from "./api.ts";
import type { Surface } from "./sheet.ts";

type UpdateOf<K extends FromWorker["type"]> = Extract<FromWorker, { type: K }>;
type Listener<K extends FromWorker["type"]> = (update: UpdateOf<K>) => void;

/** What of `Worker` is needed: tests pass a pair of queues. */
export interface WorkerPort {
  postMessage(message: ToWorker, transfer: Transferable[]): void;
  onmessage: ((event: MessageEvent<FromWorker>) => unknown) | null;
}

/** A request that got no reply: it was not sent, or its connection was lost. */
export class RequestError extends Error {
  override name = "RequestError";
}

/** Sends commands to the worker and passes its updates on. */
export class WorkerClient {
  private readonly listeners = new Map<string, Set<(update: never) => void>>();
  private readonly waiting = new Map<number, { resolve: (reply: Reply) => void; reject: (error: Error) => void }>();
  private nextId = 1;

  constructor(private readonly port: WorkerPort) {
    port.onmessage = (event) => this.dispatch(event.data);
  }

  /** Call `listener` with every update of a type. Returns a function that ends it. */
  on<K extends FromWorker["type"]>(type: K, listener: Listener<K>): () => void {
    const listeners = this.listeners.get(type) ?? new Set();
    this.listeners.set(type, listeners);
    listeners.add(listener as (update: never) => void);
    return () => listeners.delete(listener as (update: never) => void);
  }

  /** Post a command. */
  post(message: ToWorker, transfer: Transferable[] = []): void {
    this.port.postMessage(message, transfer);
  }

  /** Send a request; the reply may be a denial. Rejects with `RequestError` when there is none. */
  request(message: RequestMessage): Promise<Reply> {
    const id = this.nextId++;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      this.post({ type: "request", id, message });
    });
  }

  /** Give the buffer of a frame back. */
  recycle(poses: Float32Array): void {
    this.post({ type: "recycle", poses }, [poses.buffer as ArrayBuffer]);
  }

  /** Give the surface of a frame of a deformable back, null for one without. */
  recycleSurface(stream: string, surface: Surface | null): void {
    const buffers = surface === null ? [] : [surface.position.buffer, surface.normal.buffer];
    this.post({ type: "recycle_surface", stream, surface }, buffers);
  }

  private dispatch(update: FromWorker): void {
    if (update.type === "reply") {
      const waiting = this.waiting.get(update.id);
      this.waiting.delete(update.id);
      if (update.reply !== null) waiting?.resolve(update.reply);
      else waiting?.reject(new RequestError(update.error));
    }
    if (update.type === "cloud" || update.type === "picture") this.post({ type: "taken", stream: update.stream });
    for (const listener of this.listeners.get(update.type) ?? []) (listener as (update: FromWorker) => void)(update);
  }
}

/** Start the worker of this page. */
export function startWorker(): WorkerClient {
  return new WorkerClient(new Worker(new URL("./worker.ts", import.meta.url), { type: "module", name: "iris-session" }));
}
