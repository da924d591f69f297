// The colours of page.css, as a canvas takes them: resolved for the scheme that is shown.

const NAMES = [
  "ink", "muted", "line", "panel", "kept", "hazard", "hazard-edge", "goal", "path", "velocity", "risk",
  "nominal", "guided", "filtered", "fallback",
  "by-risk", "by-dwell", "by-barrier", "by-novelty", "by-fault", "by-always",
];

/** The page's font for a canvas, of some pixels. */
export const font = (pixels) => `${pixels}px ${getComputedStyle(document.body).fontFamily}`;

/** Name → colour; read anew by `readPalette` when the scheme changes. */
export const palette = {};

export function readPalette() {
  const probe = document.createElement("span");
  document.body.append(probe);
  for (const name of NAMES) {
    probe.style.color = `var(--${name})`;
    palette[name] = getComputedStyle(probe).color;
  }
  probe.remove();
}

/** A canvas's context, in CSS pixels, cleared; the canvas as large as its box. */
export function fitted(canvas) {
  const { width, height } = canvas.getBoundingClientRect();
  const scale = window.devicePixelRatio || 1;
  const [w, h] = [Math.round(width * scale), Math.round(height * scale)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}
