// What a page shows, kept in its address: a link repeats it, so does a reload, and signing in.
//
//   <form data-keeps>      its named fields are kept as they are changed; the page's GET fills them
//   <input data-unkept>    but this one is not; files, passwords and hidden fields never are
//   <input data-usual="2"> is left out of the address while it has this value
//   kept("sort")           what the address says of one thing, "" where it says nothing
//   keep({ sort: "mag" })  changes things in the address; "" takes one out
//   goTo("?a=1")           the whole query of the address, as the server has written it

const NEVER = new Set(["file", "password", "hidden", "submit", "button"]);

export function kept(name) {
  return new URLSearchParams(location.search).get(name) ?? "";
}

export function keep(values) {
  const query = new URLSearchParams(location.search);
  for (const [name, value] of Object.entries(values)) {
    query.delete(name);
    for (const text of [value].flat()) if (text !== "") query.append(name, text);
  }
  goTo(`${query}` && `?${query}`);
}

// An entry of the history for each change would make the button "back" useless.
export function goTo(query) {
  if (query !== location.search) {
    history.replaceState(history.state, "", `${location.pathname}${query}${location.hash}`);
  }
  for (const link of document.querySelectorAll('a[href^="/sign-in"]')) {
    link.href = `/sign-in?next=${encodeURIComponent(location.pathname + location.search)}`;
  }
}

export function keepForm(form) {
  const values = {};
  for (const field of form.elements) {
    if (!field.name || NEVER.has(field.type) || "unkept" in field.dataset) continue;
    values[field.name] ??= [];
    const isOff = (field.type === "checkbox" || field.type === "radio") && !field.checked;
    if (!isOff && field.value !== (field.dataset.usual ?? "")) values[field.name].push(field.value);
  }
  keep(values);
}

export function startKeeping() {
  for (const form of document.querySelectorAll("form[data-keeps]")) {
    form.addEventListener("input", () => keepForm(form));
    form.addEventListener("change", () => keepForm(form));
  }
}
