// As much of a browser as the page's modules need in Node. Import it first. Time goes on by `pass` alone.

class FakeElement {
  constructor() {
    Object.assign(this, { children: [], dataset: {}, style: {}, textContent: "", value: "", hidden: false, selectedIndex: 0 });
  }

  append(...children) { this.children.push(...children); }
  replaceChildren(...children) { this.children = children; }
  setAttribute() {}
  addEventListener() {}
  contains() { return false; }
  closest() { return null; }
  getContext() { return null; } // There is no WebGL: the page shows the camera alone.
}

const elements = new Map();
export function element(id) {
  if (!elements.has(id)) elements.set(id, new FakeElement());
  return elements.get(id);
}
Object.assign(element("viewer").dataset, { version: "0.41.1", kind: "page" });

let now = 0; // ms
let timers = []; // when and what, and a number
export function pass(milliseconds) {
  const end = now + milliseconds;
  for (;;) {
    timers.sort((a, b) => a.at - b.at);
    if (!timers.length || timers[0].at > end) break;
    const next = timers.shift();
    now = Math.max(now, next.at);
    next.call(now);
  }
  now = end;
}
let number = 0;
globalThis.setTimeout = (call, wait = 0) => {
  number += 1;
  timers.push({ at: now + wait, call, number });
  return number;
};
globalThis.clearTimeout = (which) => { timers = timers.filter((one) => one.number !== which); };
Object.defineProperty(globalThis, "performance", { value: { now: () => now, mark() {} } });

const listeners = {};
export const address = [];
Object.assign(globalThis, {
  window: globalThis,
  document: { getElementById: element, createElement: () => new FakeElement(), addEventListener() {} },
  location: { hash: "", href: "http://127.0.0.1/", origin: "http://127.0.0.1", pathname: "/", search: "" },
  history: { pushState: (_, __, to) => address.push(to), replaceState: (_, __, to) => { address[Math.max(0, address.length - 1)] = to; } },
  Element: FakeElement,
  Image: FakeElement,
  Option: class { constructor(text, value) { Object.assign(this, { text, value }); } },
  CustomEvent: class { constructor(type, more) { Object.assign(this, { type }, more); } },
  addEventListener: (type, listener) => { (listeners[type] ??= []).push(listener); },
  dispatchEvent: (event) => { for (const one of listeners[event.type] ?? []) one(event); },
  requestAnimationFrame: (draw) => setTimeout(() => draw(now), 16),
});
