import { element, pass } from "./browser.js";
import assert from "node:assert/strict";
import test from "node:test";

const { requestAnimationFrame: draw, fetch } = window;
const { compileStreaming } = WebAssembly;
const patches = (query) => import(`../../bevviz/workbench/page/rerun_patches.js?${query}`);

// A viewer that draws again and again. Returns the page's part in it, and the number of its pictures until now.
async function viewer(query) {
  window.requestAnimationFrame = draw;
  const { wake } = await patches(query);
  let drawn = 0;
  const redraw = () => { drawn += 1; window.requestAnimationFrame(redraw); };
  redraw();
  return { wake, pictures: () => drawn };
}

test("a viewer of another version is left as it is", async () => {
  element("viewer").dataset.version = "0.45.0";
  const { keepCompiled, wake } = await patches("other");
  keepCompiled("http://127.0.0.1/viewer.wasm");
  wake(1e6);
  assert.deepEqual([window.requestAnimationFrame, window.fetch, WebAssembly.compileStreaming], [draw, fetch, compileStreaming]);
});

test("a browser that cannot compile a stream loads the viewer as ever", async () => {
  element("viewer").dataset.version = "0.41.1";
  delete WebAssembly.compileStreaming;
  const { keepCompiled } = await patches("old");
  keepCompiled("http://127.0.0.1/viewer.wasm");
  assert.equal(window.fetch, fetch);
});

test("pictures are held back until there is something to draw", async () => {
  const { wake, pictures } = await viewer("own");
  pass(10000);
  const before = pictures();
  pass(10000);
  assert.equal(pictures(), before);
  wake();
  pass(1000);
  assert.ok(pictures() > before);
});

test("some time after the last data more pictures are drawn: a busy machine may not have read all", async () => {
  const { wake, pictures } = await viewer("late");
  wake(1000);
  pass(2900);
  const counts = [4000, 6000, 10000, 20000, 60000].map((wait) => { const before = pictures(); pass(wait); return pictures() - before; });
  assert.ok(counts.slice(0, 4).every((count) => count > 0 && count < 80), counts.join());
  assert.equal(counts[4], 0);
});
