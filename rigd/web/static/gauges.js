// Live signals in per cent of their limits, and how the session's ticks go.

import { byId, make, setText } from "./dom.js";
import { digits, whole } from "./format.js";

/** From here on a signal is near its limit, as the interlocks warn (docs/safety.md). */
const NEAR = 0.8;

const SIGNALS = {
  angle: "Angle", velocity: "Speed", tracking_error: "Tracking error",
  torque_command: "Torque command", i2t: "Motor load (i²t)",
};
const AXES = ["fx", "fy", "fz", "tx", "ty", "tz"];

/** Class of a share of a limit. */
export const toneOf = (fraction) => (fraction >= 1 ? "over" : fraction >= NEAR ? "near" : "");

export class Gauges {
  #rows = new Map();

  constructor(link) {
    const place = byId("gauges");
    const signals = make("div", {});
    for (const [name, title] of Object.entries(SIGNALS)) signals.append(this.#row(name, title));
    const axes = make("div", { class: "split" });
    for (const name of AXES) axes.append(this.#row(name, name));
    place.append(signals, axes, make("p", { class: "note" }, "Per cent of the limit; fx to tz: axes of the sensor."));
    link.on("gauges", (gauges) => this.#update(gauges));
    for (const gone of ["closed", "lost"]) link.on(gone, () => this.#update({}));
    link.on("status", (status) => this.#count(status));
    link.on("progress", (progress) => this.#ticks(progress));
    this.#count(null);
  }

  #row(name, title) {
    const percent = make("span", { class: "percent" }, "–");
    const fill = make("div", { class: "fill" });
    const row = make("div", { class: "gauge", id: `gauge-${name}` },
      make("span", {}, title), make("div", { class: "track" }, fill), percent);
    this.#rows.set(name, { row, fill, percent });
    return row;
  }

  #update(gauges) {
    for (const [name, { row, fill, percent }] of this.#rows) {
      const gauge = gauges[name];
      const fraction = gauge?.fraction;
      const known = Number.isFinite(fraction);
      row.className = `gauge ${known ? toneOf(fraction) : ""}`;
      fill.style.transform = `scaleX(${known ? Math.min(Math.max(fraction, 0), 1) : 0})`;
      const value = gauge && Number.isFinite(gauge.value)
        ? `${digits(gauge.value)} ${gauge.unit}` : "–";
      setText(percent, known ? `${Math.round(100 * fraction)} %` : value);
      row.title = known ? `${value} of ${digits(gauge.limit)} ${gauge.unit}` : value;
    }
  }

  #count(status) {
    const { health = {}, signals } = status?.rig ?? {};
    this.#fill({
      missed: [whole(health.missed), "missed"],
      late: [whole(health.late), "late"],
      lost: [whole(health.lost), "lost"],
      latency: [signals ? `${whole(signals.lateness_p50_us)}/${whole(signals.lateness_p99_us)} µs`
        : "–", "wake-up latency p50/p99"],
      disk: [Number.isFinite(health.disk_free_mb) ? `${digits(health.disk_free_mb / 1e3)} GB` : "–",
        "disk free"],
    });
  }

  #ticks({ missed, late, lost }) {
    for (const [name, value] of Object.entries({ missed, late, lost })) {
      this.#counted(name, whole(value));
    }
  }

  #fill(values) {
    const list = byId("counts");
    for (const [name, [value, words]] of Object.entries(values)) {
      if (!byId(`count-${name}`)) {
        list.append(make("li", {}, make("b", { id: `count-${name}` }), ` ${words}`));
      }
      this.#counted(name, value);
    }
  }

  #counted(name, value) {
    const shown = byId(`count-${name}`);
    setText(shown, value);
    shown.parentElement.classList.toggle(
      "near", (name === "missed" || name === "lost") && value !== "0" && value !== "–");
  }
}
