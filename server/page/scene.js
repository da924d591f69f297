// The picture of what a robot sees, as the filter sees it. Places come in the robot's own frame: x ahead, y to
// the left [m]. Where the magnetometer tells a heading the picture stands still and the robot turns in it;
// otherwise ahead is up.

import { fitted, font, palette } from "./palette.js";

const HALF = 2.0; // from the robot to the picture's edge [m]
const BODY = 0.1; // the robot's radius [m]
const GOAL = 0.3; // the goal's radius [m]
const AHEAD = 0.5; // seconds of velocity that the arrow shows
const TURN = 2 * Math.PI;

/** Draws a view (see server/view.py), or that there is none. */
export function drawScene(canvas, view) {
  const { context: c, width, height } = fitted(canvas);
  if (!width || !height) return;
  const scale = Math.min(width, height) / 2 / HALF;
  const turn = view?.heading ?? Math.PI / 2;
  const [cos, sin] = [Math.cos(turn), Math.sin(turn)];
  // From the robot's frame to the screen.
  const at = (x, y) => [width / 2 + scale * (cos * x - sin * y), height / 2 - scale * (sin * x + cos * y)];
  c.font = font(12);
  c.lineJoin = c.lineCap = "round";
  rings(c, width, height, scale);
  if (!view || view.problem) {
    words(c, view?.problem ? "surroundings unknown" : "no robot", width / 2, height / 2 + 4, "center");
    return;
  }
  const draw = { c, at, scale, width, height };
  keptClear(draw, view);
  hazards(draw, view);
  goal(draw, view);
  path(draw, view);
  robot(draw, view);
  c.textAlign = "left";
  c.fillStyle = palette.muted;
  for (const radius of [1.0, 2.0]) c.fillText(`${radius} m`, width / 2 + 4, height / 2 - radius * scale + 14);
}

/** What the picture shows, in words. */
export function describeScene(view) {
  if (!view) return "No robot is shown.";
  if (view.problem) return `The surroundings are unknown: ${view.problem}.`;
  const near = [...view.given, ...view.likely].map(([x, y]) => [Math.hypot(x, y) - view.radius, x, y]);
  near.sort((one, other) => one[0] - other[0]);
  const parts = [
    near.length
      ? `${near.length} hazards in sight, the nearest ${near[0][0].toFixed(2)} metres off, ${bearing(near[0][1], near[0][2])}`
      : "No hazard in sight",
    view.goal ? `goal ${Math.hypot(...view.goal).toFixed(1)} metres off, ${bearing(...view.goal)}` : "goal out of range",
    `speed ${Math.hypot(...view.velocity).toFixed(2)} metres a second`,
    view.path ? "a backup is committed" : "no backup is committed",
  ];
  return `${parts.join("; ")}.`;
}

function bearing(x, y) {
  const degrees = Math.round((Math.atan2(y, x) * 180) / Math.PI);
  if (Math.abs(degrees) < 5) return "ahead";
  if (Math.abs(degrees) > 175) return "behind";
  return `${Math.abs(degrees)} degrees to the ${degrees > 0 ? "left" : "right"}`;
}

function rings(c, width, height, scale) {
  c.strokeStyle = palette.line;
  c.lineWidth = 1;
  for (const radius of [0.5, 1.0, 1.5, 2.0]) {
    c.beginPath();
    c.arc(width / 2, height / 2, radius * scale - (radius === HALF ? 1 : 0), 0, TURN);
    c.stroke();
  }
}

function words(c, text, x, y, align, colour = palette.muted) {
  c.textAlign = align;
  // A rim of the background keeps what is drawn below from crossing the letters.
  c.strokeStyle = palette.panel;
  c.lineWidth = 4;
  c.strokeText(text, x, y);
  c.fillStyle = colour;
  c.fillText(text, x, y);
}

/** Discs whose radius grows along a segment: all as one shape, so that where they overlap is no darker. */
function keptClear({ c, at, scale }, view) {
  const shape = new Path2D();
  const cause = new Path2D();
  for (const [x, y, dx, dy, radius, growth, number] of view.obstacles) {
    const one = cone(at(x, y), at(x + dx, y + dy), scale * radius, scale * (radius + growth));
    shape.addPath(one);
    if (number === view.blamed) cause.addPath(one);
  }
  c.fillStyle = palette.kept;
  c.fill(shape);
  c.fill(cause);
}

function cone([x0, y0], [x1, y1], r0, r1) {
  const shape = new Path2D();
  const [dx, dy] = [x1 - x0, y1 - y0];
  const length = Math.hypot(dx, dy);
  if (length <= Math.abs(r1 - r0) + 1e-6) {
    const [x, y, r] = r1 > r0 ? [x1, y1, r1] : [x0, y0, r0];
    shape.arc(x, y, r, 0, TURN);
    return shape;
  }
  // The common tangents touch both circles at the same angle from the axis.
  const axis = Math.atan2(dy, dx);
  const spread = Math.acos((r0 - r1) / length);
  shape.arc(x0, y0, r0, axis + spread, axis - spread);
  shape.arc(x1, y1, r1, axis - spread, axis + spread);
  shape.closePath();
  return shape;
}

function hazards({ c, at, scale }, view) {
  const shown = [...view.given.map((h) => [...h, true]), ...view.likely.map((h) => [...h, false])];
  for (const [x, y, number, given] of shown) {
    const [px, py] = at(x, y);
    const radius = scale * view.radius;
    c.beginPath();
    c.arc(px, py, radius, 0, TURN);
    c.fillStyle = palette.hazard;
    c.fill();
    c.setLineDash(given ? [] : [4, 4]);
    c.strokeStyle = palette["hazard-edge"];
    c.lineWidth = 1.5;
    c.stroke();
    c.setLineDash([]);
    if (number === view.blamed) blame(c, px, py, radius);
  }
  // What is behind an intervention may be no hazard that the scan tells apart.
  if (view.blamed !== null && !shown.some(([, , number]) => number === view.blamed)) {
    const behind = view.obstacles.find((obstacle) => obstacle[6] === view.blamed);
    if (behind) blame(c, ...at(behind[0], behind[1]), scale * behind[4]);
  }
}

function blame(c, x, y, radius) {
  c.strokeStyle = palette.fallback;
  c.lineWidth = 3;
  c.beginPath();
  c.arc(x, y, radius + 4, 0, TURN);
  c.stroke();
  c.beginPath();
  for (const [dx, dy] of [[1, 1], [1, -1]]) {
    c.moveTo(x - 5 * dx, y - 5 * dy);
    c.lineTo(x + 5 * dx, y + 5 * dy);
  }
  c.stroke();
}

function goal({ c, at, scale, width, height }, view) {
  if (!view.goal) return;
  const [x, y] = at(...view.goal);
  c.strokeStyle = palette.goal;
  c.fillStyle = palette.goal;
  const distance = Math.hypot(...view.goal);
  if (distance < HALF - GOAL) {
    c.lineWidth = 2;
    c.beginPath();
    c.arc(x, y, GOAL * scale, 0, TURN);
    c.stroke();
    c.beginPath();
    c.arc(x, y, 3, 0, TURN);
    c.fill();
    return;
  }
  // Beyond the picture: an arrow at its edge, with the distance.
  const [dx, dy] = [(x - width / 2) / (distance * scale), (y - height / 2) / (distance * scale)];
  const edge = HALF * scale - 14;
  const [px, py] = [width / 2 + edge * dx, height / 2 + edge * dy];
  head(c, px + 10 * dx, py + 10 * dy, Math.atan2(dy, dx), 11);
  words(c, `goal ${distance.toFixed(1)} m`, width / 2 + (edge - 30) * dx, height / 2 + (edge - 14) * dy + 4, "center", palette.goal);
}

function path({ c, at }, view) {
  if (!view.path) return;
  c.strokeStyle = palette.path;
  c.lineWidth = 3;
  c.setLineDash([1, 6]);
  c.beginPath();
  for (const place of view.path) c.lineTo(...at(...place));
  c.stroke();
  c.setLineDash([]);
  const [x, y] = at(...view.path.at(-1));
  c.lineWidth = 2;
  c.fillStyle = palette.panel;
  c.beginPath();
  c.arc(x, y, 4, 0, TURN);
  c.fill();
  c.stroke();
}

function robot({ c, at, scale }, view) {
  const [x, y] = at(0, 0);
  const [ax, ay] = at(1, 0);
  const ahead = Math.atan2(ay - y, ax - x);
  c.fillStyle = palette.panel;
  c.strokeStyle = palette.ink;
  c.lineWidth = 2;
  c.beginPath();
  c.arc(x, y, BODY * scale, 0, TURN);
  c.fill();
  c.stroke();
  c.fillStyle = palette.ink;
  head(c, x + BODY * scale * Math.cos(ahead), y + BODY * scale * Math.sin(ahead), ahead, BODY * scale * 1.3);
  const [vx, vy] = at(...view.velocity.map((v) => v * AHEAD));
  const length = Math.hypot(vx - x, vy - y);
  if (length < 4) return;
  c.strokeStyle = c.fillStyle = palette.velocity;
  c.lineWidth = 3;
  c.beginPath();
  c.moveTo(x, y);
  c.lineTo(vx, vy);
  c.stroke();
  head(c, vx, vy, Math.atan2(vy - y, vx - x), 9);
}

/** A filled arrow head whose tip is at (x, y). */
function head(c, x, y, angle, size) {
  c.beginPath();
  c.moveTo(x, y);
  for (const side of [2.6, -2.6]) c.lineTo(x + size * Math.cos(angle + side), y + size * Math.sin(angle + side));
  c.closePath();
  c.fill();
}

/** The nominal and the sent action: thrust upwards as a share of full thrust, turn to the left and right. */
export function drawPad(canvas, view, fullThrust) {
  const { context: c, width } = fitted(canvas);
  if (!width) return;
  const middle = width / 2;
  const reach = middle - 10;
  c.strokeStyle = palette.line;
  c.lineWidth = 1;
  c.strokeRect(middle - reach, middle - reach, 2 * reach, 2 * reach);
  c.beginPath();
  c.moveTo(middle, middle - reach);
  c.lineTo(middle, middle + reach);
  c.moveTo(middle - reach, middle);
  c.lineTo(middle + reach, middle);
  c.stroke();
  const place = ([thrust, turn]) => [
    middle - reach * Math.max(-1, Math.min(1, turn)),
    middle - reach * Math.max(-1, Math.min(1, thrust / fullThrust)),
  ];
  const sent = view?.action ? place(view.action) : null;
  const nominal = view?.nominal ? place(view.nominal) : null;
  if (sent && nominal) {
    c.strokeStyle = palette.muted;
    c.beginPath();
    c.moveTo(...nominal);
    c.lineTo(...sent);
    c.stroke();
  }
  if (sent) {
    c.fillStyle = palette.velocity;
    c.beginPath();
    c.arc(...sent, 5, 0, TURN);
    c.fill();
  }
  if (nominal) {
    c.strokeStyle = palette.ink;
    c.lineWidth = 2;
    c.beginPath();
    c.arc(...nominal, 7, 0, TURN);
    c.stroke();
  }
}
