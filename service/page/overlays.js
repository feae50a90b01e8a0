// Layers that lie over the grid: the ground, distances to obstacles, walls as lines, where maps contradict each other.

import { colours, drawRaster } from "./draw.js";

const LITTLE = (r, g, b, a) => ((a << 24) | (b << 16) | (g << 8) | r) >>> 0;
const GROUND = [LITTLE(47, 158, 110, 90), LITTLE(224, 161, 0, 130), LITTLE(240, 115, 40, 150), LITTLE(217, 40, 40, 170)]; // as map/elevation numbers them
const NOTHING = 0;

// A picture of cells, the lowest row first, as drawRaster takes it.
function raster(width, height, resolution, origin, shade) {
  const canvas = document.createElement("canvas");
  canvas.width = Math.max(width, 1);
  canvas.height = Math.max(height, 1);
  const pixels = new Uint32Array(canvas.width * canvas.height);
  for (let i = 0; i < width * height; i++) pixels[i] = shade(i);
  canvas.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(pixels.buffer), canvas.width, canvas.height), 0, 0);
  return { canvas, resolution, origin };
}

// map/elevation: where the vehicle can drive, and what keeps it from there; unknown ground is left as it is.
export function groundImage(doc) {
  const origin = { x: doc.origin.x_m, y: doc.origin.y_m, yaw: doc.origin.yaw_rad };
  const cells = doc.ground.flat();
  return raster(doc.columns, doc.rows, doc.resolution_m, origin, (i) => GROUND[cells[i]] ?? NOTHING);
}

// map/clearance: the nearer the next obstacle, the stronger; nothing where it is farther than the reach, or unknown.
export function clearanceImage(grid) {
  return raster(grid.width, grid.height, grid.resolution, grid.origin, (i) => {
    const cost = grid.cells[i];
    return cost > 0 ? LITTLE(255, Math.round(190 - 1.5 * cost), 40, Math.round(20 + 1.6 * cost)) : NOTHING;
  });
}

export function drawOverlay(g2, camera, image) { drawRaster(g2, camera, image.canvas, image.origin, image.resolution); }

// map/lines: walls as the line map has them.
export function drawLines(g2, camera, doc) {
  g2.strokeStyle = colours["sector-obstacle"];
  g2.globalAlpha = 0.85;
  g2.lineWidth = 2;
  g2.beginPath();
  for (const line of doc.lines) {
    g2.moveTo(...camera.toScreen(...line.start));
    g2.lineTo(...camera.toScreen(...line.end));
  }
  g2.stroke();
  g2.globalAlpha = 1;
}

// map/agreement: a ring with a mark at each place where one map denies what another says.
export function drawDisagreements(g2, camera, doc) {
  g2.strokeStyle = colours["sector-obstacle"];
  g2.lineWidth = 2.5;
  g2.font = "bold 14px sans-serif";
  g2.textAlign = "center";
  for (const { position } of doc.where) {
    const [px, py] = camera.toScreen(...position);
    g2.beginPath();
    g2.arc(px, py, 10, 0, 2 * Math.PI);
    g2.fillStyle = colours["map-free"];
    g2.fill();
    g2.stroke();
    g2.fillStyle = colours["sector-obstacle"];
    g2.fillText("!", px, py + 5);
  }
}
