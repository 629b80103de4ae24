// Layout of the viewer's views: the tab of the camera that shows the subject, and what the user has chosen, which the
// browser keeps. Where the viewer's layout cannot be read, each page begins with our own.

import { $, keep, kept } from "./page_state.js";
import { viewer } from "./rerun_patches.js";

/** @typedef {import("./rerun_patches.js").Blueprint} Blueprint */

const LATER = 1500; // ms after a click in the viewer, which may move a view
const [TRIES, AGAIN] = [40, 500]; // attempts to restore the layout, and ms between them
const LARGEST = 1e6; // characters
const CAMERAS = "Cameras"; // name of the tabs
const EYE = "/EyeControls3D";

let name = ""; // under which the layout is kept: it names the sensors and the kind of page
let saving = 0;
let last = ""; // the layout that is kept
/** @type {Promise<void>} */
let changing = Promise.resolve(); // one change at a time

const asText = (/** @type {unknown} */ tree) => JSON.stringify(tree, (_, value) => (typeof value === "bigint" ? { big: String(value) } : value));
const parsed = (/** @type {string} */ text) => JSON.parse(text, (_, value) => (typeof value?.big === "string" ? BigInt(value.big) : value));
const titleOf = (/** @type {Blueprint} */ layout, /** @type {string} */ path) => layout[path]?.ViewBlueprint?.display_name;
const viewsOf = (/** @type {Blueprint} */ layout) => Object.keys(layout).filter((path) => layout[path].ViewBlueprint).map((path) => titleOf(layout, path)).sort();

/**
 * The layout with the tab of one of these cameras in front, if no other of them is there. null: nothing is to be done.
 * @param {Blueprint} layout
 * @param {string[]} cameras the best one first
 */
export function withCamera(layout, cameras) {
  const tabs = Object.values(layout).find((one) => one.ContainerBlueprint?.display_name === CAMERAS)?.ContainerBlueprint;
  if (tabs?.container_kind !== "Tabs" || cameras.includes(titleOf(layout, tabs.active_tab))) return null;
  const path = tabs.contents.find((/** @type {string} */ one) => titleOf(layout, one) === cameras[0]);
  if (!path) return null;
  tabs.active_tab = path;
  return layout;
}

/**
 * The kept layout, with the eyes of our own, which go to the subject. null: our own has other views.
 * @param {Blueprint} saved
 * @param {Blueprint} own
 */
export function restored(saved, own) {
  if (asText(viewsOf(saved)) !== asText(viewsOf(own))) return null;
  const eyes = (/** @type {Blueprint} */ layout) => Object.keys(layout).filter((path) => path.endsWith(EYE));
  const title = (/** @type {Blueprint} */ layout, /** @type {string} */ path) => titleOf(layout, path.slice(0, -EYE.length));
  const known = new Map(eyes(own).map((path) => [title(own, path), own[path]]));
  return { ...saved, ...Object.fromEntries(eyes(saved).map((path) => [path, known.get(title(saved, path)) ?? saved[path]])), "/time_panel": own["/time_panel"] };
}

/** @param {(layout: Blueprint) => Blueprint | null} made */
function change(made) {
  changing = changing.then(async () => {
    if (!viewer) return;
    const { blueprint, recording } = await viewer.get_blueprint();
    const next = made(blueprint);
    if (next) await viewer.set_blueprint(next, { kind: "recording", recording });
  });
  return changing = changing.catch(() => {});
}

/** @param {string[]} cameras that show the subject, the best one first */
export function show(cameras) {
  if (cameras.length) change((layout) => withCamera(layout, cameras));
}

window.addEventListener("viewer-event", (event) => {
  const { type, application_id: application } = /** @type {CustomEvent} */ (event).detail;
  if (type !== "recording_open" || name || !viewer) return;
  name = `layout.${application}`;
  last = kept(name, "");
  if (last) restore(TRIES);
});

// Until the viewer has our layout, it has none, or one of its own.
/** @param {number} tries */
async function restore(tries) {
  let isDone = false;
  await change((own) => {
    isDone = Object.keys(own).some((path) => path.endsWith(EYE));
    return isDone ? restored(parsed(last), own) : null;
  });
  if (!isDone && tries > 0) setTimeout(restore, AGAIN, tries - 1);
}

async function save() {
  if (!viewer || !name) return;
  const text = asText((await viewer.get_blueprint()).blueprint);
  if (text !== last && text.length < LARGEST) keep(name, last = text);
}

$("viewer").addEventListener("pointerup", () => {
  clearTimeout(saving);
  saving = window.setTimeout(() => save().catch(() => {}), LATER);
});
