// The page's link to its server: a WebSocket for what happens, requests for what is asked.

const FIRST_WAIT_MS = 250;
const LONGEST_WAIT_MS = 2000;
const STOP_MS = 3000;
const KEPT = "rigd-token";

/** The right to act: taken from the address once, kept for this tab, and hidden from the address. */
function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem(KEPT, given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem(KEPT);
}

export class Link {
  #listeners = new Map();
  #wait = FIRST_WAIT_MS;
  #socket = null;
  /** Ends the wait for the replies to stops, each with the reply or null. */
  #stops = new Set();

  constructor() {
    this.token = takeToken();
    /** When the last message came, in ms of `performance.now()`. */
    this.heard = 0;
    addEventListener("hashchange", () => {  // a printed address opened in the same tab
      this.token = takeToken();
      this.#tell("token", {});
    });
  }

  /** Have a function called with each message of a type; `open` and `closed` are of the link. */
  on(type, listener) {
    this.#listeners.set(type, [...(this.#listeners.get(type) ?? []), listener]);
  }

  #tell(type, message) {
    for (const listener of this.#listeners.get(type) ?? []) listener(message);
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/api/live`);
    this.#socket = socket;
    socket.addEventListener("message", ({ data }) => {
      this.heard = performance.now();
      this.#wait = FIRST_WAIT_MS;
      for (const line of data.split("\n")) {
        try {
          const message = JSON.parse(line);
          if (message.type === "stop") this.#endStops(message);
          this.#tell(message.type, message);
        } catch (error) {
          reportError(error);  // the other messages are shown all the same
        }
      }
    });
    socket.addEventListener("close", () => {
      this.#endStops(null);
      this.#tell("closed", {});
      setTimeout(() => this.connect(), this.#wait);
      this.#wait = Math.min(2 * this.#wait, LONGEST_WAIT_MS);
    });
  }

  /**
   * Ask the daemon for something.
   * @returns {Promise<object>} its reply; a refusal has `ok` false and `error`
   */
  command(name, members = {}) {
    return this.post("/api/command", { command: name, ...members });
  }

  #endStops(reply) {
    for (const end of this.#stops) end(reply);
    this.#stops.clear();
  }

  /**
   * Have the session stopped: over the WebSocket, for a request may wait behind six downloads.
   * @returns {Promise<object>} the reply, after STOP_MS at the latest
   */
  async stop() {
    const limit = AbortSignal.timeout(STOP_MS);
    const late = { ok: false, error: `No answer within ${STOP_MS / 1e3} s.` };
    if (this.#socket?.readyState === WebSocket.OPEN) {
      const reply = await new Promise((resolve) => {
        this.#stops.add(resolve);
        limit.addEventListener("abort", () => resolve(late));
        this.#socket.send("stop");
      });
      if (reply !== null) return reply;
    }
    const reply = await this.post("/api/command", { command: "stop" }, limit);
    return limit.aborted && !reply.ok ? late : reply;
  }

  /** Send a request that acts; whatever fails comes as a refusal, with a sentence in `error`. */
  async post(address, body = {}, signal = undefined) {
    const headers = { "Content-Type": "application/json", "X-Rigd": "1" };
    if (this.token) headers.Authorization = `Bearer ${this.token}`;
    let answer;
    try {
      answer = await fetch(address, { method: "POST", headers, body: JSON.stringify(body), signal });
    } catch {
      return { ok: false, error: "The page's server does not answer." };
    }
    let reply = {};
    try {
      reply = await answer.json();
    } catch {
      // A refusal of the server itself may be plain text, or nothing.
    }
    if (!answer.ok && !reply.error) {
      reply.error = answer.status === 403
        ? "The token is missing or no longer valid: open the address that rigd serve printed."
        : `The server refused the request (HTTP ${answer.status}).`;
    }
    return { ...reply, ok: answer.ok && reply.ok !== false };
  }

  /** Read a document; null where there is none. */
  async get(address) {
    try {
      const answer = await fetch(address);
      return answer.ok ? await answer.json() : null;
    } catch {
      return null;
    }
  }
}
