// Identify: files can be dropped, it is said that the answer is being looked for, and the address
// becomes that of the answer.

import { goTo } from "./address.js";
import { droppable } from "./drop.js";
import { startSliders } from "./sliders.js";
import { announce } from "./starcat.js";

const form = document.getElementById("identify");
const answer = document.getElementById("answer");

if (form) {
  const file = document.getElementById("file");
  const centroids = document.getElementById("centroids");
  startSliders(form);

  droppable(document.getElementById("drop"), file, () => { centroids.value = ""; });

  // A file goes before what was pasted: whoever pastes means that.
  centroids.addEventListener("input", () => { if (centroids.value) file.value = ""; });
  file.addEventListener("change", () => { if (file.files.length) centroids.value = ""; });

  // A picture of another size is one of another camera.
  const compareSize = async () => {
    if (!file.files.length) return;
    const size = await createImageBitmap(file.files[0]).catch(() => null); // FITS is not one
    const fields = [form.elements["camera.width_px"], form.elements["camera.height_px"]];
    if (!size || fields.some((field) => field.value)) return;
    const dimensions = [size.width, size.height];
    if (dimensions.every((pixels, k) => pixels === Number(fields[k].placeholder))) return;
    fields.forEach((field, k) => { field.value = dimensions[k]; });
    document.getElementById("other-camera").open = true;
    announce(`The picture has ${dimensions.join(" x ")} px: say which field its camera has`);
  };
  file.addEventListener("change", compareSize);
  compareSize(); // it may have been chosen before this script came

  form.addEventListener("submit", () => {
    answer.setAttribute("aria-busy", "true");
    announce("Identifying");
  });
  if (answer.dataset.link && !location.search) goTo(answer.dataset.link.replace("/identify", ""));

  // Browsers save no address of more than 2 MB as a file: it is made one first.
  answer.addEventListener("click", (event) => {
    const link = event.target.closest('a[download][href^="data:"]');
    if (!link || link.href.length < 1_000_000) return;
    const [kind, content] = link.href.slice(5).split(";base64,");
    const bytes = Uint8Array.from(atob(content), (character) => character.codePointAt(0));
    link.href = URL.createObjectURL(new Blob([bytes], { type: kind }));
  });

  // Coming back by the browser's button, nothing is under way.
  addEventListener("pageshow", () => answer.removeAttribute("aria-busy"));
  if (answer.querySelector(".card, .notice") && !matchMedia("(min-width: 62rem)").matches) {
    answer.scrollIntoView();
  }
}
