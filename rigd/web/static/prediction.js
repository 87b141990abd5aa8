// A predicted session: peaks against their limits, and the largest amplitude that passes.

import { byId, make } from "./dom.js";
import { digits, level, withUnit } from "./format.js";
import { toneOf } from "./gauges.js";

/**
 * A bar of a value in parts of its limit.
 * @param {string} name
 * @param {number} value
 * @param {number|undefined} limit - without one there is no bar
 * @param {string} unit
 */
function peakBar(name, value, limit, unit) {
  const limited = Number.isFinite(limit) && limit > 0;
  const fraction = limited ? value / limit : 0;
  const text = limited ? `${digits(value)} of ${level(limit)} ${unit}` : withUnit(value, unit);
  const fill = make("div", { class: "fill" });
  fill.style.transform = `scaleX(${Math.min(fraction, 1)})`;
  return make("div", { class: `bar-row ${toneOf(fraction)}` },
    make("span", {}, name), make("span", { class: "number" }, text),
    limited ? make("div", { class: "track" }, fill) : null);
}

export class Prediction {
  /** @param {function(number): void} take - called with the amplitude that is to be taken */
  constructor(take) {
    this.place = byId("prediction");
    this.take = take;
  }

  clear() {
    this.place.replaceChildren();
  }

  /** What is shown was predicted of other values than the form has now. */
  outdate() {
    this.place.classList.add("outdated");
  }

  /**
   * @param {object} plan - as in the reply to `predict` and `start`
   * @param {number|null|undefined} largest - amplitude in rad that all limits allow
   */
  show(plan, largest) {
    const limits = plan.limits ?? {};
    const bars = [
      peakBar("Angle", plan.peak_angle_rad, limits.angle_rad, "rad"),
      peakBar("Speed", plan.peak_velocity_rad_s, limits.velocity_rad_s, "rad/s"),
      peakBar("Torque", plan.peak_torque_nm, limits.torque_nm, "N·m"),
    ];
    const { tip } = plan;
    if (tip) {
      bars.push(peakBar("Tip slope, linear model", tip.slope_rad, limits.tip_slope_rad, "rad"));
      if (tip.physical !== false) {
        bars.push(peakBar("Tip deflection", 1e3 * tip.deflection_m, undefined, "mm"));
        bars.push(peakBar("Tip speed", tip.speed_m_s, undefined, "m/s"));
      }
    }
    if (tip && plan.tip_in_words) bars.push(make("p", { class: "muted" }, plan.tip_in_words));
    const words = [];
    if (plan.refused) words.push(make("p", { class: "refused" }, plan.refused));
    for (const warning of plan.warnings ?? []) {
      words.push(make("p", { class: "refused" }, `Warning: ${warning}`));
    }
    this.place.classList.remove("outdated");
    this.place.replaceChildren(
      make("h3", {}, `Predicted peaks (record of ${digits(plan.record_s)} s)`), ...bars,
      this.#largest(largest), ...words);
  }

  #largest(largest) {
    if (!Number.isFinite(largest)) return "";
    // Rounded down: what is offered must pass.
    const power = 10 ** (Math.floor(Math.log10(largest)) - 2);
    const rounded = Number((Math.floor(largest / power + 1e-9) * power).toPrecision(3));
    const button = make("button", { type: "button", class: "small", id: "take-largest" }, "Use it");
    button.addEventListener("click", () => this.take(rounded));
    return make("div", { class: "largest" },
      make("span", {}, `Largest allowed: ${withUnit(rounded, "rad")}`), button);
  }
}
