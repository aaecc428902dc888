// Runs the script of an animation's page in node, with as much of a browser as it asks for; tells what it did.
import { readFileSync } from "node:fs";

const page = readFileSync(process.argv[2], "utf8");
const scripts = [...page.matchAll(/<script([^>]*)>([\s\S]*?)<\/script>/g)];
const told = { strokes: 0, wild: 0, names: [], paused: [], speeds: [], followed: [] };

const pen = new Proxy({}, {
  get: (kept, name) => kept[name] ?? ((...args) => {
    if (name === "stroke") told.strokes += 1;
    if (name === "fillText") told.names.push(args.shift());
    told.wild += args.filter((x) => !Number.isFinite(x)).length;
  }),
  set: (kept, name, value) => { kept[name] = value; return true; },
});
const element = () => ({
  handlers: {}, hidden: true, clientWidth: 800, clientHeight: 500,
  addEventListener(name, act) { this.handlers[name] = act; },
  setAttribute() {}, append() {}, focus() {}, getContext: () => pen,
});
const elements = {}, keys = {};
let frames = [], seen;
const observer = (then) => class { constructor(act) { then(act); } observe() {} };
globalThis.document = {
  getElementById: (id) => elements[id] ??= { ...element(), textContent: id === "scene" ? scripts[0][2] : "" },
  createElement: element, documentElement: { dataset: { theme: "auto" } },
};
globalThis.window = {
  devicePixelRatio: 1, location: { hash: "" }, addEventListener: (name, act) => { keys[name] = act; },
  matchMedia: () => ({ matches: false, addEventListener() {} }),
};
globalThis.requestAnimationFrame = (act) => frames.push(act);
globalThis.ResizeObserver = observer((act) => act());
globalThis.IntersectionObserver = observer((act) => { seen = act; });

let now = 0;
const wait = (ms) => { for (const end = now + ms; now < end; now += 20) { const due = frames; frames = []; for (const act of due) act(now); } };
const press = (key) => { keys.keydown({ key, target: null, preventDefault() {} }); wait(60); };

(0, eval)(scripts[1][2]);
const { state } = elements.canvas.viewer;
wait(500);
told.drawn_unseen = told.strokes;
seen([{ isIntersecting: true }]);
wait(1020);
told.time_after_a_second = state.time;
for (let i = 0; i < 2; i++) { press(" "); told.paused.push(!state.playing); }
for (const key of ["ArrowUp", "ArrowDown"]) { press(key); told.speeds.push(state.speed); }
press(" ");
press("End");
told.at_the_end = state.time;
press("n");
press("n");
told.names = [...new Set(told.names)];
for (let i = 0; i < 2; i++) { told.followed.push(state.follow); press("f"); }
console.log(JSON.stringify(told));
