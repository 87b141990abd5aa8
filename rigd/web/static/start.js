// The form that starts a session: excitation and parameters, notes, metadata; Predict, then Start.

import { byId, make, setText, show } from "./dom.js";
import { unitOf, wordsOf } from "./format.js";
import { Prediction } from "./prediction.js";

const OPERATOR = "rigd-operator";
const NOTES = ["operator", "specimen", "note"];  // metadata with a field of their own
const PLACEHOLDERS = {
  path: "/absolute/path, read by the daemon",
  targets: "damping 1%; frequency 2:0.01%; alpha 0.03",
};

export class StartForm {
  #link;
  #excitations = {};
  #inputs = new Map();
  #prediction = new Prediction((amplitude) => this.#take(amplitude));
  #state = "";
  #failedChecks = "";  // of the profile, as the daemon reported them last

  constructor(link) {
    this.#link = link;
    link.on("hello", (hello) => this.#offer(hello));
    link.on("status", (status) => {
      setText(byId("what-moves"), status.daemon?.what_moves ?? "");
      this.#showFailedChecks(status.daemon?.failed_checks ?? []);
      this.#enable(status.doing ? "busy" : status.state);
    });
    link.on("state", ({ to }) => this.#enable(to));
    for (const gone of ["closed", "lost"]) link.on(gone, () => this.#enable(""));
    link.on("token", () => this.#enable(this.#state));
    byId("excitation").addEventListener("change", () => this.#choose());
    byId("metadata-add").addEventListener("click", () => this.#addValue().name.focus());
    byId("predict").addEventListener("click", () => this.#predict());
    const form = byId("start-form");
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#start();
    });
    form.addEventListener("input", () => this.#prediction.outdate());
    byId("operator").value = localStorage.getItem(OPERATOR) ?? "";
    this.#enable("");
  }

  #enable(state) {
    this.#state = state;
    const right = Boolean(this.#link.token);
    show(byId("read-only"), !right);
    byId("start-button").disabled = !(right && state === "ready");
    byId("predict").disabled = !["ready", "running", "stopping", "fault"].includes(state);
  }

  // What can be chosen

  #offer({ excitations = {}, specimens = [], required_meta: required = [] }) {
    byId("specimens").replaceChildren(...specimens.map((specimen) =>
      make("option", { value: specimen.name ?? specimen })));
    for (const name of NOTES) {
      byId(name).required = required.includes(name);
      byId(name).placeholder = required.includes(name) ? "required" : "";
    }
    for (const name of required.filter((each) => !NOTES.includes(each))) {
      if (!this.#pairs().some((pair) => pair.name.value === name)) this.#addValue(name);
    }
    // The same daemon again: what has been typed stays.
    if (JSON.stringify(excitations) === JSON.stringify(this.#excitations)) return;
    this.#excitations = excitations;
    byId("excitation").replaceChildren(
      ...Object.keys(excitations).map((name) => make("option", { value: name }, name)));
    this.#choose();
  }

  #choose() {
    this.#inputs.clear();
    const fields = (this.#excitations[byId("excitation").value] ?? []).map((parameter) =>
      this.#field(parameter));
    byId("parameters").replaceChildren(...fields);
    show(byId("watch-fit-choice"), byId("excitation").value !== "until");  // which is fitted anyway
    this.#prediction.clear();
    byId("start-result").replaceChildren();
  }

  #field({ name, unit, default: usual, help, text = false }) {
    const isText = text || name === "path";
    const known = usual !== null && usual !== undefined;
    const input = make("input", {
      id: `parameter-${name}`, value: known ? String(usual) : "", title: help ?? "",
      inputMode: isText ? "text" : "decimal",
    });
    if (isText) input.placeholder = PLACEHOLDERS[name] ?? "";
    input.addEventListener("change", () => this.#parsed(name));
    this.#inputs.set(name, { input, isText, unit: unit || unitOf(name) });
    return make("label", { class: isText ? "field wide" : "field", title: known
      ? `${help ?? ""} Default: ${usual} ${unit ?? ""}`.trim() : help ?? "" },
    wordsOf(name), make("span", { class: "with-unit" }, input,
      make("span", { class: "unit" }, unit || unitOf(name))));
  }

  #take(amplitude) {
    const { input } = this.#inputs.get("amplitude_rad");
    input.value = String(amplitude);
    input.setAttribute("aria-invalid", "false");
    this.#predict();
  }

  #showFailedChecks(rows) {
    const found = JSON.stringify(rows);
    if (found === this.#failedChecks) return;  // else a prediction's, with another specimen, go on
    this.#failedChecks = found;
    this.#offerAcceptance(rows);
  }

  /** List the failed rows of check; those that can be accepted get a box, for one start. */
  #offerAcceptance(rows) {
    show(byId("failed-checks"), rows.length > 0);
    const ticked = this.#accepted();
    byId("failed-rows").replaceChildren(...rows.map(({ name, text, acceptable }) =>
      make("label", { class: "check" },
        acceptable
          ? make("input", { type: "checkbox", value: name, checked: ticked.includes(name) }) : null,
        make("span", {}, make("span", { class: "refused" }, `${name}: ${text}`),
          acceptable ? ` Accept it for this start (--accept ${name}).` : ""))));
  }

  #accepted() {
    return [...byId("failed-rows").querySelectorAll("input:checked")].map(({ value }) => value);
  }

  // Metadata

  #pairs() {
    return [...byId("metadata-rows").children].map((row) => {
      const [name, value] = row.querySelectorAll("input");
      return { name, value };
    });
  }

  #addValue(required = "") {
    const name = make("input", {
      value: required, readOnly: Boolean(required), placeholder: "temperature_c",
      "aria-label": "Name of the value, its unit at the end",
    });
    const value = make("input", {
      placeholder: required ? "required" : "21.4", "aria-label": `Value of ${required || "it"}`,
    });
    const remove = make("button", { type: "button", "aria-label": "Remove the value" }, "×");
    const row = make("div", { class: "pair" }, name, value, required ? null : remove);
    remove.addEventListener("click", () => row.remove());
    byId("metadata-rows").append(row);
    return { name, value };
  }

  // Request

  /** Value of a parameter: undefined where the default is meant, null where it is not a number. */
  #parsed(name) {
    const { input, isText, unit } = this.#inputs.get(name);
    const text = input.value.trim();
    if (text === "") return undefined;
    if (isText) return text;
    const value = Number(text.replace(/^([-+]?\d*),(\d+)$/, "$1.$2"));
    input.setAttribute("aria-invalid", String(!Number.isFinite(value)));
    if (Number.isFinite(value)) return value;
    this.#say(`${wordsOf(name)} ${text} is not a number; give one in ${unit || "digits"}.`);
    return null;
  }

  /** The request as the form has it; null if a value cannot be sent, which was said then. */
  #request() {
    byId("start-result").replaceChildren();
    const parameters = {};
    for (const name of this.#inputs.keys()) {
      const value = this.#parsed(name);
      if (value === null) return null;
      if (value !== undefined) parameters[name] = value;
    }
    const repeat = Number(byId("repeat").value || "1");
    if (!Number.isInteger(repeat)) {
      this.#say(`Repeat ${byId("repeat").value} is not a whole number; give one from 1 to 1000.`);
      return null;
    }
    const notes = {};
    for (const name of NOTES) {
      const text = byId(name).value.trim();
      if (text) notes[name] = text;
    }
    const meta = {};
    for (const { name, value } of this.#pairs()) {
      const text = value.value.trim();
      if (!text) continue;
      const number = Number(text.replace(/^([-+]?\d+),(\d+)$/, "$1.$2"));
      meta[name.value.trim()] = unitOf(name.value.trim()) && Number.isFinite(number) ? number : text;
    }
    if (Object.keys(meta).length) notes.meta = meta;
    const force = byId("force").checked;
    const slope = this.#tipSlope();
    if (slope === null) return null;
    const excitation = byId("excitation").value;
    const watch = byId("watch-fit").checked && excitation !== "until" ? { watch_fit: true } : {};
    const accepted = this.#accepted();
    const accept = accepted.length ? { accept: accepted } : {};
    return { excitation, parameters, repeat, notes, force, ...watch, ...accept, ...slope };
  }

  /** The limit of the tip's slope for this session, as a member; null if it is not a number. */
  #tipSlope() {
    const text = byId("tip-slope").value.trim();
    if (text === "") return {};
    const value = Number(text.replace(/^(\d*),(\d+)$/, "$1.$2"));
    byId("tip-slope").setAttribute("aria-invalid", String(!(value > 0 && Number.isFinite(value))));
    if (value > 0 && Number.isFinite(value)) return { tip_slope_rad: value };
    this.#say(`Tip slope limit ${text} is not a number above 0; give one in rad.`);
    return null;
  }

  async #predict() {
    const request = this.#request();
    if (request === null) return;
    const reply = await this.#link.command("predict", request);
    if (!reply.ok) {
      this.#prediction.clear();
      this.#say(reply.error);
      return;
    }
    this.#offerAcceptance(reply.plan.failed_checks ?? []);
    this.#prediction.show(reply.plan, reply.largest_amplitude_rad);
  }

  async #start() {
    const request = this.#request();
    if (request === null || byId("start-button").disabled) return;
    localStorage.setItem(OPERATOR, byId("operator").value.trim());
    byId("start-button").disabled = true;  // until the state is told again: one press, one session
    const reply = await this.#link.command("start", request);
    if (reply.ok) {
      // For one session: the next one is asked for again.
      byId("force").checked = false;
      for (const box of byId("failed-rows").querySelectorAll("input")) box.checked = false;
      byId("tip-slope").value = "";
      this.#prediction.show(reply.plan, null);
    } else {
      this.#enable(this.#state);
      this.#say(reply.error);
    }
  }

  #say(text) {
    const lines = String(text).split("\n");
    byId("start-result").replaceChildren(
      ...lines.map((line) => make("p", { class: "refused" }, line)));
  }
}
