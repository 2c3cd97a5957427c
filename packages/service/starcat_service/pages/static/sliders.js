// Sliders beside fields of numbers: the macro `slide`.

function places(step) {
  return (String(step).split(".")[1] ?? "").length;
}

function valueOf(range) {
  const position = Number(range.value);
  if (range.dataset.noneAt === "low" && position <= Number(range.min)) return "";
  if (range.dataset.noneAt === "high" && position >= Number(range.max)) return "";
  if (range.dataset.scale !== "log") return String(position);
  const { low, high, step } = range.limits;
  const value = low * (high / low) ** (position / 1000);
  const rounded = step < 1 ? value : Number(value.toPrecision(3));
  return String(Number(rounded.toFixed(places(step))));
}

// Puts a slider where its number is.
export function follow(range) {
  const number = document.getElementById(range.dataset.of);
  if (range === document.activeElement && range.matches(":active")) return;
  // An empty field may have a placeholder that counts instead.
  const value = Number(number.value || number.placeholder);
  if (number.value === "" && !(value > 0)) range.value = range.dataset.noneAt === "low" ? range.min : range.max;
  else if (range.dataset.scale !== "log") range.value = String(value);
  else range.value = String((1000 * Math.log(value / range.limits.low)) / Math.log(range.limits.high / range.limits.low));
  const unit = document.querySelector(`label[for="${number.id}"] .unit`)?.textContent ?? "";
  range.setAttribute("aria-valuetext", number.value === "" ? number.placeholder : `${number.value} ${unit}`);
}

// Shows the sliders of a form, and gives them.
export function startSliders(form) {
  const ranges = [...form.querySelectorAll("input[type=range]")];
  for (const range of ranges) {
    const number = document.getElementById(range.dataset.of);
    range.limits = { low: Number(range.min), high: Number(range.max), step: Number(range.step) };
    if (range.dataset.scale === "log") [range.min, range.max, range.step] = ["0", "1000", "1"];
    range.hidden = false;
    range.closest(".slider").classList.add("live");
    range.addEventListener("input", () => {
      number.value = valueOf(range);
      follow(range);
    });
    number.addEventListener("input", () => follow(range));
    follow(range);
  }
  return ranges;
}
