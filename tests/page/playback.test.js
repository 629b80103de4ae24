import { element, pass } from "./browser.js";
import assert from "node:assert/strict";
import test from "node:test";

const { addFrames, frameTimes, shownFrame, state } = await import("../../bevviz/workbench/page/page_state.js");
const loading = import("../../bevviz/workbench/page/playback.js");
const { faster, start, toggle, toggleLoop } = await loading;
const { isThere, seek } = await import("../../bevviz/workbench/page/viewer.js");

const FRAMES = 11; // 0.1 s each
addFrames({ type: "frames", frames: [...Array(FRAMES).keys()].map((frame) => ({ stamp: String(1e9 + frame * 1e8), frame })) });
state.over = true;
start();
pass(100);
const show = (row) => { seek(frameTimes.stamp(row)); pass(100); };

test("it plays at the speed of the drive, and stops at its end", () => {
  show(0);
  toggle();
  pass(520);
  assert.equal(shownFrame(), 5);
  pass(2000);
  assert.deepEqual([shownFrame(), element("play").textContent], [FRAMES - 1, "▶"]);
});

test("a speed is chosen, and a second toggle pauses", () => {
  show(0);
  element("speed").selectedIndex = 3;
  faster(1);
  element("speed").value = "2";
  toggle();
  pass(260);
  assert.ok(shownFrame() >= 4, String(shownFrame()));
  toggle();
  const frame = shownFrame();
  pass(1000);
  assert.equal(shownFrame(), frame);
});

test("a loop stays in the marked span", () => {
  state.span = { first: frameTimes.stamp(2), last: frameTimes.stamp(4) };
  show(8);
  toggleLoop();
  toggle();
  const seen = new Set();
  for (let step = 0; step < 100; step += 1) { pass(20); seen.add(shownFrame()); }
  assert.deepEqual([...seen].sort(), [2, 3, 4]);
});

test("it pauses where the user goes elsewhere", () => {
  show(9);
  pass(500);
  assert.deepEqual([shownFrame(), element("play").textContent, isThere()], [9, "▶", true]);
});
