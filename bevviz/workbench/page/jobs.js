// Background work: trials of other values over the drive, and reports. Also the text field for notes.

import { $, beforeAfter, element, inSpan, spanText, state } from "./page_state.js";
import { isTried } from "./viewer.js";
import { follow, send } from "./connection.js";

/** @import { FixJob, Progress, ReportJob, Trial } from "./types" */

/** @type {Trial[]} */
let trials = []; // runs with other values, from the server, the newest last
/** @type {(settings: string[]) => void} */
let use = () => {}; // shows the settings of a run

export const settings = () => trials.at(-1)?.settings ?? null; // of the newest run, whose differences are listed
const isShown = (/** @type {Trial} */ run) => run.settings.join() === state.set.join();
const shownRun = () => trials.find(isShown) ?? trials.at(-1);

/** @param {typeof use} using */
export function start(using) {
  use = using;
  const say = (/** @type {"effect" | "fix-text" | "noted"} */ id) => (/** @type {{ text: string }} */ { text }) => {
    $(id).textContent = text;
    $(id).className = "alarm";
    const section = $(id).closest("section");
    if (section) section.hidden = false;
  };
  $("drive").onclick = () => send({ type: "drive", set: state.set }, say("effect"));
  $("drive-span").onclick = () => send({ type: "drive", set: state.set, span: state.span }, say("effect"));
  $("drive-cancel").onclick = () => send({ type: "cancel", what: "drive" });
  $("fix").onclick = () => send({ type: "fix" }, say("fix-text"));
  $("fix-cancel").onclick = () => send({ type: "cancel", what: "fix" });
  $("report").onclick = () => {
    const number = (/** @type {"before" | "after"} */ id) => Number($(id).value) || 0;
    const range = { before: number("before"), after: number("after") };
    if (state.span) {
      if (!inSpan(state.time)) {
        say("noted")({ text: `The shown frame is not in the marked ${spanText(state.span)}: go into it, or clear the span.` });
        return;
      }
      const from = (/** @type {string} */ stamp) => Math.abs(Number(stamp) - Number(state.time)) / 1e9;
      [range.before, range.after] = [from(state.span.first), from(state.span.last)];
    }
    const set = isTried() ? state.set : []; // settings of the shown side
    const about = { time: Number(state.time), set, pick: state.pick };
    send({ type: "report", ...about, text: $("words").value, ...range }, say("noted"));
  };
  $("note").onclick = () => send({ type: "note", time: Number(state.time), pick: state.pick, text: $("words").value,
    span: state.span }, say("noted"));
}

/** @param {{ text: string }} message */
export function noted({ text }) {
  $("words").value = "";
  $("noted").textContent = text;
  $("noted").className = "faint";
}

/** @param {Progress} message */
export function progress(message) {
  $("bar").max = message.total || 1;
  $("bar").value = message.done;
  $("bar").hidden = message.over;
  state.over = message.over;
  const part = `${message.done} of ${message.total} frames`;
  const run = { run: "", overview: `Overview: ${part}, all over the drive; then every frame in order`,
    again: `The list is complete, from an earlier run; ${part} run again for tracks and plots` }[message.phase ?? "run"] || `${part} run in order`;
  const text = message.over ? `${message.done} frames` : run;
  $("run").textContent = [text, message.error, ...message.warnings].filter(Boolean).join(" · ");
  $("run").className = message.error ? "alarm" : "faint";
  $("run").title = $("run").textContent;
  trials = message.trials;
  showRuns();
  if (message.fix) showFix(message.fix);
  $("reports").replaceChildren(...message.reports.map(report));
}

// --- trial over the drive -----------------------------------------------------------------------

// Show the run with the shown settings, else the newest one, and the table of all runs.
export function showRuns() {
  const message = shownRun();
  $("trial").hidden = !message;
  if (!message) return;
  for (const run of trials.filter(isShown)) follow(run.lane);
  $("runs").replaceChildren(...(trials.length > 1 ? [row(["", "values", "F1", ...kindsOf(trials)], "th"), ...trials.map(runRow)] : []));
  const going = message.state === "waiting" || message.state === "running";
  $("trial-bar").max = message.total || 1;
  $("trial-bar").value = message.done;
  $("trial-bar").hidden = !going;
  $("drive-cancel").hidden = !going;
  $("trial-text").textContent = { waiting: "Waiting for the first run ...", failed: message.error }[message.state] ?? summary(message);
  $("trial-text").className = message.state === "failed" ? "alarm" : "";
  $("trial-set").textContent = named(message);
  const newest = trials[trials.length - 1];
  $("trial-listed").hidden = message === newest;
  $("trial-listed").textContent = `The table of findings has the differences of ${named(newest)}.`;
}

/**
 * @param {(string | Node)[]} values
 * @param {"td" | "th"} kind
 */
function row(values, kind = "td") {
  const cells = values.map((value) => element(kind, "", "", value));
  for (const [column, cell] of cells.entries()) if (kind === "th") cell.title = state.meanings[String(values[column])] ?? "";
  return element("tr", "", "", ...cells);
}

// The values of a run, and the span that it was run over.
const named = (/** @type {Trial} */ run) => [run.settings.join(", "), ...(run.span ? [`of ${spanText(run.span)}`] : [])].join("; ");

/** @param {Trial} run */
function runRow(run) {
  const button = element("button", "", named(run));
  button.onclick = () => use(run.settings);
  const f1 = run.f1 ? beforeAfter(run.f1) : "–";
  const ended = { over: "", cancelled: " (cancelled)", failed: " (failed)" }[run.state] ?? " ...";
  const made = row([isShown(run) ? "▸" : "", button, f1 + ended, ...kindsOf(trials).map((kind) => String(run.counts[kind] ?? 0))]);
  made.ariaCurrent = String(isShown(run));
  return made;
}

const kindsOf = (/** @type {Trial[]} */ runs) => [...new Set(runs.flatMap((run) => Object.keys(run.counts)))];

/** @param {Trial} message */
function summary(message) {
  const parts = [];
  if (message.f1) parts.push(`F1 ${beforeAfter(message.f1)}`);
  const frames = message.state === "running" ? `${message.done} of ${message.total} frames` : `${message.done} frames`;
  parts.push(frames);
  for (const [what, number] of Object.entries(message.counts)) parts.push(`${number} ${what}`);
  if (message.state === "cancelled") parts.push("cancelled");
  return parts.join("; ");
}

// --- search of a fix ----------------------------------------------------------------------------

/** @param {FixJob} fix */
function showFix(fix) {
  const going = fix.state === "running";
  const steps = fix.total ? `${fix.done} of ${fix.total} settings tried` : "Reading frames ...";
  $("fix").disabled = going;
  $("fix-section").hidden = false;
  for (const id of /** @type {const} */ (["fix-bar", "fix-cancel"])) $(id).hidden = !going;
  $("fix-bar").max = fix.total || 1;
  $("fix-bar").value = fix.done;
  $("fix-text").textContent = { running: steps, failed: fix.error, cancelled: "Cancelled." }[fix.state] ?? fix.text;
  $("fix-text").className = fix.state === "failed" ? "alarm" : "faint";
  $("fix-use").hidden = going || !fix.settings.length;
  $("fix-use").textContent = `try ${fix.settings.join(", ")}`;
  $("fix-use").onclick = () => use(fix.settings);
}

// --- reports ------------------------------------------------------------------------------------

/** @param {ReportJob} one */
function report(one) {
  const item = element("li", one.state === "failed" ? "alarm" : "", "");
  if (one.state === "failed") item.textContent = `${one.name}: ${one.error}`;
  else if (one.state === "running") {
    const cancel = element("button", "", "cancel");
    cancel.onclick = () => send({ type: "cancel", what: "report" });
    item.append(`${one.name}: ${one.total ? `${one.done} of ${one.total} frames` : "being cut out"} `, cancel);
  } else {
    const links = one.files.map((file) => {
      const link = element("a", "", `${file.name.slice(file.name.lastIndexOf("."))} ${file.megabytes.toFixed(1)} MB`);
      link.href = `/report/${one.number}/${encodeURIComponent(file.name)}`;
      link.target = "_blank";
      return link;
    });
    item.append(element("b", "", one.name), ...links.flatMap((link) => [" ", link]),
      element("span", "faint", [` in ${one.folder}`, one.settings.join(", "),
        one.state === "cancelled" ? "cancelled" : ""].filter(Boolean).join("; ")));
  }
  return item;
}
