// The library of sessions: filters, quick looks, reports, downloads, campaigns and comparisons.

import { byId, make, setText, show } from "./dom.js";
import { clock, date, digits, megabytes, unitOf, whole, withUnit, wordsOf } from "./format.js";
import { LOW_COHERENCE, ResponsePlot } from "./response.js";
import { lookElements, modesInShort } from "./quick_look.js";

const PAGE = 50;
const PATIENCE_MS = 300;
const MOST_CURVES = 6;

export class Sessions {
  #link;
  #ticked = new Map();
  #open = new Set();
  #shown = PAGE;
  #timer = 0;
  #asked = 0;
  #plot = new ResponsePlot(
    byId("comparison-plot"), byId("comparison-keys"), byId("comparison-readout"));

  constructor(link) {
    this.#link = link;
    link.on("hello", ({ excitations = {} }) => {
      const select = byId("filters").elements.excitation;
      const names = Object.keys(excitations);
      if (select.options.length !== names.length + 1) {
        select.replaceChildren(make("option", { value: "" }, "all"),
          ...names.map((name) => make("option", {}, name)));
      }
      this.load();
    });
    link.on("session", () => this.load());
    link.on("quick_look", (told) => this.#looked(told));
    link.on("job", (job) => this.#job(job));
    byId("filters").addEventListener("input", () => {
      clearTimeout(this.#timer);
      this.#shown = PAGE;
      this.#timer = setTimeout(() => this.load(), PATIENCE_MS);
    });
    byId("filters").addEventListener("submit", (event) => event.preventDefault());
    byId("more").addEventListener("click", () => {
      this.#shown += PAGE;
      this.load();
    });
    byId("overlay").addEventListener("click", () => this.#compare());
    byId("campaign").addEventListener("click", () => this.#makeCampaign());
    byId("comparison-close").addEventListener("click", () => show(byId("comparison"), false));
    link.on("token", () => this.load());
  }

  async load() {
    const asked = ++this.#asked;
    const query = new URLSearchParams({ limit: this.#shown, offset: 0 });
    for (const [name, value] of new FormData(byId("filters"))) {
      if (value.trim()) query.set(name, value.trim());
    }
    const found = await this.#link.get(`/api/sessions?${query}`);
    if (asked !== this.#asked) return;  // a later request was faster
    if (found === null) {
      this.#say("The library of sessions cannot be read at the moment.");
      return;
    }
    this.#say("");
    setText(byId("sessions-count"), found.total === 1 ? "1 session" : `${found.total} sessions`);
    show(byId("more"), found.total > found.sessions.length);
    byId("rows").replaceChildren(...found.sessions.flatMap((session) => this.#rows(session)));
    this.#count();
  }

  #say(...lines) {
    byId("sessions-result").replaceChildren(
      ...lines.filter(Boolean).map((line) => (line instanceof Node ? line : make("p", {}, line))));
  }

  // Rows

  #rows(session) {
    const { id } = session;
    const at = session.start_utc_ns;
    const began = Number.isFinite(at) ? `${date(at)} ${clock(at)}` : id;
    const tick = make("input", {
      type: "checkbox", checked: this.#ticked.has(id), "aria-label": `Compare ${began}`,
    });
    tick.addEventListener("change", () => {
      if (tick.checked) this.#ticked.set(id, began);
      else this.#ticked.delete(id);
      this.#count();
    });
    const open = make("button", {
      type: "button", class: "link", "aria-expanded": String(this.#open.has(id)),
      title: "Show the quick look",
    }, began);
    const detail = make("tr", { class: "detail", hidden: true }, make("td", { colSpan: 8 }));
    open.addEventListener("click", () => {
      const opened = detail.hidden;
      open.setAttribute("aria-expanded", String(opened));
      if (opened) this.#open.add(id);
      else this.#open.delete(id);
      this.#fill(detail, session, opened);
    });
    if (this.#open.has(id)) this.#fill(detail, session, true);
    const row = make("tr", { id: `session-${id}` },
      make("td", { class: "tick" }, tick),
      make("td", {}, open),
      make("td", {}, session.excitation || "–"),
      make("td", { "data-label": "Specimen" }, session.specimen || "–"),
      make("td", { "data-label": "Operator" }, session.operator || "–"),
      make("td", { title: session.reason ?? "" }, make("span",
        { class: `outcome ${session.outcome}` }, session.outcome || "unknown")),
      make("td", { class: "modes" }, ...modesInShort(session.modes ?? [], session.validity)),
      make("td", { class: "files" }, ...this.#files(session)));
    return [row, detail];
  }

  #files({ id, path, report }) {
    if (path?.endsWith(".part")) return ["–"];  // without its end there is nothing to send
    const at = `/api/sessions/${encodeURIComponent(id)}`;
    const links = ["mcap", "mat", "uff"].map((ending) =>
      make("a", { href: `${at}/file.${ending}`, download: `${id}.${ending}` }, `.${ending}`));
    let first;
    if (report) {
      first = make("a", { href: `${at}/report/`, target: "_blank", rel: "noopener" }, "Report");
    } else {
      first = make("button", {
        type: "button", class: "link", disabled: !this.#link.token,
        title: this.#link.token ? "" : "Making a report needs the token",
      }, "Make report");
      first.addEventListener("click", () => this.#makeReport(id, first));
    }
    return [first, ...links].flatMap((each) => [each, " "]);
  }

  async #fill(detail, session, shown) {
    if (!shown) {
      detail.hidden = true;
      return;
    }
    const at = `/api/sessions/${encodeURIComponent(session.id)}`;
    const look = await this.#link.get(`${at}/look`);
    const facts = [
      ["Samples", Number.isFinite(session.scheduled) && samples(session)],
      ["Duration", Number.isFinite(session.duration_s) && withUnit(session.duration_s, "s")],
      ["Problem", session.problem], ["Reason", session.reason], ["Note", session.note], ["Profile", session.profile],
      ...Object.entries(session.meta ?? {}).map(([name, value]) =>
        [wordsOf(name), `${value} ${unitOf(name)}`.trim()]),
      ["File", `${session.path} (${megabytes(session.size_bytes)})`],
    ].filter(([, text]) => text);
    detail.firstChild.replaceChildren(...lookElements(look),
      make("dl", {}, ...facts.flatMap(([name, text]) =>
        [make("dt", {}, name), make("dd", {}, String(text))])));
    detail.hidden = false;
  }

  /** A quick look is there: the row's modes, and its detail if that is open. */
  #looked({ error }) {
    this.load();
    if (error) this.#say(`Quick look: ${error}`);
  }

  // Several

  #count() {
    const count = this.#ticked.size;
    setText(byId("ticked"), count ? `${count} selected` : "Select sessions to compare");
    byId("overlay").disabled = count < 1 || count > MOST_CURVES;
    byId("overlay").title = count > MOST_CURVES ? `At most ${MOST_CURVES} responses` : "";
    byId("campaign").disabled = count < 2 || !this.#link.token;
  }

  async #compare() {
    const ids = [...this.#ticked.keys()];
    this.#say("Computing the responses …");
    const found = await this.#link.get(`/api/frf?ids=${ids.map(encodeURIComponent).join(",")}`);
    if (found === null) {
      this.#say("The responses cannot be computed at the moment.");
      return;
    }
    const errors = [...(found.errors ?? [])];
    const curves = [];
    for (const response of found.responses) {
      const name = [this.#ticked.get(response.id) ?? response.id, response.specimen]
        .filter(Boolean).join(", ");
      const curve = modelCurve(response) ?? measuredCurve(response);
      if (curve) {
        curves.push({ ...curve, name: `${name}: ${curve.name}`, colour: `curve-${curves.length + 1}` });
      } else {
        errors.push(`${name}: there is no fitted model, and the coherence of the measured response `
          + "is not known: it is not shown.");
      }
    }
    this.#say(...errors);
    show(byId("comparison"), true);
    this.#plot.show(curves);
    byId("comparison").scrollIntoView({ block: "nearest" });
  }

  async #makeReport(id, button) {
    button.disabled = true;
    const reply = await this.#link.post(`/api/sessions/${encodeURIComponent(id)}/report`);
    if (!reply.ok) {
      this.#say(reply.error);
      button.disabled = false;
    }
  }

  async #makeCampaign() {
    const reply = await this.#link.post("/api/campaign", { ids: [...this.#ticked.keys()] });
    if (!reply.ok) this.#say(reply.error);
  }

  /** How a report or a campaign stands. */
  async #job({ state, kind, id, error, address }) {
    const what = kind === "campaign" ? "Campaign" : `Report of ${id}`;
    if (state === "waiting" || state === "running") {
      this.#say(`${what}: ${state}; a job waits while a session runs.`);
      return;
    }
    await this.load();
    if (error) this.#say(error);
    else if (address) {
      this.#say(make("p", {}, `${what}: `,
        make("a", { href: address, target: "_blank", rel: "noopener" }, "open the report")));
    }
  }
}

/** The fitted model of a session with its band; null if there is none. */
function modelCurve({ model }) {
  if (!model) return null;
  const { magnitude_low_95: low, magnitude_high_95: high, ...curves } = model;
  return { name: "fitted model, 95 % band", response: { ...curves, low, high } };
}

/** The measured response where its coherence is high; null if that is not known. */
function measuredCurve({ frequency_hz, magnitude, phase_rad, coherence, resolution_hz: width }) {
  if (!coherence) return null;
  const coherent = (value, k) => (coherence[k] < LOW_COHERENCE ? null : value);
  return {
    name: `measured by Welch's method, coherence above ${LOW_COHERENCE}`
      + (Number.isFinite(width) ? `, resolution ${digits(width)} Hz` : ""),
    dashed: true,
    response: {
      frequency_hz, magnitude: magnitude.map(coherent), phase_rad: phase_rad.map(coherent),
    },
  };
}

const samples = ({ recorded, scheduled, missed, late, lost }) =>
  `${whole(recorded)} of ${whole(scheduled)}, `
  + `${whole(missed)} missed, ${whole(late)} late, ${whole(lost)} lost`;
