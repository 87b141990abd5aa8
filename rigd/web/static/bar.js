// Top bar: rig, state in one word and colour, who controls, time left, frequency, and STOP.

import { byId, setText, show } from "./dom.js";
import { digits, minutes } from "./format.js";

const SILENT_MS = 2000;
const TONES = {
  READY: "ready", RUNNING: "running", STOPPING: "stopping", FAULT: "alarm",
  PREPARING: "stopping", RETURNING: "stopping", FINISHING: "stopping",
};
/** Names of the phases of a session, as on the terminal. */
const PHASES = {
  preparing: "preparing", settling: "settling", taring: "taring", ready: "waiting for the recorder",
  running: "recording", returning: "returning", off: "drive off",
  waiting: "waiting for the beam to rest",
  probing: "probing move",
};

export class Bar {
  #link;
  #status = null;
  #progress = null;
  #gone = "Connecting to the server …";
  #connected = false;
  #stopped = "";

  constructor(link) {
    this.#link = link;
    link.on("hello", (hello) => {
      this.#gone = "";
      this.#connected = true;
      if (hello.profile) this.#name(hello.profile);
    });
    link.on("status", (status) => {
      this.#gone = "";
      this.#status = status;
      this.#progress = status.progress;
      this.#render();
    });
    link.on("progress", (progress) => {
      this.#progress = progress;
      this.#render();
    });
    link.on("state", (change) => {
      if (this.#status === null) return;
      this.#status = { ...this.#status, state: change.to, reason: change.reason };
      if (change.to !== "running" && change.to !== "stopping") this.#progress = null;
      this.#stopped = "";
      this.#render();
    });
    link.on("gauges", ({ frequency_hz: frequency }) => this.#frequency(frequency));
    link.on("lost", ({ reason }) => this.#lose(reason || "The daemon does not answer."));
    link.on("closed", () => this.#lose("The page's server does not answer."));
    byId("stop").addEventListener("click", () => this.#stop());
    setInterval(() => this.#listen(), 500);
  }

  #name(profile) {
    setText(byId("rig-name"), profile);
    document.title = `${profile} – rigd`;
  }

  #lose(reason) {
    this.#gone = reason;
    this.#render();
  }

  /** What moves and says nothing is as good as gone. */
  #listen() {
    const silent = performance.now() - this.#link.heard;
    const moving = ["running", "stopping"].includes(this.#status?.state);
    if (moving && !this.#gone && silent > SILENT_MS) {
      this.#lose(`No message for ${Math.round(silent / 1e3)} s.`);
    }
  }

  async #stop() {
    const button = byId("stop");
    button.setAttribute("aria-busy", "true");
    const reply = await this.#link.stop();
    button.removeAttribute("aria-busy");
    if (reply.ok) {
      this.#stopped = reply.stopping ? "Stop requested." : "No session is running.";
    } else {
      this.#stopped =
        `Not stopped. Press the wired stop (STO), then run rigd stop. ${reply.error}`;
    }
    this.#render();
    if (reply.ok) setTimeout(() => { this.#stopped = ""; this.#render(); }, 4000);
  }

  #frequency(frequency) {
    const shown = this.#progress !== null && Number.isFinite(frequency);
    setText(byId("frequency"), shown ? `${digits(frequency)} Hz` : "–");
  }

  #word() {
    if (this.#gone) return this.#connected ? "OFFLINE" : "CONNECTING";
    if (this.#status === null || this.#status.doing === "connecting") return "CONNECTING";
    const { state } = this.#status;
    // What a session does, in the words of the live view.
    if (state !== "running") return state.toUpperCase();
    return (this.#progress ? this.#progress.activity ?? state : "preparing").toUpperCase();
  }

  #reason(word) {
    if (this.#stopped) return this.#stopped;
    if (this.#gone) {
      return this.#connected
        // What to do comes first: a narrow bar cuts the text.
        ? "Press the wired stop (STO) if the rig moves or you cannot see it: its state is unknown. " +
          this.#gone
        : `Press the wired stop (STO) if the rig moves. ${this.#gone}`;
    }
    if (this.#status === null) return "";
    const { doing, reason, zero_lost: zeroLost } = this.#status;
    const busy = doing && word !== "CONNECTING" ? `Busy: ${doing}. ` : "";
    const zero = zeroLost ? "The zero is lost: move the motor to mid-travel and press Zero. " : "";
    return `${busy}${zero}${sentence(reason)}`;
  }

  #render() {
    const word = this.#word();
    const gone = word === "OFFLINE" || word === "CONNECTING";
    document.body.classList.toggle("gone", gone);
    byId("bar").dataset.tone = TONES[word] ?? "quiet";
    setText(byId("state-word"), word);
    const reason = this.#reason(word);
    setText(byId("state-reason"), reason);
    byId("state-reason").title = reason;
    show(byId("fault"), word === "FAULT");
    if (word === "FAULT") setText(byId("fault-reason"), sentence(this.#status.reason));
    this.#facts(gone);
  }

  #facts(gone) {
    const status = this.#status;
    const progress = gone ? null : this.#progress;
    if (status?.daemon?.profile) this.#name(status.daemon.profile);
    const left = progress?.time_left_s;
    const percent = progress ? `${Math.round(progress.percent)} %` : "–";
    setText(byId("time-left"), Number.isFinite(left) ? minutes(left) : percent);
    byId("progress").value = progress?.percent ?? 0;
    const of = progress?.repeat > 1 ? `, ${progress.session} of ${progress.repeat}` : "";
    const phase = progress ? (PHASES[progress.phase] ?? progress.phase) + of : "–";
    setText(byId("phase"), phase);
    byId("phase").title = phase;
    const controller = gone ? null : status?.controller;
    const who = controller ? `${controller.user}, process ${controller.pid}` : "nobody";
    setText(byId("controller"), gone ? "–" : who);
    byId("controller").title = gone ? "" : who;
    if (!progress) setText(byId("frequency"), "–");
  }
}

const sentence = (text) => {
  if (!text) return "";
  const first = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?]$/.test(first) ? first : `${first}.`;
};
