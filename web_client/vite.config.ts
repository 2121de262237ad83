import { appendFileSync, readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";

import { defineConfig, type Plugin } from "vite";

const LICENSES = "licenses.md";

/** Folders of packages whose modules are in the worker: a bundle of its own, which `build.license` leaves out. */
const ofWorker = new Set<string>();

const notePackages: Plugin = {
  name: "note-packages",
  generateBundle(_options, bundle) {
    for (const chunk of Object.values(bundle)) {
      for (const id of chunk.type === "chunk" ? chunk.moduleIds : []) {
        const folder = /^.*\/node_modules\/(?:@[^/]+\/)?[^/]+/.exec(id)?.[0];
        if (folder !== undefined) ofWorker.add(folder);
      }
    }
  },
};

const addLicenses: Plugin = {
  name: "add-licenses",
  writeBundle({ dir = "" }) {
    for (const folder of [...ofWorker].sort()) {
      const { name, version, license } = JSON.parse(readFileSync(join(folder, "package.json"), "utf-8"));
      const file = readdirSync(folder).find((one) => /^license/i.test(one));
      const text = file === undefined ? "" : `\n${readFileSync(join(folder, file), "utf-8").trim()}\n`;
      appendFileSync(join(dir, LICENSES), `\n## ${name} - ${version} (${license})\n${text}`);
    }
  },
};

// The page is served by the gateway under a content security policy that allows this origin only: nothing is inlined.
export default defineConfig({
  base: "/",
  build: {
    outDir: "../iris_session/web/page",
    emptyOutDir: true,
    assetsInlineLimit: 0,
    target: "es2023",
    chunkSizeWarningLimit: 1500,
    license: { fileName: LICENSES },
  },
  plugins: [addLicenses],
  worker: { format: "es", plugins: () => [notePackages] },
});
