// An area where files can be dropped, for a field of files.

import { announce } from "./starcat.js";

export function droppable(area, field, then) {
  const over = (event) => {
    if (![...event.dataTransfer.types].includes("Files")) return;
    event.preventDefault();
    area.classList.add("over");
  };
  document.getElementById("drop-words").hidden = false;
  area.addEventListener("dragenter", over);
  area.addEventListener("dragover", over);
  area.addEventListener("dragleave", () => area.classList.remove("over"));
  area.addEventListener("drop", (event) => {
    event.preventDefault();
    area.classList.remove("over");
    if (!event.dataTransfer.files.length) return;
    field.files = event.dataTransfer.files;
    then();
    announce([...field.files].map((file) => file.name).join(", "));
  });
}
