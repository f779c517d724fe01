// Between the tablet and the service: the day comes, entries go, the difference of the clocks is measured on the way.
const TIMEOUT_MS = 8000;
const BATCH = 50;
const PAUSES_MS = [1000, 2000, 5000, 10000, 20000];

export const call = (path, options = {}) =>
  fetch(path, { headers: { Accept: "application/json", ...(options.body ? { "Content-Type": "application/json" } : {}) }, signal: AbortSignal.timeout(TIMEOUT_MS), ...options });

export class Link {
  // `changed(link)` is called whenever status, clock or the entries that wait have changed; `acknowledged(entries)` with what was taken.
  constructor(store, visit, { changed, acknowledged, arrived }) {
    Object.assign(this, { store, visit, changed, acknowledged, arrived, status: "starting", offsetMs: null, waiting: [], failures: 0 });
    addEventListener("online", () => this.send());
    document.addEventListener("visibilitychange", () => { if (!document.hidden) this.send(); });
  }

  #clock(sentMs, serverTime) {
    // the service read its clock between sending and receiving: the middle is wrong by half the way there and back at most
    this.offsetMs = Math.round(Date.parse(serverTime) - (sentMs + Date.now()) / 2);
  }

  #set(status) {
    this.status = status;
    this.changed(this);
  }

  // Fetch the day. Returns it, or null with `status` saying why not: offline, signed-out, or refused with `problem`.
  async fetchDay() {
    const sent = Date.now();
    try {
      const answer = await call(`/api/v1/visits/${this.visit}/day`);
      if (answer.ok) {
        const day = await answer.json();
        this.#clock(sent, day.server_time);
        this.status = "online";
        return day;
      }
      this.#failed(answer.status, await problemOf(answer));
    } catch (error) {
      if (!isNetwork(error)) throw error;
      this.status = "offline";
    }
    return null;
  }

  #failed(status, problem) {
    this.problem = problem;
    this.status = status === 401 ? "signed-out" : status >= 500 || status === 429 ? "offline" : "refused";
  }

  async load() {
    this.waiting = await this.store.waiting(this.visit);
    this.changed(this);
  }

  // Send what waits; again and again until all is acknowledged. Two pages of one tablet do not send at the same time.
  async send() {
    if (!this.store.key || this.sending) return;
    this.sending = true;
    clearTimeout(this.timer);
    try {
      await navigator.locks.request(`betaloop-visit-day-${this.visit}`, () => this.#sendAll());
    } finally {
      this.sending = false;
    }
    if (this.#ready().length) {
      const pause = PAUSES_MS[Math.min(this.failures, PAUSES_MS.length - 1)];
      this.timer = setTimeout(() => this.send(), pause);
    }
  }

  #ready() {
    return this.waiting.filter((row) => !row.refused);
  }

  async #sendAll() {
    await this.load();
    for (let ready = this.#ready(); ready.length; ready = this.#ready()) {
      // a batch is of one plan; after a batch that could not be read each entry goes alone, so that one bad entry holds up no other
      const batch = ready.filter((row) => row.plan === ready[0].plan).slice(0, this.single ? 1 : BATCH);
      if (!(await this.#post(batch))) return;
    }
    this.single = false;
    if (this.status !== "online") {
      const day = await this.fetchDay();
      if (day) await this.arrived(day);
    }
    this.failures = 0;
    this.changed(this);
  }

  async #post(batch) {
    const sent = Date.now();
    const body = JSON.stringify({ plan_id: batch[0].plan, entries: batch.map((row) => row.entry) });
    try {
      const answer = await call(`/api/v1/visits/${this.visit}/day/entries`, { method: "POST", body });
      if (answer.ok) {
        const { server_time: time, results } = await answer.json();
        this.#clock(sent, time);
        // an answer comes in the order of its entries; one whose own identifier could not be read has none there
        await this.#settle(batch, results.map((result, i) => ({ ...result, uuid: result.uuid ?? batch[i].entry.uuid })));
        this.#set("online");
        return true;
      }
      const problem = await problemOf(answer);
      if (answer.status === 422 || answer.status === 404) {
        if (batch.length === 1) await this.#settle(batch, [{ uuid: batch[0].entry.uuid, outcome: "refused", ...problem }]);
        else this.single = true;
        return true;
      }
      this.#failed(answer.status, problem);
    } catch (error) {
      if (!isNetwork(error)) throw error;
      this.status = "offline";
    }
    this.failures += 1;
    this.changed(this);
    return false;
  }

  async #settle(batch, results) {
    const taken = new Set(results.filter((r) => r.outcome !== "refused").map((r) => r.uuid));
    const entries = batch.map((row) => row.entry).filter((entry) => taken.has(entry.uuid));
    if (entries.length) {
      await this.acknowledged(entries); // the page knows them before the tablet forgets them
      await this.store.remove(entries.map((entry) => entry.uuid));
    }
    for (const result of results) {
      if (result.outcome === "refused") await this.store.setRefused(this.visit, result.uuid, `${result.detail} ${result.hint}`.trim());
    }
    await this.load();
  }
}

// What fetch throws where nothing answers: a TypeError without network, an AbortError or TimeoutError when time is up.
const isNetwork = (error) => error instanceof TypeError || ["AbortError", "TimeoutError"].includes(error?.name);

async function problemOf(answer) {
  const text = await answer.text();
  try {
    const { detail, hint } = JSON.parse(text);
    return { detail: detail ?? "", hint: hint ?? "" };
  } catch (error) {
    if (!(error instanceof SyntaxError)) throw error;
    return { detail: `The service answered with status ${answer.status}.`, hint: "" };
  }
}
