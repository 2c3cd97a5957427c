// A job as it goes on, by server-sent events.

const BYTES = new Set(["fetch", "publish", "pull", "read"]);
const UNITS = ["kB", "MB", "GB", "TB"];
const STAGE_MS = 200;

let stageAt = 0;

function count(value) {
  return Math.round(value).toString().replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

function size(value) {
  let unit = "B";
  for (const larger of UNITS) {
    if (value < 999.5) break;
    [value, unit] = [value / 1000, larger];
  }
  return `${value.toFixed(unit !== "B" && value < 99.95 ? 1 : 0)}\u00a0${unit}`;
}

function showStage({ stage, done, total }) {
  const word = stage.split(" ")[0];
  const steps = [...document.querySelectorAll("#steps li")];
  const reached = steps.findIndex((step) => step.dataset.words.split(" ").includes(word));
  steps.forEach((step, k) => {
    if (reached < 0) return;
    const state = k < reached ? "done" : k === reached ? "current" : "open";
    step.className = state;
    if (state === "current") step.setAttribute("aria-current", "step");
    else step.removeAttribute("aria-current");
    step.querySelector(".step-state").textContent = { done: ", done", current: ", now", open: "" }[state];
  });
  const bar = document.getElementById("bar");
  bar.hidden = false;
  if (total) [bar.max, bar.value] = [total, done];
  else bar.removeAttribute("value");
  const now = performance.now();
  const stageLine = document.getElementById("stage");
  const shown = BYTES.has(word) ? size : count;
  // A listener hears each stage, not each step of the bar.
  stageLine.setAttribute("aria-live", stageLine.dataset.stage === stage ? "off" : "polite");
  if (stageLine.dataset.stage !== stage || now - stageAt > STAGE_MS) {
    stageLine.textContent = total ? `${stage}: ${shown(done)} of ${shown(total)}` : stage;
    [stageLine.dataset.stage, stageAt] = [stage, now];
  }
}

function showLine({ at_s: at, level, text }) {
  document.getElementById("no-log")?.remove();
  const log = document.getElementById("log");
  const isAtEnd = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
  const line = document.createElement("p");
  line.className = level;
  const moment = document.createElement("time");
  moment.dateTime = new Date(at * 1000).toISOString();
  moment.textContent = moment.dateTime.slice(11, 19);
  line.append(moment, ` ${text}`);
  log.append(line);
  if (isAtEnd) log.scrollTop = log.scrollHeight;
}

// The state decides what the page offers: the server draws it again.
async function redraw() {
  const answer = await fetch(location.href);
  if (!answer.ok) return;
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  const job = document.getElementById("job");
  const news = page.getElementById("job");
  document.title = page.title;
  const stageLine = document.getElementById("stage");
  job.dataset.state = news.dataset.state;
  job.querySelector(".page-head").replaceWith(news.querySelector(".page-head"));
  job.querySelectorAll(":scope > .notice").forEach((notice) => notice.remove());
  job.querySelector(".page-head").after(...news.querySelectorAll(":scope > .notice"));
  for (const part of ["#found", "#steps", ".facts"]) job.querySelector(part).replaceWith(news.querySelector(part));
  const [bar, next] = [document.getElementById("bar"), news.querySelector("#bar")];
  if (bar && next) bar.replaceWith(next);
  else bar?.remove();
  stageLine.setAttribute("aria-live", "polite");
  stageLine.textContent = news.querySelector("#stage").textContent;
  delete stageLine.dataset.stage;
}

function watch() {
  const { events, after, state } = document.getElementById("job").dataset;
  if (["done", "failed", "cancelled"].includes(state)) return;
  const source = new EventSource(`${events}?after=${after}`);
  const of = (listener) => (event) => listener(JSON.parse(event.data));
  source.addEventListener("stage", of(showStage));
  source.addEventListener("log", of(showLine));
  source.addEventListener("state", of(async (news) => {
    if (["done", "failed", "cancelled"].includes(news.state)) source.close();
    await redraw();
  }));
}

const log = document.getElementById("log");
log.scrollTop = log.scrollHeight;
watch();
