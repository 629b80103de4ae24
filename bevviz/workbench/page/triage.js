// Triage of the findings: severity, filters, groups of one cause, and the table as CSV.

import { $, seconds } from "./page_state.js";

export const KINDS = ["missed", "lost", "contradicted", "unmatched", "doubtful", "broken", "new false", "fixed", "false gone", "new",
  "gone", "unnamed", "false", "anomaly", "note"];
const RANK = new Map(KINDS.map((kind, row) => [kind, row]));
RANK.set("unmatched", 0);
const NEAR = 10; // metres
const LONG = 0.5e9; // nanoseconds until it is seen again
const SENSORS = ["sensor", "sync", "tf", "stage"]; // anomalies that concern everything

export const away = (sight) => sight.distance ?? 99;
export const hasCause = (entry) => entry.what !== "anomaly" && entry.what !== "note";
export const cause = (entry) => (hasCause(entry) ? entry.sights[entry.best].text || "unknown" : entry.what);

// Reasons that make a finding severe. Each counts once.
export function severity(entry) {
  if (entry.what === "anomaly" && SENSORS.includes(entry.name)) return ["concerns everything that the sensors see"];
  if (!hasCause(entry)) return [];
  const stamps = entry.sights.map((one) => Number(one.stamp));
  const lasts = Math.max(...stamps) - Math.min(...stamps);
  const reasons = [];
  if (entry.sights.some((one) => one.in_way)) reasons.push("in the way of the robot");
  if (Math.min(...entry.sights.map(away)) <= NEAR) reasons.push(`nearer than ${NEAR} m`);
  if (lasts >= LONG) reasons.push(`lasts ${(lasts / 1e9).toFixed(1)} s`);
  return reasons;
}

const level = (entry) => (entry.what === "anomaly" && severity(entry).length ? 3 : severity(entry).length);
const order = (a, b) => Number(Boolean(a.handled)) - Number(Boolean(b.handled)) || level(b) - level(a)
  || RANK.get(a.what) - RANK.get(b.what) || away(a.sights[a.best]) - away(b.sights[b.best])
  || Number(a.sights[0].stamp) - Number(b.sights[0].stamp);

// Sort by severity. With groups, the group of the severest finding comes first.
export function sorted(entries) {
  const rows = [...entries].sort(order);
  if (!$("grouped").checked) return rows;
  const groups = new Map();
  for (const entry of rows) groups.set(cause(entry), [...groups.get(cause(entry)) ?? [], entry]);
  return [...groups.values()].flat();
}

// The filters, without the kinds. They see what the rows show: not the sentences of the answers.
export function matches(entry) {
  const words = $("find").value.toLowerCase().split(/\s+/).filter(Boolean);
  const text = [entry.what, entry.name, entry.handled?.text ?? "", ...entry.sights.map((one) => one.text)]
    .join(" ").toLowerCase();
  return words.every((word) => text.includes(word))
    && (!$("class").value || entry.name === $("class").value)
    && (!$("reason").value || (hasCause(entry) && cause(entry) === $("reason").value))
    && (!$("within").value || away(entry.sights[entry.best]) <= Number($("within").value));
}

// Offer the classes and reasons that the drive has. The chosen one stays.
export function offerFilters(entries) {
  const objects = entries.filter(hasCause);
  const offer = (select, first, names) => {
    const options = [...new Set(names)].filter(Boolean).sort();
    if (select.value && !options.includes(select.value)) options.push(select.value);
    if ([...select.options].slice(1).map((one) => one.value).join() === options.join()) return;
    const chosen = select.value;
    select.replaceChildren(new Option(first, ""), ...options.map((name) => new Option(name, name)));
    select.value = chosen;
  };
  offer($("class"), "any class", objects.map((entry) => entry.name));
  offer($("reason"), "any reason", objects.map(cause));
}

const COLUMNS = ["severity", "why_severe", "kind", "class", "frame", "seconds", "distance_m", "frames", "reason", "remark", "state", "note"];
export function csv(rows) {
  const quoted = (value) => (/[",\n]/.test(String(value)) ? `"${String(value).replaceAll('"', '""')}"` : String(value));
  const line = (entry) => {
    const one = entry.sights[entry.best];
    return [level(entry), severity(entry).join("; "), entry.what, entry.name, one.frame ?? "", seconds(one.stamp).replace(" s", ""),
      one.distance ?? "", entry.sights.length, one.text, one.remark, entry.handled?.state ?? "", entry.handled?.text ?? ""];
  };
  return [COLUMNS, ...rows.map(line)].map((values) => values.map(quoted).join(",")).join("\n") + "\n";
}
