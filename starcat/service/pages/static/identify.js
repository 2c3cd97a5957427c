// Identify: a file can be dropped, and it is said that the answer is being looked for.

import { announce } from "./starcat.js";

const form = document.getElementById("identify");
const answer = document.getElementById("answer");

if (form) {
  const drop = document.getElementById("drop");
  const file = document.getElementById("file");
  const centroids = document.getElementById("centroids");
  document.getElementById("drop-words").hidden = false;

  const over = (event) => {
    if (![...event.dataTransfer.types].includes("Files")) return;
    event.preventDefault();
    drop.classList.add("over");
  };
  drop.addEventListener("dragenter", over);
  drop.addEventListener("dragover", over);
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    if (!event.dataTransfer.files.length) return;
    const one = new DataTransfer();
    one.items.add(event.dataTransfer.files[0]);
    file.files = one.files;
    announce(`${file.files[0].name} is chosen`);
  });

  // A file goes before what was pasted: whoever pastes means that.
  centroids.addEventListener("input", () => { if (centroids.value) file.value = ""; });
  file.addEventListener("change", () => { if (file.files.length) centroids.value = ""; });

  form.addEventListener("submit", () => {
    answer.setAttribute("aria-busy", "true");
    announce("Identifying");
  });
  // Coming back by the browser's button, nothing is under way.
  addEventListener("pageshow", () => answer.removeAttribute("aria-busy"));
  if (answer.querySelector(".card, .notice") && !matchMedia("(min-width: 62rem)").matches) {
    answer.scrollIntoView();
  }
}
