// Who this browser is: a secret that it makes once, and the resume token of each of its tabs.

import type { IdentityStore } from "./connection.ts";
import { SECRET_BYTES } from "./pairing.ts";
import type { Store } from "./storage.ts";

const SECRET_KEY = "secret";
/** Tabs that can each resume: more join as new participants after a reload. */
const MAX_SLOTS = 8;
/** Time for the worker of a page that is reloaded to end. */
const SLOT_PATIENCE_MS = 250;

/** Identity of one tab at one gateway. */
export class BrowserIdentity implements IdentityStore {
  private constructor(
    readonly secret: Uint8Array<ArrayBuffer>,
    public resumeToken: Uint8Array<ArrayBuffer>,
    private readonly store: Store,
    private readonly tokenKey: string,
  ) {}

  /** Load the identity for a gateway. `slot`: of this tab, empty for one that cannot resume. */
  static async load(store: Store, baseUrl: string, slot: string): Promise<BrowserIdentity> {
    const key = slot === "" ? "" : `token ${slot} ${baseUrl}`;
    const token = key === "" ? null : await store.getValue(key);
    return new BrowserIdentity(await loadSecret(store), token ?? new Uint8Array(), store, key);
  }

  remember(token: Uint8Array): void {
    this.resumeToken = token.slice();
    if (this.tokenKey !== "") void this.store.putValue(this.tokenKey, this.resumeToken);
  }
}

/** Return the secret of this browser; make it the first time. */
export async function loadSecret(store: Store): Promise<Uint8Array<ArrayBuffer>> {
  const kept = await store.getValue(SECRET_KEY);
  if (kept !== null && kept.length === SECRET_BYTES) return kept;
  const secret = crypto.getRandomValues(new Uint8Array(SECRET_BYTES));
  await store.putValue(SECRET_KEY, secret);
  return secret;
}

/** Take a number that no other tab has, until this worker ends. Returns an empty text when there is none. */
export async function takeSlot(): Promise<string> {
  const { locks } = navigator;
  if (locks === undefined) return "";
  for (let slot = 0; slot < MAX_SLOTS; slot++) {
    const options: LockOptions = slot === 0 ? { signal: AbortSignal.timeout(SLOT_PATIENCE_MS) } : { ifAvailable: true };
    const taken = await new Promise<boolean>((resolve) => {
      const hold = (lock: Lock | null): Promise<void> | undefined => {
        resolve(lock !== null);
        return lock === null ? undefined : new Promise(() => {});
      };
      locks.request(`iris-session tab ${slot}`, options, hold).catch(() => resolve(false));
    });
    if (taken) return String(slot);
  }
  return "";
}
