// The list of jobs is loaded again while one of them waits or runs.

import { announce } from "./starcat.js";
import { startTables } from "./tables.js";

const EVERY_MS = 2000;

let shown = "";

function states(root) {
  return new Map([...root.querySelectorAll("[data-job]")].map((row) => [row.dataset.job, row]));
}

async function refresh() {
  const list = document.getElementById("jobs");
  if (list.dataset.live !== "true") return;
  if (!document.hidden && !list.contains(document.activeElement)) {
    try {
      const answer = await fetch(location.href);
      if (answer.ok) show(list, await answer.text());
    } catch {
      // The next time, perhaps.
    }
  }
  setTimeout(refresh, EVERY_MS);
}

function show(list, html) {
  const page = new DOMParser().parseFromString(html, "text/html");
  const news = page.getElementById("jobs");
  if (!news || news.innerHTML === shown) return;
  shown = news.innerHTML;
  const before = states(list);
  for (const [id, row] of states(news)) {
    const earlierRow = before.get(id);
    if (earlierRow && earlierRow.dataset.state !== row.dataset.state) {
      announce(`${row.dataset.title}: ${row.dataset.state}`);
    }
  }
  list.replaceWith(news);
  startTables(news);
  document.querySelector(".tabs").replaceWith(page.querySelector(".tabs"));
}

setTimeout(refresh, EVERY_MS);
