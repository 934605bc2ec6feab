// Reads what replay_page.py wrote: a JSON header, and int16 columns as differences, deflated.

const MISSING = -32768;

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Arrays by name, unpacked when first asked for: {rows, columns, values}, values row by row, NaN where nothing is known.
function shelf(bytes, entries) {
  const known = new Map();
  return (name) => {
    if (!known.has(name)) known.set(name, unpack(bytes, entries[name]));
    return known.get(name);
  };
}

function unpack(bytes, { at, rows, columns, unit }) {
  const size = rows * columns;
  const values = new Float32Array(size);
  for (let column = 0; column < columns; column++) {
    let count = 0;
    for (let row = 0; row < rows; row++) {
      const k = at + column * rows + row;
      count = ((count + bytes[k] + (bytes[k + size] << 8)) << 16) >> 16; // int16, modulo 2^16
      values[row * columns + column] = count === MISSING ? NaN : count * unit;
    }
  }
  return { rows, columns, values };
}

export async function load(root) {
  const header = JSON.parse(root.querySelector("#replay-header").textContent);
  const text = atob(root.querySelector("#replay-numbers").textContent.trim());
  const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  const [first] = header.bytes;
  const motion = shelf(await inflate(bytes.subarray(0, first)), header.entries);
  const hulls = shelf(await inflate(bytes.subarray(first)), header.volumes.entries);
  return { header, motion, volumes: volumes(header.volumes, hulls) };
}

// The stored hulls, by instant.
function volumes(header, hulls) {
  const { rows, values: limb } = hulls("limb");
  const count = hulls("count").values;
  const radius = hulls("radius").values;
  const horizon = hulls("horizon").values;
  const vertices = hulls("vertices").values;
  const instants = []; // {at_s, horizon_s, hulls: [{limb, radius, vertices}]}
  let from = 0;
  for (let row = 0; row < rows; row++) {
    const at_s = header.at_s[row];
    if (!instants.length || instants[instants.length - 1].at_s !== at_s) {
      instants.push({ at_s, horizon_s: horizon[row], hulls: [] });
    }
    const to = from + 3 * count[row];
    instants[instants.length - 1].hulls.push({
      limb: limb[row], radius: radius[row], vertices: vertices.subarray(from, to),
    });
    from = to;
  }
  const times = instants.map((one) => one.at_s);
  const stale_s = header.rate_hz ? 1.6 / header.rate_hz : 0;
  return {
    ...header,
    // The last stored instant that is not later than t_s, if it is not too old.
    at(t_s) {
      const k = lastNotAfter(times, t_s + 1e-6);
      return k >= 0 && t_s - times[k] <= stale_s ? instants[k] : null;
    },
  };
}

export function lastNotAfter(sorted, value) {
  let low = 0, high = sorted.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

// A row of an array between two instants, linear; the nearer one where either is not known.
export function between(array, at, out = []) {
  const last = array.rows - 1;
  const i = Math.max(0, Math.min(last, Math.floor(at)));
  const j = Math.min(last, i + 1);
  const share = Math.max(0, Math.min(1, at - i));
  for (let c = 0; c < array.columns; c++) {
    const a = array.values[i * array.columns + c], b = array.values[j * array.columns + c];
    out[c] = Number.isNaN(a) || Number.isNaN(b) ? (share < 0.5 ? a : b) : a + share * (b - a);
  }
  return out;
}

export function nearest(array, at) {
  const i = Math.max(0, Math.min(array.rows - 1, Math.round(at)));
  return array.values[i * array.columns];
}
