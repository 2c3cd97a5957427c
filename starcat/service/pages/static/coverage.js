// Coverage of a database: the map tells its fields, a row of the table shows where its field is.

import { startMap } from "./sky.js";

const figure = document.querySelector("figure.sky");
const cross = figure.querySelector(".cross");

startMap(figure, async () => {
  const answer = await fetch(figure.dataset.sky);
  if (!answer.ok) throw new Error(String(answer.status));
  return answer.json();
});

for (const row of document.querySelectorAll("#field-table tbody tr")) {
  const show = () => {
    cross.setAttribute("transform", `translate(${row.dataset.at})`);
    cross.setAttribute("visibility", "visible");
  };
  const hide = () => cross.setAttribute("visibility", "hidden");
  row.addEventListener("pointerenter", show);
  row.addEventListener("pointerleave", hide);
  row.addEventListener("focusin", show);
  row.addEventListener("focusout", hide);
}

const order = document.getElementById("order");
order.form.querySelector("button").hidden = true;
order.addEventListener("change", () => order.form.requestSubmit());
