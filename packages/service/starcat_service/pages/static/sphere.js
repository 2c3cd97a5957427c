// The sphere: directions, Hammer's projection about any middle, and the nearest of many fields.

const DEG = Math.PI / 180;

export function direction(ra, dec) {
  const across = Math.cos(dec * DEG);
  return [across * Math.cos(ra * DEG), across * Math.sin(ra * DEG), Math.sin(dec * DEG)];
}

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const sum = (...parts) => [0, 1, 2].map((k) => parts.reduce((all, [f, u]) => all + f * u[k], 0));
export const position = (u) => ({
  ra: (Math.atan2(u[1], u[0]) / DEG + 360) % 360,
  dec: Math.atan2(u[2], Math.hypot(u[0], u[1])) / DEG,
});

export function axes(ra, dec) {
  const sine = Math.sin(ra * DEG);
  const cosine = Math.cos(ra * DEG);
  const c = direction(ra, dec);
  const e = [-sine, cosine, 0];
  return { c, e, n: cross(c, e) };
}

// To the map and back, in units of the sphere's radius; x grows to the east.
export function hammer(u, { c, e, n }) {
  const [x, y, z] = [dot(u, c), dot(u, e), dot(u, n)];
  const r = Math.hypot(x, y);
  if (r === 0) return [0, Math.sign(z) * Math.SQRT2];
  let half;
  let cosine;
  if (x > 0) {
    cosine = Math.sqrt((1 + x / r) / 2);
    half = y / (2 * r * cosine);
  } else {
    half = (y < 0 ? -1 : 1) * Math.sqrt((1 - x / r) / 2);
    cosine = Math.abs(y / (2 * r * half));
  }
  const d = Math.sqrt(1 + r * cosine);
  return [(2 * Math.SQRT2 * r * half) / d, (Math.SQRT2 * z) / d];
}

export function unhammer(x, y, { c, e, n }) {
  if (x * x / 8 + y * y / 2 >= 1) return null;
  const z = Math.sqrt(1 - (x / 4) ** 2 - (y / 2) ** 2);
  const lon = 2 * Math.atan2(z * x, 2 * (2 * z * z - 1));
  const up = z * y;
  const across = Math.sqrt(Math.max(0, 1 - up * up));
  return sum([across * Math.cos(lon), c], [across * Math.sin(lon), e], [up, n]);
}

// The nearest field to any direction: the fields by declination, those within a band compared.
export class Fields {
  constructor({ ra_deg, dec_deg, stars: count, bins }) {
    Object.assign(this, { ra: ra_deg, dec: dec_deg, count, size: ra_deg.length });
    this.u = ra_deg.map((ra, k) => direction(ra, dec_deg[k]));
    this.byDec = dec_deg.map((_, k) => k).sort((a, b) => dec_deg[a] - dec_deg[b]);
    this.sorted = this.byDec.map((k) => dec_deg[k]);
    this.reach = Math.max(3 / Math.sqrt(this.size) / DEG, 0.01);
    this.emptiest = this.ra.map((_, k) => k).sort((a, b) => count[a] - count[b] || a - b);
    this.colour = count.map((starCount) => {
      const bin = bins.findLast(({ least }) => least <= starCount) ?? bins[0];
      const number = parseInt(bin.colour, 16);
      return [number >> 16, (number >> 8) & 255, number & 255];
    });
  }

  nearest(u) {
    const dec = Math.asin(Math.max(-1, Math.min(1, u[2]))) / DEG;
    for (let reach = this.reach; ; reach *= 4) {
      let best = -1;
      let most = -2;
      for (let k = this.first(dec - reach); k < this.size && this.sorted[k] <= dec + reach; k += 1) {
        const along = dot(u, this.u[this.byDec[k]]);
        if (along > most) [most, best] = [along, this.byDec[k]];
      }
      if (best >= 0 || reach > 180) return best;
    }
  }

  first(dec) {
    let [low, high] = [0, this.size];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.sorted[middle] < dec) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}
