// What is said of an episode, on the page and before the eyes.

import { afterEach, describe, expect, test, vi } from "vitest";
import { describeEpisode, type EpisodeNow, episodeAdvice, episodeTitle, isEpisodeOver, isUrgent, makeEpisodeStrip, secondsLeft } from "../../src/ui/episodes.ts";
import { PageState } from "../../src/ui/state.ts";

const NOW: EpisodeNow = {
  event: "episode_changed",
  number: 13,
  state: "countdown",
  label: "",
  participant: "p1",
  task: "pour",
  instruction: "Pour the cup.",
  wanted: 50,
  successes: 12,
  started_by: "p1",
  started_by_name: "ann",
  led_by: "p1",
  started_ns: 0,
  until_ns: 3e9,
  verdict: "",
  robots: [],
};

/** Return the state of the page of ann, p1, who holds a robot. */
function makeState(role: string, held: string, task_robots: string[], robots: string[], episode: EpisodeNow | null): PageState {
  const state = new PageState({ on: () => undefined } as unknown as ConstructorParameters<typeof PageState>[0]);
  const leases = [{ target: held, holder: "p1", sub_holders: [] }];
  const session = { participant_id: "p1", participants: [{ id: "p1", name: "ann", role }], leases, robots: robots.map((name) => ({ name })), episode };
  return Object.assign(state, { session, welcome: { task_robots }, phase: { phase: "ready" } }) as PageState;
}

describe("words", () => {
  test("a countdown is in whole seconds, and none before the clock is known", () => {
    expect([1, 1e9, 2.01e9, 3e9, 4e9].map((ns) => secondsLeft(NOW, ns))).toEqual([3, 2, 1, 0, 0]);
    expect(secondsLeft(NOW, 0)).toBe(0);
    expect(secondsLeft({ ...NOW, until_ns: 0 }, 1)).toBe(0);
  });

  test("the board has the task, how far it is, and what to do", () => {
    const describe = (episode: EpisodeNow | null, held = "left", role = "operator", robots = ["left", "right"]): string[] => {
      const state = makeState(role, held, [], robots, episode);
      vi.spyOn(state, "sessionTime").mockReturnValue(1e9);
      return describeEpisode(state);
    };
    const idle = { ...NOW, state: "idle", number: 12 };
    expect(describe(NOW)).toEqual(["Pour the cup.", "Episode 13, 12 of 50: begins in 2"]);
    expect(describe(idle)).toEqual(["Pour the cup.", "12 episodes so far, 12 of 50"]);
    expect(describe(idle, "", "observer")).toEqual(describe(idle));
    expect(describe(idle, "")[1]).toBe("12 episodes so far, 12 of 50: take left or right to start");
    expect(describe({ ...NOW, state: "success" }, "", "operator", ["a", "b", "c"])[1]).toBe("Episode 13, 12 of 50: success; take one of a, b, c to start");
    expect(describe(null)).toEqual([]);
    expect(episodeTitle({ ...NOW, wanted: 0 })).toBe("Episode 13");
  });

  test("every state has its advice", () => {
    const advice = (state: string, verdict = ""): string => episodeAdvice({ ...NOW, state, verdict }, 1e9, "ann");
    expect(advice("running")).toBe("is recorded, led by ann");
    expect(advice("confirm")).toBe("discard it? Press Discard again within 2 s");
    expect(advice("left")).toBe("ann is disconnected: take it over within 2 s");
    expect(advice("closing")).toBe("robots hold: was it a success? 2 s");
    expect(advice("closing", "success")).toBe("success: the scene is made ready");
    expect(advice("unknown")).toBe("unknown");
  });

  test("what asks for an answer is before the eyes, and an episode that is over is not", () => {
    const states = ["countdown", "running", "confirm", "left", "closing", "success", "cancelled"];
    expect(states.filter((state) => isUrgent({ ...NOW, state }))).toEqual(["countdown", "confirm", "left", "closing"]);
    expect(states.filter((state) => isEpisodeOver({ ...NOW, state }))).toEqual(["success", "cancelled"]);
  });
});

describe("offers", () => {
  afterEach(() => vi.unstubAllGlobals());

  /** Return the buttons that are offered after the last episode, and what key 1 sends. */
  function offer(role: string, held: string, task_robots: string[], robots = ["left", "right"]): unknown[] {
    const texts: [string, { hidden?: boolean; value: string }][] = [];
    const createElement = (): object => {
      const element = { classList: { toggle: () => undefined }, value: "", setAttribute: () => undefined, addEventListener: () => undefined };
      return Object.assign(element, { append: (child: unknown) => typeof child === "string" && texts.push([child, element]) });
    };
    let press = (_event: object): void => undefined;
    vi.stubGlobal("HTMLElement", class {});
    vi.stubGlobal("document", { createElement });
    vi.stubGlobal("window", { addEventListener: (_type: string, listener: typeof press) => (press = listener) });
    const state = makeState(role, held, task_robots, robots, { ...NOW, state: "success" });
    const sent: string[] = [];
    const request = async ({ action }: { action: string }): Promise<boolean> => sent.push(action) > 0;
    const strip = makeEpisodeStrip(state, { request } as unknown as Parameters<typeof makeEpisodeStrip>[1]);
    strip.update();
    press({ code: "Digit1" });
    return [texts.flatMap(([text, { hidden }]) => (["Start", "Reset scene"].includes(text) && !hidden ? [text] : [])), sent];
  }
  const ALL = [["Start", "Reset scene"], ["start"]];
  const NONE = [[], []];

  test("who may start an episode is offered it: directors, holders of a robot of the task, all where there is none", () => {
    expect(offer("director", "", ["left"])).toEqual(ALL);
    expect(offer("operator", "", ["left"])).toEqual(NONE);
    expect(offer("operator", "right", ["left"])).toEqual(NONE);
    expect(offer("operator", "left", ["left"])).toEqual(ALL);
    expect(offer("operator", "right", [])).toEqual(ALL);
    expect(offer("operator", "", [])).toEqual(NONE);
    expect(offer("operator", "", [], [])).toEqual(ALL);
  });
});
