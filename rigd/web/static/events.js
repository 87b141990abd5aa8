// Events in full, with time and level, newest first.

import { byId, make } from "./dom.js";
import { clock, date } from "./format.js";

const MOST = 500;

export class Events {
  #told = new Set();

  constructor(link) {
    link.on("event", (event) => this.#add(event));
    link.on("status", ({ history = [] }) => {
      for (const change of history) this.#add(transition(change));
    });
    link.on("state", (change) => this.#add(transition(change)));
    link.on("lost", ({ reason }) => this.#add({
      utc_ns: Date.now() * 1e6, level: "error", text: reason || "The daemon does not answer.",
    }));
  }

  #add({ utc_ns: at, level, text }) {
    // States come with the history as well.
    const key = `${at} ${text}`;
    if (this.#told.has(key)) return;
    this.#told.add(key);
    const list = byId("event-list");
    const entry = make("li", { class: level },
      make("time", { dateTime: new Date(at / 1e6).toISOString(), title: date(at) }, clock(at)),
      make("span", { class: "level" }, level), make("span", { class: "text" }, text));
    entry.dataset.at = at;
    entry.dataset.key = key;
    const after = [...list.children].find((each) => Number(each.dataset.at) <= at);
    list.insertBefore(entry, after ?? null);
    while (list.children.length > MOST) {
      this.#told.delete(list.lastChild.dataset.key);
      list.lastChild.remove();
    }
  }
}

const transition = ({ utc_ns: at, from, to, reason }) => ({
  utc_ns: at, level: to === "fault" ? "error" : "info", text: `${from} → ${to}: ${reason}`,
});
