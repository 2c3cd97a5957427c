// Coverage of a database: a row of the table leads to its field in the view of the sky.

const sky = document.querySelector(".skyview").sky;

for (const row of document.querySelectorAll("#field-table tbody tr")) {
  row.querySelector("th a").addEventListener("click", (event) => {
    if (!sky.fields) return; // the address leads there too
    event.preventDefault();
    sky.show(Number(row.dataset.field));
    sky.root.scrollIntoView({ block: "nearest" });
  });
}

const order = document.getElementById("order");
order.form.querySelector("button").hidden = true;
order.addEventListener("change", () => order.form.requestSubmit());
