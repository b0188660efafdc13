// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

"use strict";
// What is drawn: arrays of the page's store, or lists as they stand in a figure.

const page = JSON.parse(document.getElementById("data").textContent);

const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

const half = (bits) => { // IEEE 754 binary16: half the size, and 0.05 % is finer than a screen
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return exponent ? sign * 2 ** (exponent - 15) * (1 + fraction / 1024) : sign * 2 ** -24 * fraction;
};

// Series of a long recording hold the smallest and the largest value of each span of samples, one after the other.
const stores = page.stores.map(({ time, width, series }) => ({ time: new Float64Array(bytes(time)), step: width > 1 ? 2 : 1, series }));
const known = {};
const read = (name) => {
  const { time, step, series } = stores.find((store) => name in store.series), [kind, text] = series[name];
  const buffer = bytes(text);
  const values = kind === "f2" ? Float32Array.from(new Uint16Array(buffer), half) : new Float32Array(buffer);
  if (step === 1) return { time, low: values, high: values };
  return { time, low: values.filter((_, i) => i % 2 === 0), high: values.filter((_, i) => i % 2 === 1) };
};
const stored = (name) => (known[name] ??= read(name));

const number = (value) => (value === null || value === undefined ? NaN : +value);

// x of a trace, and for each x the smallest and the largest value: one array where they are the same.
const curveOf = (trace) => {
  if (!trace.packed) {
    const x = Array.from(trace.x ?? [], number);
    if (trace.type === "band") return { x, low: trace.low.map(number), high: trace.high.map(number) };
    const y = Array.from(trace.y ?? [], number);
    return { x, low: y, high: y };
  }
  const base = stored(trace.packed), x = base.time;
  if (trace.type === "band") {
    const [name, factor] = trace.spread, spread = stored(name).high;
    return { x, low: base.low.map((v, i) => v - factor * spread[i]), high: base.high.map((v, i) => v + factor * spread[i]) };
  }
  if (!trace.plus) return { x, low: base.low, high: base.high };
  const [name, factor] = trace.plus, more = stored(name);
  if (base.low === base.high) {
    const sum = base.low.map((v, i) => v + factor * more.low[i]);
    return { x, low: sum, high: sum };
  }
  // Extremes of two series in one span need not come together: about the middle of the one, the other is exact.
  const side = (which) => base.low.map((v, i) => (v + base.high[i]) / 2 + factor * which[i]);
  return factor > 0 ? { x, low: side(more.low), high: side(more.high) } : { x, low: side(more.high), high: side(more.low) };
};

const firstFrom = (x, value) => { // number of values below
  let low = 0, high = x.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (x[middle] < value) low = middle + 1; else high = middle;
  }
  return low;
};

const nearest = (x, value) => {
  const i = Math.min(firstFrom(x, value), x.length - 1);
  return i > 0 && value - x[i - 1] < x[i] - value ? i - 1 : i;
};

// Points within a range: smallest and largest of every group of spans, so that no spike is lost.
const points = ({ x, low, high }, range, most) => {
  const sorted = x.length > 500; // short lists may run either way
  const first = sorted ? Math.max(0, firstFrom(x, range[0]) - 1) : 0;
  const last = sorted ? Math.min(x.length, firstFrom(x, range[1]) + 1) : x.length;
  const group = Math.max(1, Math.ceil((last - first) / most)), found = [];
  for (let i = first; i < last; i += group) {
    if (group === 1 && low === high) { found.push([x[i], low[i]]); continue; }
    const end = Math.min(last, i + group);
    let least = Infinity, largest = -Infinity, leastAt = i, largestAt = i;
    for (let k = i; k < end; k++) {
      if (low[k] < least) { least = low[k]; leastAt = k; }
      if (high[k] > largest) { largest = high[k]; largestAt = k; }
    }
    if (least > largest) { found.push([x[i], NaN]); continue; }
    const before = found.length ? found[found.length - 1][1] : NaN;
    // Within one span it is not known which came first: the nearer one makes no false step.
    const falls = leastAt === largestAt ? Math.abs(before - largest) < Math.abs(before - least) : largestAt < leastAt;
    const ends = [[x[leastAt], least], [x[largestAt], largest]];
    found.push(...(falls ? ends.reverse() : ends));
  }
  return found;
};

// Smallest and largest value of curves in each of so many columns of a range.
const columns = (curves, range, count) => {
  const low = new Array(count).fill(Infinity), high = new Array(count).fill(-Infinity);
  for (const curve of curves) {
    for (let i = 0; i < curve.x.length; i++) {
      const share = (curve.x[i] - range[0]) / (range[1] - range[0]);
      if (!(share >= 0 && share <= 1)) continue;
      const k = Math.min(count - 1, Math.floor(share * count));
      if (curve.low[i] < low[k] && curve.low[i] > -Infinity) low[k] = curve.low[i];
      if (curve.high[i] > high[k] && curve.high[i] < Infinity) high[k] = curve.high[i];
    }
  }
  return low.map((value, k) => [value, high[k]]).filter(([a, b]) => a <= b);
};
