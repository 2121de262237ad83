// Pairing with a session through its gateway: one WebSocket, one `pair`, one answer. The connection stays that of an unknown
// identity until it is closed, so joining uses another one.

import { encodeClient, decodeServer } from "./codec.ts";
import { PairingError, WireError } from "./errors.ts";
import { hashSecret, isSameProof, makeProof, stretchCode } from "./pairing.ts";
import { Channel, packMessage, SUBPROTOCOL, unpackMessage } from "./wire.ts";

/** After so long without an answer, or after `rate`, the same is sent again. */
const ANSWER_MS = 5_000;
const RATE_PAUSE_MS = 1_000;
const ATTEMPTS = 3;

/** What of `WebSocket` is needed. */
export interface SocketLike {
  binaryType: BinaryType;
  readonly readyState: number;
  readonly bufferedAmount: number;
  onopen: ((event: Event) => unknown) | null;
  onmessage: ((event: MessageEvent) => unknown) | null;
  onclose: ((event: CloseEvent) => unknown) | null;
  onerror: ((event: Event) => unknown) | null;
  send(data: Uint8Array<ArrayBuffer>): void;
  close(code?: number): void;
}

/** What of the environment is needed. */
export interface PairEnvironment {
  openSocket(url: string, protocol: string): SocketLike;
  setTimer(ms: number, callback: () => void): () => void;
}

/** What is sent: `certificateHash` is S, of the gateway. */
export interface PairRequest {
  url: string;
  code: string;
  certificateHash: Uint8Array;
  secret: Uint8Array<ArrayBuffer>;
  name: string;
  software: string;
}

/** Pair, and return the roles that this identity may join as; empty: any. Throws `PairingError`. */
export async function pair(environment: PairEnvironment, request: PairRequest): Promise<string[]> {
  const stretched = await stretchCode(request.code, request.certificateHash);
  const identity = await hashSecret(request.secret);
  const proof = await makeProof(stretched, "client", request.certificateHash, identity);
  const message = encodeClient({ type: "pair", name: request.name, proof, software: request.software, identity });
  const expected = await makeProof(stretched, "server", request.certificateHash, identity);
  for (let attempt = 1; ; attempt++) {
    const answer = await ask(environment, request.url, message);
    if (answer.type === "paired") {
      if (!isSameProof(answer.proof, expected)) {
        throw new PairingError("the session could not prove that it knows the code: this may be another machine that pretends to be it");
      }
      return answer.roles;
    }
    if (answer.code !== "rate" || attempt === ATTEMPTS) throw new PairingError([answer.message, answer.advice].filter(Boolean).join("; "), answer.code);
    await new Promise<void>((resolve) => environment.setTimer(RATE_PAUSE_MS, resolve));
  }
}

type Answer = { type: "paired"; proof: Uint8Array; roles: string[] } | { type: "refused"; code: string; message: string; advice: string };

function ask(environment: PairEnvironment, url: string, message: Uint8Array): Promise<Answer> {
  return new Promise((resolve, reject) => {
    const socket = environment.openSocket(url, SUBPROTOCOL);
    socket.binaryType = "arraybuffer";
    const end = (): void => {
      cancel();
      socket.onopen = socket.onmessage = socket.onclose = socket.onerror = null;
      socket.close();
    };
    const fail = (text: string): void => {
      end();
      reject(new PairingError(text));
    };
    const cancel = environment.setTimer(ANSWER_MS, () => fail("the session did not answer within five seconds: try again"));
    socket.onopen = () => socket.send(packMessage(Channel.CONTROL, [message]));
    socket.onclose = (event) => fail(event.reason || "the connection was closed before the session answered");
    socket.onmessage = (event) => {
      try {
        const { channel, frames } = unpackMessage(new Uint8Array(event.data as ArrayBuffer));
        if (channel !== Channel.CONTROL) return;
        const [, , answer] = decodeServer(frames[0] ?? new Uint8Array());
        if (answer.type !== "paired" && answer.type !== "refused" && answer.type !== "protocol_fault") return;
        end();
        resolve(answer.type === "protocol_fault" ? { type: "refused", code: answer.code, message: answer.message, advice: "" } : answer);
      } catch (error) {
        if (!(error instanceof WireError)) throw error;
        fail(`the answer could not be read: ${error.message}`);
      }
    };
  });
}
