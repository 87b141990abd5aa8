// Quick look at a session: modes with intervals, what is flagged, and against the last session.

import { make } from "./dom.js";
import { estimate, level } from "./format.js";

/** What is said of numbers from a daemon or a look of before an update. */
const NOT_KNOWN = "The slope of the tip, and with it the error of the linear model, is unknown.";

const KG_MM2 = 1e6;

/** Models that modes are of, in words. */
const SOURCES = { modal: "modal model", beam: "beam" };

/** What is said of the validity: slope of the tip, and whether a uniform beam predicts the modes. */
const sentences = (validity) =>
  [validity?.sentence ?? NOT_KNOWN, validity?.uniform_beam?.sentence].filter(Boolean);

const flagsOf = ({ frequency_hz: frequency, damping_ratio: damping }) =>
  [...new Set([frequency?.flag, damping?.flag].filter(Boolean))].join(" ");

/** Modes in short, as a cell of the table of sessions has them. */
export function modesInShort(modes, validity) {
  const shown = modes.slice(0, 3);
  const parts = shown.map((mode) => {
    const { frequency_hz: frequency, damping_ratio: damping } = mode;
    return make("span", { class: "line" }, `${estimate(frequency, 1, 1).value} Hz, `
      + `${estimate(damping, 100, 1).value} %${flagsOf(mode) ? " (flagged)" : ""}`);
  });
  const reasons = [...new Set(shown.map(flagsOf).filter(Boolean))].map((flag) => `flagged: ${flag}`);
  const said = modes.length ? [...reasons, ...sentences(validity)] : [];
  return [...parts, ...said.map((text) => make("div", { class: "muted" }, text))];
}

function modeTable(modes) {
  const heads = ["Mode", "Frequency (Hz)", "95 % interval", "Damping ratio (%)", "95 % interval",
    "Inertia (kg·mm²)", "Source", ""];
  return make("table", {},
    make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { scope: "col" }, text)))),
    make("tbody", {}, ...modes.map((mode, k) => {
      const hertz = estimate(mode.frequency_hz);
      const percent = estimate(mode.damping_ratio, 100);
      return make("tr", {}, ...[mode.mode ?? k + 1, hertz.value, hertz.interval, percent.value,
        percent.interval, estimate(mode.participation, KG_MM2).value, SOURCES[mode.source] ?? "",
        flagsOf(mode)].map((text) => make("td", {}, String(text))));
    })));
}

/** The look as elements; a sentence where there is none. */
export function lookElements(look) {
  if (!look) return [make("p", { class: "muted" }, "No quick look at this session.")];
  const parts = [];
  if (look.modes?.length) {
    parts.push(modeTable(look.modes), ...sentences(look.validity).map((text) =>
      make("p", {}, text)));
  } else parts.push(make("p", {}, "No mode was identified."));
  if (Number.isFinite(look.coherence?.mean)) {
    const bands = (look.coherence.low_bands ?? []).map(([from, to]) =>
      `${level(from)} to ${level(to)} Hz`);
    parts.push(make("p", {}, `Mean coherence ${look.coherence.mean.toFixed(3)}`
      + (bands.length ? `; low from ${bands.join(", ")}.` : ".")));
  }
  if (look.flags?.length) {
    parts.push(make("ul", {}, ...look.flags.map((flag) => make("li", {}, flag))));
  }
  if (look.against_last) parts.push(make("p", {}, look.against_last.sentence));
  return parts;
}
