import { address } from "./browser.js";
import assert from "node:assert/strict";
import test from "node:test";
import {
  addFrames, at, beforeAfter, dropFrames, frameTimes, inSpan, neighbour, remember, shownFrame, spanText, state,
} from "../../bevviz/workbench/page/page_state.js";

const START = 1750000000000000000n;
const stamp = (frame) => String(START + BigInt(frame) * 100000000n);
const show = (frame) => { state.time = stamp(frame); };

test("frames come in any order, and have neighbours where these are known", () => {
  addFrames({ type: "frames", frames: [3, 0, 1].map((frame) => ({ stamp: stamp(frame), frame })) });
  assert.deepEqual(frameTimes().map((_, row) => frameTimes.number(row)), [0, 1, 3]);
  show(0);
  assert.deepEqual([shownFrame(), neighbour(1), neighbour(-1)], [0, stamp(1), null]);
  show(1);
  assert.deepEqual([shownFrame(), neighbour(1)], [1, null], "frame 2 has not come");
  show(2);
  assert.equal(shownFrame(), null);
  state.over = true;
  show(1);
  assert.equal(neighbour(1), stamp(3));
});

test("times are seconds of the drive, or numbers of single frames", () => {
  Object.assign(state, { opening: stamp(0), first: stamp(0) });
  const span = { first: stamp(1), last: stamp(3) };
  assert.deepEqual([at(stamp(3)), spanText(span)], ["0.30 s", "0.10 to 0.30 s"]);
  state.single = true;
  assert.deepEqual([at(stamp(3)), spanText(span)], ["frame 3", "frame 1 to frame 3"]);
  state.single = false;
});

test("a span has both of its ends", () => {
  assert.ok(inSpan(stamp(7)), "without a span all frames are in it");
  state.span = { first: stamp(1), last: stamp(3) };
  assert.deepEqual([0, 1, 3, 4].map((frame) => inSpan(stamp(frame))), [false, true, true, false]);
});

test("the address holds the state", () => {
  Object.assign(state, { bag: "a b", pick: "truth//0", set: ["clustering.eps=1"], flipped: true });
  remember();
  const parts = new URLSearchParams(address.at(-1).split("#")[1]);
  assert.deepEqual(Object.fromEntries(parts), {
    bag: "a b", at: stamp(1), pick: "truth//0", span: `${stamp(1)}-${stamp(3)}`, set: "clustering.eps=1", side: "before",
  });
});

test("frames that a robot has no longer are dropped, but those that it holds", () => {
  dropFrames([stamp(0), stamp(3)]);
  assert.deepEqual(frameTimes().map((_, row) => frameTimes.number(row)), [0, 3]);
});

test("an unknown number is a dash", () => {
  assert.equal(beforeAfter({ before: null, after: 0 }), "– → 0");
});
