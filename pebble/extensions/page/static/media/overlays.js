/** Shapes and labels that robots publish to be drawn over their picture, in all forms that viewers accept. */

const SHAPES = 100; // of a payload
const POINTS = 500; // of a shape
const SOURCES = 8; // of a robot; more are not drawn
const LONGEST = 40; // characters of a label
export const STALE_MS = 500;

/** @typedef {[number, number]} Point right and down, 0..1 of the picture */
/** @typedef {{shapes: Point[][], labels: {text: string, at: Point}[]}} Overlays */

/**
 * An object with ``shapes`` and ``labels``, a bare list of shapes or tags, or a payload like ``apriltag-data``. What is
 * not understood is left out.
 * @param {unknown} payload @returns {Overlays}
 */
export function readOverlays(payload) {
  const items = Array.isArray(payload) ? payload : [payload];
  /** @type {Overlays} */
  const found = { shapes: [], labels: [] };
  for (const item of items.slice(0, SHAPES)) {
    if (Array.isArray(item)) addShape(found, item);
    else if (typeof item === "object" && item !== null) addObject(found, item);
  }
  return found;
}

/** @param {Overlays} found @param {any} item */
function addObject(found, item) {
  for (const shape of list(item.shapes)) addShape(found, shape);
  for (const label of list(item.labels)) addLabel(found, label?.marker_id ?? label?.text, point(label?.center_norm));
  if (item.detected === false || !list(item.corners_norm).length) return;
  const corners = addShape(found, item.corners_norm);
  if (corners.length) addLabel(found, item.marker_id, point(item.center_norm) ?? middle(corners));
}

/** @param {Overlays} found @param {unknown} shape @returns {Point[]} */
function addShape(found, shape) {
  const points = (Array.isArray(shape) ? shape.slice(0, POINTS) : []).map(point).filter((one) => one !== null);
  if (points.length < 2 || found.shapes.length >= SHAPES) return [];
  found.shapes.push(points);
  return points;
}

/** @param {Overlays} found @param {unknown} text @param {Point | null} at */
function addLabel(found, text, at) {
  const known = typeof text === "number" || typeof text === "string";
  if (known && at && found.labels.length < SHAPES) found.labels.push({ text: String(text).slice(0, LONGEST), at });
}

/** @param {unknown} value @returns {Point | null} moved to the edge if it is outside */
function point(value) {
  if (!Array.isArray(value) || !Number.isFinite(value[0]) || !Number.isFinite(value[1])) return null;
  return [clamp(value[0]), clamp(value[1])];
}

/** @param {Point[]} points @returns {Point} */
function middle(points) {
  const sum = points.reduce(([x, y], one) => [x + one[0], y + one[1]], [0, 0]);
  return [sum[0] / points.length, sum[1] / points.length];
}

const clamp = (share) => Math.min(1, Math.max(0, share));
const list = (value) => (Array.isArray(value) ? value.slice(0, SHAPES) : []);

/** The newest overlays of each source; those without a successor are gone. */
export class NewestOverlays {
  constructor() {
    /** @type {Map<string, {at: number, overlays: Overlays}>} */
    this.sources = new Map();
  }

  /** @param {any} payload @param {number} at ms */
  receive(payload, at) {
    const source = typeof payload?.source === "string" ? payload.source : "";
    this.forget(at);
    if (this.sources.size < SOURCES || this.sources.has(source)) {
      this.sources.set(source, { at, overlays: readOverlays(payload) });
    }
  }

  /** @param {number} now @returns {Overlays} what to draw now, of all sources together */
  current(now) {
    this.forget(now);
    const all = [...this.sources.values()].map(({ overlays }) => overlays);
    return { shapes: all.flatMap(({ shapes }) => shapes), labels: all.flatMap(({ labels }) => labels) };
  }

  forget(now) {
    for (const [source, { at }] of this.sources) if (Math.abs(now - at) > STALE_MS) this.sources.delete(source);
  }
}

/**
 * Where a picture is within a box that shows all of it in its middle (CSS: object-fit contain).
 * @param {number} width @param {number} height of the picture @param {number} boxWidth @param {number} boxHeight
 */
export function contained(width, height, boxWidth, boxHeight) {
  const scale = Math.min(boxWidth / width, boxHeight / height);
  const [w, h] = [width * scale, height * scale];
  return { x: (boxWidth - w) / 2, y: (boxHeight - h) / 2, width: w, height: h };
}

const INK = "#4df3ff";
const EDGE = "rgb(0 0 0 / 75%)";

/**
 * @param {CanvasRenderingContext2D} context @param {Overlays} overlays
 * @param {{x: number, y: number, width: number, height: number}} area of the picture @param {number} scale pixels of the
 * canvas per pixel of the page
 */
export function drawOverlays(context, overlays, area, scale) {
  /** @returns {Point} */
  const place = ([x, y]) => [area.x + x * area.width, area.y + y * area.height];
  context.lineJoin = "round";
  for (const shape of overlays.shapes) {
    context.beginPath();
    for (const one of shape) context.lineTo(...place(one));
    if (shape.length > 2) context.closePath();
    stroke(context, EDGE, 4 * scale);
    stroke(context, INK, 2 * scale);
  }
  context.font = `600 ${14 * scale}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  for (const { text, at } of overlays.labels) {
    const [x, y] = place(at);
    const width = context.measureText(text).width + 8 * scale;
    context.fillStyle = EDGE;
    context.fillRect(x - width / 2, y - 10 * scale, width, 20 * scale);
    context.fillStyle = INK;
    context.fillText(text, x, y);
  }
}

function stroke(context, style, width) {
  context.strokeStyle = style;
  context.lineWidth = width;
  context.stroke();
}
