// Drawing: the world on the map canvas, the sectors on the ring. Metres in, pixels out; y points up in the world.

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

const NAMES = ["--map-unknown", "--map-free", "--map-wall", "--scan", "--cone", "--trail", "--robot", "--ink", "--soft", "--rule",
  "--sector-free", "--sector-obstacle", "--sector-unknown", "--sector-stale"];
export let colours = {};
export function readColours() { colours = Object.fromEntries(NAMES.map((name) => [name.slice(2), css(name)])); }
readColours();

function rgb(hex) {
  const n = parseInt(hex.slice(1, 7), 16);
  return [n >> 16, (n >> 8) & 255, n & 255];
}

// The shade of every cell value: index value & 255; unknown (-1) is apart from free (0).
function shades() {
  const unknown = rgb(colours["map-unknown"]), free = rgb(colours["map-free"]), wall = rgb(colours["map-wall"]);
  const table = new Uint32Array(256);
  const pixel = (c) => (255 << 24) | (c[2] << 16) | (c[1] << 8) | c[0];
  table.fill(pixel(unknown));
  for (let v = 0; v <= 100; v++) table[v] = pixel(free.map((f, i) => Math.round(f + ((wall[i] - f) * v) / 100)));
  return table;
}

export class Camera {
  constructor(canvas) { this.canvas = canvas; this.x = 0; this.y = 0; this.scale = 60; }
  toScreen(x, y) {
    return [(x - this.x) * this.scale + this.width / 2, (this.y - y) * this.scale + this.height / 2];
  }
  toWorld(px, py) {
    return [(px - this.width / 2) / this.scale + this.x, this.y - (py - this.height / 2) / this.scale];
  }
  get width() { return this.canvas.clientWidth; }
  get height() { return this.canvas.clientHeight; }
  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [wx, wy] = this.toWorld(px, py);
    this.scale = Math.min(2000, Math.max(1, this.scale * factor));
    const [nx, ny] = this.toWorld(px, py);
    this.x += wx - nx;
    this.y += wy - ny;
  }
  pan(dx, dy) { this.x -= dx / this.scale; this.y += dy / this.scale; }
  fit(x0, y0, x1, y1) {
    const margin = this.width > 720 ? 330 : 40;
    const w = Math.max(this.width - margin, 100), h = Math.max(this.height - 160, 100);
    this.scale = Math.min(200, Math.max(2, 0.94 * Math.min(w / Math.max(x1 - x0, 1), h / Math.max(y1 - y0, 1))));
    this.x = (x0 + x1) / 2 + (this.width > 720 ? 150 / this.scale : 0);
    this.y = (y0 + y1) / 2;
  }
}

// The grid as an image that updates are written into; row 0 of the image is the map's lowest row, flipped when drawn.
export class GridImage {
  constructor() { this.canvas = document.createElement("canvas"); this.grid = null; this.table = shades(); }
  recolour() { this.table = shades(); if (this.grid) this.full(this.grid, this.epoch); }
  full(grid, epoch) {
    this.grid = grid;
    this.epoch = epoch;
    this.canvas.width = Math.max(grid.width, 1);
    this.canvas.height = Math.max(grid.height, 1);
    this.write(0, 0, grid.width, grid.height, grid.cells);
    this.measure();
  }
  update(patch) {
    const g = this.grid;
    if (!g || patch.x < 0 || patch.y < 0 || patch.x + patch.width > g.width || patch.y + patch.height > g.height) return false;
    for (let row = 0; row < patch.height; row++) {
      g.cells.set(patch.cells.subarray(row * patch.width, (row + 1) * patch.width), (patch.y + row) * g.width + patch.x);
    }
    this.write(patch.x, patch.y, patch.width, patch.height, patch.cells);
    this.grow(patch);
    return true;
  }
  write(x, y, width, height, cells) {
    if (!width || !height) return;
    const pixels = new Uint32Array(width * height);
    for (let i = 0; i < pixels.length; i++) pixels[i] = this.table[cells[i] & 255];
    const image = new ImageData(new Uint8ClampedArray(pixels.buffer), width, height);
    this.canvas.getContext("2d").putImageData(image, x, y);
  }
  measure() {
    const g = this.grid;
    this.box = [g.width, g.height, 0, 0];
    this.grow({ x: 0, y: 0, width: g.width, height: g.height, cells: g.cells });
  }
  grow(patch) {
    for (let row = 0; row < patch.height; row++) {
      for (let col = 0; col < patch.width; col++) {
        if (patch.cells[row * patch.width + col] < 50) continue; // framed by its walls: a beam out of a window frees far space
        const x = patch.x + col, y = patch.y + row;
        if (x < this.box[0]) this.box[0] = x;
        if (y < this.box[1]) this.box[1] = y;
        if (x > this.box[2]) this.box[2] = x;
        if (y > this.box[3]) this.box[3] = y;
      }
    }
  }
  // World corners of what is occupied, or null.
  bounds() {
    if (!this.grid || this.box[2] < this.box[0]) return null;
    const { origin, resolution } = this.grid, xs = [], ys = [];
    const c = Math.cos(origin.yaw), s = Math.sin(origin.yaw);
    for (const i of [this.box[0], this.box[2] + 1]) {
      for (const k of [this.box[1], this.box[3] + 1]) {
        xs.push(origin.x + (c * i - s * k) * resolution);
        ys.push(origin.y + (s * i + c * k) * resolution);
      }
    }
    return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  }
  draw(g2, camera) {
    if (!this.grid) return;
    drawRaster(g2, camera, this.canvas, this.grid.origin, this.grid.resolution);
  }
}

// Cells as an image, its row 0 the lowest of the map, where origin puts its corner.
export function drawRaster(g2, camera, canvas, origin, resolution) {
  const [px, py] = camera.toScreen(origin.x, origin.y);
  const k = camera.scale * resolution;
  g2.save();
  g2.translate(px, py);
  g2.rotate(-origin.yaw);
  g2.scale(k, -k);
  g2.imageSmoothingEnabled = k < 1;
  g2.drawImage(canvas, 0, 0);
  g2.restore();
}

export function clearMap(g2, camera) {
  g2.fillStyle = colours["map-unknown"];
  g2.fillRect(0, 0, camera.width, camera.height);
  const step = camera.scale > 25 ? 1 : camera.scale > 5 ? 5 : 25;
  const [x0, y1] = camera.toWorld(0, 0), [x1, y0] = camera.toWorld(camera.width, camera.height);
  g2.strokeStyle = colours.rule;
  g2.lineWidth = 0.5;
  g2.beginPath();
  for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) { const [px] = camera.toScreen(x, 0); g2.moveTo(px, 0); g2.lineTo(px, camera.height); }
  for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) { const [, py] = camera.toScreen(0, y); g2.moveTo(0, py); g2.lineTo(camera.width, py); }
  g2.stroke();
}

export function drawTrail(g2, camera, trail) {
  if (trail.length < 2) return;
  g2.strokeStyle = colours.trail;
  g2.globalAlpha = 0.55;
  g2.lineWidth = 2;
  g2.beginPath();
  for (const p of trail) g2.lineTo(...camera.toScreen(p.x, p.y));
  g2.stroke();
  g2.globalAlpha = 1;
}

// Pairs of places on the way that are the same place: what closes the loops of the map. Doubted ones are faint.
export function drawLoops(g2, camera, graph) {
  g2.strokeStyle = g2.fillStyle = colours.cone;
  g2.lineWidth = 1.5;
  for (const closure of graph.closures) {
    const ends = [graph.keys[closure.from], graph.keys[closure.to]].map(([x, y]) => camera.toScreen(x, y));
    g2.globalAlpha = 0.2 + 0.6 * closure.weight;
    g2.beginPath();
    for (const [px, py] of ends) g2.lineTo(px, py);
    g2.stroke();
    for (const [px, py] of ends) { g2.beginPath(); g2.arc(px, py, 2.5, 0, 2 * Math.PI); g2.fill(); }
  }
  g2.globalAlpha = 1;
}

// Places and the ways driven between them, or regions and the passages: doors are drawn stronger.
export function drawTopo(g2, camera, topo) {
  const at = new Map(topo.nodes.map((node) => [node.id, camera.toScreen(...node.position)]));
  g2.strokeStyle = colours["sector-free"];
  g2.lineWidth = 1;
  g2.globalAlpha = 0.5;
  for (const node of topo.nodes.filter((n) => n.polygon)) {
    g2.beginPath();
    for (const corner of node.polygon) g2.lineTo(...camera.toScreen(...corner));
    g2.closePath();
    g2.stroke();
  }
  for (const edge of topo.edges) {
    const middle = edge.ends ? [camera.toScreen((edge.ends[0][0] + edge.ends[1][0]) / 2, (edge.ends[0][1] + edge.ends[1][1]) / 2)] : [];
    g2.globalAlpha = edge.is_door ? 1 : 0.7;
    g2.lineWidth = edge.is_door ? 2.5 : 1.5;
    g2.beginPath();
    for (const point of [at.get(edge.from), ...middle, at.get(edge.to)]) if (point) g2.lineTo(...point);
    g2.stroke();
  }
  g2.fillStyle = colours["sector-free"];
  g2.globalAlpha = 1;
  for (const [px, py] of at.values()) { g2.beginPath(); g2.arc(px, py, 3, 0, 2 * Math.PI); g2.fill(); }
}

// Rooms in tints of their id, doors across their openings, and the graph: from the middle of a room through a door to the next.
export function drawRooms(g2, camera, map) {
  const at = new Map(map.rooms.map((room) => [room.id, room.position]));
  for (const room of map.rooms) {
    g2.fillStyle = `hsl(${(room.id * 137) % 360} 60% 55%)`;
    g2.globalAlpha = 0.18;
    g2.beginPath();
    for (const [x, y] of room.outline) g2.lineTo(...camera.toScreen(x, y));
    g2.fill();
  }
  g2.globalAlpha = 0.8;
  g2.strokeStyle = g2.fillStyle = colours.soft;
  g2.lineWidth = 1;
  for (const door of map.doors) {
    g2.beginPath();
    for (const [x, y] of [at.get(door.rooms[0]), door.position, at.get(door.rooms[1])]) g2.lineTo(...camera.toScreen(x, y));
    g2.stroke();
  }
  g2.strokeStyle = colours.cone;
  g2.lineWidth = 3;
  for (const door of map.doors) {
    g2.beginPath();
    for (const [x, y] of door.ends) g2.lineTo(...camera.toScreen(x, y));
    g2.stroke();
  }
  g2.globalAlpha = 1;
  g2.fillStyle = colours.ink;
  g2.font = "12px sans-serif";
  g2.textAlign = "center";
  for (const room of map.rooms) g2.fillText(room.name ?? `room ${room.id}`, ...camera.toScreen(...room.position));
}

// The way last planned, its goal as a ring; alternatives are faint and dashed.
export function drawPlan(g2, camera, plan) {
  g2.strokeStyle = colours.robot;
  g2.lineJoin = "round";
  const line = (poses) => {
    g2.beginPath();
    for (const [x, y] of poses) g2.lineTo(...camera.toScreen(x, y));
    g2.stroke();
  };
  g2.globalAlpha = 0.5;
  g2.lineWidth = 1.5;
  g2.setLineDash([6, 5]);
  for (const other of plan.alternatives) line(other.poses);
  g2.setLineDash([]);
  g2.globalAlpha = 0.9;
  g2.lineWidth = 3;
  line(plan.poses);
  const [x, y] = plan.poses.at(-1);
  g2.beginPath();
  g2.arc(...camera.toScreen(x, y), 6, 0, 2 * Math.PI);
  g2.stroke();
  g2.globalAlpha = 1;
}

export function compose(a, b) {
  const c = Math.cos(a.yaw), s = Math.sin(a.yaw);
  return { x: a.x + c * b.x - s * b.y, y: a.y + s * b.x + c * b.y, yaw: a.yaw + b.yaw };
}

export function drawScan(g2, camera, scan, mapFromSensor) {
  g2.fillStyle = colours.scan;
  const size = Math.max(2, Math.min(4, camera.scale * 0.04));
  for (let i = 0; i < scan.ranges.length; i++) {
    const r = scan.ranges[i];
    if (!Number.isFinite(r)) continue;
    const a = mapFromSensor.yaw + scan.angleMin + i * scan.angleIncrement;
    const [px, py] = camera.toScreen(mapFromSensor.x + r * Math.cos(a), mapFromSensor.y + r * Math.sin(a));
    g2.fillRect(px - size / 2, py - size / 2, size, size);
  }
}

// A sonar's cone: filled up to an echo with its arc; only outlined where nothing was heard; nothing when not known.
export function drawCone(g2, camera, cone, mapFromTransducer) {
  if (cone.range === null) return;
  const heard = Number.isFinite(cone.range) || cone.range === -Infinity;
  const reach = cone.range === Infinity ? cone.max : cone.range === -Infinity ? cone.min : cone.range;
  const [px, py] = camera.toScreen(mapFromTransducer.x, mapFromTransducer.y);
  const from = -(mapFromTransducer.yaw + cone.fieldOfView / 2), to = -(mapFromTransducer.yaw - cone.fieldOfView / 2);
  g2.strokeStyle = g2.fillStyle = colours.cone;
  g2.globalAlpha = heard ? 0.14 : 0.05;
  g2.beginPath();
  g2.moveTo(px, py);
  g2.arc(px, py, reach * camera.scale, from, to);
  g2.closePath();
  g2.fill();
  g2.globalAlpha = heard ? 0.9 : 0.2;
  g2.lineWidth = heard ? 2 : 1;
  g2.beginPath();
  g2.arc(px, py, reach * camera.scale, from, to);
  g2.stroke();
  g2.globalAlpha = 1;
}

function outline(g2, toScreen, footprint, pose) {
  const c = Math.cos(pose.yaw), s = Math.sin(pose.yaw);
  g2.beginPath();
  for (const [x, y] of footprint) g2.lineTo(...toScreen(pose.x + c * x - s * y, pose.y + s * x + c * y));
  g2.closePath();
}

export function drawRobot(g2, camera, pose, footprint) {
  const toScreen = (x, y) => camera.toScreen(x, y);
  outline(g2, toScreen, footprint, pose);
  g2.fillStyle = g2.strokeStyle = colours.robot;
  g2.globalAlpha = 0.35;
  g2.fill();
  g2.globalAlpha = 1;
  g2.lineWidth = 2;
  g2.stroke();
  const front = Math.max(...footprint.map(([x]) => x), 0.1);
  g2.beginPath();
  g2.moveTo(...camera.toScreen(pose.x, pose.y));
  g2.lineTo(...camera.toScreen(pose.x + front * Math.cos(pose.yaw), pose.y + front * Math.sin(pose.yaw)));
  g2.stroke();
}

function wedge(g2, px, py, scale, from, to, inner, outer) {
  g2.beginPath();
  g2.arc(px, py, outer * scale, -to, -from);
  if (inner > 0) g2.arc(px, py, inner * scale, -from, -to, true);
  else g2.lineTo(px, py);
  g2.closePath();
}

// One sector: free is filled as far as it was seen; an obstacle is an arc with free space up to it; unknown and stale
// are hatched bands, so that nobody takes them for free at a glance.
function drawSector(g2, px, py, scale, sector, yaw, reach) {
  const from = yaw + sector.start, to = yaw + sector.stop;
  const distance = sector.distance === null ? null : Math.min(sector.distance, reach);
  if (sector.state === "free" || sector.state === "obstacle") {
    g2.fillStyle = colours["sector-free"];
    g2.globalAlpha = 0.16;
    wedge(g2, px, py, scale, from, to, 0, distance);
    g2.fill();
    g2.globalAlpha = 1;
  }
  if (sector.state === "obstacle" && sector.distance <= reach) {
    g2.strokeStyle = colours["sector-obstacle"];
    g2.lineWidth = 3;
    g2.beginPath();
    g2.arc(px, py, distance * scale, -to, -from);
    g2.stroke();
  }
  if (sector.state === "unknown" || sector.state === "stale") {
    g2.fillStyle = colours[`sector-${sector.state}`];
    g2.globalAlpha = sector.state === "stale" ? 0.5 : 0.28;
    wedge(g2, px, py, scale, from, to, 0.86 * reach, reach);
    g2.fill();
    if (sector.state === "stale" && distance !== null) {
      g2.setLineDash([4, 3]);
      g2.strokeStyle = colours["sector-stale"];
      g2.lineWidth = 2;
      g2.beginPath();
      g2.arc(px, py, distance * scale, -to, -from);
      g2.stroke();
      g2.setLineDash([]);
    }
    g2.globalAlpha = 1;
  }
}

// The ring: the robot in the middle, forward up, one sector map at a time.
export function drawRing(canvas, sectors, footprint, reach) {
  const g2 = prepare(canvas), w = canvas.clientWidth, scale = w / 2 / (reach * 1.06), middle = w / 2;
  g2.clearRect(0, 0, w, w);
  g2.strokeStyle = colours.rule;
  g2.lineWidth = 1;
  for (let r = 1; r <= reach; r++) { g2.beginPath(); g2.arc(middle, middle, r * scale, 0, 2 * Math.PI); g2.stroke(); }
  const up = Math.PI / 2;
  if (sectors) {
    const pose = compose({ x: 0, y: 0, yaw: up }, sectors.pose);
    for (const sector of sectors.sectors) drawSector(g2, middle + pose.x * scale, middle - pose.y * scale, scale, sector, pose.yaw, reach);
  }
  outline(g2, (x, y) => [middle + x * scale, middle - y * scale], footprint, { x: 0, y: 0, yaw: up });
  g2.fillStyle = colours.robot;
  g2.fill();
  g2.fillStyle = colours.soft;
  g2.font = "11px system-ui, sans-serif";
  g2.textAlign = "center";
  g2.fillText(sectors ? sectors.name : "no sector map", middle, w - 12);
}

export function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const g2 = canvas.getContext("2d");
  g2.setTransform(ratio, 0, 0, ratio, 0, 0);
  return g2;
}
