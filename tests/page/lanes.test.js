import assert from "node:assert/strict";
import test from "node:test";
import { bars, lanes, nearest, shade } from "../../bevviz/workbench/page/lanes.js";

const finding = (what, ...sights) => ({ what, sights: sights.map(([stamp, distance]) => ({ stamp, distance })) });

test("each sort has a lane, if it has findings", () => {
  const found = lanes([finding("note"), finding("lost"), finding("missed")]);
  assert.deepEqual(found.map(({ name, entries }) => [name, entries.length]), [["missed", 2], ["note", 1]]);
});

test("a bar has the number of its findings and the nearest one", () => {
  const [far, near] = [finding("missed", ["10", 20], ["50", null]), finding("missed", ["10.3", 4])];
  const made = bars({ name: "missed", color: "", entries: [far, near] }, Number);
  assert.deepEqual(made.map(({ x, count, distance, row }) => ({ x, count, distance, row })), [
    { x: 10, count: 2, distance: 4, row: 0 }, { x: 50, count: 1, distance: null, row: 1 },
  ]);
  assert.equal(made[0].entry, near);
});

test("a nearer finding is darker", () => {
  assert.deepEqual([0, 5, 40, 90].map(shade), [1, 1, 0.35, 0.35]);
  assert.ok(shade(10) > shade(20) && shade(null) < 1);
});

test("the nearest time", () => {
  assert.deepEqual([-5, 4, 6, 99].map((wanted) => nearest([0, 10, 20], wanted)), [0, 0, 1, 2]);
});
