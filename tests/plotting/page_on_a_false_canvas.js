// Runs a page's script where there is no browser: counts what it fills at a time of the clock.
const fs = require("fs"), vm = require("vm");
const [, , file, seconds] = process.argv;
const text = fs.readFileSync(file, "utf8");
const data = text.match(/<script id="data" type="application\/json">([\s\S]*?)<\/script>/)[1];
const script = text.match(/<script>\s*("use strict"[\s\S]*?)<\/script>/)[1];

let filled = 0, finite = true;
const point = (x, y) => { finite = finite && Number.isFinite(x) && Number.isFinite(y); };
const pen = {
  setTransform() {}, clearRect() { filled = 0; }, beginPath() {}, closePath() {}, stroke() {},
  moveTo: point, lineTo: point, fill() { filled++; },
};
const element = () => ({ append() {}, addEventListener() {}, setPointerCapture() {} });
const found = {
  data: { textContent: data },
  view: { ...element(), clientWidth: 900, clientHeight: 600, getContext: () => pen },
};
const page = {
  document: { getElementById: id => found[id] ||= element(), createElement: element },
  window: {}, atob: s => Buffer.from(s, "base64").toString("latin1"),
  requestAnimationFrame: f => { page.next = f; },
};
vm.runInContext(script, vm.createContext(page));
page.next(0);
page.next(1000 * seconds);
found.view.onpointermove({ buttons: 1, movementX: 30, movementY: 10 });
console.log(JSON.stringify({ filled, finite, time: found.time.textContent }));
