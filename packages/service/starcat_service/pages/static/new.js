// New database: sliders, the spec and what it would give, kept in step by the server.

import { goTo } from "./address.js";
import { droppable } from "./drop.js";
import { announce, copy } from "./starcat.js";
import { startMap } from "./sky.js";
import { follow, startSliders } from "./sliders.js";

const form = document.getElementById("design");
const result = document.getElementById("result");
const wrong = document.getElementById("wrong");
const body = document.getElementById("body");
const text = document.getElementById("toml");
const before = document.getElementById("toml-before");
const summary = document.getElementById("summary");
const pinned = document.getElementById("pinned");
const share = document.getElementById("share");
const build = document.getElementById("build");
const response = document.getElementById("response_file");
const FIELDS_AFTER_MS = 120;
const TEXT_AFTER_MS = 450;
const BUSY_AFTER_MS = 2500;

let waiting = 0;
let asked = null;
let tiling = { count: 0, fields: null };
const ranges = startSliders(form);

// What the server says

function showErrors(errors) {
  for (const errorLine of form.querySelectorAll("[id$='-error']")) {
    const key = errorLine.id.slice(0, -"-error".length);
    const message = errors[key] ?? "";
    if (errorLine.textContent !== message) errorLine.textContent = message;
    const control = document.getElementById(key);
    (control?.closest(".field") ?? control?.closest(".copybox"))?.classList.toggle("wrong", message !== "");
    const details = errorLine.closest("details");
    if (message && details) details.open = true;
    if (message) control?.setAttribute("aria-invalid", "true");
    else control?.removeAttribute("aria-invalid");
  }
}

// Gives a list other choices, each a value and its text, where they have changed.
function offer(id, choices) {
  const list = document.getElementById(id);
  if ([...list.options].map((option) => option.value).join("\n") === choices.map(([value]) => value).join("\n")) return;
  list.replaceChildren(...choices.map(([value, words]) => new Option(words, value)));
}

function showValues(state) {
  const bands = state.bands.map((name) => [name, name]);
  offer("catalog.band", state.values["catalog.band"] === "" ? [["", "the catalog's first"], ...bands] : bands);
  offer("camera.response.name", state.responses);
  for (const [key, value] of Object.entries(state.values)) {
    const control = document.getElementById(key);
    if (control && control !== document.activeElement && control.value !== value) control.value = value;
  }
  document.getElementById(`lens-${state.lens}`).checked = true;
  for (const [name, isEnabled] of Object.entries(state.products)) {
    document.getElementById(`products.${name}.enabled`).checked = isEnabled;
  }
  ranges.forEach(follow);
}

function showMap({ stars, region_tiling: ofRegion }) {
  const figure = result.querySelector(".sky");
  if (!figure || stars.length === 0) return;
  startMap(figure, async () => {
    if (ofRegion) return { ...ofRegion, stars };
    if (tiling.count !== stars.length) {
      const answer = await fetch(`${form.dataset.tiling}?count=${stars.length}`);
      if (!answer.ok) throw new Error(String(answer.status));
      tiling = { count: stars.length, fields: await answer.json() };
    }
    return { ...tiling.fields, stars };
  });
}

function show(state) {
  if (document.activeElement !== text && text.value !== state.toml) text.value = state.toml;
  before.value = state.toml;
  showValues(state);
  showErrors(state.errors);
  wrong.innerHTML = state.wrong;
  const first = body.querySelector(".waiting .soft");
  if (first && !state.is_busy) first.textContent = state.summary || "No estimate.";
  body.classList.toggle("stale", !state.is_known && !first);
  body.inert = !state.is_known;
  if (state.is_known) {  // else the last estimate stays, pale
    const hadFocus = body.querySelector(".sky svg") === document.activeElement;
    body.innerHTML = state.result;
    showMap(state);
    if (hadFocus) body.querySelector(".sky svg")?.focus();
  }
  if (summary.textContent !== state.summary) summary.textContent = state.summary;
  if (build) build.disabled = !state.can_build;
  pinned.value = state.pinned_query;
  showAddress(state.address);
}

function showAddress(address) {
  share.hidden = address === "";  // too long: its table of a response is in the text only
  if (share.hidden) return;
  share.href = address;
  goTo(new URL(share.href).search);
}

// What the form has, without its files.
function textsOf(fields) {
  return new URLSearchParams([...fields].filter(([, value]) => typeof value === "string"));
}

// The address of the design as it is now: its estimate may take long.
async function freshAddress(signal) {
  const answer = await fetch(form.dataset.address, { method: "POST", body: textsOf(new FormData(form)), signal });
  if (!answer.ok) throw new Error(String(answer.status));
  const { address } = await answer.json();
  showAddress(address);
  return address;
}

// Waits until a job has ended that the server needs first.
async function ended(job, signal) {
  for (;;) {
    await new Promise((done) => { setTimeout(done, BUSY_AFTER_MS); });
    if (signal.aborted) return;
    const answer = await fetch(`/api/v1/jobs/${job}`, { signal });
    if (answer.ok && ["done", "failed", "cancelled"].includes((await answer.json()).state)) return;
  }
}

// `action` is what a button does besides: suggest, pin, unpin or photos.
async function ask(action = "preview") {
  asked?.abort();
  clearTimeout(waiting);
  asked = new AbortController();
  result.setAttribute("aria-busy", "true");
  const fields = new FormData(form);
  fields.set("do", action);
  const hasFile = response.files.length > 0;
  if (action !== "photos") fields.delete("photos");
  const sent = hasFile || action === "photos" ? fields : textsOf(fields);
  const { signal } = asked;
  if (action === "preview") freshAddress(signal).catch(() => {});  // the estimate tells it, too
  try {
    const answer = await fetch(form.dataset.preview, {
      method: "POST", body: sent, signal,
    });
    if (!answer.ok) {
      const problem = await answer.json().catch(() => null);
      throw new Error(problem?.detail ?? `the service answers ${answer.status}`);
    }
    const state = await answer.json();
    if (hasFile) response.value = "";  // its numbers are in the text now
    show(state);
    if (state.job) {
      await ended(state.job, signal);
      if (!signal.aborted) ask(action);
      return;
    }
    if (state.is_busy) {
      waiting = setTimeout(ask, BUSY_AFTER_MS, action);
      return;
    }
  } catch (error) {
    if (error.name === "AbortError") return;
    summary.textContent = `No estimate: ${error.message}`;
  }
  result.setAttribute("aria-busy", "false");
  form.dataset.state = "settled";
}

form.addEventListener("input", (event) => {
  form.dataset.state = "changed";
  clearTimeout(waiting);
  waiting = setTimeout(ask, event.target === text ? TEXT_AFTER_MS : FIELDS_AFTER_MS);
});
droppable(document.getElementById("drop"), response, () => form.dispatchEvent(new Event("input")));
text.addEventListener("blur", () => { if (text.value !== before.value && text.value.trim() === before.value.trim()) text.value = before.value; });
// What a browser kept of a page that was left is newer than what the server sent.
document.getElementById("update").hidden = true;
form.addEventListener("submit", (event) => {
  const action = event.submitter?.value;
  if (["preview", "suggest", "pin", "unpin", "photos"].includes(action)) {
    event.preventDefault();
    form.dataset.state = "changed";
    ask(action);
    return;
  }
  announce("Sent");
  clearTimeout(waiting);
});
share.addEventListener("click", async (event) => {
  event.preventDefault();
  const before = share.textContent;
  await freshAddress().catch(() => {});
  share.textContent = await copy(share.href, share) === "Copied" ? "Copied" : share.href;
  announce(share.textContent);
  setTimeout(() => { share.textContent = before; }, 1600);
});
const who = document.querySelector("a.who[href^='/sign-in?']");
who?.addEventListener("click", async (event) => {
  event.preventDefault();
  const address = await freshAddress().catch(() => "");
  location.href = address ? `/sign-in?next=${encodeURIComponent(address)}` : who.href;
});
ask();
