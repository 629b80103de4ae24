// Lanes of the timeline: the findings of each sort, and the bars of a lane.

/** @import { Finding } from "./triage.js" */
/** @typedef {{ name: string, color: string, entries: Finding[] }} Lane */
/** @typedef {{ x: number, count: number, distance: number | null, entry: Finding, row: number }} Bar the nearest finding of it */

/** @type {[string, string, string[]][]} */
const LANES = [
  ["missed", "--bad", ["missed", "lost", "unmatched", "broken"]],
  ["false", "--doubtful", ["false", "doubtful", "contradicted", "new false"]],
  ["unnamed", "--unknown", ["unnamed", "new", "gone"]],
  ["fixed", "--good", ["fixed", "false gone"]],
  ["anomaly", "--other", ["anomaly"]],
  ["note", "--subject", ["note"]],
];
export const KINDS = LANES.flatMap(([, , kinds]) => kinds); // of the findings
const [NEAR, FAR] = [5, 40]; // metres: a nearer one has the full colour, a farther one the faintest
const [FAINTEST, UNKNOWN] = [0.35, 0.7]; // opacities: of the farthest, and where the distance is unknown

/**
 * The lanes that have findings.
 * @param {Finding[]} rows
 * @returns {Lane[]}
 */
export function lanes(rows) {
  return LANES.map(([name, color, kinds]) => ({ name, color, entries: rows.filter((entry) => kinds.includes(entry.what)) }))
    .filter((lane) => lane.entries.length);
}

/**
 * Bars of a lane: its findings at each pixel, and the nearest of them.
 * @param {Lane} lane
 * @param {(stamp: string) => number} x
 */
export function bars(lane, x) {
  /** @type {Map<number, Bar>} */
  const all = new Map();
  for (const entry of lane.entries) {
    for (const [row, { stamp, distance }] of entry.sights.entries()) {
      const at = x(stamp);
      const known = all.get(Math.round(at));
      const isNearer = !known || (distance ?? Infinity) < (known.distance ?? Infinity);
      const nearest = isNearer ? { entry, row, distance } : known;
      all.set(Math.round(at), { ...nearest, x: known?.x ?? at, count: (known?.count ?? 0) + 1 });
    }
  }
  return [...all.values()];
}

/**
 * Opacity of a bar.
 * @param {number | null} distance
 */
export function shade(distance) {
  if (distance === null) return UNKNOWN;
  const far = Math.min(1, Math.max(0, (distance - NEAR) / (FAR - NEAR)));
  return 1 - far * (1 - FAINTEST);
}

/**
 * Row of the time that is nearest to another one.
 * @param {number[]} times
 * @param {number} wanted
 */
export const nearest = (times, wanted) => (
  times.reduce((row, time, other) => (Math.abs(time - wanted) < Math.abs(times[row] - wanted) ? other : row), 0));
