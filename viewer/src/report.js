// The viewer inside a report: the points are in the page.
import { decode } from "./decode.js";
import { expose, hasWebGl, makeViewer } from "./viewer.js";

async function start() {
  const root = document.getElementById("viewer");
  if (!hasWebGl()) {
    root.textContent = "This browser draws no 3-D (WebGL 2 is missing or switched off); the still pictures below show the same clouds.";
    root.classList.add("failed");
    return;
  }
  const scene = JSON.parse(document.getElementById("viewer-scene").textContent);
  const viewer = makeViewer(root, scene, false);
  for (const cloud of scene.clouds) viewer.stage.add(await decode(cloud));
  viewer.stage.draw();
  viewer.status.remove();
  document.documentElement.classList.add("viewer-ready");
  expose(viewer, { ready: performance.now() });
}

start().catch((error) => {
  const root = document.getElementById("viewer");
  root.textContent = `The 3-D view could not be started (${error.message}); the still pictures below show the same clouds.`;
  root.classList.add("failed");
  console.error(error);
});
