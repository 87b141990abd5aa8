// Fits of the record while it is recorded: what is asked for, and modes with shrinking intervals.

import { byId, make, setText, show } from "./dom.js";
import { digits, withHalfWidth } from "./format.js";

export class Fit {
  #session = "";
  /** Widest 95 % interval of this session, by mode and quantity: what is drawn is a part of it. */
  #widest = new Map();

  constructor(link) {
    link.on("status", ({ series }) => this.#update(series));
  }

  #update(series) {
    const fit = series?.fit;
    const searches = series?.excitation === "until";
    show(byId("fit"), Boolean(fit) || Boolean(searches && series.running));
    if (series?.path !== this.#session) {
      this.#session = series?.path ?? "";
      this.#widest.clear();
    }
    setText(byId("fit-of"), fit?.duration_s === undefined ? "not yet"
      : `first ${fit.duration_s.toFixed(1)} s of the record, ± 95 %, statistical only`);
    setText(byId("fit-search"), searchInWords(fit?.search));
    byId("fit-result").replaceChildren(
      this.#targets(fit?.search?.targets ?? []), this.#modes(fit?.modes ?? []),
      ...[fit?.modes?.length ? fit.validity?.sentence : "",
        fit?.modes?.length ? fit.validity?.uniform_beam?.sentence : "", fit?.problem,
        ...doubts(fit?.modes ?? []), ...(fit?.findings ?? [])].filter(Boolean).map((text) =>
        make("p", { class: "muted" }, text)));
  }

  #targets(targets) {
    if (!targets.length) return "";
    return table("fit-targets", ["Quantity", "Standard deviation", "Requested", "Information"],
      targets.map(({ name, value, std, asked_std: asked, doubt }) => {
        const known = Number.isFinite(std) && Number.isFinite(asked) && std > 0;
        // Information grows with time, once what tells most is excited; deviations go slower.
        const share = known ? Math.min((asked / std) ** 2, 1) : 0;
        const fill = make("div", { class: "fill" });
        fill.style.transform = `scaleX(${share})`;
        return [name, known ? deviation(std, value) : "–", deviation(asked, value),
          make("div", { class: share < 1 ? "share" : "share reached", title: doubt ?? "" },
            make("div", { class: "track" }, fill),
            make("span", {}, known ? `${Math.floor(100 * share)} %` : "–"))];
      }));
  }

  #modes(modes) {
    const shown = modes.filter((mode) => mode.shown !== false);
    if (!shown.length) return "";
    return table("fit-modes", ["Mode", "Frequency (Hz)", "Damping ratio (%)"],
      shown.map(({ mode, frequency_hz: frequency, damping_ratio: damping }) => [String(mode),
        this.#cell(`${mode} f`, frequency, 1), this.#cell(`${mode} d`, damping, 100)]));
  }

  #cell(name, found, factor) {
    const ends = found.flag ? null : found.interval_95;
    if (!ends) {
      return make("span", { title: found.flag ?? "" }, `${digits(factor * found.value)} (doubtful)`);
    }
    const half = (ends[1] - ends[0]) / 2;
    const widest = Math.max(this.#widest.get(name) ?? 0, half);
    this.#widest.set(name, widest);
    const width = make("div", { class: "fill" });
    width.style.transform = `scaleX(${widest > 0 ? half / widest : 0})`;
    return make("div", { class: "interval", title: "95 % interval, of the widest in this session" },
      make("span", {}, withHalfWidth(factor * found.value, factor * half)),
      make("div", { class: "track" }, width));
  }
}

function table(id, heads, rows) {
  return make("table", { id },
    make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { scope: "col" }, text)))),
    make("tbody", {}, ...rows.map((cells) =>
      make("tr", {}, ...cells.map((cell) => make("td", {}, cell))))));
}

/** Why numbers of modes are doubtful, each reason once. */
function doubts(modes) {
  const flags = modes.filter((mode) => mode.shown !== false)
    .flatMap((mode) => [mode.frequency_hz.flag, mode.damping_ratio.flag]).filter(Boolean);
  return [...new Set(flags)].map((flag) => `Doubtful: ${flag}.`);
}

/** A standard deviation as it is and in per cent of its value. */
function deviation(std, value) {
  if (!Number.isFinite(std)) return "–";
  const share = value ? ` (${digits(100 * std / Math.abs(value), 2)} %)` : "";
  return `${digits(std, 2)}${share}`;
}

function searchInWords(search) {
  if (search?.reason) return search.reason;
  return Number.isFinite(search?.left_s) ? `About ${Math.ceil(search.left_s)} s more.` : "";
}
