// Draws the run's state, once a half second: a row for each machine, a bar for each print.
"use strict";

const SPACE = "http://www.w3.org/2000/svg";
const LEFT = 150, TOP = 24, ROW = 26, RIGHT = 12;
const byId = (id) => document.getElementById(id);

function element(name, attributes, text) {
  const made = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

const hours = (seconds) => `${(seconds / 3600).toFixed(1)} h`;
const colour = (order) => `hsl(${(order * 137.5) % 360} 60% 58%)`;

function bar(parent, from, to, y, x, attributes, title) {
  const made = element("rect", { x: x(from), y, width: Math.max(1, x(to) - x(from)), height: ROW - 8, ...attributes });
  made.append(element("title", {}, title));
  parent.append(made);
}

function drawMachine(parent, machine, y, x, end) {
  const label = machine.alarm ? `${machine.name} · ${machine.alarm}` : `${machine.name} · ${machine.status}`;
  parent.append(element("text", { x: 0, y: y + 13, class: machine.alarm ? "alarm" : "" }, label.slice(0, 24)));
  for (const one of machine.bars) {
    const good = one.result === "Finished";
    const title = `${one.name}, order ${one.order}: ${one.result}, ${hours(one.from)} to ${hours(one.to)}`;
    if (one.setup > 0) bar(parent, one.from, one.from + one.setup, y, x, { class: "setup" }, `setup for ${one.name}`);
    const kind = `print ${good ? "good" : "bad"}${one.priority ? " urgent" : ""}`;
    bar(parent, one.from + one.setup, one.to, y, x, good ? { class: kind, fill: colour(one.order) } : { class: kind }, title);
  }
  if (machine.running) {
    const kind = `running${machine.running.priority ? " urgent" : ""}`;
    bar(parent, machine.began, Math.min(machine.free_at, end), y, x, { class: kind, fill: colour(machine.running.order) },
      `order ${machine.running.order}, job ${machine.running.number}: in progress, expected to end at ${hours(machine.free_at)}`);
  }
}

function draw(state) {
  const chart = byId("chart");
  const width = chart.clientWidth || 1000, height = TOP + state.machines.length * ROW + 8;
  const ends = state.machines.map((machine) => Math.max(machine.free_at, ...machine.bars.map((one) => one.to), 0));
  const end = Math.max(3600, state.time, ...ends) * 1.02;
  const x = (seconds) => LEFT + (seconds / end) * (width - LEFT - RIGHT);
  const next = element("g", {});
  const every = [1, 2, 4, 8, 12, 24, 48].find((step) => end / 3600 / step <= 14) || 96;
  for (let hour = 0; hour * 3600 < end; hour += every) {
    next.append(element("line", { x1: x(hour * 3600), x2: x(hour * 3600), y1: TOP - 6, y2: height, class: "grid" }));
    next.append(element("text", { x: x(hour * 3600) + 3, y: 12 }, `${hour} h`));
  }
  state.machines.forEach((machine, row) => drawMachine(next, machine, TOP + row * ROW, x, end));
  next.append(element("line", { x1: x(state.time), x2: x(state.time), y1: TOP - 6, y2: height, class: "now" }));
  chart.setAttribute("viewBox", `0 0 ${width} ${height}`);
  chart.setAttribute("height", height);
  chart.replaceChildren(next);
  byId("scenario").textContent = `· ${state.scenario} · ${state.machines.length} machines · ${state.orders.length} orders`;
  byId("time").textContent = hours(state.time);
  byId("done").textContent = `${state.done} of ${state.jobs}`;
  byId("progress").max = state.jobs;
  byId("progress").value = state.done;
}

async function follow() {
  try {
    const answer = await fetch("/state", { cache: "no-store" });
    if (!answer.ok) throw new Error(`status ${answer.status}`);
    const state = await answer.json();
    draw(state);
    byId("link").textContent = state.done === state.jobs ? "all jobs done" : "live";
  } catch (error) {
    byId("link").textContent = `the run does not answer (${error.message})`;
  }
  setTimeout(follow, 500);
}

follow();
