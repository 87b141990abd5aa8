// Strips of the last 10 s: angle with its reference, and coupling torque, as envelopes.

import { byId } from "./dom.js";
import { Surface, roundStep, roundTicks, tickText } from "./canvas.js";
import { digits } from "./format.js";

const SHOWN_S = 10;
/** Least half-spans, so that noise and encoder steps do not fill the strip. */
const LEAST = { angle: 0.002, torque: 0.02 };
const LEFT = 52;
const BOTTOM = 18;
const TOP = 8;
const HALVES = [1, 1.5, 2, 3, 4, 6, 8, 10];
const SPOKEN_MS = 1000;

class Strip {
  #surface;
  #half;
  #small = 0;
  #spoken = -Infinity;

  constructor(canvas, { name, unit, least, bands }) {
    this.canvas = canvas;
    this.name = name;
    this.unit = unit;
    this.least = least;
    this.bands = bands;
    this.bins = [];
    this.#half = least;
    this.#surface = new Surface(canvas, () => this.draw());
  }

  /** Half of the span: grows at once, and shrinks only when much less has been enough for 3 s. */
  #span() {
    let largest = 0;
    for (const bin of this.bins) {
      for (const value of bin.values) {
        if (Number.isFinite(value)) largest = Math.max(largest, Math.abs(value));
      }
    }
    const wanted = Math.max(this.least, 1.1 * largest);
    const now = performance.now();
    if (wanted > 0.6 * this.#half) this.#small = now;
    if (wanted > this.#half || now - this.#small > 3000) {
      const power = 10 ** Math.floor(Math.log10(wanted));
      this.#half = power * HALVES.find((half) => half * power >= wanted);
      this.#small = now;
    }
    return this.#half;
  }

  draw() {
    const surface = this.#surface;
    const { width, height } = surface;
    if (width === 0) return;
    const half = this.#span();
    const end = this.bins.at(-1);
    const last = end ? end.t + end.dt : 0;
    const inner = { width: width - LEFT - 4, height: height - TOP - BOTTOM };
    const x = (t) => LEFT + inner.width * (1 + (t - last) / SHOWN_S);
    const y = (value) => TOP + (inner.height * (1 - value / half)) / 2;
    surface.clear();
    const step = roundStep(2 * half, 4);
    for (const tick of roundTicks(-half, half, 4)) {
      surface.line(LEFT, y(tick), width - 4, y(tick), tick === 0 ? "line" : "grid");
      surface.text(tickText(tick, step), LEFT - 6, y(tick), "right");
    }
    for (let ago = 0; ago <= SHOWN_S; ago += 2) {
      const at = x(last - ago);
      surface.line(at, TOP, at, height - BOTTOM, "grid");
      const align = ago === 0 ? "right" : ago === SHOWN_S ? "left" : "center";
      surface.text(ago ? `−${ago} s` : "now", at, height - 7, align);
    }
    surface.within(LEFT, TOP, inner.width, inner.height, (context) => {
      for (const band of this.bands) this.#drawBand(context, x, y, band);
    });
    this.#speak();
  }

  /** Runs of bins without a gap, as centres in time and values of a column. */
  #runs(column) {
    const runs = [[]];
    for (const { t, dt, values } of this.bins) {
      if (Number.isFinite(values[column])) runs.at(-1).push([t + dt / 2, values[column]]);
      else if (runs.at(-1).length) runs.push([]);
    }
    return runs.filter((run) => run.length);
  }

  #drawBand(context, x, y, { low, high, colour, width, filled = 1 }) {
    context.fillStyle = this.#surface.colour(colour);
    context.strokeStyle = this.#surface.colour(colour);
    context.lineWidth = width;
    context.lineJoin = "round";
    const lows = this.#runs(low);
    this.#runs(high).forEach((upper, k) => {
      context.beginPath();
      for (const [t, value] of [...upper, ...[...lows[k]].reverse()]) context.lineTo(x(t), y(value));
      context.closePath();
      context.globalAlpha = filled;
      context.fill();
      context.globalAlpha = 1;
      context.stroke();
    });
  }

  /** Tell the extremes to those who do not see the strip, once a second. */
  #speak() {
    const now = performance.now();
    if (now - this.#spoken < SPOKEN_MS || this.bins.length === 0) return;
    this.#spoken = now;
    const { low, high } = this.bands.at(-1);
    const lows = this.bins.map((bin) => bin.values[low]).filter(Number.isFinite);
    const highs = this.bins.map((bin) => bin.values[high]).filter(Number.isFinite);
    if (lows.length === 0) return;
    const ends = `${digits(Math.min(...lows))} to ${digits(Math.max(...highs))} ${this.unit}`;
    this.canvas.setAttribute("aria-label", `${this.name}, last 10 s: ${ends}`);
  }
}

export class Strips {
  #angle = new Strip(byId("strip-angle"), {
    name: "Angle", unit: "rad", least: LEAST.angle,
    // The reference behind what is measured: a rim where both agree, a band where they do not.
    bands: [
      { low: 2, high: 3, colour: "reference", width: 2.5, filled: 0.35 },
      { low: 0, high: 1, colour: "measured", width: 1.4 },
    ],
  });

  #torque = new Strip(byId("strip-torque"), {
    name: "Coupling torque", unit: "N·m", least: LEAST.torque,
    bands: [{ low: 0, high: 1, colour: "torque", width: 1.4 }],
  });

  constructor(link) {
    link.on("strip", (block) => this.#take(block));
  }

  #take(block) {
    const { t0_s: start, dt_s: dt } = block;
    const add = (strip, columns) => {
      if (strip.bins.length && start < strip.bins.at(-1).t - dt / 2) strip.bins = [];  // a new record
      columns[0].forEach((_, k) => {
        const values = columns.map((column) => (column[k] === null ? NaN : column[k]));
        strip.bins.push({ t: start + k * dt, dt, values });
      });
      const first = strip.bins.at(-1).t - SHOWN_S;
      strip.bins = strip.bins.filter(({ t }) => t >= first);
      strip.draw();
    };
    if (!block.angle_min.length) return;
    add(this.#angle,
      [block.angle_min, block.angle_max, block.reference_min, block.reference_max]);
    add(this.#torque, [block.torque_min, block.torque_max]);
  }
}
