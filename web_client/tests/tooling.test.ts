// What the lock file may contain: exact versions from the public registry.

import { readFileSync } from "node:fs";
import { expect, test } from "vitest";

const read = (name: string) => JSON.parse(readFileSync(new URL(`../${name}`, import.meta.url), "utf-8"));

test("the lock file names the public registry only, with hashes", () => {
  const packages: Record<string, { resolved?: string; integrity?: string; link?: boolean }> = read("package-lock.json").packages;
  for (const [path, entry] of Object.entries(packages)) {
    if (path === "") continue;
    expect(entry.resolved, path).toMatch(/^https:\/\/registry\.npmjs\.org\//);
    expect(entry.integrity, path).toMatch(/^sha512-/);
  }
});

test("versions are pinned", () => {
  const { dependencies, devDependencies } = read("package.json");
  for (const [name, version] of Object.entries({ ...dependencies, ...devDependencies })) {
    expect(version, name).toMatch(/^\d+\.\d+\.\d+$/);
  }
});
