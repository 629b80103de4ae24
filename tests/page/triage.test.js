import "./browser.js";
import assert from "node:assert/strict";
import test from "node:test";
import { state } from "../../bevviz/workbench/page/page_state.js";
import { csv, matches, similar, sorted } from "../../bevviz/workbench/page/triage.js";

const sight = (more = {}) => ({
  frame: 0, stamp: "1000000000", distance: 30, pick: "truth//0", tried: false, text: "merged", remark: "", in_way: false, ...more,
});
const finding = (key, more = {}, ...sights) => (
  { key, what: "missed", name: "car", reasons: ["nearer than 10 m"], rank: [-1, -1, 30, 1], best: 0, handled: null, sights: sights.length ? sights : [sight()], ...more });
const keys = (rows) => rows.map(({ key }) => key);
const ALL = { words: "", class: "", reason: "", within: "" };

test("similar cases have the same reason, and the same kind, class and distance before others", () => {
  const own = finding("own");
  const others = [
    finding("another reason", {}, sight({ text: "ground" })), finding("another kind", { what: "false" }), finding("far", {}, sight({ distance: 45 })),
    finding("handled", { handled: { state: "done" } }), finding("near", {}, sight({ distance: 29 })), finding("note", { what: "note" }),
  ];
  assert.deepEqual(keys(similar(own, [own, ...others])), ["near", "another kind"]);
  assert.deepEqual(keys(similar(own, [own, ...others], 9)), ["near", "another kind", "far"]);
});

test("rows are in the order of the server, handled ones last", () => {
  const rows = [
    finding("handled", { handled: { state: "done" }, rank: [-3, -1, 2, 0] }), finding("later", { rank: [-1, -1, 5, 9] }), finding("note", { rank: [0, 1, 0] }),
    finding("first", { rank: [-1, -1, 5, 1] }), finding("doubtful", { rank: [-1, -0.5, 1, 0] }),
  ];
  assert.deepEqual(keys(sorted(rows, false)), ["first", "later", "doubtful", "note", "handled"]);
});

test("the group of the severest finding comes first", () => {
  const rows = [finding(1, { rank: [0, -1, 30, 0] }), finding(2, { rank: [0, -1, 31, 0] }, sight({ text: "ground" })),
    finding(3, { rank: [-1, -1, 2, 0] }, sight({ text: "ground" }))];
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
