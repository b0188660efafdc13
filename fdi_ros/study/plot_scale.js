// Axes: values to pixels and back, ticks, and the words for numbers.

const SUPER = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
const power = (n) => `10${String(n).replace(/./g, (c) => SUPER[c])}`;

const short = (value) => {
  if (!Number.isFinite(value)) return "none";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-4 || size >= 1e6)) return value.toExponential(2);
  return String(+value.toPrecision(4));
};

const linearTicks = (low, high, count) => {
  const raw = (high - low) / Math.max(1, count), unit = 10 ** Math.floor(Math.log10(raw));
  const step = unit * [1, 2, 5, 10].find((m) => raw / unit <= m * 1.0001);
  const places = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    const value = k * step;
    found.push([value, places > 4 && value ? value.toExponential(1) : value.toFixed(Math.min(places, 6))]);
  }
  return found;
};

const logTicks = (low, high, count) => {
  const first = Math.ceil(Math.log10(low) - 1e-9), last = Math.floor(Math.log10(high) + 1e-9), found = [];
  if (last - first < 1) {
    for (let n = first - 1; n <= last; n++) {
      for (const m of [1, 2, 5]) {
        const value = m * 10 ** n;
        if (value >= low && value <= high) found.push([value, short(value)]);
      }
    }
    return found;
  }
  const step = Math.max(1, Math.ceil((last - first + 1) / count));
  for (let n = first; n <= last; n += step) found.push([10 ** n, n >= -2 && n <= 3 ? String(+(10 ** n).toPrecision(1)) : power(n)]);
  return found;
};

const scaleOf = (kind, [low, high], [from, to], count) => {
  const warp = kind === "log" ? Math.log10 : (v) => v, back = kind === "log" ? (v) => 10 ** v : (v) => v;
  const a = warp(low), b = warp(high);
  return {
    kind, range: [low, high], pixels: [from, to],
    to: (value) => from + (warp(value) - a) / (b - a) * (to - from),
    back: (pixel) => back(a + (pixel - from) / (to - from) * (b - a)),
    ticks: (kind === "log" ? logTicks : linearTicks)(low, high, count),
  };
};

// Room above and below, and none of width zero.
const padded = ([low, high], kind) => {
  if (!(low <= high)) return kind === "log" ? [0.1, 1] : [0, 1];
  if (kind === "log") return low === high ? [low / 2, high * 2] : [low / (high / low) ** 0.05, high * (high / low) ** 0.05];
  const room = low === high ? Math.abs(low) * 0.1 || 1 : 0.06 * (high - low);
  return [low - room, high + room];
};

const WIDE = 3; // values this many times beyond what most of the time shows do not set the scale
const MOST = 0.8; // share of the time that does
const COLUMNS = 60;

const quantile = (values, share) => values.sort((a, b) => a - b)[Math.round(share * (values.length - 1))];

// Range of values: all, and what most of the time shows together with what must be seen (spans of x).
const valueRange = (curves, range, needed) => {
  const seen = columns(curves, range, COLUMNS);
  if (!seen.length) return null;
  const all = [Math.min(...seen.map((c) => c[0])), Math.max(...seen.map((c) => c[1]))];
  let low = quantile(seen.map((c) => c[0]), 1 - MOST), high = quantile(seen.map((c) => c[1]), MOST);
  const room = 0.5 * (high - low);
  low -= room; high += room;
  for (const span of needed) {
    for (const [a, b] of columns(curves, span, 1)) { low = Math.min(low, a); high = Math.max(high, b); }
  }
  return { all, usual: [Math.max(low, all[0]), Math.min(high, all[1])], floor: quantile(seen.map((c) => c[0]), 1 - MOST) };
};

const together = (ranges) => {
  const known = ranges.filter(Boolean);
  if (!known.length) return null;
  const join = (name) => [Math.min(...known.map((r) => r[name][0])), Math.max(...known.map((r) => r[name][1]))];
  return { all: join("all"), usual: join("usual") };
};
