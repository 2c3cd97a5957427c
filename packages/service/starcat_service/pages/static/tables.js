// Tables whose rows sort and filter: <table id="..." data-sorts>. Both are kept in the address, as
// sort.ID=COLUMN (-COLUMN: the largest first) and filter.ID=TEXT. data-sorts="list": even few rows
// have a filter.

import { keep, kept } from "./address.js";
import { announce } from "./starcat.js";

const FEW = 6; // rows that need no filter
const UNITS = { kB: 1e3, MB: 1e6, GB: 1e9, TB: 1e12 };

function valueOf(row, column) {
  const text = row.cells[column]?.textContent.trim() ?? "";
  const plain = text.replaceAll("\u2212", "-").replace(/[\s,\u202f\u00a0](?=\d{3}(\D|$))/g, "");
  const match = /^([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)\s*(kB|MB|GB|TB|B|[°%]|px|arcsec)?$/i.exec(plain);
  return match ? Number(match[1]) * (UNITS[match[2]] ?? 1) : text;
}

function compare(a, b) {
  const kinds = [a, b].map((value) => (typeof value === "number" ? 0 : value === "" || value === "–" ? 2 : 1));
  if (kinds[0] !== kinds[1]) return kinds[0] - kinds[1];
  return kinds[0] === 0 ? a - b : a.localeCompare(b, undefined, { numeric: true });
}

function startTable(table) {
  const [sortName, filterName] = [`sort.${table.id}`, `filter.${table.id}`];
  const body = table.tBodies[0];
  const rows = [...body.rows];
  const heads = [...table.tHead.rows[0].cells];
  const column = (head) => head.dataset.column;
  heads.forEach((head, k) => {
    head.dataset.column = head.firstChild?.textContent.trim() || String(k + 1);
    const button = document.createElement("button");
    Object.assign(button, { type: "button", className: "plain sorter" });
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const isUp = head.getAttribute("aria-sort") === "ascending";
      keep({ [sortName]: `${isUp ? "-" : ""}${column(head)}` });
      sort();
      announce(`Sorted by ${column(head)}, ${isUp ? "the largest" : "the smallest"} first`);
    });
  });

  function sort() {
    const order = kept(sortName);
    const name = order.replace(/^-/, "");
    for (const head of heads) head.removeAttribute("aria-sort");
    const number = heads.findIndex((head) => column(head) === name);
    if (number < 0) return;
    const sign = order.startsWith("-") ? -1 : 1;
    heads[number].setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    const values = new Map(rows.map((row) => [row, valueOf(row, number)]));
    body.append(...[...rows].sort((a, b) => sign * compare(values.get(a), values.get(b))));
  }

  const input = document.createElement("input");
  Object.assign(input, { type: "search", placeholder: "Rows with …", value: kept(filterName) });
  const count = document.createElement("span");
  count.className = "soft small-text";
  function filter() {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
    }
    const seen = rows.filter((row) => !row.hidden).length;
    count.textContent = words.length ? `${seen} of ${rows.length} rows` : "";
  }
  input.setAttribute("aria-label", `Filter: ${table.caption?.textContent ?? table.parentElement.ariaLabel ?? "rows"}`);
  input.addEventListener("input", () => {
    keep({ [filterName]: input.value });
    filter();
  });
  if (rows.length > FEW || input.value || table.dataset.sorts === "list") {
    const tools = document.createElement("div");
    tools.className = "row table-tools";
    tools.append(input, count);
    table.closest(".scroll").before(tools);
  }
  sort();
  filter();
}

export function startTables(root = document) {
  for (const table of root.querySelectorAll("table[data-sorts]")) {
    if (table.tBodies[0]?.rows.length > 1) startTable(table);
  }
}

startTables();
