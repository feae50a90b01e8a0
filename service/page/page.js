// The page: receives what the robot publishes, keeps the newest of each, draws at the screen's pace. It sends nothing.

import * as cdr from "./cdr.js";
import * as draw from "./draw.js";
import * as overlays from "./overlays.js";

const $ = (id) => document.getElementById(id);
const TEXT = new TextDecoder();
const TRAIL_STEP_M = 0.05, TRAIL_POINTS = 6000, POSES_KEPT = 200, EVENTS_KEPT = 12, RING_REACH_M = 3;
const LEVELS = ["ok", "warning", "error", "stale"]; // as health names them

class Robot {
  constructor(base) {
    this.base = base;
    this.info = null;
    this.health = null;
    this.healthAt = 0;
    this.pose = null;
    this.poses = [];
    this.trail = [];
    this.scans = new Map();
    this.cones = new Map();
    this.polar = new Map();
    this.grid = new draw.GridImage();
    this.graph = null;
    this.topo = null;
    this.rooms = null;
    this.plan = null;
    this.lines = null;
    this.ground = null; // images
    this.clearance = null;
    this.agreement = null;
    this.seen = new Map(); // when a device's newest reading came here
  }

  addPose(pose) {
    this.pose = pose;
    if (pose.stamp < (this.poses.at(-1)?.stamp ?? pose.stamp) - 0.5) this.poses = [];  // the robot's clock was set back
    this.poses.push(pose);
    if (this.poses.length > POSES_KEPT) this.poses.shift();
    const last = this.trail.at(-1);
    if (!last || Math.hypot(pose.x - last.x, pose.y - last.y) >= TRAIL_STEP_M) this.trail.push(pose);
    if (this.trail.length > TRAIL_POINTS) this.trail.splice(0, TRAIL_POINTS / 10);
  }

  // After a correction the map lies elsewhere: the old trail does not fit it any more, the graph's way does.
  setGraph(graph) {
    if (this.graph && this.graph.epoch !== graph.epoch) this.trail = [];
    this.graph = graph;
  }

  // The pose at a stamp: between the two kept around it, else the nearest.
  poseAt(stamp) {
    const p = this.poses;
    if (!p.length) return null;
    let after = p.length - 1;
    if (stamp >= p[after].stamp) return p[after];
    while (after > 0 && p[after - 1].stamp > stamp) after--;
    if (after === 0) return p[0];
    const a = p[after - 1], b = p[after], t = (stamp - a.stamp) / Math.max(b.stamp - a.stamp, 1e-9);
    const turn = Math.atan2(Math.sin(b.yaw - a.yaw), Math.cos(b.yaw - a.yaw));
    return { x: a.x + t * (b.x - a.x), y: a.y + t * (b.y - a.y), yaw: a.yaw + t * turn };
  }

  mount(name) { return this.info?.sensors.find((sensor) => sensor.name === name)?.pose ?? null; }
  get footprint() { return this.info?.footprint_m ?? [[0.2, 0.15], [-0.2, 0.15], [-0.2, -0.15], [0.2, -0.15]]; }
}

const robots = new Map();
let shown = null;
let changed = true;
const camera = new draw.Camera($("map"));
const layers = { grid: true, scan: true, sonar: true, sectors: true, trail: true, loops: true, topo: true, rooms: true, plan: true,
  lines: false, ground: true, clearance: false, conflicts: true };
const buttons = new Map();
// Layers that not every robot has: their buttons come with their maps.
const HAS = { loops: (r) => r.graph, topo: (r) => r.topo, rooms: (r) => r.rooms, plan: (r) => r.plan, lines: (r) => r.lines, ground: (r) => r.ground,
  clearance: (r) => r.clearance, conflicts: (r) => r.agreement, sonar: (r) => r.cones.size > 0 };
let follow = false;
let ringMap = null;

// ---- receiving -------------------------------------------------------------------------------------------------

async function unpack(buffer) {
  const view = new DataView(buffer), bytes = new Uint8Array(buffer);
  let at = 0;
  const piece = () => { const n = view.getUint16(at, true); at += 2 + n; return bytes.subarray(at - n, at); };
  const key = TEXT.decode(piece()), attachment = piece().slice();
  const packed = bytes[at++] === 1;
  let payload = bytes.subarray(at);
  if (packed) {
    const stream = new Blob([payload]).stream().pipeThrough(new DecompressionStream("deflate"));
    payload = new Uint8Array(await new Response(stream).arrayBuffer());
  }
  return { key, attachment, payload };
}

function robotOf(key) {
  const base = key.split("/").slice(0, baseChunks).join("/");
  if (!robots.has(base)) { robots.set(base, new Robot(base)); listRobots(); }
  return robots.get(base);
}

let baseChunks = 2;

const HANDLERS = [
  [/^scan\/([^/]+)$/, (robot, payload, _a, [name]) => robot.scans.set(name, cdr.laserScan(payload))],
  [/^range\/([^/]+)$/, (robot, payload, _a, [name]) => robot.cones.set(name, json(payload))],
  [/^sectors\/polar\/([^/]+)$/, (robot, payload, _a, [name]) => robot.polar.set(name, json(payload))],
  [/^pose$/, (robot, payload) => { robot.addPose(cdr.poseWithCovariance(payload)); seeWheels(robot); }],
  [/^map\/grid$/, (robot, payload, attachment) => robot.grid.full(cdr.occupancyGrid(payload), epochOf(attachment))],
  [/^map\/grid\/update$/, (robot, payload, attachment) => {
    if (epochOf(attachment) === robot.grid.epoch) robot.grid.update(cdr.occupancyGridUpdate(payload));
  }],
  [/^map\/graph$/, (robot, payload) => robot.setGraph(json(payload))],
  [/^map\/topo$/, (robot, payload) => { robot.topo = json(payload); }],
  [/^map\/rooms$/, (robot, payload) => { robot.rooms = json(payload); }],
  [/^map\/plan$/, (robot, payload) => { robot.plan = json(payload); }],
  [/^map\/lines$/, (robot, payload) => { robot.lines = json(payload); }],
  [/^map\/elevation$/, (robot, payload) => { robot.ground = overlays.groundImage(json(payload)); }],
  [/^map\/clearance$/, (robot, payload) => { robot.clearance = overlays.clearanceImage(cdr.occupancyGrid(payload)); }],
  [/^map\/agreement$/, (robot, payload) => takeAgreement(robot, json(payload))],
  [/^health\/json$/, (robot, payload) => takeHealth(robot, json(payload))],
  [/^info$/, (robot, payload) => { robot.info = json(payload); }],
];

// A pose is made of the wheels' newest counts. (odom says so, too, but at up to 100 Hz, and nothing else here needs it.)
function seeWheels(robot) {
  for (const s of robot.health?.sources ?? []) if (s.kind === "wheels" && s.state === "running") robot.seen.set(s.name, performance.now());
}

function json(payload) { return JSON.parse(TEXT.decode(payload)); }

// Attachment of grids: epoch and number of the update, two unsigned 64-bit numbers, little endian.
function epochOf(attachment) {
  if (attachment.length < 8) return null;
  return new DataView(attachment.buffer, attachment.byteOffset).getBigUint64(0, true);
}

function take({ key, attachment, payload }) {
  if (key === "!alive") { takeAlive(json(payload)); return; }
  const robot = robotOf(key), suffix = key.slice(robot.base.length + 1);
  for (const [pattern, handle] of HANDLERS) {
    const match = pattern.exec(suffix);
    if (match) {
      handle(robot, payload, attachment, match.slice(1));
      if (match.length > 1) robot.seen.set(match[1], performance.now());
      changed = true;
      return;
    }
  }
}

let alive = null;

function takeAlive(bases) {
  for (const base of bases) {
    baseChunks = base.split("/").length;
    robotOf(`${base}/`);
    if (alive && !alive.includes(base)) note(0, `${base}: running`);
  }
  for (const base of alive ?? []) if (!bases.includes(base)) { robots.set(base, new Robot(base)); note(2, `${base}: gone`); }
  alive = bases;
  listRobots();
  changed = true;
}

function listRobots() {
  if (!shown || !robots.has(shown)) shown = [...robots.keys()].sort()[0] ?? null;
  const select = $("robot");
  select.hidden = robots.size < 2;
  select.replaceChildren(...[...robots.keys()].sort().map((base) => new Option(base.split("/").at(-1), base, false, base === shown)));
}

function takeHealth(robot, health) {
  const before = new Map((robot.health?.sources ?? []).map((source) => [source.name, source]));
  for (const source of health.sources) {
    const old = before.get(source.name);
    if (old && (old.state !== source.state || old.level !== source.level)) {
      note(LEVELS.indexOf(source.level), `${source.name}: ${source.text || source.state}`);
    }
  }
  robot.health = health;
  robot.healthAt = performance.now();
}

function begun(doc) { return (doc?.kinds ?? []).reduce((sum, kind) => sum + kind.began, 0); }

function where(doc) { return doc.where.map((each) => `${each.what} at ${each.position.map((v) => v.toFixed(1)).join(", ")}`); }

function takeAgreement(robot, doc) {
  const before = robot.agreement;
  robot.agreement = doc;
  if (before && doc.disagreements && begun(doc) > begun(before)) note(1, `maps disagree: ${where(doc).slice(0, 2).join("; ")}`);
  else if (before?.disagreements && !doc.disagreements) note(0, "maps agree again");
}

// ---- the parts around the map ------------------------------------------------------------------------------------

function element(tag, text = "", properties = {}) {
  const e = document.createElement(tag);
  e.textContent = text;
  Object.assign(e, properties);
  return e;
}

function note(level, text) {
  const item = element("li");
  item.dataset.level = level;
  item.append(element("time", new Date().toLocaleTimeString([], { hour12: false })), text);
  $("events").prepend(item);
  while ($("events").children.length > EVENTS_KEPT) $("events").lastChild.remove();
}

function number(value, digits, unit) { return Number.isFinite(value) ? `${value.toFixed(digits)} ${unit}` : "–"; }

function figure(list, label, value, className = "") {
  const box = element("div");
  box.append(element("dt", label), element("dd", value, { className }));
  list.append(box);
}

function ageClass(age, rate) {
  if (!Number.isFinite(age)) return "age-old";
  const period = rate > 0 ? 1 / rate : 0.2;
  return age <= Math.max(3 * period, 0.3) ? "age-fresh" : age < 2 ? "age-late" : "age-old";
}

// Health comes once a second; a reading that came here since then is the better witness.
function ageNow(robot, source) {
  const told = source.age_s === null ? Infinity : source.age_s + (performance.now() - robot.healthAt) / 1000;
  return Math.min(told, (performance.now() - (robot.seen.get(source.name) ?? -Infinity)) / 1000);
}

function card(source, age) {
  const box = element("article", "", { className: "card" });
  box.dataset.level = LEVELS.indexOf(source.level);
  const title = element("h2", source.name);
  title.append(element("small", source.kind));
  box.append(title);
  box.append(element("p", source.text || source.state));
  if (source.identity) box.append(element("p", source.identity, { className: "who" }));
  const list = element("dl");
  figure(list, "rate", number(source.rate_hz, 1, "Hz"));
  figure(list, "age", Number.isFinite(age) ? (age < 10 ? `${(age * 1000).toFixed(0)} ms` : `${age.toFixed(0)} s`) : "never", ageClass(age, source.rate_hz));
  const drops = Object.entries(source.drops ?? {}).filter(([, n]) => n > 0);
  figure(list, "drops", String(drops.reduce((sum, [, n]) => sum + n, 0)), drops.length ? "age-late" : "");
  box.append(list);
  if (drops.length) box.append(element("p", drops.map(([reason, n]) => `${reason.replaceAll("_", " ")} ${n}`).join(", "), { className: "drops" }));
  return box;
}

function drawPanel(robot) {
  const sources = robot?.health?.sources ?? [];
  $("devices").replaceChildren(...sources.map((source) => card(source, ageNow(robot, source))));
  const maps = [...(robot?.polar.keys() ?? [])].sort();
  const cards = [];
  if (maps.length) {
    const box = element("article", "", { className: "card" });
    box.append(element("h2", "sector map on the ring"));
    for (const name of maps) {
      const button = element("button", name);
      button.setAttribute("aria-pressed", String(name === ringName(robot)));
      button.onclick = () => { ringMap = name; changed = true; drawPanel(robot); };
      box.append(button, " ");
    }
    cards.push(box);
  }
  const doc = robot?.agreement;
  if (doc) {
    const box = element("article", "", { className: "card" });
    box.dataset.level = doc.disagreements ? 1 : 0;
    const title = element("h2", "maps");
    title.append(element("small", doc.disagreements ? "disagree" : "agree"));
    box.append(title);
    for (const text of where(doc).slice(0, 4)) box.append(element("p", text));
    const list = element("dl");
    for (const [label, field] of [["agree", "agree"], ["unknown", "unknown"], ["disagree", "disagree"]]) {
      figure(list, label, String(doc.kinds.reduce((sum, kind) => sum + kind[field], 0)), field === "disagree" && doc.disagreements ? "age-late" : "");
    }
    box.append(list);
    cards.push(box);
  }
  const dropped = Object.entries(robot?.health?.counters ?? {}).filter(([, n]) => n > 0);
  if (dropped.length) {
    const box = element("article", "", { className: "card" });
    box.append(element("h2", "daemon counters"));
    box.append(element("p", dropped.map(([name, n]) => `${name.replaceAll("_", " ")} ${n}`).join(", "), { className: "who" }));
    cards.push(box);
  }
  $("maps").replaceChildren(...cards);
}

function ringName(robot) {
  if (ringMap && robot?.polar.has(ringMap)) return ringMap;
  return robot ? [...robot.polar.keys()].sort()[0] ?? null : null;
}

function showButtons(robot) {
  for (const [name, has] of Object.entries(HAS)) buttons.get(name).hidden = !(robot && has(robot));
}

function drawHeader(robot) {
  const link = $("link");
  const here = robot && (alive ?? []).includes(robot.base);
  link.dataset.state = !online ? "gone" : here ? "live" : "waiting";
  link.textContent = !online ? "page lost its server" : here ? robot.base.split("/").at(-1) : "waiting for a robot";
  const p = robot?.pose;
  $("pose").textContent = p ? `x ${p.x.toFixed(2)} m  y ${p.y.toFixed(2)} m  ${((p.yaw * 180) / Math.PI).toFixed(0)}°` : "";
  const process = robot?.health?.process ?? {};
  $("load").textContent = [
    Number.isFinite(process.cpu_percent) ? `CPU ${process.cpu_percent.toFixed(0)} %` : "",
    Number.isFinite(process.memory_mb) ? `${process.memory_mb.toFixed(0)} MB` : "",
  ].filter(Boolean).join("  ");
}

function drawScale() {
  const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100];
  const metres = steps.find((m) => m * camera.scale >= 60) ?? 100;
  $("scale").firstElementChild.style.width = `${metres * camera.scale}px`;
  $("scale").lastElementChild.textContent = `${metres} m`;
}

// ---- drawing -----------------------------------------------------------------------------------------------------

function planar(pose) { return { x: pose.x_m, y: pose.y_m, yaw: pose.yaw_rad }; }

function polarForDrawing(name, doc) {
  return {
    name,
    pose: planar(doc.origin),
    sectors: doc.sectors.map((s) => ({ start: s.start_rad, stop: s.stop_rad, state: s.state, distance: s.distance_m })),
  };
}

function drawMap(robot) {
  const g2 = draw.prepare($("map"));
  draw.clearMap(g2, camera);
  if (!robot) return;
  frameWhenKnown(robot);
  if (follow && robot.pose) { camera.x = robot.pose.x; camera.y = robot.pose.y; }
  if (layers.grid) robot.grid.draw(g2, camera);
  if (layers.ground && robot.ground) overlays.drawOverlay(g2, camera, robot.ground);
  if (layers.clearance && robot.clearance) overlays.drawOverlay(g2, camera, robot.clearance);
  if (layers.rooms && robot.rooms) draw.drawRooms(g2, camera, robot.rooms);
  if (layers.lines && robot.lines) overlays.drawLines(g2, camera, robot.lines);
  if (layers.trail) {
    if (robot.graph) draw.drawTrail(g2, camera, robot.graph.keys.map(([x, y]) => ({ x, y })));
    draw.drawTrail(g2, camera, robot.trail);
  }
  if (layers.loops && robot.graph) draw.drawLoops(g2, camera, robot.graph);
  if (layers.topo && robot.topo) {
    draw.drawTopo(g2, camera, robot.topo);
    const [x, y, yaw] = robot.topo.robot ?? [];
    if (!robot.pose && yaw !== undefined) draw.drawRobot(g2, camera, { x, y, yaw }, robot.footprint);
  }
  if (layers.plan && robot.plan) draw.drawPlan(g2, camera, robot.plan);
  if (layers.conflicts && robot.agreement) overlays.drawDisagreements(g2, camera, robot.agreement);
  if (robot.pose) {
    if (layers.sonar) drawCones(g2, robot);
    if (layers.scan) drawScans(g2, robot);
    draw.drawRobot(g2, camera, robot.pose, robot.footprint);
  }
}

function drawScans(g2, robot) {
  for (const [name, scan] of robot.scans) {
    const mount = robot.mount(name), pose = robot.poseAt(scan.stamp);
    if (pose && mount) draw.drawScan(g2, camera, scan, draw.compose(pose, planar(mount)));
  }
}

function drawCones(g2, robot) {
  for (const doc of robot.cones.values()) {
    for (const transducer of doc.transducers) {
      const reach = { echo: transducer.range_m, nothing: Infinity, too_close: -Infinity }[transducer.status] ?? null;
      const cone = { range: reach, min: doc.range_min_m, max: doc.range_max_m, fieldOfView: doc.cone_rad };
      draw.drawCone(g2, camera, cone, draw.compose(robot.pose, planar(transducer.pose)));
    }
  }
}

let userMoved = false;

// Until somebody moves the view, it shows all that is known.
function frameWhenKnown(robot) {
  if (userMoved) return;
  const box = robot.grid.bounds() ?? placesBox(robot.topo);
  if (box) camera.fit(...box);
  else if (robot.pose) { camera.x = robot.pose.x; camera.y = robot.pose.y; }
}

// Around the places of a robot that draws no grid.
function placesBox(topo) {
  const at = (topo?.nodes ?? []).map((node) => node.position).filter(Boolean);
  if (!at.length) return null;
  const xs = [...at.map((p) => p[0]), topo.robot?.[0] ?? at[0][0]], ys = [...at.map((p) => p[1]), topo.robot?.[1] ?? at[0][1]];
  return [Math.min(...xs) - 1, Math.min(...ys) - 1, Math.max(...xs) + 1, Math.max(...ys) + 1];
}

function frame() {
  const robot = robots.get(shown) ?? null;
  if (changed) {
    changed = false;
    drawMap(robot);
    const name = ringName(robot), doc = name && robot.polar.get(name);
    $("ring").hidden = !layers.sectors;
    if (layers.sectors) draw.drawRing($("ring"), doc ? polarForDrawing(name, doc) : null, robot?.footprint ?? [], RING_REACH_M);
    drawScale();
  }
  requestAnimationFrame(frame);
}

// ---- hands -------------------------------------------------------------------------------------------------------

function setFollow(on) {
  follow = on;
  userMoved = true;
  $("follow").setAttribute("aria-pressed", String(on));
  changed = true;
}

function moved() { userMoved = true; changed = true; }

function fit() { userMoved = false; setFollow(false); userMoved = false; }

const pointers = new Map();
$("map").addEventListener("pointerdown", (e) => {
  $("map").setPointerCapture(e.pointerId);
  pointers.set(e.pointerId, [e.clientX, e.clientY]);
  $("map").classList.add("dragging");
});
$("map").addEventListener("pointermove", (e) => {
  const before = pointers.get(e.pointerId);
  if (!before) return;
  const others = [...pointers].filter(([id]) => id !== e.pointerId);
  if (others.length) {
    const [ox, oy] = others[0][1];
    const old = Math.hypot(before[0] - ox, before[1] - oy), now = Math.hypot(e.clientX - ox, e.clientY - oy);
    if (old > 0) camera.zoom(now / old, (ox + e.clientX) / 2, (oy + e.clientY) / 2);
  } else {
    if (follow) setFollow(false);
    camera.pan(e.clientX - before[0], e.clientY - before[1]);
  }
  pointers.set(e.pointerId, [e.clientX, e.clientY]);
  moved();
});
for (const kind of ["pointerup", "pointercancel"]) {
  $("map").addEventListener(kind, (e) => { pointers.delete(e.pointerId); $("map").classList.toggle("dragging", pointers.size > 0); });
}
$("map").addEventListener("wheel", (e) => {
  e.preventDefault();
  camera.zoom(Math.exp(-e.deltaY * (e.deltaMode === 1 ? 0.05 : 0.0015)), e.offsetX, e.offsetY);
  moved();
}, { passive: false });
$("map").addEventListener("keydown", (e) => {
  const step = 60;
  const pan = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[e.key];
  if (pan) { if (follow) setFollow(false); camera.pan(...pan); moved(); }
  else if (e.key === "+" || e.key === "=") { camera.zoom(1.25); moved(); }
  else if (e.key === "-") { camera.zoom(0.8); moved(); }
  else if (e.key === "f") setFollow(!follow);
  else return;
  e.preventDefault();
});
$("zoom-in").onclick = () => { camera.zoom(1.4); moved(); };
$("zoom-out").onclick = () => { camera.zoom(1 / 1.4); moved(); };
$("fit").onclick = () => { fit(); changed = true; };
$("follow").onclick = () => setFollow(!follow);
$("follow").setAttribute("aria-pressed", "false");
$("robot").onchange = (e) => { shown = e.target.value; userMoved = false; changed = true; };

function setPanel(open) {
  $("panel").hidden = !open;
  $("panel-switch").setAttribute("aria-expanded", String(open));
  document.body.classList.toggle("panel-open", open);
}
$("panel-switch").onclick = () => setPanel($("panel").hidden);
setPanel(window.innerWidth > 720);

for (const name of Object.keys(layers)) {
  const button = element("button", name);
  button.setAttribute("aria-pressed", String(layers[name]));
  buttons.set(name, button);
  button.onclick = () => { layers[name] = !layers[name]; button.setAttribute("aria-pressed", String(layers[name])); changed = true; };
  $("layers").append(button);
}
window.addEventListener("resize", () => { changed = true; });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  draw.readColours();
  for (const robot of robots.values()) robot.grid.recolour();
  changed = true;
});

// ---- the line to the server ---------------------------------------------------------------------------------------

let online = false;
let inOrder = Promise.resolve();
let broken = 0;

function connect() {
  const socket = new WebSocket(`ws${location.protocol === "https:" ? "s" : ""}://${location.host}/stream`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { online = true; };
  socket.onmessage = (e) => {
    inOrder = inOrder.then(() => unpack(e.data)).then(take).catch((error) => {
      broken += 1;
      if (broken === 1 || broken % 1000 === 0) note(1, `unreadable messages: ${broken} (${error.message})`);
    });
  };
  socket.onclose = () => { online = false; setTimeout(connect, 1000); };
}

setInterval(() => { const robot = robots.get(shown) ?? null; drawHeader(robot); drawPanel(robot); showButtons(robot); }, 250);
connect();
requestAnimationFrame(frame);
window.umfeld = { robots, camera }; // for tests and for the curious at the browser's console
