// Entry of the page.

import { startWorker } from "./core/page_client.ts";
import { startPage } from "./ui/app.ts";

const root = document.getElementById("page");
if (root) {
  // For tests and the console; the page itself does not use it.
  Object.assign(window, { irisSession: startPage(root, startWorker()) });
}
