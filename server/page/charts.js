// The charts of the last minute: uPlot, and a ribbon of modes drawn by hand on the same axis.

import uPlot from "./uplot/uPlot.esm.js";
import { MINUTE, STALE } from "./history.js";
import { font, palette } from "./palette.js";

const LEFT = 46; // width of the vertical axes: the charts stand in line
const RIGHT = 12;
const TICK = 0.1; // seconds between two updates
const MODES = ["nominal", "guided", "filtered", "fallback"];

let now = 0;

/** All charts of one page. */
export class Charts {
  #charts;

  /** @param places  name → element for risk, barrier, modes and latency. */
  constructor(places) {
    this.#charts = {
      risk: chart(places.risk, 112, [line("risk", 2), line("muted", 1.5, [6, 4])], { y: (u, low, high) => [0, 1.25 * Math.max(high || 0, 1e-3)] }),
      barrier: chart(places.barrier, 92, [line("velocity", 2)], {
        y: (u, low, high) => [Math.min(low ?? 0, 0) - 0.05, Math.min(Math.max(1.1 * (high ?? 0), 0.2), 1)],
        zero: true,
      }),
      modes: chart(places.modes, 66, [{ show: false }], { y: () => [0, 1], draw: ribbon, bare: true }),
      latency: chart(places.latency, 92, [line("ink", 1.5)], { y: (u, low, high) => [0, 1.25 * Math.max(high || 0, 1)], times: true }),
    };
    const resize = new ResizeObserver((entries) => {
      for (const { target, contentRect } of entries) {
        const one = this.#charts[target.id];
        if (one && contentRect.width > 0) one.setSize({ width: contentRect.width, height: one.height });
      }
    });
    for (const place of Object.values(places)) resize.observe(place);
  }

  /** Draws a history up to a time on the page's clock [s]; null: nothing. */
  draw(history, at) {
    now = at;
    const c = history?.columns ?? { at: [], risk: [], threshold: [], barrier: [], latency: [], mode: [], cause: [] };
    this.#charts.risk.setData([c.at, c.risk, c.threshold]);
    this.#charts.barrier.setData([c.at, c.barrier]);
    this.#charts.modes.history = c;
    this.#charts.modes.setData([c.at, c.mode]);
    this.#charts.latency.setData([c.at, c.latency]);
  }
}

function line(colour, width, dash) {
  return { stroke: () => palette[colour], width, dash, points: { show: false }, spanGaps: false };
}

function chart(place, height, series, { y, draw, bare = false, zero = false, times = false }) {
  const options = {
    width: Math.max(place.clientWidth, 200),
    height,
    padding: [6, RIGHT, bare || !times ? 4 : 0, 0],
    legend: { show: false },
    cursor: { show: false },
    scales: { x: { time: false, range: () => [now - MINUTE, now] }, y: { range: y } },
    series: [{}, ...series],
    axes: [
      {
        show: true,
        size: times ? 28 : 0,
        stroke: () => palette.muted,
        font: font(12),
        gap: 8,
        grid: { stroke: () => palette.line, width: 1 },
        ticks: { show: false },
        splits: () => [-60, -45, -30, -15, 0].map((s) => now + s),
        values: (u, splits) => (times ? splits.map((s) => label(Math.round(s - now))) : splits.map(() => "")),
      },
      {
        size: LEFT,
        stroke: () => palette.muted,
        font: font(12),
        gap: 6,
        grid: { show: !bare, stroke: () => palette.line, width: 1 },
        ticks: { show: false },
        space: 28,
        values: bare ? () => [] : undefined,
      },
    ],
    hooks: { draw: [...(draw ? [draw] : []), ...(zero ? [zeroLine] : [])] },
  };
  return new uPlot(options, series.length === 2 ? [[], [], []] : [[], []], place);
}

const label = (seconds) => (seconds === 0 ? "now" : `${seconds} s`.replace("-", "\u2212"));

/** Where the barrier is 0. */
function zeroLine(u) {
  const { ctx } = u;
  const y = u.valToPos(0, "y", true);
  ctx.save();
  ctx.strokeStyle = palette.fallback;
  ctx.lineWidth = window.devicePixelRatio || 1;
  ctx.beginPath();
  ctx.moveTo(u.bbox.left, y);
  ctx.lineTo(u.bbox.left + u.bbox.width, y);
  ctx.stroke();
  ctx.restore();
}

/** Modes as bars whose height says how severe they are as well; below them, where the gate was open. */
function ribbon(u) {
  const { ctx, bbox, history } = u;
  if (!history) return;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  const strip = Math.round(0.24 * bbox.height);
  const base = bbox.top + bbox.height - strip - Math.round(0.05 * bbox.height);
  const tall = base - bbox.top;
  runs(history.at, history.mode, (from, to, mode) => {
    const [x, width] = span(u, from, to);
    const height = (tall * (mode + 1)) / MODES.length;
    ctx.fillStyle = palette[MODES[mode]];
    ctx.fillRect(x, base - height, width, height);
  });
  ctx.font = font(Math.round(0.72 * strip));
  ctx.textBaseline = "middle";
  ctx.textAlign = "center";
  runs(history.at, history.cause, (from, to, cause) => {
    const [x, width] = span(u, from, to);
    const y = bbox.top + bbox.height - strip;
    ctx.fillStyle = palette[`by-${cause}`];
    ctx.fillRect(x, y, width, strip);
    if (ctx.measureText(cause).width + 6 > width) return;
    ctx.fillStyle = palette.panel;
    ctx.fillText(cause, x + width / 2, y + strip / 2);
  });
  ctx.restore();
}

function span(u, from, to) {
  const x = u.valToPos(from, "x", true);
  return [x, Math.max(u.valToPos(to, "x", true) - x, 1.5)];
}

/** Calls back for every run of equal values that are not null; a sample stands for the time since the last. */
function runs(at, values, draw) {
  let start = 0;
  for (let i = 1; i <= values.length; i += 1) {
    if (i < values.length && values[i] === values[start] && at[i] - at[i - 1] < STALE) continue;
    const before = start && at[start] - at[start - 1] < STALE ? at[start - 1] : at[start] - TICK;
    if (values[start] !== null) draw(before, at[i - 1], values[start]);
    start = i;
  }
}
