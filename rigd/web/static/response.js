// Frequency responses: magnitude and phase over frequency; the growing one, and comparisons.

import { byId, make, setText } from "./dom.js";
import { Surface, roundStep, roundTicks, tickText } from "./canvas.js";
import { digits, minus } from "./format.js";

const FIRST_HZ = 0.5;  // below it the antenna's torque is lost in the sensor's noise
const LAST_HZ = 60;
export const LOW_COHERENCE = 0.8;
const PHASE_FROM = -90;  // phases lie about 0° and 180°; cut here, they do not jump
const LEFT = 52;
const RIGHT = 6;
const TOP = 6;
const BOTTOM = 20;
const BETWEEN = 14;
const PHASE_SHARE = 0.3;

const decibels = (magnitude) => 20 * Math.log10(magnitude);

const degrees = (radians) => {
  const turn = ((radians * 180) / Math.PI - PHASE_FROM) % 360;
  return (turn < 0 ? turn + 360 : turn) + PHASE_FROM;
};

const known = (value) => value !== null && Number.isFinite(value);

/** A plot of some responses; the first of them is what low coherence is shown of. */
export class ResponsePlot {
  #surface;
  #curves = [];
  #pointer = null;
  #span = [-40, 20];

  constructor(canvas, keys, readout) {
    this.canvas = canvas;
    this.keys = keys;
    this.readout = readout;
    this.#surface = new Surface(canvas, () => this.draw());
    canvas.addEventListener("pointermove", (event) => this.#point(event.offsetX));
    canvas.addEventListener("pointerdown", (event) => this.#point(event.offsetX));
    canvas.addEventListener("pointerleave", () => this.#point(null));
  }

  /**
   * @param {{name: string, colour: string, dashed: boolean, width: number, response: object}[]}
   *   curves - with `frequency_hz`, `magnitude` (N·m/rad), `phase_rad` and perhaps `coherence`;
   *   `reached_hz` of the first: how far its sweep is; `low` and `high`: limits of a band of the
   *   magnitude
   */
  show(curves) {
    this.#curves = curves.filter(({ response }) => response?.frequency_hz.length > 1);
    this.#label();
    this.draw();
  }

  #label() {
    const entries = this.#curves.map(({ name, colour }) => [colour, name]);
    const first = this.#curves[0]?.response;
    if (first && (first.coherence || known(first.reached_hz))) {
      entries.push(["shade", `not reached, or coherence below ${LOW_COHERENCE}`]);
    }
    const texts = JSON.stringify(entries);
    if (this.keys.dataset.shown !== texts) {
      this.keys.dataset.shown = texts;
      this.keys.replaceChildren(
        ...entries.map(([colour, name]) => make("span", { class: `key ${colour}` }, name)));
    }
    const names = this.#curves.map(({ name }) => name).join(", ");
    this.canvas.setAttribute("aria-label", names
      ? `Magnitude and phase of the frequency response, ${FIRST_HZ} to ${LAST_HZ} Hz: ${names}`
      : "Frequency response: no data yet");
  }

  #point(x) {
    this.#pointer = x;
    this.draw();
  }

  /** Span of the magnitude in dB, in steps of 10, and grown rather than changed. */
  #magnitudes() {
    const values = [];
    for (const { response } of this.#curves) {
      response.frequency_hz.forEach((frequency, k) => {
        const magnitude = response.magnitude[k];
        if (frequency >= FIRST_HZ && frequency <= LAST_HZ && known(magnitude) && magnitude > 0) {
          values.push(decibels(magnitude));
        }
      });
    }
    if (values.length === 0) return this.#span;
    const low = Math.floor((Math.min(...values) - 2) / 10) * 10;
    const high = Math.ceil((Math.max(...values) + 2) / 10) * 10;
    const enough = low >= this.#span[0] && high <= this.#span[1]
      && high - low > 0.6 * (this.#span[1] - this.#span[0]);
    if (!enough) this.#span = [low, high];
    return this.#span;
  }

  draw() {
    const surface = this.#surface;
    const { width, height } = surface;
    if (width === 0) return;
    const inner = width - LEFT - RIGHT;
    const all = height - TOP - BOTTOM - BETWEEN;
    const magnitude = { top: TOP, height: all * (1 - PHASE_SHARE) };
    const phase = { top: TOP + magnitude.height + BETWEEN, height: all * PHASE_SHARE };
    const [low, high] = this.#magnitudes();
    const decades = Math.log(LAST_HZ / FIRST_HZ);
    const x = (frequency) => LEFT + (inner * Math.log(frequency / FIRST_HZ)) / decades;
    const yMagnitude = (value) =>
      magnitude.top + (magnitude.height * (high - decibels(value))) / (high - low);
    const yPhase = (value) =>
      phase.top + (phase.height * (PHASE_FROM + 360 - degrees(value))) / 360;
    surface.clear();
    for (const panel of [magnitude, phase]) this.#shade(panel, x, inner);
    this.#grid(x, magnitude, phase, low, high);
    for (const [panel, y, member] of [
      [magnitude, yMagnitude, "magnitude"], [phase, yPhase, "phase_rad"],
    ]) {
      surface.within(LEFT, panel.top, inner, panel.height, (context) => {
        // The first one last: what is measured lies on top.
        for (const curve of [...this.#curves].reverse()) {
          if (member === "magnitude") this.#band(context, curve, x, y);
          this.#curve(context, curve, member, x, y, panel.height);
        }
      });
    }
    if (this.#curves.length === 0) {
      surface.text("The response appears here during a session.", LEFT + inner / 2,
        magnitude.top + magnitude.height / 2, "center");
    }
    this.#read(x, inner, magnitude, phase);
  }

  #grid(x, magnitude, phase, low, high) {
    const surface = this.#surface;
    const right = surface.width - RIGHT;
    const bottom = phase.top + phase.height;
    for (const frequency of [0.5, 1, 2, 5, 10, 20, 50]) {
      surface.line(x(frequency), magnitude.top, x(frequency), magnitude.top + magnitude.height, "grid");
      surface.line(x(frequency), phase.top, x(frequency), bottom, "grid");
      surface.text(frequency === 50 ? "50 Hz" : String(frequency), x(frequency), bottom + 11, "center");
    }
    surface.text("Magnitude (dB re 1 N·m/rad)", LEFT + 6, magnitude.top + 10);
    surface.text("Phase", LEFT + 6, phase.top + 10);
    const step = roundStep(high - low, 7);
    for (const tick of roundTicks(low, high, 7)) {
      const y = magnitude.top + (magnitude.height * (high - tick)) / (high - low);
      surface.line(LEFT, y, right, y, "grid");
      surface.text(tickText(tick, step), LEFT - 6, y, "right");
    }
    for (const tick of [0, 180]) {
      const y = phase.top + (phase.height * (PHASE_FROM + 360 - tick)) / 360;
      surface.line(LEFT, y, right, y, "grid");
      surface.text(`${tick}°`, LEFT - 6, y, "right");
    }
  }

  /** Grey what the sweep has not reached, and where the coherence is low. */
  #shade(panel, x, inner) {
    const response = this.#curves[0]?.response;
    if (!response || (!response.coherence && !known(response.reached_hz))) return;
    const surface = this.#surface;
    surface.within(LEFT, panel.top, inner, panel.height, (context) => {
      context.fillStyle = surface.colour("shade");
      const { frequency_hz: at, magnitude, coherence, reached_hz: reached } = response;
      for (let k = 0; k + 1 < at.length; k += 1) {
        const beyond = known(reached) && at[k] >= reached;
        const doubtful = known(coherence?.[k]) && coherence[k] < LOW_COHERENCE;
        if (!beyond && (doubtful || !known(magnitude[k]))) {
          const from = x(k ? Math.sqrt(at[k - 1] * at[k]) : at[k]);
          context.fillRect(from, panel.top, x(Math.sqrt(at[k] * at[k + 1])) - from, panel.height);
        }
      }
      if (known(reached) && reached < LAST_HZ) {
        const from = x(Math.max(reached, FIRST_HZ));
        context.fillRect(from, panel.top, LEFT + inner - from, panel.height);
      }
    });
  }

  /** Fill the band of the magnitude, of a curve that has one. */
  #band(context, { colour, response }, x, y) {
    const { frequency_hz: at, low, high } = response;
    if (!low || !high) return;
    context.fillStyle = this.#surface.colour(colour);
    context.globalAlpha = 0.25;
    context.beginPath();
    at.forEach((frequency, k) => context.lineTo(x(frequency), y(high[k])));
    for (let k = at.length - 1; k >= 0; k -= 1) context.lineTo(x(at[k]), y(low[k]));
    context.fill();
    context.globalAlpha = 1;
  }

  #curve(context, { colour, dashed, width, response }, member, x, y, height) {
    context.strokeStyle = this.#surface.colour(colour);
    context.lineWidth = width ?? 1.6;
    context.setLineDash(dashed ? [6, 4] : []);
    context.lineJoin = "round";
    context.beginPath();
    let before = null;
    response.frequency_hz.forEach((frequency, k) => {
      const value = response[member][k];
      const shown = known(value) && (member !== "magnitude" || value > 0)
        && !(known(response.reached_hz) && frequency > response.reached_hz);
      if (!shown) {
        before = null;
        return;
      }
      const at = y(value);
      // A phase that goes around the cut is not drawn across the plot.
      const jumps = member === "phase_rad" && before !== null && Math.abs(at - before) > height / 2;
      context[before === null || jumps ? "moveTo" : "lineTo"](x(frequency), at);
      before = at;
    });
    context.stroke();
  }

  /** Read the curves where the pointer is. */
  #read(x, inner, magnitude, phase) {
    const pointer = this.#pointer;
    if (pointer === null || pointer < LEFT || pointer > LEFT + inner || !this.#curves.length) {
      setText(this.readout, "");
      return;
    }
    const frequency = FIRST_HZ * (LAST_HZ / FIRST_HZ) ** ((pointer - LEFT) / inner);
    for (const panel of [magnitude, phase]) {
      this.#surface.line(pointer, panel.top, pointer, panel.top + panel.height, "muted");
    }
    const { response } = this.#curves[0];
    const k = nearest(response.frequency_hz, frequency);
    const parts = [`${digits(response.frequency_hz[k])} Hz`];
    if (known(response.magnitude[k]) && response.magnitude[k] > 0) {
      parts.push(`${minus(decibels(response.magnitude[k]).toFixed(1))} dB`);
      parts.push(`${minus(degrees(response.phase_rad[k]).toFixed(0))}°`);
    }
    if (known(response.coherence?.[k])) parts.push(`coherence ${response.coherence[k].toFixed(3)}`);
    setText(this.readout, parts.join(", "));
  }
}

/** Index of the nearest of ascending values. */
function nearest(values, wanted) {
  let best = 0;
  values.forEach((value, k) => {
    if (Math.abs(value - wanted) < Math.abs(values[best] - wanted)) best = k;
  });
  return best;
}

/** The response as it grows, over the nominal model and the last session of the specimen. */
export class LiveResponse {
  #plot = new ResponsePlot(byId("response-plot"), byId("response-keys"), byId("response-readout"));
  #measured = null;
  #nominal = null;
  #last = null;

  constructor(link) {
    link.on("response", (response) => this.#set(() => { this.#measured = response; }));
    link.on("last", (response) => this.#set(() => { this.#last = response; }));
    // It comes first, and again with each session of a series: the others were of the one before.
    link.on("nominal", (response) => this.#set(() => {
      this.#nominal = response;
      this.#measured = this.#last = null;
    }));
  }

  #set(change) {
    change();
    const curves = [];
    if (this.#measured) {
      curves.push({ name: "measured", colour: "measured", width: 2, response: this.#measured });
    }
    if (this.#last) {
      const specimen = this.#last.specimen ? ` (${this.#last.specimen})` : "";
      curves.push({ name: `last session${specimen}`, colour: "last", response: this.#last });
    }
    if (this.#nominal) {
      curves.push({
        name: "nominal model", colour: "nominal", dashed: true, response: this.#nominal,
      });
    }
    this.#plot.show(curves);
  }
}
