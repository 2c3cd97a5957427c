// A place where files can be dropped, for a field of files.

import { announce } from "./starcat.js";

export function droppable(place, field, then) {
  const over = (event) => {
    if (![...event.dataTransfer.types].includes("Files")) return;
    event.preventDefault();
    place.classList.add("over");
  };
  document.getElementById("drop-words").hidden = false;
  place.addEventListener("dragenter", over);
  place.addEventListener("dragover", over);
  place.addEventListener("dragleave", () => place.classList.remove("over"));
  place.addEventListener("drop", (event) => {
    event.preventDefault();
    place.classList.remove("over");
    if (!event.dataTransfer.files.length) return;
    field.files = event.dataTransfer.files;
    then();
    announce([...field.files].map((one) => one.name).join(", "));
  });
}
