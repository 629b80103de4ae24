// Triage of the findings: severity, filters, groups of one cause, and the table as CSV.

import { seconds } from "./page_state.js";

/** @import { Entry, HandledEntry, NoteEntry, Remark, Sight } from "./types" */
/** @typedef {Omit<Sight, "frame"> & { frame: number | null, chip?: Remark["chip"] }} RowSight a frame of a row */

/**
 * A row of the list: a finding of the server, or a note.
 * @typedef {object} Finding
 * @property {number | string} key number of the finding, or stamp and text of the note
 * @property {string} what
 * @property {string} name
 * @property {RowSight[]} sights
 * @property {number} best index of the sight that the row shows
 * @property {HandledEntry | null} handled
 * @property {NoteEntry} [note]
 */
/** @typedef {{ words: string, class: string, reason: string, within: string }} Filters empty: all */

export const KINDS = ["missed", "lost", "contradicted", "unmatched", "doubtful", "broken", "new false", "fixed", "false gone", "new",
  "gone", "unnamed", "false", "anomaly", "note"];
const RANK = new Map(KINDS.map((kind, row) => [kind, row]));
RANK.set("unmatched", 0);
const NEAR = 10; // metres
const LONG = 0.5e9; // nanoseconds until it is seen again
const SENSORS = ["sensor", "sync", "tf", "stage"]; // anomalies that concern everything

export const away = (/** @type {RowSight} */ sight) => sight.distance ?? 99;
export const hasCause = (/** @type {Finding} */ entry) => entry.what !== "anomaly" && entry.what !== "note";
export const cause = (/** @type {Finding} */ entry) => (hasCause(entry) ? entry.sights[entry.best].text || "unknown" : entry.what);

/**
 * Reasons that make a finding severe. Each counts once.
 * @param {Finding} entry
 */
export function severity(entry) {
  if (entry.what === "anomaly" && SENSORS.includes(entry.name)) return ["concerns everything that the sensors see"];
  if (!hasCause(entry) || entry.sights.every((one) => one.text === "second name")) return [];
  const stamps = entry.sights.map((one) => Number(one.stamp));
  const lasts = Math.max(...stamps) - Math.min(...stamps);
  const reasons = [];
  if (entry.sights.some((one) => one.in_way)) reasons.push("in the way of the robot");
  if (Math.min(...entry.sights.map(away)) <= NEAR) reasons.push(`nearer than ${NEAR} m`);
  if (lasts >= LONG) reasons.push(`lasts ${(lasts / 1e9).toFixed(1)} s`);
  return reasons;
}

const level = (/** @type {Finding} */ entry) => (entry.what === "anomaly" && severity(entry).length ? 3 : severity(entry).length);
const rank = (/** @type {Finding} */ entry) => RANK.get(entry.what) ?? KINDS.length;
const order = (/** @type {Finding} */ a, /** @type {Finding} */ b) => Number(Boolean(a.handled)) - Number(Boolean(b.handled)) || level(b) - level(a)
  || rank(a) - rank(b) || away(a.sights[a.best]) - away(b.sights[b.best])
  || Number(a.sights[0].stamp) - Number(b.sights[0].stamp);

/**
 * The findings of other objects that are most like one: of its reason, by kind, class and distance.
 * @param {Finding} own
 * @param {Finding[]} entries
 */
export function similar(own, entries, most = 2) {
  const unlike = (/** @type {Finding} */ entry) => Number(entry.what !== own.what) + Number(entry.name !== own.name)
    + Math.abs(away(entry.sights[entry.best]) - away(own.sights[own.best])) / NEAR;
  const others = entries.filter((entry) => entry !== own && hasCause(entry) && !entry.handled && cause(entry) === cause(own));
  return others.sort((a, b) => unlike(a) - unlike(b)).slice(0, most);
}

/**
 * Sort by severity. With groups, the group of the severest finding comes first.
 * @param {Finding[]} entries
 * @param {boolean} isGrouped
 */
export function sorted(entries, isGrouped) {
  const rows = [...entries].sort(order);
  if (!isGrouped) return rows;
  /** @type {Map<string, Finding[]>} */
  const groups = new Map();
  for (const entry of rows) groups.set(cause(entry), [...groups.get(cause(entry)) ?? [], entry]);
  return [...groups.values()].flat();
}

/**
 * The filters, without the kinds. They see what the rows show: not the sentences of the answers.
 * @param {Finding} entry
 * @param {Filters} filters
 */
export function matches(entry, filters) {
  const words = filters.words.toLowerCase().split(/\s+/).filter(Boolean);
  const text = [entry.what, entry.name, entry.handled?.text ?? "", ...entry.sights.map((one) => one.text)]
    .join(" ").toLowerCase();
  return words.every((word) => text.includes(word))
    && (!filters.class || entry.name === filters.class)
    && (!filters.reason || (hasCause(entry) && cause(entry) === filters.reason))
    && (!filters.within || away(entry.sights[entry.best]) <= Number(filters.within));
}

const COLUMNS = ["severity", "why_severe", "kind", "class", "frame", "seconds", "distance_m", "frames", "reason", "remark", "state", "note"];
/** @param {Finding[]} rows */
export function csv(rows) {
  const quoted = (/** @type {unknown} */ value) => (/[",\n]/.test(String(value)) ? `"${String(value).replaceAll('"', '""')}"` : String(value));
  const line = (/** @type {Finding} */ entry) => {
    const one = entry.sights[entry.best];
    return [level(entry), severity(entry).join("; "), entry.what, entry.name, one.frame ?? "", seconds(one.stamp).replace(" s", ""),
      one.distance ?? "", entry.sights.length, one.text, one.remark, entry.handled?.state ?? "", entry.handled?.text ?? ""];
  };
  return [COLUMNS, ...rows.map(line)].map((values) => values.map(quoted).join(",")).join("\n") + "\n";
}
