// A map of the sky tells the field under the pointer, or under a cross that arrow keys move.

import { direction } from "./sphere.js";

const HALF_WIDTH = 200 * Math.SQRT2;
const HALF_HEIGHT = 100 * Math.SQRT2;
const DEG = Math.PI / 180;
const IDLE = "Point at the map, or choose it and use the arrow keys, to see a field.";
const STEPS = { ArrowLeft: [5, 0], ArrowRight: [-5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] };

// Mollweide's projection back to the sky; null outside of the map.
function skyAt(x, y) {
  if (Math.abs(y) > HALF_HEIGHT) return null;
  const theta = Math.asin(-y / HALF_HEIGHT);
  const dec = Math.asin(Math.max(-1, Math.min(1, (2 * theta + Math.sin(2 * theta)) / Math.PI))) / DEG;
  const east = (180 * x) / (HALF_WIDTH * Math.max(Math.cos(theta), 1e-9));
  return Math.abs(east) > 180 ? null : { ra: (360 - east) % 360, dec };
}

function mapPosition(ra, dec) {
  const target = Math.PI * Math.sin(dec * DEG);
  let low = -Math.PI / 2;
  let high = Math.PI / 2;
  for (let step = 0; step < 40; step += 1) {
    const middle = (low + high) / 2;
    if (2 * middle + Math.sin(2 * middle) < target) low = middle;
    else high = middle;
  }
  const east = -(((ra + 180) % 360 + 360) % 360 - 180);
  return [(HALF_WIDTH / 180) * east * Math.cos(low), -HALF_HEIGHT * Math.sin(low)];
}

// `fieldsOf` gives {ra_deg, dec_deg, stars}, or a promise of it, when the map is first asked.
export function startMap(figure, fieldsOf) {
  const svg = figure.querySelector("svg");
  const cross = figure.querySelector(".cross");
  const readout = figure.querySelector(".readout");
  let fields = null;
  let at = { ra: 0, dec: 0 };

  const load = async () => {
    if (fields) return;
    const columns = await fieldsOf();
    fields = { ...columns, u: columns.ra_deg.map((ra, k) => direction(ra, columns.dec_deg[k])) };
  };

  const nearest = (sky) => {
    const [a, b, c] = direction(sky.ra, sky.dec);
    let best = 0;
    let most = -2;
    fields.u.forEach(([x, y, z], k) => {
      const along = a * x + b * y + c * z;
      if (along > most) [most, best] = [along, k];
    });
    return best;
  };

  const tell = async (sky) => {
    try {
      await load();
    } catch {
      readout.textContent = "The fields cannot be loaded.";
      return;
    }
    const number = nearest(sky);
    const ra = fields.ra_deg[number];
    const dec = fields.dec_deg[number];
    const stars = fields.stars[number];
    cross.setAttribute("transform", `translate(${mapPosition(ra, dec).join(" ")})`);
    cross.setAttribute("visibility", "visible");
    const sign = dec < 0 ? "\u2212" : "+";
    readout.textContent =
      `Field ${number}: ${stars} guide star${stars === 1 ? "" : "s"}, centre at RA ` +
      `${ra.toFixed(3)}\u00b0, Dec ${sign}${Math.abs(dec).toFixed(3)}\u00b0`;
  };

  const hide = () => {
    cross.setAttribute("visibility", "hidden");
    readout.textContent = IDLE;
  };

  svg.addEventListener("pointermove", (event) => {
    const point = new DOMPoint(event.clientX, event.clientY);
    const { x, y } = point.matrixTransform(svg.getScreenCTM().inverse());
    const sky = skyAt(x, y);
    if (sky) tell(sky);
    else hide();
  });
  svg.addEventListener("pointerleave", hide);
  svg.setAttribute("tabindex", "0");
  svg.setAttribute("role", "application");
  svg.addEventListener("focus", () => { if (svg.matches(":focus-visible")) tell(at); });
  svg.addEventListener("blur", hide);
  svg.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (!step) return;
    event.preventDefault();
    const ra = (at.ra + step[0] / Math.max(Math.cos(at.dec * DEG), 0.2) + 360) % 360;
    at = { ra, dec: Math.max(-90, Math.min(90, at.dec + step[1])) };
    tell(at);
  });
  hide();
}
