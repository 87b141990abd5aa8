// A plain canvas of the right resolution, with axes whose ticks are round numbers.

import { minus } from "./format.js";

const FONT = '12px system-ui, "Liberation Sans", Arial, sans-serif';

/** Round step that divides a span into about so many parts. */
export function roundStep(span, parts) {
  const rough = span / parts;
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * ([1, 2, 5].find((step) => step * power >= rough) ?? 10);
}

/** Round values within a span. */
export function roundTicks(first, last, parts) {
  const step = roundStep(last - first, parts);
  const ticks = [];
  for (let k = Math.ceil(first / step - 1e-9); k * step <= last + 1e-9 * step; k += 1) {
    ticks.push(k * step);
  }
  return ticks;
}

/** A tick as text, with the decimals of its step. */
export function tickText(value, step) {
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return minus((Math.abs(value) < step / 1e6 ? 0 : value).toFixed(Math.min(decimals, 8)));
}

export class Surface {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {function(): void} draw - called when size or colours have changed
   */
  constructor(canvas, draw) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    new ResizeObserver(() => {
      this.#fit();
      draw();
    }).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.#colours.clear();
      draw();
    });
    this.#fit();
  }

  #colours = new Map();

  #fit() {
    const { clientWidth, clientHeight } = this.canvas;
    const ratio = devicePixelRatio || 1;
    this.width = clientWidth;
    this.height = clientHeight;
    this.canvas.width = Math.round(clientWidth * ratio);
    this.canvas.height = Math.round(clientHeight * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  /** Colour by its name in the style sheet. */
  colour(name) {
    if (!this.#colours.has(name)) {
      this.#colours.set(name, getComputedStyle(this.canvas).getPropertyValue(`--${name}`).trim());
    }
    return this.#colours.get(name);
  }

  clear() {
    this.context.clearRect(0, 0, this.width, this.height);
  }

  text(text, x, y, align = "left", colour = "muted") {
    this.context.font = FONT;
    this.context.fillStyle = this.colour(colour);
    this.context.textAlign = align;
    this.context.textBaseline = "middle";
    this.context.fillText(text, x, y);
  }

  line(x0, y0, x1, y1, colour) {
    this.context.strokeStyle = this.colour(colour);
    this.context.lineWidth = 1;
    this.context.setLineDash([]);
    this.context.beginPath();
    this.context.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
    this.context.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
    this.context.stroke();
  }

  /** Draw what is inside a box only. */
  within(left, top, width, height, draw) {
    this.context.save();
    this.context.beginPath();
    this.context.rect(left, top, width, height);
    this.context.clip();
    draw(this.context);
    this.context.restore();
  }
}
