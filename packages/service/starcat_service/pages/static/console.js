// The SQL console: the answer comes without the page being loaded again; Ctrl and Enter run.

import { startSky } from "./skyview.js";
import { announce } from "./starcat.js";
import { startTables } from "./tables.js";

const form = document.getElementById("console");
const query = document.getElementById("query");
const answer = document.getElementById("answer");
const recent = document.getElementById("recent");
const MOST_RECENT = 20;
let asking = null;

// The queries that were answered are kept in this browser, the newest first.
function remember(text) {
  try {
    const before = JSON.parse(localStorage.getItem("queries") ?? "[]");
    const all = [...new Set([text, ...before])].filter(Boolean).slice(0, MOST_RECENT);
    if (text) localStorage.setItem("queries", JSON.stringify(all));
    recent.hidden = all.length === 0;
    recent.querySelector("ul").replaceChildren(...all.map((recentQuery) => {
      const [item, link] = ["li", "a"].map((name) => document.createElement(name));
      Object.assign(link, { href: `?${new URLSearchParams({ query: recentQuery })}`, textContent: recentQuery });
      item.append(link);
      return item;
    }));
  } catch {
    // A browser that keeps nothing shows none.
  }
}

document.getElementById("keys").hidden = false;
query.addEventListener("keydown", (event) => {
  if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) {
    event.preventDefault();
    form.requestSubmit(form.querySelector("button.primary"));
  }
});

// A name that the query has got since has no field yet: the page is loaded again to give it one.
function lacksFields() {
  const names = query.value.matchAll(/\$([A-Za-z_]\w{0,63})/g);
  return [...names].some(([, name]) => !form.elements.namedItem(`value.${name}`));
}

form.addEventListener("submit", async (event) => {
  if (event.submitter?.formAction !== form.action || lacksFields()) return;
  event.preventDefault();
  asking?.abort();
  const mine = new AbortController();
  asking = mine;
  const parameters = new URLSearchParams(new FormData(form));
  answer.setAttribute("aria-busy", "true");
  try {
    const response = await fetch(`${form.action}?${parameters}&part=answer`, { signal: mine.signal });
    const text = await response.text();
    if (response.headers.get("Content-Type")?.startsWith("text/html")) answer.innerHTML = text;
    else answer.textContent = JSON.parse(text).detail;
    history.replaceState(null, "", `?${parameters}`);
    if (response.ok) remember(query.value.trim());
    startTables(answer);
    for (const root of answer.querySelectorAll(".skyview[data-sky]")) startSky(root);
    announce(document.getElementById("answer-count")?.textContent ?? "The query failed");
  } catch (error) {
    if (error.name === "AbortError") return;
    answer.textContent = "The service does not answer; is it running?";
  } finally {
    if (asking === mine) answer.removeAttribute("aria-busy");
  }
});

remember(document.getElementById("answer-count") ? query.value.trim() : "");
