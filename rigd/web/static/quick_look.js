// Quick look at a session: modes with intervals, what is flagged, and against the last session.

import { make } from "./dom.js";
import { estimate, level } from "./format.js";

/** What is said of numbers from a daemon or a look of before an update. */
const NOT_KNOWN = "The slope of the tip, and with it the error of the linear model, is unknown.";

/** Modes in short, as a cell of the table of sessions has them. */
export function modesInShort(modes, validity) {
  const parts = modes.slice(0, 3).map(({ frequency_hz: frequency, damping_ratio: damping }) => {
    const flagged = frequency?.flag || damping?.flag;
    return make("span", { class: "line", title: [frequency?.flag, damping?.flag]
      .filter(Boolean).join(" ") },
    `${estimate(frequency, 1, 1).value} Hz, ${estimate(damping, 100, 1).value} %${flagged ? " (flagged)" : ""}`);
  });
  if (modes.length) {
    parts.push(make("div", { class: "muted" }, validity?.sentence ?? NOT_KNOWN));
  }
  return parts;
}

function modeTable(modes) {
  const heads = ["Mode", "Frequency (Hz)", "95 % interval", "Damping ratio (%)", "95 % interval", ""];
  return make("table", {},
    make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { scope: "col" }, text)))),
    make("tbody", {}, ...modes.map(({ frequency_hz: frequency, damping_ratio: damping }, k) => {
      const hertz = estimate(frequency);
      const percent = estimate(damping, 100);
      const flags = [frequency?.flag, damping?.flag].filter(Boolean).join(" ");
      return make("tr", {}, ...[k + 1, hertz.value, hertz.interval, percent.value, percent.interval,
        flags].map((text) => make("td", {}, String(text))));
    })));
}

/** The look as elements; a sentence where there is none. */
export function lookElements(look) {
  if (!look) return [make("p", { class: "muted" }, "No quick look at this session.")];
  const parts = [];
  if (look.modes?.length) {
    parts.push(modeTable(look.modes), make("p", {}, look.validity?.sentence ?? NOT_KNOWN));
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
