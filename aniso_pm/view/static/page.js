"use strict";
const $ = (id) => document.getElementById(id);
const steered = document.body.dataset.steered === "1";
let known = {}; // the last status
let filled = false; // has the form got its values?

async function ask(path, body) {
  const options = body === undefined ? {} : {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
  };
  const response = await fetch(path, options);
  const found = await response.json().catch(() => ({ error: `${response.status} ${response.statusText}` }));
  if (!response.ok) throw new Error(found.error);
  return found;
}

function complain(error) {
  $("error").textContent = error ? error.message : "";
  $("error").hidden = !error;
}

async function act(path, body = {}) {
  try {
    complain(null);
    show(await ask(path, body));
  } catch (error) { complain(error); }
}

// --- Picture ---

function showPicture() {
  if (!known.version) return;
  const query = new URLSearchParams({
    layer: $("layer").value, exposure: $("exposure").value, tonemap: $("tonemap").value, v: known.version,
  });
  $("stops").textContent = `${$("exposure").value} stops`;
  const next = new Image();
  next.onload = () => { $("picture").src = next.src; $("picture").dataset.version = known.version; };
  next.onerror = () => fetch(next.src).then((r) => r.json()).then((r) => complain(new Error(r.error)));
  next.src = `picture.png?${query}`;
}

function showLayers(names) {
  const select = $("layer"), before = select.value;
  if (names.join() === Array.from(select.options, (o) => o.value).join()) return;
  select.replaceChildren(...names.map((name) => new Option(name)));
  if (names.includes(before)) select.value = before;
}

// --- Numbers ---

const seconds = (s) => s === null ? "–" : s < 90 ? `${s.toFixed(1)} s` : `${(s / 60).toFixed(1)} min`;
const percent = (e) => e ? `${(100 * e).toPrecision(3)} %` : "–";

function showFacts(s) {
  const facts = {
    "Passes": s.total && s.total < 1e6 ? `${s.passes} of ${s.total}` : s.passes,
    "Samples a pixel": s.spp, "Standard error": percent(s.relative_error),
    "Time": seconds(s.seconds), "Time left": s.left === null ? (s.state === "rendering" ? "until stopped" : "–") : seconds(s.left),
    "Map": s.map ?? "–", "Kernel radius": s.radius ? s.radius.toPrecision(3) : "–",
    "Size": s.size.join(" × "),
  };
  $("facts").replaceChildren(...Object.entries(facts).flatMap(([name, value]) => {
    const [dt, dd] = [document.createElement("dt"), document.createElement("dd")];
    dt.textContent = name; dd.textContent = value;
    return [dt, dd];
  }));
  $("bar").hidden = !(s.total && s.total < 1e6);
  if (!$("bar").hidden) $("bar").value = s.done / s.total;
}

function showHistory(points) {
  const plot = $("plot");
  plot.replaceChildren();
  const add = (name, attributes, text) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", name);
    Object.entries(attributes).forEach(([key, value]) => node.setAttribute(key, value));
    if (text) node.textContent = text;
    plot.append(node);
  };
  add("path", { class: "axis", d: "M36 6V128H314" });
  if (points.length < 2) return add("text", { x: 44, y: 70 }, "after two passes");
  const logs = points.filter((p) => p[0] > 0 && p[1] > 0).map((p) => p.map(Math.log10));
  const range = (k) => [Math.min(...logs.map((p) => p[k])), Math.max(...logs.map((p) => p[k]))];
  const [[x0, x1], [y0, y1]] = [range(0), range(1)];
  const x = (v) => 40 + 270 * (v - x0) / (x1 - x0 || 1), y = (v) => 122 - 110 * (v - y0) / (y1 - y0 || 1);
  add("polyline", { class: "curve", points: logs.map((p) => `${x(p[0])},${y(p[1])}`).join(" ") });
  add("text", { x: 40, y: 142 }, seconds(10 ** x0));
  add("text", { x: 314, y: 142, "text-anchor": "end" }, seconds(10 ** x1));
  add("text", { x: 33, y: 14, "text-anchor": "end" }, percent(10 ** y1));
  add("text", { x: 33, y: 126, "text-anchor": "end" }, percent(10 ** y0));
}

function show(s) {
  const fresh = s.version !== known.version;
  known = s;
  $("state").textContent = s.state;
  $("message").textContent = s.message;
  showFacts(s);
  showHistory(s.history);
  showLayers(s.layers);
  if (fresh) showPicture();
  if (!steered) return;
  $("pause").textContent = s.state === "paused" ? "Go on" : "Pause";
  $("pause").disabled = !["rendering", "paused"].includes(s.state);
  $("stop").disabled = !["rendering", "paused"].includes(s.state);
  if (!filled) {
    for (const [name, value] of Object.entries(s.parameters)) $("parameters").elements[name].value = value;
    filled = true;
  }
}

async function look() {
  try { show(await ask("status")); }
  catch { $("state").textContent = "no connection"; }
  setTimeout(look, 500);
}

// --- What the user does ---

for (const id of ["layer", "exposure", "tonemap"]) $(id).addEventListener("input", () => { complain(null); showPicture(); });
$("quit").addEventListener("click", () => act("quit"));
if (steered) {
  $("pause").addEventListener("click", () => act(known.state === "paused" ? "go_on" : "pause"));
  $("stop").addEventListener("click", () => act("stop"));
  $("parameters").addEventListener("submit", (event) => {
    event.preventDefault();
    const changes = Object.fromEntries(new FormData(event.target));
    changes.initial_radius = Number(changes.initial_radius || 0);
    act("restart", changes);
  });
  $("picture").addEventListener("click", async (event) => {
    if (!known.version) return;
    const box = $("picture").getBoundingClientRect();
    const at = (k, from, length) => Math.min(known.size[k] - 1, Math.floor(known.size[k] * from / length));
    const x = at(0, event.clientX - box.left, box.width), y = at(1, event.clientY - box.top, box.height);
    const mark = $("mark");
    mark.hidden = false;
    mark.style.left = `${100 * (x + 0.5) / known.size[0]}%`;
    mark.style.top = `${100 * (y + 0.5) / known.size[1]}%`;
    const [column, row] = [x + known.offset[0], y + known.offset[1]];
    $("hint").textContent = `Explaining pixel ${column},${row} …`;
    try {
      $("explanation").textContent = (await ask("explain", { x: column, y: row })).text;
      $("explanation").hidden = false;
      $("hint").textContent = "";
    } catch (error) { $("hint").textContent = error.message; }
  });
}
look();
