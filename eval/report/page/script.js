"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const REFERENCE = "reference";
const byId = id => document.getElementById(id);
const colour = name => `var(--s${data.denoisers.indexOf(name) % 10})`;
const dash = name => (data.denoisers.indexOf(name) >= 10 ? "6 3" : "none"); // colours repeat after ten

function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

function draw(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

function fill(select, options) { // options: [value, text]
  select.replaceChildren(...options.map(([value, text]) => make("option", { value }, text)));
}

const short = value => (value === null ? "-" : String(+value.toPrecision(Math.abs(value) >= 100 ? 4 : 3)));

// --- the table ---

function sortTable(header) {
  const table = byId("table"), headers = [...table.tHead.rows[0].cells], column = headers.indexOf(header);
  const sign = header.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  const key = row => {
    const cell = row.cells[column];
    if (cell.dataset.value !== undefined) return +cell.dataset.value;
    return cell.classList.contains("number") ? null : cell.textContent;
  };
  const compare = (a, b) => {
    const [x, y] = [key(a), key(b)];
    if (x === null || y === null) return (x === null) - (y === null); // what is undefined stays last
    return sign * (typeof x === "number" ? x - y : x.localeCompare(y, undefined, { numeric: true }));
  };
  headers.forEach(other => other.removeAttribute("aria-sort"));
  header.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
  table.tBodies[0].append(...[...table.tBodies[0].rows].sort(compare));
}

function filterTable() {
  const clip = byId("table-clip").value;
  for (const row of byId("table").tBodies[0].rows) row.hidden = clip ? row.dataset.clip !== clip : "mean" in row.dataset;
}

function startTable() {
  for (const header of byId("table").tHead.rows[0].cells) header.firstElementChild.onclick = () => sortTable(header);
  byId("table-clip").onchange = filterTable;
  filterTable();
}

// --- plots ---

function scaleOf(values, log, from, to) { // from and to: pixels
  let low = Math.min(...values), high = Math.max(...values);
  if (log) [low, high] = [low / 1.15, high * 1.15];
  else [low, high] = [low - 0.05 * (high - low || 1), high + 0.05 * (high - low || 1)];
  const warp = log ? Math.log : x => x;
  const scale = value => from + (to - from) * (warp(value) - warp(low)) / (warp(high) - warp(low));
  scale.ticks = log ? logTicks(low, high) : linearTicks(low, high);
  return scale;
}

function logTicks(low, high) {
  const ratio = high / low, steps = ratio < 10 ? [1, 1.5, 2, 3, 5, 7] : ratio < 1000 ? [1, 2, 5] : [1], ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++)
    ticks.push(...steps.map(step => step * 10 ** power).filter(tick => tick >= low && tick <= high));
  return ticks.length > 2 ? ticks : linearTicks(low, high);
}

function linearTicks(low, high) {
  const raw = (high - low) / 4, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find(factor => factor * power >= raw), ticks = [];
  for (let tick = Math.ceil(low / step) * step; tick <= high; tick += step) ticks.push(+tick.toPrecision(6));
  return ticks;
}

function axes(svg, x, y, box, xTitle) {
  for (const tick of y.ticks)
    svg.append(draw("line", { class: "grid", x1: box.left, x2: box.right, y1: y(tick), y2: y(tick) }),
      draw("text", { x: box.left - 5, y: y(tick) + 4, "text-anchor": "end" }, short(tick)));
  for (const tick of x.ticks) svg.append(draw("text", { x: x(tick), y: box.bottom + 14, "text-anchor": "middle" }, short(tick)));
  svg.append(draw("text", { x: box.right, y: box.bottom + 27, "text-anchor": "end" }, xTitle));
}

// Values by frame of every denoiser; dashed, the noise floor.
function plotCurves(host, title, curves, hidden, now, pick) {
  const width = 620, height = 205, box = { left: 46, right: width - 6, top: 6, bottom: height - 32 };
  const svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title} by frame` });
  const shown = Object.entries(curves).filter(([name]) => !hidden.has(name));
  const all = shown.flatMap(([, values]) => values).filter(value => value !== null && isFinite(value));
  if (!all.length) return host.replaceChildren("undefined here");
  const count = shown[0][1].length, log = Math.min(...all) > 0 && !data.metrics[title].more;
  const x = scaleOf([0, Math.max(1, count - 1)], false, box.left, box.right), y = scaleOf(all, log, box.bottom, box.top);
  x.ticks = x.ticks.filter(tick => Number.isInteger(tick) && tick >= 0 && tick < count);
  axes(svg, x, y, box, "frame");
  for (const [name, values] of shown) {
    const points = values.map((value, index) => (value === null ? "" : `${x(index)},${y(value)}`)).filter(Boolean);
    const style = name === REFERENCE ? { class: "noise" } : { class: "curve", style: `stroke: ${colour(name)}`, "stroke-dasharray": dash(name) };
    svg.append(draw("polyline", { points: points.join(" "), ...style }, draw("title", {}, name)));
  }
  svg.append(draw("line", { class: "now", x1: x(now), x2: x(now), y1: box.top, y2: box.bottom }));
  svg.onclick = event => {
    const bounds = svg.getBoundingClientRect(), at = (event.clientX - bounds.left) / bounds.width * width;
    pick((at - x(0)) / (x(1) - x(0)));
  };
  host.replaceChildren(svg);
}

function plotTrade(plot) {
  const width = 640, height = 400, box = { left: 50, right: width - 96, top: 10, bottom: height - 34 };
  const metric = data.metrics[plot.metric], svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, role: "img" });
  svg.setAttribute("aria-label", `${metric.title} against milliseconds a frame`);
  const { points } = plot; // fastest first
  const log = !metric.more && Math.min(...points.map(point => point.quality)) > 0;
  const x = scaleOf(points.map(point => point.ms), true, box.left, box.right);
  const y = scaleOf(points.map(point => point.quality), log, box.bottom, box.top);
  axes(svg, x, y, box, `milliseconds a frame at ${plot.size}`);
  const front = points.filter(point => point.by === null);
  svg.append(draw("polyline", { class: "front", points: front.map(({ ms, quality }) => `${x(ms)},${y(quality)}`).join(" ") }));
  const taken = [];
  for (const { name, ms, quality, by } of points) {
    const free = place => !taken.some(other => Math.abs(other.x - x(ms)) < 90 && Math.abs(other.y - place) < 12);
    const places = [0, -12, 12, -24, 24, -36, 36].map(shift => y(quality) + 4 + shift), place = places.find(free) ?? places[0];
    taken.push({ x: x(ms), y: place });
    const style = `stroke: ${colour(name)}; fill: ${by === null ? colour(name) : "none"}; stroke-width: 2`;
    svg.append(draw("circle", { cx: x(ms), cy: y(quality), r: 5, style }, draw("title", {}, `${name}: ${short(ms)} ms, ${short(quality)}`)),
      draw("text", { class: "name", x: x(ms) + 9, y: place }, name));
  }
  byId("trade-plot").replaceChildren(svg);
  const lines = points.map(({ name, ms, quality, by }) => make("li", {}, make("b", {}, name),
    ` ${short(ms)} ms, ${metric.title} ${short(quality)}: ${by === null ? "on the Pareto front" : `dominated by ${by}`}`));
  const missing = plot.missing.length ? [make("p", { class: "note" }, `Not timed: ${plot.missing.join(", ")}. Time all with: ${plot.command}`)] : [];
  byId("trade-words").replaceChildren(make("ul", {}, ...lines), ...missing);
}

function startTrade() {
  const select = byId("trade-select");
  if (!select) return;
  fill(select, data.trades.map((plot, index) => [index, `${data.metrics[plot.metric].title}${plot.signal === "total" ? "" : `, ${plot.signal} light`}`]));
  select.onchange = () => plotTrade(data.trades[select.value]);
  select.onchange();
}

// --- the comparer ---

const cache = new Map();

async function load(uri) { // decoded images of late, for playing
  if (!cache.has(uri)) {
    const image = new Image();
    image.src = uri;
    cache.set(uri, image.decode().then(() => image));
    if (cache.size > 200) cache.delete(cache.keys().next().value);
  }
  return cache.get(uri);
}

function pixels(image, width, height) {
  const context = new OffscreenCanvas(width, height).getContext("2d");
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, width, height);
}

function paintNumbers(context, number, clip) { // number(pixel index * 4) in [0, 255]
  const picture = context.createImageData(clip.width, clip.height);
  for (let i = 0; i < picture.data.length; i += 4) picture.data.set([...data.magma[Math.min(255, Math.round(number(i)))], 255], i);
  context.putImageData(picture, 0, 0);
}

const view = { clip: 0, left: "", right: REFERENCE, frame: 0, mode: "slider", split: 50, flipped: false, zoom: 1, metric: "rmse", hidden: new Set(), timer: 0, draws: 0 };
const clipNow = () => data.clips[view.clip];
const MODES = [...byId("views").children].map(button => button.dataset.view);
const MAPS = { map: "flips", error: "errors" }; // views of one picture
const mappedOf = { // whose picture that is
  map: () => (view.left === REFERENCE ? view.right : view.left),
  error: clip => (view.left in clip.errors ? view.left : view.right),
};

async function paint() {
  const clip = clipNow(), turn = ++view.draws, canvas = byId("canvas");
  const uris = view.mode in MAPS ? [clip[MAPS[view.mode]][mappedOf[view.mode](clip)]] : [clip.images[view.left], clip.images[view.right]];
  const [left, right] = await Promise.all(uris.map(list => (list ? load(list[view.frame]) : null)));
  if (turn !== view.draws) return; // something newer is on its way
  if (canvas.width !== clip.width || canvas.height !== clip.height) [canvas.width, canvas.height] = [clip.width, clip.height];
  const context = canvas.getContext("2d"), { width, height } = clip, split = Math.round(width * view.split / 100);
  context.clearRect(0, 0, width, height);
  if (view.mode === "slider") {
    context.drawImage(right, 0, 0);
    if (split) context.drawImage(left, 0, 0, split, height, 0, 0, split, height);
  } else if (view.mode === "flip") {
    context.drawImage(view.flipped ? right : left, 0, 0);
  } else if (view.mode in MAPS && left) {
    const map = pixels(left, width, height).data;
    paintNumbers(context, i => map[i], clip);
  } else if (view.mode === "difference") {
    const [a, b] = [left, right].map(image => pixels(image, width, height).data);
    paintNumbers(context, i => 4 / 3 * (Math.abs(a[i] - b[i]) + Math.abs(a[i + 1] - b[i + 1]) + Math.abs(a[i + 2] - b[i + 2])), clip);
  }
  canvas.dataset.shown = [view.mode, view.left, view.right, clip.frames[view.frame], view.flipped].join(" ");
}

function measured(name) {
  const clip = clipNow(), frame = clip.frames[view.frame];
  if (name === REFERENCE) return `${name}: what its own noise would score, RMSE ${short(clip.curves.rmse[name][frame])}`;
  const numbers = ["rmse", "psnr", "ssim", "flip"].filter(metric => metric in clip.curves);
  return `${name}: ${numbers.map(metric => `${data.metrics[metric].title} ${short(clip.curves[metric][name][frame])}`).join(", ")}`;
}

function describe() {
  const clip = clipNow();
  const texts = {
    slider: "", flip: `Shown: ${view.flipped ? view.right : view.left}; press space. `,
    difference: `Mean difference of ${view.left} and ${view.right}: black 0, brightest 0.25 and more. `,
    map: `FLIP of ${mappedOf.map()} against the reference: black 0, brightest 1. `,
    error: mappedOf.error(clip) in clip.errors
      ? `Estimated error of ${mappedOf.error(clip)}, in exposed radiance: black 0, brightest 0.25 and more. `
      : "Neither tells its error: NAME+js does, where frames have two sample buffers. ",
  };
  byId("caption").textContent = texts[view.mode] + [...new Set([view.left, view.right])].map(measured).join("; ");
  byId("name-left").textContent = view.mode === "flip" && view.flipped ? "" : view.left;
  byId("name-right").textContent = view.mode === "flip" && !view.flipped ? "" : view.right;
}

function plots() {
  const clip = clipNow(), now = clip.frames[view.frame];
  const pick = frame => setFrame(clip.frames.reduce((best, at, index) => (Math.abs(at - frame) < Math.abs(clip.frames[best] - frame) ? index : best), 0));
  plotCurves(byId("errors"), view.metric, clip.curves[view.metric], view.hidden, now, pick);
  plotCurves(byId("temporal"), "temporal_error", clip.curves.temporal_error ?? {}, view.hidden, now, pick);
}

function refresh() {
  const clip = clipNow();
  byId("frame").value = view.frame;
  byId("number").textContent = `${clip.frames[view.frame]} of ${clip.count}`;
  for (const button of byId("views").children) button.setAttribute("aria-pressed", button.dataset.view === view.mode);
  [byId("left").value, byId("right").value] = [view.left, view.right];
  byId("split-label").style.visibility = byId("line").style.visibility = view.mode === "slider" ? "visible" : "hidden";
  byId("line").style.left = `${view.split}%`;
  byId("split").value = view.split;
  byId("canvas").style.width = `${clip.width * view.zoom}px`;
  byId("zoom").textContent = `${short(view.zoom)}×`;
  describe();
  plots();
  return paint();
}

function setFrame(frame) {
  const count = clipNow().frames.length;
  view.frame = (frame + count) % count;
  return refresh();
}

function bestOf(clip) {
  const error = name => clip.curves.flip[name].reduce((sum, value) => sum + value, 0);
  return Object.keys(clip.flips).reduce((best, name) => (error(name) < error(best) ? name : best));
}

function setClip(index) {
  view.clip = index;
  const clip = clipNow(), names = Object.keys(clip.images), error = byId("metric");
  if (!names.includes(view.left)) view.left = names[0];
  if (!names.includes(view.right)) view.right = REFERENCE;
  for (const id of ["left", "right"]) fill(byId(id), names.map(name => [name, name]));
  fill(error, Object.keys(clip.curves).filter(key => key !== "temporal_error").map(key => [key, data.metrics[key].title]));
  if (!(view.metric in clip.curves)) view.metric = "rmse";
  error.value = view.metric;
  view.frame = Math.min(view.frame, clip.frames.length - 1);
  byId("frame").max = clip.frames.length - 1;
  const room = Math.min(byId("stage").clientWidth / clip.width, 512 / clip.height);
  view.zoom = room >= 1 ? Math.floor(room) : room;
  fillLegend(names);
  crops(clip, names);
  return refresh();
}

function fillLegend(names) {
  byId("legend").replaceChildren(...names.filter(name => name !== REFERENCE).map(name => {
    const button = make("button", { "aria-pressed": !view.hidden.has(name) }, make("i", { style: `color: ${colour(name)}` }), name);
    button.onclick = () => {
      if (!view.hidden.delete(name)) view.hidden.add(name);
      button.setAttribute("aria-pressed", !view.hidden.has(name));
      plots();
    };
    return button;
  }));
}

async function crops(clip, names) {
  if (!clip.crops.length) return byId("crops").replaceChildren("Nothing comes into view in this clip.");
  const head = make("tr", {}, make("td"), ...names.map(name => make("th", { scope: "col" }, name)));
  const rows = clip.crops.map(crop => make("tr", {},
    make("th", { scope: "row" }, `frame ${crop.frame}, x ${crop.x}, y ${crop.y}: ${crop.pixels} px`),
    ...names.map(name => make("td", {}, cropped(clip.images[name][clip.frames.indexOf(crop.frame)], crop, name)))));
  byId("crops").replaceChildren(make("table", {}, make("thead", {}, head), make("tbody", {}, ...rows)));
}

function cropped(uri, { x, y, size, frame }, name) {
  const canvas = make("canvas", { width: size, height: size, role: "img", "aria-label": `${name}, frame ${frame}` });
  load(uri).then(image => canvas.getContext("2d").drawImage(image, x, y, size, size, 0, 0, size, size));
  return canvas;
}

function play() {
  const playing = !view.timer;
  clearInterval(view.timer);
  view.timer = playing ? setInterval(() => setFrame(view.frame + 1), 120) : 0;
  byId("play").setAttribute("aria-pressed", playing);
}

function setMode(mode) {
  view.mode = mode;
  return refresh();
}

function zoom(factor) {
  view.zoom = Math.min(32, Math.max(1 / 8, view.zoom * factor));
  return refresh();
}

function nextLeft(step) {
  const names = Object.keys(clipNow().images);
  view.left = names[(names.indexOf(view.left) + step + names.length) % names.length];
  return refresh();
}

function flip() {
  view.mode = "flip";
  view.flipped = !view.flipped;
  return refresh();
}

const KEYS = {
  ArrowLeft: () => setFrame(view.frame - 1), ArrowRight: () => setFrame(view.frame + 1), " ": flip, p: play,
  "+": () => zoom(2), "=": () => zoom(2), "-": () => zoom(0.5), "[": () => nextLeft(-1), "]": () => nextLeft(1),
  ...Object.fromEntries(MODES.map((mode, index) => [String(index + 1), () => setMode(mode)])),
};

function onKey(event) {
  const { tagName } = event.target, act = KEYS[event.key];
  if (!act || event.ctrlKey || event.metaKey || event.altKey || tagName === "SELECT") return;
  const own = tagName === "BUTTON" ? [" "] : tagName === "INPUT" ? ["ArrowLeft", "ArrowRight"] : []; // keys they need themselves
  const scrolls = event.target.classList.contains("scroll") && event.target.id !== "stage";
  if (own.includes(event.key) || (scrolls && event.key.startsWith("Arrow"))) return;
  event.preventDefault();
  act();
}

function followPointer(event) {
  if (view.mode !== "slider" || (event.type === "pointermove" && !event.buttons)) return;
  const bounds = byId("canvas").getBoundingClientRect();
  view.split = Math.min(100, Math.max(0, 100 * (event.clientX - bounds.left) / bounds.width));
  refresh();
}

function startComparer() {
  fill(byId("clip"), data.clips.map((clip, index) => [index, clip.name]));
  byId("clip").onchange = event => setClip(+event.target.value);
  for (const side of ["left", "right"]) byId(side).onchange = event => { view[side] = event.target.value; refresh(); };
  for (const button of byId("views").children) button.onclick = () => (button.dataset.view === view.mode && view.mode === "flip" ? flip() : setMode(button.dataset.view));
  byId("metric").onchange = event => { view.metric = event.target.value; plots(); };
  byId("frame").oninput = event => setFrame(+event.target.value);
  byId("split").oninput = event => { view.split = +event.target.value; refresh(); };
  byId("play").onclick = play;
  byId("in").onclick = () => zoom(2);
  byId("out").onclick = () => zoom(0.5);
  byId("canvas").onpointerdown = byId("canvas").onpointermove = followPointer;
  document.onkeydown = onKey;
  view.left = "noisy";
  view.right = bestOf(clipNow());
  view.frame = Math.floor(clipNow().frames.length / 2);
  setClip(0);
}

startTable();
startTrade();
startComparer();
