import "./browser.js";
import assert from "node:assert/strict";
import test from "node:test";
import { state } from "../../bevviz/workbench/page/page_state.js";
import { csv, matches, severity, similar, sorted } from "../../bevviz/workbench/page/triage.js";

const sight = (more = {}) => ({
  frame: 0, stamp: "1000000000", distance: 30, pick: "truth//0", tried: false, text: "merged", remark: "", in_way: false, ...more,
});
const finding = (key, more = {}, ...sights) => (
  { key, what: "missed", name: "car", best: 0, handled: null, sights: sights.length ? sights : [sight()], ...more });
const keys = (rows) => rows.map(({ key }) => key);
const ALL = { words: "", class: "", reason: "", within: "" };

test("each reason that makes a finding severe counts once", () => {
  const near = finding(1, {}, sight({ distance: 10, in_way: true }), sight({ stamp: "1500000000", distance: 9, in_way: true }));
  assert.deepEqual(severity(near), ["in the way of the robot", "nearer than 10 m", "lasts 0.5 s"]);
  assert.deepEqual(severity(finding(2)), []);
  assert.deepEqual(severity(finding(3, { what: "note" }, sight({ distance: 1 }))), []);
  assert.equal(severity(finding(4, { what: "anomaly", name: "sync" })).length, 1);
});

test("a second name is not severe", () => {
  assert.deepEqual(severity(finding(1, {}, sight({ distance: 2, text: "second name" }))), []);
});

test("similar cases have the same reason, and the same kind, class and distance before others", () => {
  const own = finding("own");
  const others = [
    finding("another reason", {}, sight({ text: "ground" })), finding("another kind", { what: "false" }), finding("far", {}, sight({ distance: 45 })),
    finding("handled", { handled: { state: "done" } }), finding("near", {}, sight({ distance: 29 })), finding("note", { what: "note" }),
  ];
  assert.deepEqual(keys(similar(own, [own, ...others])), ["near", "another kind"]);
  assert.deepEqual(keys(similar(own, [own, ...others], 9)), ["near", "another kind", "far"]);
});

test("severe ones come first, handled ones last", () => {
  const rows = [
    finding("handled", { handled: { state: "done" } }, sight({ distance: 1, in_way: true })),
    finding("far"),
    finding("unknown distance", {}, sight({ distance: null })),
    finding("false", { what: "false" }, sight({ distance: 5 })),
    finding("near", {}, sight({ distance: 5 })),
    finding("sync", { what: "anomaly", name: "sync" }),
  ];
  assert.deepEqual(keys(sorted(rows, false)), ["sync", "near", "false", "far", "unknown distance", "handled"]);
});

test("the group of the severest finding comes first", () => {
  const rows = [finding(1), finding(2, {}, sight({ text: "ground" })), finding(3, {}, sight({ text: "ground", distance: 2 }))];
  assert.deepEqual(keys(sorted(rows, true)), [3, 2, 1]);
});

test("filters see what the rows show", () => {
  const row = finding(1, {}, sight({ remark: "a cure" }));
  for (const filters of [{ words: "MISSED merg" }, { class: "car" }, { reason: "merged" }, { within: "30" }]) {
    assert.ok(matches(row, { ...ALL, ...filters }), JSON.stringify(filters));
  }
  for (const filters of [{ words: "cure" }, { class: "bus" }, { reason: "ground" }, { within: "20" }]) {
    assert.ok(!matches(row, { ...ALL, ...filters }), JSON.stringify(filters));
  }
  assert.ok(!matches(finding(2, {}, sight({ distance: null })), { ...ALL, within: "30" }));
});

test("the table has one line for each row, and quotes what needs it", () => {
  Object.assign(state, { opening: "0", first: 0 });
  const [head, line] = csv([finding(1, {}, sight({ remark: 'says "no", twice', distance: 3.5 }))]).split("\n");
  assert.equal(head, "severity,why_severe,kind,class,frame,seconds,distance_m,frames,reason,remark,state,note");
  assert.equal(line, '1,nearer than 10 m,missed,car,0,1.00,3.5,1,merged,"says ""no"", twice",,');
});
