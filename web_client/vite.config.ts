import { defineConfig } from "vite";

// The page is served by the gateway under a content security policy that allows this origin only: nothing is inlined.
export default defineConfig({
  base: "/",
  build: {
    outDir: "../iris_session/web/page",
    emptyOutDir: true,
    assetsInlineLimit: 0,
    target: "es2023",
    chunkSizeWarningLimit: 1500,
    license: { fileName: "licenses.md" },
  },
  worker: { format: "es" },
});
