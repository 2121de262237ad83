// Drives Chromium for tests in another language: one JSON command per line on standard input, one JSON answer per line
// on standard output. Commands name a page; `open` makes it, in a browser context (storage, identity) of its own unless
// `like` names the page whose context it shares. Answers: {"id", "value"} or {"id", "error"}.

import { createInterface } from "node:readline";
import { chromium } from "playwright-core";

const [executablePath] = process.argv.slice(2);
const browser = await chromium.launch({
  executablePath,
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
});
const pages = new Map();
/** Sessions that hold a finger on a page: it is taken away when they end. */
const fingers = new Map();

/** The messages of a page that tests look at: errors of the page itself, and refused requests. */
const logs = new Map();

const commands = {
  async open({ page, url, width = 1280, height = 800, like = "", phone = false, before = [] }) {
    const context =
      pages.get(like)?.context() ??
      (await browser.newContext({ viewport: { width, height }, ignoreHTTPSErrors: true, hasTouch: phone, isMobile: phone }));
    const made = await context.newPage();
    for (const content of before) await made.addInitScript({ content }); // runs before the page's own scripts
    const log = [];
    made.on("pageerror", (error) => log.push(`page: ${error.message}`));
    made.on("console", (message) => message.type() === "error" && log.push(`console: ${message.text()}`));
    made.on("requestfailed", (request) => log.push(`request: ${request.url()} ${request.failure()?.errorText}`));
    logs.set(page, log);
    pages.set(page, made);
    await made.goto(url);
  },
  log: ({ page }) => logs.get(page),
  close: ({ page }) => pages.get(page).close(),
  reload: ({ page }) => pages.get(page).reload(),
  evaluate: ({ page, script }) => pages.get(page).evaluate(script),
  // Not waitForFunction: it evaluates strings within the page, which the page's security policy forbids.
  async wait({ page, script, timeout_ms }) {
    const deadline = Date.now() + timeout_ms;
    while (!(await pages.get(page).evaluate(script).catch(() => false))) {
      if (Date.now() > deadline) throw new Error(`not within ${timeout_ms} ms: ${script}`);
      await new Promise((resolve) => setTimeout(resolve, 50));
    }
    return true;
  },
  click: ({ page, role, name, timeout_ms }) => pages.get(page).getByRole(role, { name, exact: true }).click({ timeout: timeout_ms }),
  fill: ({ page, label, text, timeout_ms }) => pages.get(page).getByRole("textbox", { name: label, exact: true }).fill(text, { timeout: timeout_ms }),
  select: ({ page, label, text, timeout_ms }) =>
    pages.get(page).getByRole("combobox", { name: label, exact: true }).selectOption({ label: text }, { timeout: timeout_ms }),
  check: ({ page, name, timeout_ms }) => pages.get(page).getByRole("checkbox", { name, exact: true }).check({ timeout: timeout_ms }),
  press: ({ page, key }) => pages.get(page).keyboard.press(key),
  hold: ({ page, key }) => pages.get(page).keyboard.down(key),
  let_go: ({ page, key }) => pages.get(page).keyboard.up(key),
  // Presses the mouse in the middle of an element, moves it by (x, y) pixels, and lets it go.
  async drag({ page, selector, x, y, steps, step_ms }) {
    const { mouse } = pages.get(page);
    const box = await pages.get(page).locator(selector).boundingBox();
    const at = { x: box.x + box.width / 2, y: box.y + box.height / 2 };
    await mouse.move(at.x, at.y);
    await mouse.down();
    for (let i = 1; i <= steps; i++) {
      await mouse.move(at.x + (x * i) / steps, at.y + (y * i) / steps);
      await new Promise((resolve) => setTimeout(resolve, step_ms));
    }
    await mouse.up();
  },
  /** Moves the mouse to a place of the page [pixels], and presses or lets go its button there. */
  async point({ page, x, y, action = "" }) {
    const { mouse } = pages.get(page);
    await mouse.move(x, y);
    if (action !== "") await mouse[action]();
  },
  /** Puts a finger at a place of the page ("touchStart"), moves it there, or takes it away ("touchEnd"). */
  async touch({ page, x, y, action }) {
    if (!fingers.has(page)) fingers.set(page, await pages.get(page).context().newCDPSession(pages.get(page)));
    await fingers.get(page).send("Input.dispatchTouchEvent", { type: action, touchPoints: action === "touchEnd" ? [] : [{ x, y }] });
  },
  type: ({ page, text }) => pages.get(page).keyboard.type(text),
  screenshot: ({ page, path, full = false }) => pages.get(page).screenshot({ path, fullPage: full }).then(() => path),
  /** Lets nothing run on the page's main thread for a while. Its worker runs on, as that of a tab in the background does. */
  async stand_still({ page, ms }) {
    const session = await pages.get(page).context().newCDPSession(pages.get(page));
    await session.send("Debugger.enable");
    const paused = new Promise((resolve) => session.once("Debugger.paused", resolve));
    await session.send("Debugger.pause");
    await paused;
    await new Promise((resolve) => setTimeout(resolve, ms));
    await session.send("Debugger.resume");
    await session.detach();
  },
  /** Bytes of the page's heap on its main thread, after a garbage collection. */
  async heap({ page }) {
    const session = await pages.get(page).context().newCDPSession(pages.get(page));
    await session.send("HeapProfiler.collectGarbage");
    const { usedSize } = await session.send("Runtime.getHeapUsage");
    await session.detach();
    return usedSize;
  },
  inject: ({ page, path }) => pages.get(page).addScriptTag({ path }).then(() => true),
};

const answer = (id, body) => process.stdout.write(`${JSON.stringify({ id, ...body })}\n`);
for await (const line of createInterface({ input: process.stdin })) {
  const { id, command, ...rest } = JSON.parse(line);
  try {
    answer(id, { value: (await commands[command](rest)) ?? null });
  } catch (error) {
    answer(id, { error: String(error.message ?? error) });
  }
}
await browser.close();
