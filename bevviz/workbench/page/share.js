// Link to what the page shows, for another machine that has the same bag. The address carries the bag's name and first
// stamp and the opened values, so that the other page can tell whether it shows the same.

import { $, state, stated } from "./page_state.js";

/** @import { Welcome } from "./types" */

let opened = ""; // digest of the values that the drive was opened with

export function start() {
  $("share").onclick = async () => {
    const parts = new URLSearchParams(location.hash.slice(1));
    parts.set("first", String(state.first));
    parts.set("opened", opened);
    await navigator.clipboard.writeText(`${location.origin}/shared#${parts}`);
    $("shared").textContent = `Copied. It opens wherever 'bevviz open' shows ${state.bag}: at another port, paste it into that page.`;
  };
  // The link names our port. A page at another port takes what it says about the drive.
  window.addEventListener("paste", (event) => {
    const link = /^https?:\/\/[^/]+\/shared(#.+)$/.exec(event.clipboardData?.getData("text").trim() ?? "");
    if (!link || (event.target instanceof Element && event.target.matches("aside input"))) return;
    history.replaceState(null, "", link[1]);
    location.reload();
  });
  // A link was put into the address. Ours is only a sign to the viewer, or a step of the history, which has a state.
  window.addEventListener("hashchange", (event) => event.isTrusted && !history.state && location.reload());
}

/** @param {Welcome} message */
export const welcomed = (message) => { opened = message.opened; };

// Whether the address is about this drive. What differs is told.
export function sameDrive() {
  if (!stated.get("bag")) return false;
  const bag = stated.get("bag");
  const first = stated.get("first");
  const isSame = bag === state.bag && (!first || first === String(state.first));
  if (!isSame) {
    $("linked").textContent = bag === state.bag ? `The link is about another drive of the name ${bag}: nothing of it is shown.`
      : `The link is about ${bag}: nothing of it is shown.`;
  } else if (stated.get("opened") && stated.get("opened") !== opened) {
    $("linked").textContent = "The link was made with other opened values or another model: answers may differ.";
  }
  $("linked").hidden = !$("linked").textContent;
  return isSame;
}
