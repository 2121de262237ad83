// Names and texts of a session come from strangers: nothing of the page may parse them as markup.

import { globSync, readFileSync } from "node:fs";
import { expect, test } from "vitest";

const SOURCES = new URL("../../src/", import.meta.url);
const PARSES = /innerHTML|outerHTML|insertAdjacentHTML|document\.write|createContextualFragment|DOMParser|\beval\(|new Function/;

test("no source parses text as markup or code", () => {
  const files = globSync("**/*.ts", { cwd: SOURCES });
  expect(files.length).toBeGreaterThan(20);
  const found = files.filter((file) => PARSES.test(readFileSync(new URL(file, SOURCES), "utf-8")));
  expect(found).toEqual([]);
});
