// As whom this page joins: name and role that this browser remembers, the roles that are tried, and changes of both.

import type { WorkerClient } from "../core/page_client.ts";
import type { Actions } from "./actions.ts";
import type { PageState } from "./state.ts";
import { recall, remember } from "./storage.ts";

/** Roles in the order in which they are tried when the person has not chosen one. */
const ROLES = ["director", "operator", "observer"] as const;
/** Names that pages give themselves. */
const DEFAULT_NAME = /^Web( \d\d)?$/;
const SOFTWARE = "iris-session web client";
/** What is remembered of this browser: choices of the person, no secrets. */
const STORAGE_KEY = "iris-session.page";

export class Joining {
  private readonly person = recall(STORAGE_KEY, {
    name: "",
    role: "",
    roles: [] as string[],
    /** This person has been asked for a name. */
    isAsked: false,
  });
  private untried: string[] = [];
  /** This page has asked for another name since it joined. */
  private isRenamed = false;

  constructor(
    private readonly client: WorkerClient,
    private readonly state: PageState,
    private readonly actions: Pick<Actions, "request">,
    private readonly baseUrl: string,
  ) {
    if (this.name === "" || this.name === "Web") this.keep({ name: `Web ${10 + Math.floor(90 * Math.random())}` });
    client.on("session", () => this.followName());
  }

  get name(): string {
    return this.person.name;
  }

  /** Whether this person still has to be asked for a name. */
  get isAsking(): boolean {
    return !this.person.isAsked && DEFAULT_NAME.test(this.name);
  }

  /** Roles that this browser may have. */
  listRoles(): string[] {
    const { roles } = this.person;
    return ROLES.filter((role) => roles.length === 0 || roles.includes(role));
  }

  /** Join with the role that was chosen, or with the first one that is admitted. */
  join(): void {
    if (!this.person.role) this.untried = this.listRoles();
    this.connect(this.person.role || (this.untried.shift() ?? "observer"));
  }

  /** Join for the first time after this browser was paired. */
  joinPaired(name: string, roles: string[]): void {
    this.keep({ name, roles, role: "" });
    this.join();
  }

  /** The session does not admit the role. Returns whether another one is tried; `warn`: says that a chosen one is not. */
  tryNextRole(warn: () => void): boolean {
    if (this.person.role) {
      warn();
      this.keep({ role: "" }); // else every reload would be refused again
      this.join();
      return true;
    }
    const next = this.untried.shift();
    if (next !== undefined) this.connect(next);
    return next !== undefined;
  }

  /** Return the word on the button for `answer`: what is lost by it is said before. */
  describeAnswer(role: string): string {
    const { state } = this;
    const held = state.isReady && role !== state.role ? state.heldBy(state.selfId) : [];
    return held.length > 0 ? `OK, releases ${held.join(", ")}` : "OK";
  }

  /** Take a name and a role. Another role is another participant, which holds nothing. An empty name: none is wanted. */
  answer(name: string, role: string): void {
    this.keep({ isAsked: true });
    if (!name) this.state.touch();
    else if (this.state.isReady && role === this.state.role) void this.rename(name);
    else {
      this.keep({ name, role });
      this.client.post({ type: "disconnect" });
      this.connect(role);
    }
  }

  /** Take another name, in this session and in those to come. */
  async rename(name: string): Promise<void> {
    const { state } = this;
    if (name === state.self?.name || !(await this.actions.request({ type: "rename", participant: state.selfId, name }))) return;
    this.isRenamed = true;
    this.followName();
  }

  /** Remember the name that the session lists: one that is taken got a number. It may come after the reply. */
  private followName(): void {
    const name = this.state.self?.name ?? this.name;
    if (!this.isRenamed || name === this.name) return;
    this.keep({ name });
    this.client.post({ type: "set_name", name });
  }

  private connect(role: string): void {
    this.isRenamed = false; // what the session still lists may be of before
    this.client.post({ type: "connect", base_url: this.baseUrl, role, name: this.name, ...this.state.entry, software: SOFTWARE });
  }

  private keep(changed: Partial<Joining["person"]>): void {
    Object.assign(this.person, changed);
    remember(STORAGE_KEY, this.person);
  }
}
