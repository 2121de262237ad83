// Which media streams this page subscribes to: what it can show, who a stream is for, and what the person chose. Pure.

import type { BudgetUpdate } from "../core/api.ts";
import { MediaEncoding, StreamAudience } from "../protocol/messages.g.ts";
import { recall, remember } from "./storage.ts";

export type Stream = BudgetUpdate["budget"]["streams"][number];

/** Where the page shows the session now. In AR the room is seen through it. */
export type Mode = "screen" | "immersive-ar" | "immersive-vr";

/** What shows a stream: its scene or a cloud in it, a panel that may be open, or nothing here. */
export type Shower = "scene" | "panel" | "";

const STORAGE_KEY = "iris-session.pictures";
export const MAX_PANELS = 4;

/** The choices of the person, and what follows from them. Panels are remembered, the others count for this visit. */
export class StreamChoices {
  /** Chosen by hand: with a screen or in VR, and in AR. */
  private readonly outside = new Map<string, boolean>();
  private readonly inAr = new Map<string, boolean>();
  private readonly remembered = recall<{ shown: string[] }>(STORAGE_KEY, { shown: [] });

  /** `listDeformables`: streams that the scene needs. `hasView`: the page draws the scene. */
  constructor(
    private readonly listDeformables: () => readonly string[],
    private readonly hasView: () => boolean,
  ) {}

  /** Return what shows a stream. */
  findShower({ stream, encoding }: Stream): Shower {
    if (encoding === MediaEncoding.JPEG) return "panel";
    return this.hasView() && (encoding === MediaEncoding.CLOUD || this.listDeformables().includes(stream)) ? "scene" : "";
  }

  /** Return whether a stream is shown. */
  isShown(one: Stream, mode: Mode): boolean {
    const shower = this.findShower(one);
    if (shower === "") return false;
    const isChosen = shower === "panel" ? this.remembered.shown.includes(one.stream) : (this.outside.get(one.stream) ?? true);
    if (mode !== "immersive-ar") return isChosen;
    const isSeenAnyway = one.audience === StreamAudience.REMOTE;
    return this.inAr.get(one.stream) ?? (isChosen && !isSeenAnyway);
  }

  /** Show a stream or not, as the person chose for `mode`. One panel too many closes the oldest one, but in AR. */
  choose(one: Stream, isShown: boolean, mode: Mode): void {
    const { stream } = one;
    const isPanel = this.findShower(one) === "panel";
    if (mode === "immersive-ar" || !isPanel) {
      (mode === "immersive-ar" ? this.inAr : this.outside).set(stream, isShown);
      return;
    }
    const others = this.remembered.shown.filter((other) => other !== stream);
    this.remembered.shown = isShown ? [...others.slice(-(MAX_PANELS - 1)), stream] : others;
    remember(STORAGE_KEY, this.remembered);
  }

  /** Return the streams of a session with an open panel. */
  listPanels(streams: readonly Stream[], mode: Mode): Stream[] {
    return streams.filter((one) => this.findShower(one) === "panel" && this.isShown(one, mode)).slice(0, MAX_PANELS);
  }

  /** Return the streams to subscribe to. */
  listWanted(streams: readonly Stream[], mode: Mode): string[] {
    const drawn = streams.filter((one) => this.findShower(one) === "scene" && this.isShown(one, mode));
    return [...drawn, ...this.listPanels(streams, mode)].map(({ stream }) => stream).sort();
  }
}
