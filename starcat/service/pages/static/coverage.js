// The map of the sky tells the field under the pointer, or under a cross that arrow keys move.

const map = document.getElementById("sky-map");
const svg = map.querySelector("svg");
const mark = document.getElementById("sky-mark");
const readout = document.getElementById("sky-readout");
const HALF_WIDTH = 200 * Math.SQRT2;
const HALF_HEIGHT = 100 * Math.SQRT2;
const DEG = Math.PI / 180;
const IDLE = "Point at the map, or choose it and use the arrow keys, to see the field there.";

let fields = null;
let cross = { ra: 0, dec: 0 };

// Directions of the boresights; loaded when they are first needed.
async function load() {
  if (fields) return fields;
  const answer = await fetch(map.dataset.fields);
  if (!answer.ok) throw new Error(String(answer.status));
  const { ra_deg: ra, dec_deg: dec, stars } = await answer.json();
  fields = { ra, dec, stars, u: ra.map((value, k) => direction(value, dec[k])) };
  return fields;
}

function direction(ra, dec) {
  const across = Math.cos(dec * DEG);
  return [across * Math.cos(ra * DEG), across * Math.sin(ra * DEG), Math.sin(dec * DEG)];
}

// Mollweide's projection back to the sky; null outside of the map.
function skyAt(x, y) {
  const theta = Math.asin(Math.max(-1, Math.min(1, -y / HALF_HEIGHT)));
  const dec = Math.asin((2 * theta + Math.sin(2 * theta)) / Math.PI) / DEG;
  const east = (180 * x) / (HALF_WIDTH * Math.max(Math.cos(theta), 1e-9));
  if (Math.abs(east) > 180 || Math.abs(y) > HALF_HEIGHT) return null;
  return { ra: (360 - east) % 360, dec };
}

function placeOf(ra, dec) {
  const target = Math.PI * Math.sin(dec * DEG);
  let low = -Math.PI / 2, high = Math.PI / 2;
  for (let step = 0; step < 40; step += 1) {
    const middle = (low + high) / 2;
    if (2 * middle + Math.sin(2 * middle) < target) low = middle;
    else high = middle;
  }
  const east = -(((ra + 180) % 360 + 360) % 360 - 180);
  return [(HALF_WIDTH / 180) * east * Math.cos(low), -HALF_HEIGHT * Math.sin(low)];
}

function nearest(sky) {
  const [a, b, c] = direction(sky.ra, sky.dec);
  let best = 0, most = -2;
  fields.u.forEach(([x, y, z], k) => {
    const along = a * x + b * y + c * z;
    if (along > most) [most, best] = [along, k];
  });
  return best;
}

function show(x, y) {
  mark.setAttribute("transform", `translate(${x} ${y})`);
  mark.setAttribute("visibility", "visible");
}

async function tell(sky) {
  try {
    await load();
  } catch {
    readout.textContent = "The fields cannot be loaded; the table has them.";
    return;
  }
  const number = nearest(sky);
  const ra = fields.ra[number], dec = fields.dec[number], stars = fields.stars[number];
  show(...placeOf(ra, dec));
  const sign = dec < 0 ? "−" : "+";
  readout.textContent =
    `Field ${number}: ${stars} guide star${stars === 1 ? "" : "s"}, ` +
    `centre RA ${ra.toFixed(3)}°, Dec ${sign}${Math.abs(dec).toFixed(3)}°`;
}

function hide() {
  mark.setAttribute("visibility", "hidden");
  readout.textContent = IDLE;
}

svg.addEventListener("pointermove", (event) => {
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  const sky = skyAt(at.x, at.y);
  if (sky) tell(sky);
  else hide();
});
svg.addEventListener("pointerleave", hide);

const STEPS = { ArrowLeft: [5, 0], ArrowRight: [-5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] };
svg.setAttribute("tabindex", "0");
svg.setAttribute("role", "application");
svg.addEventListener("focus", () => { if (svg.matches(":focus-visible")) tell(cross); });
svg.addEventListener("blur", hide);
svg.addEventListener("keydown", (event) => {
  const step = STEPS[event.key];
  if (!step) return;
  event.preventDefault();
  const ra = (cross.ra + step[0] / Math.max(Math.cos(cross.dec * DEG), 0.2) + 360) % 360;
  cross = { ra, dec: Math.max(-90, Math.min(90, cross.dec + step[1])) };
  tell(cross);
});

// A row of the table shows where its field is.
for (const row of document.querySelectorAll("#field-table tbody tr")) {
  const point = () => show(row.dataset.x, row.dataset.y);
  row.addEventListener("pointerenter", point);
  row.addEventListener("focusin", point);
  row.addEventListener("pointerleave", hide);
  row.addEventListener("focusout", hide);
}

const order = document.getElementById("order");
order.form.querySelector("button").hidden = true;
order.addEventListener("change", () => order.form.requestSubmit());
hide();
