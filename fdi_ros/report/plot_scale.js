// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

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
    // As many digits as neighbours need to differ.
    const digits = value ? Math.max(1, Math.round(Math.floor(Math.log10(Math.abs(value))) + places)) : 0;
    found.push([value, places > 4 && value ? value.toExponential(digits) : value.toFixed(Math.min(places, 6))]);
  }
  return found;
};

// One tick alone says nothing of the scale.
const twoTicks = (low, high, count) => {
  const tried = [1, 1.5, 2, 3, 5].map((n) => linearTicks(low, high, n * count));
  return tried.find((ticks) => ticks.length > 1) ?? tried[0];
};

// Powers of ten; over few of them 1, 2, 5 too; within less than that as on a linear axis. Two at least.
const logTicks = (low, high, count) => {
  const first = Math.ceil(Math.log10(low) - 1e-9), last = Math.floor(Math.log10(high) + 1e-9), found = [];
  if (last - first < (count > 3 ? 2 : 1)) {
    for (let n = first - 1; n <= last; n++) {
      for (const m of [1, 2, 5]) {
        const value = m * 10 ** n;
        if (value >= low * (1 - 1e-9) && value <= high * (1 + 1e-9)) found.push([value, short(value)]);
      }
    }
    if (found.length < 2) return twoTicks(low, high, Math.max(2, count));
    const every = count > 3 ? 1 : Math.ceil(found.length / Math.max(2, count));
    return found.filter((_, k) => k % every === 0);
  }
  const step = Math.max(1, Math.ceil((last - first + 1) / Math.max(2, count)));
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
    ticks: kind === "log" ? logTicks(low, high, count) : twoTicks(low, high, count),
  };
};

// Room above and below, and none of width zero.
const padded = ([low, high], kind) => {
  if (!(low <= high)) return kind === "log" ? [0.1, 1] : [0, 1];
  if (kind === "log") return low === high ? [low / 2, high * 2] : [low / (high / low) ** 0.05, high * (high / low) ** 0.05];
  const room = low === high ? Math.abs(low) * 0.1 || 1 : 0.06 * (high - low);
  return [low - room, high + room];
};

const WIDE = 3; // what lies this many times beyond all the rest does not set the scale
const SHARE = 0.2; // if it is no more of the time than this
const STRETCHES = 3; // in no more stretches: a shake, a few spikes; not motion that comes again and again
const COLUMNS = 60;

const extent = (seen) => [Math.min(...seen.map((c) => c[0])), Math.max(...seen.map((c) => c[1]))];

// Columns without those that stick out for a short time.
const usualOf = (seen) => {
  const middle = seen.map(([a, b]) => (a + b) / 2).sort((a, b) => a - b)[seen.length >> 1];
  const size = ([a, b]) => Math.max(b - middle, middle - a);
  const order = seen.map((_, k) => k).sort((a, b) => size(seen[b]) - size(seen[a])), out = new Set();
  let best = seen;
  for (const k of order.slice(0, Math.floor(SHARE * seen.length))) {
    out.add(k);
    const stretches = [...out].filter((i) => !out.has(i - 1)).length;
    if (stretches <= STRETCHES) best = seen.filter((_, i) => !out.has(i));
  }
  return best;
};

// Range of values: all; without what sticks out, but with what must be seen (spans of x); and a floor for logarithms.
const valueRange = (curves, range, needed) => {
  const seen = columns(curves, range, COLUMNS);
  if (!seen.length) return null;
  const must = needed.flatMap((span) => columns(curves, span, 1));
  const lows = seen.map((c) => c[0]).sort((a, b) => a - b);
  return { all: extent(seen), usual: extent([...usualOf(seen), ...must]), floor: lows[Math.floor(SHARE * lows.length)] };
};

const together = (ranges) => {
  const known = ranges.filter(Boolean);
  if (!known.length) return null;
  const join = (name) => [Math.min(...known.map((r) => r[name][0])), Math.max(...known.map((r) => r[name][1]))];
  return { all: join("all"), usual: join("usual"), floor: Math.min(...known.map((r) => r.floor)) };
};
