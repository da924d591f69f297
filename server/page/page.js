// The live page: hears updates from the service and shows them. Whatever is older than a second is greyed out
// and its age is told: nothing stale looks live.

import { Charts } from "./charts.js";
import { History, STALE, why } from "./history.js";
import { readPalette } from "./palette.js";
import { describeScene, drawPad, drawScene } from "./scene.js";
import { Stream } from "./stream.js";

const GONE = 60.0; // seconds after which a robot that the service no longer names leaves the list
const SAY_EVERY = 5.0; // seconds between two announcements to a screen reader
const THEME = "lagnet.theme";
const READ_KEY = "lagnet.read-key";
const NO_ALARM = "clear";

const element = (id) => document.getElementById(id);
const seconds = () => performance.now() / 1000;

let about = null; // what the service said of itself
let heard = null; // when the last update came
let update = null; // the last update
let lost = null; // why there is no connection, or null
let chosen = decodeURIComponent(location.hash.slice(1)) || null; // the robot that the user chose
let actKey = null; // never stored
const robots = new Map(); // name → {history, row, seen, parts}

const stream = new Stream({
  about(told) {
    about = told;
    element("model").textContent = told.model;
  },
  update(told) {
    update = told;
    heard = seconds();
    if (lost !== null) say("Connected.");
    lost = null;
    takeRobots(told);
    showAlarms(told.operation.alarms);
    show();
  },
  lost(reason) {
    if (lost === null && heard !== null) warn(`Not connected: ${reason}.`);
    lost = reason;
    showAges();
  },
  refused() {
    askKey("The service asks for its read key.").then((key) => {
      if (key === null) return;
      stream.key = key;
      store(sessionStorage, READ_KEY, key);
      stream.look(chosen);
    });
  },
});

/** The threshold is that of the bundle which decides now. */
function gateInWords(threshold) {
  if (about === null) return "unknown";
  return about.gate === "risk" ? `risk, opens above λ ${round(threshold ?? about.threshold, 3)}` : about.gate;
}

// --- robots ---------------------------------------------------------------------------------------------

/** The robot that is shown: the chosen one, or the one that the service shows by itself. */
const looked = () => chosen ?? update?.looked ?? null;

function takeRobots(told) {
  for (const [name, row] of Object.entries(told.robots)) {
    let robot = robots.get(name);
    if (robot === undefined) {
      robot = { history: new History(), parts: makeCard(name), row, seen: heard };
      robots.set(name, robot);
    }
    // Across a loss of the connection nothing is known.
    if (heard - robot.seen > STALE) robot.history.gap(heard - 0.05);
    const changed = robot.history.add(row, heard);
    Object.assign(robot, { row, seen: heard });
    if (changed && name === looked()) say(`${name}: ${row.since.mode}, ${why(row.since)}.`);
  }
  for (const [name, robot] of robots) {
    if (heard - robot.seen > GONE && name !== chosen) {
      robot.parts.card.remove();
      robots.delete(name);
    }
  }
  element("no-robots").hidden = robots.size > 0;
  element("crowded").hidden = !told.crowded;
}

/** A robot in the list: a radio button, so that arrow keys choose and a screen reader knows which is chosen. */
function makeCard(name) {
  const card = make("label", "card");
  const radio = make("input", "unseen");
  Object.assign(radio, { type: "radio", name: "robot", value: name });
  radio.addEventListener("change", () => choose(name));
  const title = make("span", "name", name);
  const mode = make("span", "mode");
  const meter = make("span", "meter");
  const bar = make("span", "bar");
  meter.append(bar, make("span", "limit"));
  const note = make("span", "note");
  card.append(radio, title, mode, meter, note);
  element("robots").append(card);
  if (name === chosen) card.scrollIntoView({ block: "nearest", inline: "nearest" });
  return { card, radio, mode, bar, note };
}

function choose(name) {
  chosen = name;
  history.replaceState(null, "", `#${encodeURIComponent(name)}`);
  stream.look(name);
  show();
}

function showCard(robot, name, age) {
  const { row, parts } = robot;
  const stale = age > STALE;
  parts.radio.checked = name === looked();
  parts.card.dataset.stale = stale;
  setMode(parts.mode, stale ? null : row.mode, "silent");
  // The threshold stands at half of the meter.
  const share = row.risk === null || !row.threshold ? 0 : Math.min(row.risk / row.threshold / 2, 1);
  parts.bar.style.width = `${100 * share}%`;
  parts.bar.dataset.over = share > 0.5;
  parts.note.textContent = stale ? `silent for ${ageInWords(age)}` : `λ ${known(row.risk, 3)}, barrier ${known(row.barrier, 3, "m")}`;
}

// --- the robot that is looked at ------------------------------------------------------------------------

const charts = new Charts({
  risk: element("risk"),
  barrier: element("barrier"),
  modes: element("modes"),
  latency: element("latency"),
});

const READINGS = [
  ["risk", "Risk score λ"],
  ["threshold", "Threshold"],
  ["barrier", "Barrier"],
  ["novelty", "Novelty"],
  ["speed", "Speed"],
  ["yaw", "Yaw rate"],
  ["latency", "Latency"],
  ["rate", "Decisions"],
];
const readings = Object.fromEntries(
  READINGS.map(([key, title]) => {
    const box = make("div");
    const value = make("dd");
    box.append(make("dt", null, title), value);
    element("readings").append(box);
    return [key, value];
  }),
);

/** What the robot that is shown sees; null while the service still shows another. */
const view = () => (update !== null && update.looked === looked() ? update.view : null);

let described = -Infinity;
let rate = { name: null, from: 0, steps: 0, text: "unknown" };

function show() {
  const name = looked();
  const robot = robots.get(name);
  const seen = view();
  element("looked-title").textContent = name ?? "Surroundings";
  drawScene(element("scene"), seen);
  drawPad(element("pad"), seen, about?.full_thrust ?? 1);
  charts.draw(robot?.history, seconds());
  showReadings(name, robot?.row, seen);
  showChanges(robot?.history);
  showState();
  showAges();
  // A label that changes ten times a second could not be read.
  if (seconds() - described > 1) {
    described = seconds();
    element("scene").setAttribute("aria-label", describeScene(seen));
    element("pad").setAttribute("aria-label", `Nominal action ${pair(seen?.nominal)}, sent action ${pair(seen?.action)}.`);
  }
}

function showReadings(name, row, seen) {
  setMode(element("mode"), row?.mode ?? null, "unknown");
  element("gate").textContent = gateInWords(row?.threshold);
  element("why").textContent = row ? why(row) : "";
  const told = {
    risk: known(row?.risk, 3),
    threshold: known(row?.threshold, 3),
    barrier: known(row?.barrier, 3, "m"),
    novelty: known(row?.novelty, 2) + (row?.suspect ? ` (${row.suspect})` : ""),
    speed: known(seen?.velocity && Math.hypot(...seen.velocity), 2, "m/s"),
    yaw: known(seen?.yaw_rate, 2, "rad/s"),
    latency: known(row && row.seconds * 1000, 2, "ms"),
    rate: rateOf(name, row),
  };
  for (const [key, text] of Object.entries(told)) {
    readings[key].textContent = text;
    readings[key].dataset.unknown = text.startsWith("unknown");
  }
  element("nominal").textContent = pair(seen?.nominal);
  element("sent").textContent = pair(seen?.action);
}

/** Decisions a second, counted over a second. */
function rateOf(name, row) {
  if (!row) return "unknown";
  if (rate.name !== name) rate = { name, from: heard, steps: 0, text: "unknown" };
  rate.steps += row.steps;
  if (heard - rate.from >= 1) {
    rate = { name, from: heard, steps: 0, text: `${Math.round(rate.steps / (heard - rate.from))} /s` };
  }
  return rate.text;
}

function showChanges(past) {
  const rows = (past?.changes ?? []).slice(0, 7).map(({ time, mode, text, began, ended }) => {
    const row = make("tr");
    const badge = make("span", "mode");
    setMode(badge, mode);
    const cell = make("td");
    cell.append(badge);
    const lasted = (ended ?? heard) - began;
    row.append(make("td", null, time.toLocaleTimeString("en-GB")), cell, make("td", null, text), make("td", null, ended === null ? "now" : ageInWords(lasted)));
    return row;
  });
  element("changes").replaceChildren(...rows);
}

// --- the service ----------------------------------------------------------------------------------------

function showState() {
  const state = update?.operation.state ?? "unknown";
  element("state").textContent = state;
  element("state").dataset.state = state;
  // A service that is ready need not say why.
  element("state-why").textContent = state === "ready" ? "" : (update?.operation.why ?? "");
  if (update?.operation.model) element("model").textContent = update.operation.model;
}

/** Says how old everything is, four times a second, whether or not updates come. */
function showAges() {
  const since = heard === null ? Infinity : seconds() - heard;
  const live = since <= STALE;
  document.body.dataset.live = live;
  element("connection").textContent = live ? "live" : heard === null ? "connecting" : "not connected";
  element("banner").hidden = live || (heard === null && lost === null);
  const old = heard === null ? "" : ` What is shown is ${ageInWords(since)} old.`;
  element("banner").textContent = `Not connected: ${lost ?? "no update comes"}.${old} Trying again.`;
  for (const [name, robot] of robots) showCard(robot, name, robot.row.age + (seconds() - robot.seen));
  const robot = robots.get(looked());
  const age = robot ? robot.row.age + (seconds() - robot.seen) : Infinity;
  element("looked").dataset.stale = age > STALE;
  const still = view()?.heading === null ? "no heading: ahead is up" : "held still by the magnetometer";
  element("age").textContent = !robot ? "" : age > STALE ? `last heard ${ageInWords(age)} ago` : still;
  if (!live) {
    element("state").textContent = "unknown";
    element("state").dataset.state = "unknown";
  }
}

// --- alarms ---------------------------------------------------------------------------------------------

const alarms = new Map(); // name → {item, parts, state}

function showAlarms(told) {
  const raised = told.filter(({ state }) => state !== NO_ALARM);
  element("no-alarms").textContent = told.length ? `None of ${told.length} raised.` : "None.";
  element("no-alarms").hidden = raised.length > 0;
  const names = new Set(raised.map(({ name }) => name));
  for (const [name, { item }] of alarms) {
    if (names.has(name)) continue;
    item.remove();
    alarms.delete(name);
    say(`Alarm ${name} is over.`);
  }
  for (const alarm of raised) {
    const shown = alarms.get(alarm.name) ?? makeAlarm(alarm.name);
    if (alarm.state !== shown.state && alarm.state !== "pending") {
      warn(`Alarm ${alarm.name}: ${alarm.state}. ${alarm.cause ?? ""}`);
    }
    shown.state = alarm.state;
    shown.item.dataset.state = alarm.state;
    shown.parts.state.textContent = alarm.acknowledged ? `${alarm.state}, acknowledged` : alarm.state;
    shown.parts.text.textContent = alarmInWords(alarm);
    shown.parts.button.hidden = alarm.acknowledged || alarm.state === "pending";
  }
}

function makeAlarm(name) {
  const item = make("li", "alarm");
  const [state, text] = [make("span", "badge"), make("span", "text")];
  const button = make("button", null, "Acknowledge");
  button.type = "button";
  button.setAttribute("aria-label", `Acknowledge ${name}`);
  button.addEventListener("click", () => acknowledge(name));
  item.append(make("b", null, name), state, text, button);
  element("alarm-list").append(item);
  const shown = { item, parts: { state, text, button }, state: null };
  alarms.set(name, shown);
  return shown;
}

function alarmInWords({ value, limit, since, cause }) {
  const parts = [];
  if (typeof value === "number") parts.push(`${round(value, 3)}${typeof limit === "number" ? `, limit ${round(limit, 3)}` : ""}`);
  if (typeof since === "number") parts.push(`since ${new Date(since * 1000).toLocaleTimeString("en-GB")}`);
  if (cause) parts.push(cause);
  return parts.join("; ");
}

async function acknowledge(name) {
  for (;;) {
    const key = actKey ?? stream.key;
    const headers = { "content-type": "application/json", ...(key === null ? {} : { authorization: `Bearer ${key}` }) };
    let status = 0;
    try {
      status = (await fetch(`alarms/${encodeURIComponent(name)}/acknowledge`, { method: "POST", headers, body: "{}" })).status;
    } catch {
      // Told below: status 0.
    }
    if (status === 401 || status === 403) {
      actKey = await askKey("To acknowledge an alarm the service asks for its act key.");
      if (actKey === null) return;
      continue;
    }
    if (status >= 200 && status < 300) say(`Alarm ${name} is acknowledged.`);
    else warn(`Alarm ${name} could not be acknowledged: ${status ? `status ${status}` : "the service does not answer"}.`, true);
    return;
  }
}

// --- keys, theme, words ---------------------------------------------------------------------------------

/** Asks for a key; null if the user does not give one. */
function askKey(reason) {
  const dialog = element("ask");
  element("ask-why").textContent = reason;
  element("ask-key").value = "";
  if (!dialog.open) dialog.showModal();
  return new Promise((resolve) => {
    const finish = (key) => {
      element("ask-form").onsubmit = element("ask-cancel").onclick = dialog.oncancel = null;
      dialog.close();
      resolve(key);
    };
    // The policy of this page lets no form be sent anywhere.
    element("ask-form").onsubmit = (event) => {
      event.preventDefault();
      finish(element("ask-key").value.trim());
    };
    element("ask-cancel").onclick = dialog.oncancel = () => finish(null);
  });
}

/** Storage may be forbidden; then nothing is remembered. */
function store(storage, name, value) {
  try {
    storage.setItem(name, value);
  } catch {
    // Kept in memory alone.
  }
}

function stored(storage, name) {
  try {
    return storage.getItem(name);
  } catch {
    return null;
  }
}

function applyTheme(theme) {
  document.documentElement.dataset.theme = theme;
  readPalette();
  show();
}

function make(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

function setMode(badge, mode, otherwise) {
  badge.textContent = mode ?? otherwise;
  badge.dataset.mode = mode ?? "";
}

const round = (number, digits) => number.toFixed(digits).replace("-", "\u2212");
const known = (number, digits, unit = "") => (typeof number === "number" ? `${round(number, digits)} ${unit}`.trim() : "unknown");
const pair = (action) => (action ? action.map((u) => round(u, 2)).join(", ") : "unknown");

function ageInWords(age) {
  if (!Number.isFinite(age)) return "unknown";
  if (age < 120) return `${age.toFixed(age < 10 ? 1 : 0)} s`;
  return `${Math.round(age / 60)} min`;
}

/** Tells a screen reader, not more often than every few seconds; the latest word wins. */
function announcer(place) {
  let next = 0;
  let timer = null;
  let waiting = "";
  return (text) => {
    waiting = text;
    if (timer !== null) return;
    timer = setTimeout(() => {
      timer = null;
      next = seconds() + SAY_EVERY;
      place.textContent = waiting;
    }, Math.max(0, next - seconds()) * 1000);
  };
}

const say = announcer(element("said"));
const warn = announcer(element("warned"));

element("theme").value = stored(localStorage, THEME) ?? "";
element("theme").addEventListener("change", ({ target }) => {
  store(localStorage, THEME, target.value);
  applyTheme(target.value);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => applyTheme(element("theme").value));
new ResizeObserver(() => show()).observe(element("scene"));
applyTheme(element("theme").value);
setInterval(showAges, 250);
stream.key = stored(sessionStorage, READ_KEY);
stream.look(chosen);
