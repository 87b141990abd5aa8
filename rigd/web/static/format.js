// Numbers, times and names as an operator reads them: units everywhere, sensible digits.

const NOTHING = "–";

/** A minus is not a hyphen. */
export const minus = (text) => text.replaceAll("-", "−");

/** Endings of names and the units they stand for, the longer endings first; the server's table. */
let units = {};

/** Take the table of units. */
export function useUnits(table) {
  units = table;
}

const suffixOf = (name) => Object.keys(units).find((suffix) => name.endsWith(suffix)) ?? "";

/** Unit that the ending of a name stands for; empty if there is none. */
export const unitOf = (name) => units[suffixOf(name)] ?? "";

/** A name as words: `start_hz` is the start frequency. */
export function wordsOf(name) {
  if (name === "ring_down_s") return "Ring-down";
  const suffix = suffixOf(name);
  let words = (suffix ? name.slice(0, -suffix.length) : name).replaceAll("_", " ");
  if (suffix === "_hz" && /^(start|stop)$/.test(words)) words += " frequency";
  return words.charAt(0).toUpperCase() + words.slice(1);
}

/** A number with so many significant digits, without an exponent where that is readable. */
export function digits(value, count = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return NOTHING;
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e-4 || size >= 1e6) return minus(value.toExponential(count - 1).replace("e+", "e"));
  const decimals = Math.max(0, count - 1 - Math.floor(Math.log10(size)));
  return minus(value.toFixed(Math.min(decimals, 8)));
}

/** A level that somebody chose, without the zeros that digits would add. */
export const level = (value) => String(Number(value.toPrecision(4)));

/** A number with its unit. */
export function withUnit(value, unit, count = 3) {
  const text = digits(value, count);
  return text === NOTHING || !unit ? text : `${text} ${unit}`;
}

/** A whole number in groups of three. */
export function whole(value) {
  if (value === null || value === undefined) return NOTHING;
  return String(Math.round(value)).replace(/\B(?=(\d{3})+$)/g, " ");
}

/** Seconds as minutes and seconds. */
export function minutes(seconds) {
  if (seconds === null || seconds === undefined) return NOTHING;
  const left = Math.ceil(seconds);
  return `${Math.floor(left / 60)}:${String(left % 60).padStart(2, "0")}`;
}

const two = (number) => String(number).padStart(2, "0");

/** Time of day of this computer. */
export function clock(utcNs) {
  const at = new Date(utcNs / 1e6);
  return `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}`;
}

/** Date of this computer, as ISO 8601. */
export function date(utcNs) {
  const at = new Date(utcNs / 1e6);
  return `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())}`;
}

/** Date and time to the minute. */
export const dateTime = (utcNs) => `${date(utcNs)} ${clock(utcNs).slice(0, 5)}`;

/** How long ago a time is. */
export function age(utcNs, nowMs = Date.now()) {
  const seconds = Math.max(0, nowMs - utcNs / 1e6) / 1e3;
  for (const [unit, size] of [["days", 86400], ["h", 3600], ["min", 60]]) {
    if (seconds >= 2 * size || (unit !== "days" && seconds >= size)) {
      return `${Math.floor(seconds / size)} ${unit} ago`;
    }
  }
  return "just now";
}

/** Size of a file. */
export const megabytes = (bytes) => `${digits(bytes / 1e6, 2)} MB`;

/** Decimals by which a value is shown to the first or second digit of its uncertainty. */
const decimalsOf = (std, digit) =>
  Math.min(8, Math.max(digit - 1 - Math.floor(Math.log10(std)), 0));

/**
 * A number with half the width of its interval, to the second digit of that.
 * @param {number} value
 * @param {number} half
 */
export function withHalfWidth(value, half) {
  if (!(half > 0)) return digits(value, 5);
  const decimals = decimalsOf(half, 2);
  return minus(`${value.toFixed(decimals)} ± ${half.toFixed(decimals)}`);
}

/**
 * An estimate with its 95 % interval.
 * @param {{value: number, std: number|null, interval_95: number[]|null}} found
 * @param {number} factor - such as 100 for per cent
 * @param {number} digit - of the uncertainty, up to which the value is shown
 */
export function estimate(found, factor = 1, digit = 2) {
  if (!found || !Number.isFinite(found.value)) return { value: NOTHING, interval: "" };
  const known = Number.isFinite(found.std) && found.std > 0;
  const text = (value) => (known
    ? minus((value * factor).toFixed(decimalsOf(found.std * factor, digit))) : digits(value * factor));
  const ends = found.interval_95;
  return {
    value: text(found.value),
    interval: ends ? `${text(ends[0])} to ${text(ends[1])}` : "",
  };
}
