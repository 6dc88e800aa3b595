// Bundles the viewer: `node build.mjs OUTPUT_FOLDER`.
// report.js goes inside the report, view.js (with the COPC decoder) is served by `dougong view`.
import { build } from "esbuild";
import { readFile, rm, writeFile } from "node:fs/promises";
import { join } from "node:path";

const folder = process.argv[2] ?? "dist";
const common = {
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  outdir: folder,
  logLevel: "warning",
  legalComments: "inline",
};
await build({ ...common, entryPoints: ["src/report.js", "src/viewer.css"] });
await build({
  ...common,
  entryPoints: ["src/view.js"],
  platform: "browser",
  loader: { ".wasm": "binary" },
  define: { global: "globalThis" },
  // The decoder's loader also knows Node; a browser never takes those branches.
  external: ["fs", "path", "crypto"],
});

// The report holds its script inline: nothing in it may look like the end of a script element.
const path = join(folder, "report.js");
const text = await readFile(path, "utf8");
await writeFile(path, text.replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--"));
await rm(join(folder, "view.css"), { force: true });
