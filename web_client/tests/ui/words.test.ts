import { expect, test } from "vitest";

import { denialWords, doubtWords, eventWords, formatBytes, formatCount, formatMillimetres, formatMilliseconds, formatSessionTime, graceWords, isDoubtful, limitWords, streamAgeWords, streamStateWords } from "../../src/ui/words.ts";

const nameOf = (id: string): string => ({ p1: "ann", p2: "ben" })[id] ?? "";
type Body = Parameters<typeof eventWords>[0];

test("an e-stop says who and why", () => {
  const body = { event: "estop_changed", active: true, participant: "p1", reason: "too close", stop_seq: 1 } as Body;
  expect(eventWords(body, nameOf)).toEqual({ level: "error", text: "e-stop by ann: too close" });
});

test("a lease that changes hands names both", () => {
  const lease = { target: "left", kind: "robot", mode: "takeover", holder: "p2", lease_version: 2, expires_ns: 0 };
  const filled = { ...lease, queue: [], sub_holders: [], weights: [], scale: 1 };
  const body = { event: "lease_changed", lease: filled, cause: "takeover", previous_holder: "p1" } as Body;
  expect(eventWords(body, nameOf)!.text).toBe("ben took over left from ann");
});

test("an event of another version is left out, not an error", () => {
  expect(eventWords({ event: "from_the_future" } as unknown as Body, nameOf)).toBeNull();
});

test("the return from an earlier session is no news, other security events are", () => {
  const audited = { event: "audited", kind: "flood", subject: "", name: "ann", address: "", detail: "", count: 2 };
  expect(eventWords(audited as Body, nameOf)!.text).toBe("flood, ann, 2 times");
  expect(eventWords({ ...audited, kind: "token_refused" } as Body, nameOf)).toBeNull();
});

test("a denial names the holder once, and the advice", () => {
  const denial = { reason: "not_holder", message: "left is held", advice: "wait for it", target: "left", holder: "p1" };
  expect(denialWords({ ...denial, holder_name: "ann" })).toBe("Left is held. Held by ann. Wait for it");
  expect(denialWords({ ...denial, message: "ann holds left.", holder_name: "ann" })).toBe("Ann holds left. Wait for it");
});

test("a denial of what others hold has no words of programs, and says when it is free", () => {
  const denial = { reason: "held", message: "left is held by ann, disconnected 4 s ago, free in 26 s", advice: "acquire with wait=True", target: "left", holder: "p1", holder_name: "ann" };
  expect(denialWords(denial)).toMatch(/^Left is held by ann, disconnected 4 s ago, free in 26 s\. .*Wait for it/);
  expect(denialWords(denial)).not.toMatch(/wait=/);
  const own = { ...denial, message: "who holds a robot cannot wait for another: you hold right", advice: "release it and acquire all robots in one request" };
  expect(denialWords(own)).toBe("Who holds a robot cannot wait for another: you hold right.");
  expect(graceWords(30e9, 4e9)).toMatch(/free in 26 s/);
});

test("an unconfirmed alignment says why, also for a reason of another version", () => {
  expect(doubtWords({ doubt: "", confirmed_ns: 400e9 })).toBe("");
  expect(doubtWords({ doubt: "aged", confirmed_ns: 360e9 })).toBe("the alignment is 6 min old");
  expect(doubtWords({ doubt: "contradicted", confirmed_ns: 0 })).toMatch(/contradict/);
  expect(doubtWords({ doubt: "unverified", confirmed_ns: 0 })).toMatch(/since this headset last saw it/);
  expect(doubtWords({ doubt: "too_hot", confirmed_ns: 0 })).toMatch(/too hot/);
});

test("a sheet that was moved, and one of two prints, is said of the sheet", () => {
  const alarm = { event: "alignment_alarmed", participant: "p1", kind: "two_places", anchor_id: "table", size_m: 0.8, beside: [], witnesses: [] };
  expect(eventWords(alarm as Body, nameOf)!.text).toMatch(/table in two places/);
  expect(eventWords({ ...alarm, kind: "changed", witnesses: ["p2"] } as Body, nameOf)).toBeNull();
});

test("numbers have units that fit", () => {
  expect([formatMillimetres(0.0043), formatMillimetres(0.021), formatMillimetres(1.5)]).toEqual(["4.3 mm", "21 mm", "150 cm"]);
  expect([formatBytes(512), formatBytes(48_200_000)]).toEqual(["512 B", "48 MB"]);
  expect(formatSessionTime(754.3e9)).toBe("12:34.3");
});

test("a stream that is stale or faulty says so in words, also for a fault of another version", () => {
  const good = { stale: false, fault: "", budget_class: "full" };
  expect(streamStateWords(good, false)).toBe("");
  expect(streamStateWords({ ...good, stale: true, fault: "frozen" }, true)).toBe("stale, its camera repeats one frame");
  expect(streamStateWords({ ...good, fault: "lens_dirty" }, false)).toBe("lens dirty");
  expect(streamStateWords({ ...good, budget_class: "none" }, true)).toBe("paused: the link is too slow");
  expect(streamStateWords({ ...good, budget_class: "none" }, false)).toBe(""); // a cloud at rest is still right
  expect(streamStateWords(good, true)).toBe("newer frames do not come here");
});

test("a cloud of a slow source is drawn as it is, one that is stale or wrong is dimmed", () => {
  const slow = { stale: false, fault: "slow", budget_class: "full" };
  expect(isDoubtful(slow, false)).toBe(false);
  expect(isDoubtful({ ...slow, stale: true }, false)).toBe(true);
  expect(isDoubtful(slow, true)).toBe(true);
  expect(isDoubtful({ ...slow, fault: "moved" }, false)).toBe(true);
});

test("ages of streams grow from milliseconds to hours", () => {
  expect([45, 4200, 600_000, Number.NaN, -3].map(streamAgeWords)).toEqual(["45 ms old", "4 s old", "10 min old", "", "0.0 ms old"]);
  expect(formatCount(50_000)).toBe("50,000");
});

test("every limit on the wire has words, and a joint its number or name", () => {
  const known = ["speed", "reach", "singular", "workspace", "proximity", "leader_apart", "tracking", "sag", "joints_only"];
  for (const limit of known) expect(limitWords([limit])).not.toMatch(/_|joint .* at its end/);
  expect(["panda_joint4", "left/joint_2", "left/elbow", "shoulder_pan_joint"].map((joint) => limitWords([joint]))).toEqual([
    "joint 4 at its end",
    "joint 2 at its end",
    "joint elbow at its end",
    "joint shoulder pan at its end",
  ]);
  expect(limitWords(["speed", "joint1", "singular", "tracking"])).toBe(limitWords(["tracking", "joint1"])); // the two that count
});

test("an age is never negative: clocks agree to a fraction of a millisecond only", () => {
  expect([-0.04, 0.26, 120, 1500, Number.NaN].map(formatMilliseconds)).toEqual(["0.0 ms", "0.3 ms", "120 ms", "1.5 s", "–"]);
});
