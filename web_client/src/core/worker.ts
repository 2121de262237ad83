// The worker of the page: gives `ClientWorker` sockets, clocks and the database of the browser.

import { bytesToHex } from "@noble/hashes/utils.js";

import type { ToWorker } from "./api.ts";
import { ClientWorker } from "./client_worker.ts";
import { takeSlot } from "./identity.ts";
import { DatabaseStore } from "./storage.ts";

declare const self: DedicatedWorkerGlobalScope;

const RUN_BYTES = 8;

async function start(): Promise<void> {
  const queued: ToWorker[] = [];
  self.onmessage = (event: MessageEvent<ToWorker>) => queued.push(event.data);
  const [store, slot] = await Promise.all([DatabaseStore.open(), takeSlot()]);
  const run = crypto.getRandomValues(new Uint8Array(RUN_BYTES));
  const worker = new ClientWorker({
    post: (update, transfer) => self.postMessage(update, transfer),
    nowNs: () => Math.round(performance.now() * 1e6),
    sharedOriginMs: performance.timeOrigin,
    openSocket: (url, protocol) => new WebSocket(url, protocol),
    fetch: (url, init) => fetch(url, init),
    setTimer: (ms, callback) => {
      const timer = setTimeout(callback, ms);
      return () => clearTimeout(timer);
    },
    decodeImage: (bytes, resizeWidth) => createImageBitmap(new Blob([bytes as Uint8Array<ArrayBuffer>], { type: "image/jpeg" }), { resizeWidth }),
    store,
    slot,
    run: bytesToHex(run),
  });
  self.onmessage = (event: MessageEvent<ToWorker>) => worker.receive(event.data);
  for (const command of queued) worker.receive(command);
}

void start();
