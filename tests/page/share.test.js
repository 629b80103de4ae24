import { element } from "./browser.js";
import assert from "node:assert/strict";
import test from "node:test";

location.hash = "#bag=drive.mcap&first=5&opened=abc";
const { state } = await import("../../bevviz/workbench/page/page_state.js");
const { sameDrive, welcomed } = await import("../../bevviz/workbench/page/share.js");

test("a link is about one drive, and tells where the values differ", () => {
  Object.assign(state, { bag: "drive.mcap", first: "5" });
  welcomed({ opened: "abc" });
  assert.deepEqual([sameDrive(), element("linked").hidden], [true, true]);
  welcomed({ opened: "other" });
  assert.equal(sameDrive(), true);
  assert.match(element("linked").textContent, /other opened values/);
  state.first = "6";
  assert.equal(sameDrive(), false);
  assert.match(element("linked").textContent, /another drive of the name drive.mcap/);
});
