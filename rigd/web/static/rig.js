// Zero, Tare, Check and Reset with their results; last check, and age of the calibration.

import { byId, make, setText, show } from "./dom.js";
import { age, clock, unitOf, withUnit, wordsOf } from "./format.js";

const NEEDED = { zero: ["ready"], tare: ["ready"], check: ["ready", "idle"], reset: ["fault"] };
const BUSY = { zero: "Setting the zero", tare: "Taring", check: "Checking", reset: "Resetting" };

export class Rig {
  #link;
  #state = "";
  #asked = "";

  constructor(link) {
    this.#link = link;
    link.on("status", (status) => this.#update(status));
    link.on("state", ({ to }) => this.#enable(to));
    for (const gone of ["closed", "lost"]) link.on(gone, () => this.#enable(""));
    link.on("token", () => this.#enable(this.#state));
    for (const name of Object.keys(NEEDED)) {
      byId(name).addEventListener("click", () => this.#ask(name));
    }
    byId("fault-reset").addEventListener("click", () => this.#ask("reset"));
    this.#enable("");
  }

  #enable(state) {
    this.#state = state;
    for (const [name, states] of Object.entries(NEEDED)) {
      byId(name).disabled = !this.#link.token || Boolean(this.#asked) || !states.includes(state);
    }
    byId("fault-reset").disabled = byId("reset").disabled;
  }

  #update(status) {
    const { last_check: check, daemon } = status;
    setText(byId("last-check"), check
      ? `${check.verdict}, ${age(check.utc_ns)}` : "none since the daemon started");
    setText(byId("calibration"), calibrationText(daemon?.calibration));
    setText(byId("output"), daemon?.output ?? "–");
    const path = status.series?.path;
    show(byId("fault-last"), Boolean(path));
    setText(byId("fault-last"), path ? `The session's file: ${path}` : "");
    const view = status.rig?.live_view;
    show(byId("rerun"), Boolean(view?.url));
    if (view?.url) byId("rerun").href = view.url;
    this.#enable(status.doing ? "busy" : status.state);
  }

  async #ask(name) {
    this.#asked = name;
    this.#enable(this.#state);
    const place = byId("rig-result");
    place.replaceChildren(make("p", { class: "muted" }, `${BUSY[name]} …`));
    const reply = await this.#link.command(name);
    this.#asked = "";
    this.#enable(this.#state);
    place.replaceChildren(...(reply.ok
      ? RESULTS[name](reply) : [make("p", { class: "refused" }, reply.error)]));
  }
}

const at = () => `${clock(Date.now() * 1e6)} `;

const RESULTS = {
  zero: ({ moved_rad: moved }) => [
    make("p", {}, `${at()}Zero set (shift ${withUnit(moved, "rad")}).`)],
  reset: ({ zero_lost: lost }) => [
    make("p", {}, `${at()}Fault reset.`),
    ...(lost ? [make("p", { class: "refused" },
      "The zero is lost: move the motor to mid-travel and press Zero.")] : [])],
  tare: ({ mean, std, torque_std_nm: torque }) => [
    make("p", {}, `${at()}Tare; s.d. of the coupling torque ${withUnit(torque, "N·m")}.`),
    make("table", {}, make("thead", {}, make("tr", {}, ...["Axis", "Mean", "S.d."].map((text) =>
      make("th", { scope: "col" }, text)))),
    make("tbody", {}, ...Object.keys(mean).map((axis) => make("tr", {},
      make("td", {}, wordsOf(axis)), make("td", {}, withUnit(mean[axis], unitOf(axis))),
      make("td", {}, withUnit(std[axis], unitOf(axis), 2))))))],
  check: ({ rows, verdict }) => {
    const found = (...statuses) => rows.filter(({ status }) => statuses.includes(status));
    const rest = found("ok", "skipped");
    return [
      make("p", {}, make("b", {}, `${at()}Check: ${verdict}`)),
      checkRows([...found("failed"), ...found("warning")]),
      make("details", {}, make("summary", {}, `${rest.length} more, OK or skipped`),
        checkRows(rest))];
  },
};

const checkRows = (rows) => make("ul", { class: "check-rows" },
  ...rows.map(({ what, status, text, remedy }) => make("li", { class: status },
    make("b", {}, status), ` ${what}: ${text}`,
    remedy && status !== "ok" ? make("div", { class: "muted" }, remedy) : null)));

/** Serial number of the sensor, date and age of its calibration; not every sensor tells them. */
function calibrationText(calibration) {
  if (!calibration) return "not read yet";
  const { serial, age: made } = calibration;
  const date = Date.parse(made);  // some sensors tell a date, others whatever was typed in
  const old = Number.isFinite(date) ? ` (${age(date * 1e6)})` : "";
  return [serial, made && `${made}${old}`].filter(Boolean).join(", ") || "not stated by the sensor";
}
