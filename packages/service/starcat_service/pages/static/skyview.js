// The one view of the sky: fields of a tiling, stars, frames and answers; it zooms and pans.
//
// Hammer's projection, turned so that the middle of the view is its middle: near it shapes are
// true, and with the smallest zoom all of the sky is seen. Right ascension grows to the left.

import { Fields, axes, cross, direction, dot, hammer, position, sum, unhammer } from "./sphere.js";

const DEG = Math.PI / 180;
const WHOLE_DEG = 360; // across the width
const LEAST_DEG = 0.05;
const REST_MS = 220; // how long the view has been still before stars are asked for
const REACH_PX = 14; // how near a star the pointer is that means it
const NAMED = 18; // stars whose names are written
const MOST_LABELS = 60; // of marks
const STEPS_DEG = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30];
const POLE = direction(192.85948, 27.12825); // of the Milky Way: ESA SP-1200, equation 1.5.11
const COLOURS = {
  ground: "#0b1017", grid: "rgb(190 215 240 / 30%)", text: "#b9c9d8", plane: "rgb(255 255 255 / 90%)",
  guide: "#ffffff", rejected: "#ffb454", faint: "#9fb2c4", frame: "#ff7f92", mark: "#6fe3f5",
};

function angle(value, digits) {
  return `${value < 0 ? "\u2212" : ""}${Math.abs(value).toFixed(digits)}\u00b0`;
}

const stars = (count) => `${count} guide star${count === 1 ? "" : "s"}`;

class Sky {
  constructor(root) {
    this.root = root;
    this.canvas = root.querySelector("canvas");
    this.pen = this.canvas.getContext("2d");
    this.readout = root.querySelector(".readout");
    this.details = root.querySelector(".chosen");
    this.data = JSON.parse(root.dataset.sky);
    this.fields = null;
    this.stars = [];
    this.marks = (this.data.marks ?? []).map((mark) => ({ ...mark, kind: "mark", u: direction(mark.ra_deg, mark.dec_deg) }));
    this.at = { ra: 0, dec: 0, size: WHOLE_DEG, roll: 0, ...this.data.at };
    this.field = null;
    this.frame = this.data.frame ?? null;
    this.pointers = new Map();
    this.layers = new Set([...root.querySelectorAll("[data-layer]")].filter((checkbox) => checkbox.checked).map((checkbox) => checkbox.dataset.layer));
    this.readAddress();
    this.listen();
    new ResizeObserver(() => this.fit()).observe(this.canvas);
    this.fit();
    this.load();
  }

  async load() {
    if (!this.data.fields) return;
    try {
      this.fields = new Fields(await this.ask(this.data.fields));
    } catch {
      this.tell("The fields cannot be loaded.");
      return;
    }
    this.root.dataset.state = "fields";
    if (this.addressField !== undefined) this.choose(this.addressField);
    this.moved();
  }

  async ask(address) {
    const answer = await fetch(address, { signal: this.asking?.signal });
    const content = await answer.json();
    if (!answer.ok) throw new Error(content.detail ?? String(answer.status));
    return content;
  }

  fit() {
    const { width, height } = this.canvas.getBoundingClientRect();
    if (!width) return;
    const ratio = devicePixelRatio || 1;
    [this.width, this.height, this.ratio] = [width, height, ratio];
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.moved();
  }

  // Where the view is.

  get scale() { // pixels a radian, in the middle
    const whole = Math.min(this.width / (4 * Math.SQRT2), this.height / (2 * Math.SQRT2));
    return Math.max(whole, this.width / (Math.min(this.at.size, 180) * DEG) * (this.at.size < 180 ? 1 : 0));
  }

  onScreen(u) {
    const [x, y] = hammer(u, this.axes);
    return [this.width / 2 - x * this.scaled, this.height / 2 - y * this.scaled];
  }

  skyAt(x, y) {
    return unhammer((this.width / 2 - x) / this.scaled, (this.height / 2 - y) / this.scaled, this.axes);
  }

  go(ra, dec, size = this.at.size) {
    Object.assign(this.at, {
      ra: ((ra % 360) + 360) % 360, dec: Math.max(-90, Math.min(90, dec)),
      size: Math.max(LEAST_DEG, Math.min(WHOLE_DEG, size)),
    });
    this.moved();
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const under = this.skyAt(x, y);
    // Between the whole sky and 180 degrees across the picture is the same.
    const from = factor < 1 ? Math.min(this.at.size, 180) : this.at.size;
    const size = from * factor >= 180 ? WHOLE_DEG : Math.max(LEAST_DEG, from * factor);
    this.at.size = size;
    this.measure();
    if (under && size < WHOLE_DEG) this.drag(under, x, y);
    this.moved();
  }

  // Turn the sky so that a direction comes under a position on the screen.
  drag(u, x, y) {
    for (let step = 0; step < 4; step += 1) {
      const now = this.skyAt(x, y);
      if (!now) return;
      const [a, b] = [position(u), position(now)];
      const ra = this.at.ra + ((a.ra - b.ra + 540) % 360) - 180;
      this.at.ra = ((ra % 360) + 360) % 360;
      this.at.dec = Math.max(-89.999, Math.min(89.999, this.at.dec + a.dec - b.dec));
      this.measure();
    }
  }

  measure() {
    this.axes = axes(this.at.ra, this.at.dec);
    this.scaled = this.scale;
  }

  moved() {
    if (!this.width) return;
    this.measure();
    this.isMoving = true;
    this.paint();
    clearTimeout(this.resting);
    this.resting = setTimeout(() => this.rest(), REST_MS);
  }

  async rest() {
    this.isMoving = false;
    this.paint();
    this.writeAddress();
    if (!this.data.stars) return;
    const radius = this.radius();
    const parameters = new URLSearchParams({
      ra: this.at.ra.toFixed(4), dec: this.at.dec.toFixed(4), radius: radius.toFixed(4),
      faint: this.layers.has("faint") && radius < 30 ? "1" : "0",
    });
    if (String(parameters) === this.loadedParameters) return;
    this.asking?.abort();
    this.asking = new AbortController();
    try {
      const content = await this.ask(`${this.data.stars}?${parameters}`);
      this.loadedParameters = String(parameters);
      this.stars = content.stars.map((star) => ({ ...star, u: direction(star.ra_deg, star.dec_deg) }));
      this.root.dataset.state = "stars";
      this.root.dataset.count = this.stars.length;
      this.draw(); // at once: a star is found where it was drawn
    } catch (error) {
      if (error.name !== "AbortError") this.tell(`The stars cannot be loaded: ${error.message}`);
    }
  }

  // How far the corners are from the middle, degrees; all of the sky where they are outside of it.
  radius() {
    const corner = this.skyAt(0, 0);
    if (!corner) return 180;
    return Math.min(180, 1.02 * Math.acos(Math.max(-1, Math.min(1, dot(corner, this.axes.c)))) / DEG);
  }

  readAddress() {
    const view = new URLSearchParams(location.search).get("at");
    const [ra, dec, size, roll] = (view ?? "").split(",").map(Number);
    if (view && [ra, dec].every(Number.isFinite)) Object.assign(this.at, { ra, dec });
    if (Number.isFinite(size) && size > 0) this.at.size = Math.min(size, WHOLE_DEG);
    if (Number.isFinite(roll)) this.setRoll(roll);
    const field = Number(new URLSearchParams(location.search).get("field") ?? NaN);
    if (Number.isInteger(field) && field >= 0) this.addressField = field;
  }

  writeAddress() {
    if (!this.data.fields) return; // an answer has an address of its own
    const url = new URL(location.href);
    const { ra, dec, size, roll } = this.at;
    if (size >= WHOLE_DEG && this.field === null) url.searchParams.delete("at");
    else url.searchParams.set("at", [ra.toFixed(3), dec.toFixed(3), Number(size.toPrecision(4)), roll].join(","));
    if (this.field === null) url.searchParams.delete("field");
    else url.searchParams.set("field", this.field);
    if (url.href !== location.href) history[this.isStep ? "pushState" : "replaceState"](null, "", url);
    this.isStep = false;
  }

  // The browser's Back and Forward lead through the fields that were stepped to.
  comeBack() {
    Object.assign(this.at, { ra: 0, dec: 0, size: WHOLE_DEG, roll: 0, ...this.data.at });
    [this.field, this.addressField] = [null, undefined];
    this.readAddress();
    this.details.hidden = this.addressField === undefined;
    if (this.addressField !== undefined && this.fields) this.choose(this.addressField);
    this.rank = this.fields?.emptiest.indexOf(this.field) ?? -1;
    this.moved();
  }

  // What is painted.

  paint() {
    if (this.frameId) return;
    this.frameId = requestAnimationFrame(() => {
      this.frameId = 0;
      this.draw();
    });
  }

  draw() {
    const { pen } = this;
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.save();
    pen.beginPath();
    pen.ellipse(this.width / 2, this.height / 2, 2 * Math.SQRT2 * this.scaled, Math.SQRT2 * this.scaled, 0, 0, 2 * Math.PI);
    pen.clip();
    pen.fillStyle = COLOURS.ground;
    pen.fillRect(0, 0, this.width, this.height);
    if (this.fields && this.layers.has("fields")) this.drawFields(this.isMoving ? 8 : 4);
    this.drawGrid();
    this.drawStars();
    this.drawFrames();
    pen.restore();
  }

  drawFields(block) {
    const across = Math.ceil(this.width / block);
    const down = Math.ceil(this.height / block);
    const image = new ImageData(across, down);
    const alpha = this.at.size >= 180 ? 235 : Math.round(110 + 100 * Math.min(1, this.at.size / 180));
    for (let row = 0; row < down; row += 1) {
      for (let column = 0; column < across; column += 1) {
        const u = this.skyAt((column + 0.5) * block, (row + 0.5) * block);
        if (!u) continue;
        const [red, green, blue] = this.fields.colour[this.fields.nearest(u)];
        const pixel = 4 * (row * across + column);
        image.data[pixel] = red;
        image.data[pixel + 1] = green;
        image.data[pixel + 2] = blue;
        image.data[pixel + 3] = alpha;
      }
    }
    this.buffer ??= document.createElement("canvas");
    Object.assign(this.buffer, { width: across, height: down });
    this.buffer.getContext("2d").putImageData(image, 0, 0);
    this.pen.imageSmoothingEnabled = false;
    this.pen.drawImage(this.buffer, 0, 0, across * block, down * block);
  }

  line(points, closed = false) {
    const { pen } = this;
    const limit = 2 * this.scaled;
    let last = null;
    pen.beginPath();
    for (const u of closed ? [...points, points[0]] : points) {
      const [x, y] = this.onScreen(u);
      if (last && Math.abs(x - last) < limit) pen.lineTo(x, y);
      else pen.moveTo(x, y);
      last = x;
    }
    pen.stroke();
  }

  drawGrid() {
    const { pen } = this;
    const shown = this.at.size >= 180 ? 180 : this.at.size;
    const step = STEPS_DEG.find((spacing) => spacing >= shown / 7) ?? 30;
    const reach = this.radius();
    const low = Math.max(-90, this.at.dec - reach);
    const high = Math.min(90, this.at.dec + reach);
    const isPole = low <= -89.9 || high >= 89.9;
    const wide = isPole ? 180 : Math.min(180, reach / Math.cos(Math.max(-low, high) * DEG));
    const raStep = [step, 2 * step, 5, 10, 15, 30].find((spacing) => spacing >= step && wide / spacing < 12) ?? 30;
    pen.strokeStyle = COLOURS.grid;
    pen.fillStyle = COLOURS.text;
    pen.font = "11px system-ui, sans-serif";
    pen.lineWidth = 1;
    const even = (from, to) => Array.from({ length: 61 }, (_, k) => from + ((to - from) * k) / 60);
    const digits = step < 0.1 ? 2 : step < 1 ? 1 : 0;
    for (let k = Math.ceil(low / step); k * step <= high; k += 1) {
      const dec = k * step;
      if (Math.abs(dec) > 89.99) continue;
      this.line(even(this.at.ra - wide, this.at.ra + wide).map((ra) => direction(ra, dec)));
      const [, y] = this.onScreen(direction(this.at.ra, dec));
      if (shown < 180) pen.fillText(angle(dec, digits), 4, y - 3);
      else pen.fillText(angle(dec, 0), this.onScreen(direction(this.at.ra, dec))[0] + 3, y - 3);
    }
    const from = Math.ceil((this.at.ra - wide) / raStep);
    for (let k = from; k * raStep < this.at.ra + wide; k += 1) {
      const ra = k * raStep;
      this.line(even(low, high).map((dec) => direction(ra, dec)));
      const [x, y] = this.onScreen(direction(ra, this.at.dec));
      const label = `${((ra % 360) + 360) % 360 === 0 ? 0 : (((ra % 360) + 360) % 360).toFixed(raStep < 1 ? 2 : 0)}\u00b0`;
      pen.fillText(label, x + 3, shown < 180 ? this.height - 5 : y - 3);
    }
    const side = cross([0, 0, 1], POLE);
    const length = Math.hypot(...side);
    const first = side.map((component) => component / length);
    const second = cross(POLE, first);
    pen.strokeStyle = COLOURS.plane;
    pen.lineWidth = 1.8;
    pen.setLineDash([7, 5]);
    this.line(even(0, 360).flatMap((angleDeg) => [angleDeg, angleDeg + 3]).map((angleDeg) => sum([Math.cos(angleDeg * DEG), first], [Math.sin(angleDeg * DEG), second])));
    pen.setLineDash([]);
  }

  get drawn() {
    return this.stars.filter((star) => this.layers.has(star.kind)).concat(this.marks);
  }

  drawStars() {
    const { pen } = this;
    const magnitudes = this.stars.filter((star) => star.kind === "guide" && star.mag !== null).map((star) => star.mag);
    const faintest = magnitudes.length ? Math.max(...magnitudes) : 6;
    const named = [];
    for (const star of this.drawn) {
      const [x, y] = this.onScreen(star.u);
      star.x = x;
      star.y = y;
      star.isSeen = x > -20 && y > -20 && x < this.width + 20 && y < this.height + 20 && dot(star.u, this.axes.c) > -0.999;
      if (!star.isSeen) continue;
      const r = Math.max(1.1, Math.min(8, 1.3 + 0.75 * (faintest - (star.mag ?? faintest))));
      this.drawStar(star, x, y, this.at.size >= 180 ? 0.6 * r : r);
      if (star.kind !== "faint" && (star.name || (star.kind === "mark" && star.label))) named.push(star);
    }
    named.sort((a, b) => (a.mag ?? 99) - (b.mag ?? 99));
    pen.fillStyle = COLOURS.guide;
    pen.strokeStyle = "rgb(0 0 0 / 70%)";
    pen.lineWidth = 3;
    pen.lineJoin = "round";
    for (const star of named.slice(0, NAMED + Math.min(this.marks.length, MOST_LABELS))) {
      const [text, y] = [star.name || star.label, star.y + 4];
      const wide = pen.measureText(text).width;
      const right = star.x + 9 + wide;
      const fits = right < this.width && this.skyAt(right, y + 4) && this.skyAt(right, y - 12);
      const x = fits ? star.x + 9 : star.x - 9 - wide;
      pen.strokeText(text, x, y);
      pen.fillText(text, x, y);
    }
    if (this.star?.isSeen) this.ring(this.star.x, this.star.y, 12, COLOURS.mark);
  }

  drawStar(star, x, y, r) {
    const { pen } = this;
    pen.fillStyle = COLOURS[star.kind];
    if (star.kind === "mark") {
      this.ring(x, y, 9, star.colour === "rejected" ? COLOURS.rejected : COLOURS.mark);
    } else if (star.kind === "rejected") {
      const isWhole = this.at.size >= 180; // there are many: they must not hide the fields
      pen.strokeStyle = COLOURS.rejected;
      pen.globalAlpha = isWhole ? 0.5 : 1;
      pen.lineWidth = isWhole ? 1 : 1.6;
      const arm = isWhole ? 1.5 : Math.max(2.5, r);
      pen.beginPath();
      pen.moveTo(x - arm, y - arm);
      pen.lineTo(x + arm, y + arm);
      pen.moveTo(x + arm, y - arm);
      pen.lineTo(x - arm, y + arm);
      pen.stroke();
      pen.globalAlpha = 1;
    } else {
      pen.beginPath();
      pen.arc(x, y, star.kind === "faint" ? 0.9 : r, 0, 2 * Math.PI);
      pen.fill();
    }
  }

  ring(x, y, r, colour) {
    const { pen } = this;
    pen.strokeStyle = colour;
    pen.lineWidth = 1.8;
    pen.beginPath();
    pen.arc(x, y, r, 0, 2 * Math.PI);
    pen.stroke();
  }

  outline(ra, dec, roll) {
    const { c, e, n } = axes(ra, dec);
    const [sine, cosine] = [Math.sin(roll * DEG), Math.cos(roll * DEG)];
    const right = sum([-sine, n], [-cosine, e]);
    const down = sum([-cosine, n], [sine, e]);
    return this.data.outline.map(([x, y, z]) => sum([x, right], [y, down], [z, c]));
  }

  drawFrames() {
    const { pen } = this;
    pen.strokeStyle = COLOURS.frame;
    pen.lineWidth = 2;
    if (!this.data.outline) return;
    if (this.frame) this.line(this.outline(this.frame.ra, this.frame.dec, this.frame.roll), true);
    if (this.field !== null && this.fields) {
      this.line(this.outline(this.fields.ra[this.field], this.fields.dec[this.field], this.at.roll), true);
    }
  }

  // What is pointed at and chosen.

  tell(text) {
    if (this.readout.textContent !== text) this.readout.textContent = text;
  }

  under(x, y) {
    let best = null;
    let least = REACH_PX;
    for (const star of this.drawn) {
      const off = star.isSeen ? Math.hypot(star.x - x, star.y - y) : Infinity;
      if (off < least) [least, best] = [off, star];
    }
    return best;
  }

  starInWords(star) {
    const name = star.name ? `${star.name} (${star.label})` : star.label;
    const what = { guide: "a guide star", rejected: `rejected: ${star.reason}`, faint: `rejected: ${star.reason}`, mark: star.reason ?? "in the answer" }[star.kind];
    const mag = star.mag === null || star.mag === undefined ? "" : `, ${star.mag.toFixed(2)} mag`;
    return `${name}${mag}, ${what}; RA ${angle(star.ra_deg, 4)}, Dec ${angle(star.dec_deg, 4)}`;
  }

  fieldInWords(number) {
    return `Field ${number}: ${stars(this.fields.count[number])}, centre at RA ${angle(this.fields.ra[number], 3)}, Dec ${angle(this.fields.dec[number], 3)}`;
  }

  say(x, y) {
    const star = this.under(x, y);
    const u = this.skyAt(x, y);
    this.canvas.style.cursor = star ? "pointer" : "grab";
    if (star) this.tell(this.starInWords(star));
    else if (!u) this.tell("");
    else if (this.fields) this.tell(this.fieldInWords(this.fields.nearest(u)));
    else this.tell(`RA ${angle(position(u).ra, 3)}, Dec ${angle(position(u).dec, 3)}`);
  }

  click(x, y) {
    const star = this.under(x, y);
    const u = this.skyAt(x, y);
    if (star) this.chooseStar(star);
    else if (u && this.fields) this.choose(this.fields.nearest(u));
  }

  chooseStar(star) {
    this.star = star;
    this.details.hidden = false;
    this.details.querySelector(".what").textContent = this.starInWords(star);
    this.link(...this.linksOf(star));
    this.paint();
  }

  // Where a star leads to: its row here, and its entries in the archives.
  linksOf(star) {
    const { sql, simbad, vizier, catalog } = this.data;
    const links = [];
    const to = (text, address, values) => links.push([text, `${address}?${new URLSearchParams(values)}`]);
    const table = star.kind === "guide" || star.kind === "mark" ? "stars" : "rejected";
    if (star.id) to("Its row", sql, { query: `SELECT * FROM ${table}\nWHERE star_id = ${star.id}` });
    if (simbad && star.id) to("SIMBAD", simbad, { Ident: star.label });
    const coordinates = `${star.ra_deg.toFixed(6)} ${star.dec_deg < 0 ? "" : "+"}${star.dec_deg.toFixed(6)}`;
    if (catalog && star.id) to(`VizieR ${catalog}`, vizier, { "-source": catalog, "-c": coordinates, "-c.rs": "5" });
    return links;
  }

  link(...links) {
    this.details.querySelector(".links").replaceChildren(...links.map(([text, address]) => {
      const link = document.createElement("a");
      Object.assign(link, { href: address, textContent: text });
      if (!address.startsWith("/")) link.rel = "noreferrer external";
      return link;
    }));
  }

  choose(number) {
    if (number >= this.fields.size) return;
    this.field = number;
    this.star = null;
    this.details.hidden = false;
    this.details.querySelector(".what").textContent = this.fieldInWords(number);
    const [ra, dec] = [this.fields.ra[number].toFixed(6), this.fields.dec[number].toFixed(6)];
    const [wide, high] = this.data.fov.map((fovDeg) => fovDeg.toFixed(6));
    const query = `SELECT designation, mag, ra_deg, dec_deg, field_x_deg, field_y_deg\nFROM field(${ra}, ${dec}, ${this.at.roll}, ${wide}, ${high})\nORDER BY mag`;
    this.link(["Its stars as rows", `${this.data.sql}?${new URLSearchParams({ query })}`]);
    this.root.dataset.field = number;
    this.moved();
  }

  show(number) {
    this.go(this.fields.ra[number], this.fields.dec[number], 1.7 * Math.max(...this.data.fov));
    this.choose(number);
    this.tell(this.fieldInWords(number));
  }

  step(by) {
    const now = this.rank ?? (by > 0 ? -1 : 1);
    this.rank = Math.max(0, Math.min(this.fields.size - 1, now + by));
    this.show(this.fields.emptiest[this.rank]);
    this.isStep = true;
    this.writeAddress();
    this.canvas.scrollIntoView({ block: "nearest" });
  }

  setRoll(roll) {
    this.at.roll = ((Math.round(roll * 10) / 10) % 360 + 360) % 360;
    const slider = this.root.querySelector("[data-roll]");
    if (slider) slider.value = this.at.roll;
    const rollReadout = this.root.querySelector("[data-roll-told]");
    if (rollReadout) rollReadout.textContent = `${this.at.roll}\u00b0`;
  }

  listen() {
    const { canvas } = this;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const [x, y] = at(event);
      this.pointers.set(event.pointerId, { x, y });
      this.press = { u: this.skyAt(x, y), x, y, isClick: this.pointers.size === 1 };
    });
    canvas.addEventListener("pointermove", (event) => {
      const [x, y] = at(event);
      if (!this.pointers.size) {
        this.say(x, y);
        return;
      }
      const before = [...this.pointers.values()].map((pointer) => ({ ...pointer }));
      this.pointers.set(event.pointerId, { x, y });
      const now = [...this.pointers.values()];
      if (now.length === 2) {
        const apart = ([a, b]) => Math.hypot(a.x - b.x, a.y - b.y);
        this.press.isClick = false;
        this.zoom(apart(before) / Math.max(1, apart(now)), (now[0].x + now[1].x) / 2, (now[0].y + now[1].y) / 2);
        return;
      }
      if (Math.hypot(x - this.press.x, y - this.press.y) > 4) this.press.isClick = false;
      if (this.press.isClick || !this.press.u) return;
      this.drag(this.press.u, x, y);
      this.moved();
    });
    const end = (event) => {
      const isClick = this.press?.isClick && event.type === "pointerup";
      this.pointers.delete(event.pointerId);
      if (isClick) this.click(...at(event));
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(Math.max(-80, Math.min(80, event.deltaY)) * 0.006), ...at(event));
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => this.zoom(0.5, ...at(event)));
    canvas.addEventListener("keydown", (event) => this.key(event));
    this.root.addEventListener("click", (event) => {
      const button = event.target.closest("[data-do]");
      if (button) this.do(button.dataset.do);
    });
    addEventListener("popstate", () => this.comeBack());
    this.root.addEventListener("input", (event) => {
      const { layer } = event.target.dataset;
      if (layer) this.layers[event.target.checked ? "add" : "delete"](layer);
      if ("roll" in event.target.dataset) this.setRoll(Number(event.target.value));
      this.moved();
    });
  }

  key(event) {
    const part = Math.min(this.at.size, 180) / 10;
    const steps = { ArrowLeft: [part, 0], ArrowRight: [-part, 0], ArrowUp: [0, part], ArrowDown: [0, -part] };
    const middle = [this.width / 2, this.height / 2];
    if (steps[event.key]) {
      const [ra, dec] = steps[event.key];
      this.go(this.at.ra + ra / Math.max(0.1, Math.cos(this.at.dec * DEG)), this.at.dec + dec);
    } else if (event.key === "+" || event.key === "=") this.zoom(0.6);
    else if (event.key === "-") this.zoom(1 / 0.6);
    else if (event.key === "Enter") this.click(...middle);
    else return;
    event.preventDefault();
    this.draw();
    this.say(...middle);
  }

  do(what) {
    const steps = { in: () => this.zoom(0.5), out: () => this.zoom(2) };
    steps.whole = () => this.go(this.data.at?.ra ?? 0, 0, WHOLE_DEG);
    steps.answer = () => this.go(this.data.at.ra, this.data.at.dec, this.data.at.size);
    steps.emptier = () => this.fields && this.step(-1);
    steps.fuller = () => this.fields && this.step(1);
    steps[what]?.();
  }
}

export function startSky(root) {
  root.hidden = false;
  const sky = new Sky(root);
  root.sky = sky; // for who looks at the page with a program
  return sky;
}

for (const root of document.querySelectorAll(".skyview[data-sky]")) startSky(root);
