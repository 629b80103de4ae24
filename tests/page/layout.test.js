import "./browser.js";
import assert from "node:assert/strict";
import test from "node:test";

const { restored, withCamera } = await import("../../bevviz/workbench/page/layout.js");

const view = (title) => ({ ViewBlueprint: { display_name: title } });
const layout = (kind = "Tabs", run = "a") => ({
  [`/container/${run}`]: { ContainerBlueprint: { display_name: "Cameras", container_kind: kind, active_tab: `/view/${run}1`, contents: [`/view/${run}1`, `/view/${run}2`] } },
  [`/view/${run}1`]: view("front"), [`/view/${run}2`]: view("left"),
  [`/view/${run}1/EyeControls3D`]: { EyeControls3D: { position: [run] } },
  "/time_panel": { TimePanelBlueprint: { timeline: run } },
});

test("the camera that shows the subject comes to the front, unless the one in front shows it, too", () => {
  assert.equal(withCamera(layout(), ["left"])["/container/a"].ContainerBlueprint.active_tab, "/view/a2");
  assert.equal(withCamera(layout(), ["left", "front"]), null);
  assert.equal(withCamera(layout(), ["none"]), null);
  assert.equal(withCamera(layout("Vertical"), ["left"]), null);
  assert.equal(withCamera({}, ["left"]), null);
});

test("a kept layout is restored in another run, with the eyes and the time of that one", () => {
  const [saved, own] = [layout("Tabs", "a"), layout("Tabs", "b")];
  saved["/container/a"].ContainerBlueprint.active_tab = "/view/a2";
  const now = restored(saved, own);
  assert.equal(now["/container/a"].ContainerBlueprint.active_tab, "/view/a2");
  assert.deepEqual(now["/view/a1/EyeControls3D"], own["/view/b1/EyeControls3D"]);
  assert.deepEqual(now["/time_panel"], own["/time_panel"]);
});

test("a layout of other views is not restored", () => {
  assert.equal(restored({ ...layout(), "/view/c": view("right") }, layout()), null);
});
