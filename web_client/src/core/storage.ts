// What a browser keeps: its secret, resume tokens, and assets by their hash. IndexedDB; memory where there is none.

/** Values by key, and assets by address. Nothing throws: what cannot be kept is not kept. Bytes to keep are copied at once. */
export interface Store {
  getValue(key: string): Promise<Uint8Array<ArrayBuffer> | null>;
  /** Returns whether it is kept after the page has ended. */
  putValue(key: string, bytes: Uint8Array): Promise<boolean>;
  getAsset(address: string): Promise<Uint8Array<ArrayBuffer> | null>;
  putAsset(address: string, bytes: Uint8Array): Promise<void>;
}

type Table = "values" | "assets";

const DATABASE = "iris-session";
const VERSION = 1;

/** Keeps everything until the worker ends. */
export class MemoryStore implements Store {
  private readonly values = new Map<string, Uint8Array<ArrayBuffer>>();

  async getValue(key: string): Promise<Uint8Array<ArrayBuffer> | null> {
    return this.values.get(key)?.slice() ?? null;
  }

  async putValue(key: string, bytes: Uint8Array): Promise<boolean> {
    this.values.set(key, bytes.slice());
    return false;
  }

  async getAsset(): Promise<null> {
    return null;
  }

  async putAsset(): Promise<void> {}
}

/** Keeps everything in IndexedDB. When the browser gives no more room for assets, all of them are removed first. */
export class DatabaseStore implements Store {
  private constructor(private readonly database: IDBDatabase) {}

  /** Open the database. Returns a `MemoryStore` where there is none, as in some private windows. */
  static async open(): Promise<Store> {
    try {
      const request = indexedDB.open(DATABASE, VERSION);
      request.onupgradeneeded = () => {
        request.result.createObjectStore("values");
        request.result.createObjectStore("assets");
      };
      return new DatabaseStore(await settle(request));
    } catch {
      return new MemoryStore();
    }
  }

  getValue(key: string): Promise<Uint8Array<ArrayBuffer> | null> {
    return this.get("values", key);
  }

  putValue(key: string, bytes: Uint8Array): Promise<boolean> {
    return this.put("values", key, bytes);
  }

  getAsset(address: string): Promise<Uint8Array<ArrayBuffer> | null> {
    return this.get("assets", address);
  }

  async putAsset(address: string, bytes: Uint8Array): Promise<void> {
    if (await this.put("assets", address, bytes)) return;
    try {
      await settle(this.open("assets").clear());
    } catch {
      return;
    }
    await this.put("assets", address, bytes);
  }

  private open(table: Table): IDBObjectStore {
    return this.database.transaction(table, "readwrite").objectStore(table);
  }

  private async get(table: Table, key: string): Promise<Uint8Array<ArrayBuffer> | null> {
    try {
      const value: unknown = await settle(this.database.transaction(table).objectStore(table).get(key));
      return value instanceof Uint8Array ? new Uint8Array(value) : null;
    } catch {
      return null;
    }
  }

  private async put(table: Table, key: string, bytes: Uint8Array): Promise<boolean> {
    try {
      const store = this.open(table);
      const done = new Promise<boolean>((resolve) => {
        store.transaction.oncomplete = () => resolve(true);
        store.transaction.onabort = () => resolve(false);
      });
      store.put(bytes, key);
      return await done;
    } catch {
      return false;
    }
  }
}

function settle<T>(request: IDBRequest<T>): Promise<T> {
  return new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}
