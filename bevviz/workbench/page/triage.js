// Triage of the findings: filters, groups of one cause, and the table as CSV.

import { seconds } from "./page_state.js";

/** @import { Entry, FindingFrame, HandledFinding, Note, Remark } from "./types" */
/** @typedef {Omit<FindingFrame, "frame"> & { frame: number | null, chip?: Remark["chip"] }} RowSight a frame of a row */

/**
 * A row of the list: a finding of the server, or a note.
 * @typedef {object} Finding
 * @property {number | string} key number of the finding, or stamp and text of the note
 * @property {string} what
 * @property {string} name
 * @property {string[]} reasons why it is severe
 * @property {number[]} rank key of the order, by the server
 * @property {RowSight[]} sights
 * @property {number} best index of the sight that the row shows
 * @property {HandledFinding | null} handled
 * @property {Note} [note]
 */
/** @typedef {{ words: string, class: string, reason: string, within: string }} Filters empty: all */

const ALIKE = 10; // metres that are as much as another kind or class

export const away = (/** @type {RowSight} */ sight) => sight.distance ?? 99;
export const hasCause = (/** @type {Finding} */ entry) => entry.what !== "anomaly" && entry.what !== "note";
export const cause = (/** @type {Finding} */ entry) => (hasCause(entry) ? entry.sights[entry.best].text || "unknown" : entry.what);

export const level = (/** @type {Finding} */ entry) => -entry.rank[0]; // of severity, 0 to 3
/**
 * The server's order. What the user has dealt with comes last.
 * @param {Finding} a
 * @param {Finding} b
 */
function order(a, b) {
  const differing = a.rank.findIndex((value, row) => value !== b.rank[row]);
  return Number(Boolean(a.handled)) - Number(Boolean(b.handled)) || (differing < 0 ? 0 : a.rank[differing] - b.rank[differing]);
}

/**
 * The findings of other objects that are most like one: of its reason, by kind, class and distance.
 * @param {Finding} own
 * @param {Finding[]} entries
 */
export function similar(own, entries, most = 2) {
  const unlike = (/** @type {Finding} */ entry) => Number(entry.what !== own.what) + Number(entry.name !== own.name)
    + Math.abs(away(entry.sights[entry.best]) - away(own.sights[own.best])) / ALIKE;
  const others = entries.filter((entry) => entry !== own && hasCause(entry) && !entry.handled && cause(entry) === cause(own));
  return others.sort((a, b) => unlike(a) - unlike(b)).slice(0, most);
}

/**
 * Sort in the server's order. With groups, the group of the severest finding comes first.
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
    return [level(entry), entry.reasons.join("; "), entry.what, entry.name, one.frame ?? "", seconds(one.stamp).replace(" s", ""),
      one.distance ?? "", entry.sights.length, one.text, one.remark, entry.handled?.state ?? "", entry.handled?.text ?? ""];
  };
  return [COLUMNS, ...rows.map(line)].map((values) => values.map(quoted).join(",")).join("\n") + "\n";
}
