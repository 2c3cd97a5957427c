// What every page has: the theme, buttons that copy, forms that are kept, tables as cards.

import { startKeeping } from "./address.js";

const THEMES = { system: "as the system", light: "light", dark: "dark" };

function theme() {
  return document.documentElement.dataset.theme ?? "system";
}

function setTheme(name) {
  if (name === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = name;
  try {
    if (name === "system") localStorage.removeItem("theme");
    else localStorage.setItem("theme", name);
  } catch {
    // It lasts as long as the page.
  }
}

function startTheme() {
  const button = document.getElementById("theme");
  const label = document.getElementById("theme-name");
  const tell = () => {
    label.textContent = THEMES[theme()];
    button.title = `Theme: ${THEMES[theme()]}`;
  };
  button.hidden = false;
  tell();
  button.addEventListener("click", () => {
    const names = Object.keys(THEMES);
    setTheme(names[(names.indexOf(theme()) + 1) % names.length]);
    tell();
  });
}

// Text goes to the clipboard; a page that is not served safely has none, there it is selected.
export async function copy(text, element) {
  try {
    await navigator.clipboard.writeText(text);
    return "Copied";
  } catch {
    if (element.select) element.select();
    else getSelection().selectAllChildren(element);
    return "Selected";
  }
}

function startCopying() {
  for (const button of document.querySelectorAll("button[data-copies]")) {
    button.hidden = false;
    const before = button.innerHTML;
    button.addEventListener("click", async () => {
      const source = document.getElementById(button.dataset.copies);
      button.textContent = await copy(source.value ?? source.textContent, source);
      announce(button.textContent);
      setTimeout(() => { button.innerHTML = before; }, 1600);
    });
  }
}

// Said to who listens to the page instead of looking at it.
export function announce(text) {
  let region = document.getElementById("announcement");
  if (!region) {
    region = document.createElement("p");
    region.id = "announcement";
    region.className = "unseen";
    region.setAttribute("role", "status");
    document.body.append(region);
  }
  region.textContent = text;
}

// A table of many columns can be shown as a card for each row: its cells get the heads to show.
function cardTables() {
  for (const table of document.querySelectorAll("table:not(.carded, .grid)")) {
    const heads = [...table.querySelectorAll("thead tr:last-child > *")];
    if (heads.length < (table.matches(".as-cards") ? 2 : 4)) continue;
    table.classList.add("carded");
    for (const row of table.tBodies[0]?.rows ?? []) {
      [...row.cells].forEach((cell, k) => {
        cell.dataset.head = heads[k]?.textContent.trim() ?? "";
        cell.classList.toggle("empty-cell", cell.textContent.trim() === "");
      });
    }
  }
}

startTheme();
startCopying();
startKeeping();
cardTables();
new MutationObserver(cardTables).observe(document.getElementById("content"), { childList: true, subtree: true });

// On a narrow screen, the place where one is may lie beside it.
for (const here of document.querySelectorAll(".tabs [aria-current]")) {
  const list = here.closest("ul");
  if (list.scrollWidth > list.clientWidth) list.scrollLeft = here.offsetLeft - 24;
}
