// What became of one robot over the last minute, and when its mode changed.

export const MINUTE = 60; // seconds that are kept
export const STALE = 1; // seconds after which nothing counts as live
export const SEVERITY = { nominal: 0, guided: 1, filtered: 2, fallback: 3 };
const MOST_CHANGES = 30;

export class History {
  /** Columns of equal length; null where nothing is known. `at` is on the page's clock [s]. */
  columns = { at: [], risk: [], threshold: [], barrier: [], latency: [], mode: [], cause: [] };

  /** The latest first: {time, mode, text, began, ended}; `ended` is null for the one that lasts. */
  changes = [];

  /** Takes a robot's row of an update; whether its mode changed. */
  add(row, now) {
    const since = row.since;
    // A robot may ask less often than updates come.
    if (!since && row.age < STALE) return false;
    const { at, risk, threshold, barrier, latency, mode, cause } = this.columns;
    at.push(now);
    threshold.push(row.threshold);
    risk.push(since ? since.risk : null);
    barrier.push(since ? since.barrier : null);
    latency.push(since ? since.seconds * 1000 : null);
    mode.push(since ? SEVERITY[since.mode] : null);
    cause.push(since ? since.opened_by : null);
    this.forget(now);
    return since ? this.#change(since, now) : false;
  }

  /** Drops what is older than a minute. */
  forget(now) {
    const { at } = this.columns;
    let old = 0;
    while (old < at.length && at[old] < now - MINUTE - 1) old += 1;
    if (old) for (const column of Object.values(this.columns)) column.splice(0, old);
  }

  /** A gap: nothing is known until the next row. */
  gap(now) {
    for (const [name, column] of Object.entries(this.columns)) column.push(name === "at" ? now : null);
  }

  #change(since, now) {
    const text = why(since);
    const last = this.changes[0];
    if (last && last.mode === since.mode && last.text === text) return false;
    if (last) last.ended = now;
    this.changes.unshift({ time: new Date(), mode: since.mode, text, began: now, ended: null });
    this.changes.length = Math.min(this.changes.length, MOST_CHANGES);
    return last !== undefined && last.mode !== since.mode;
  }
}

/** Why the mode is what it is, in words. */
export function why({ origin, opened_by: cause, reason }) {
  const parts = [];
  if (origin) parts.push(`by ${origin}`);
  parts.push(cause ? `gate open: ${cause}` : "gate closed");
  if (reason) parts.push(reason);
  return parts.join("; ");
}
