// What waits on the tablet: IndexedDB, every record encrypted with AES-GCM under a key that no script can read out.
//
// The key belongs to the person who signed in. The service derives it from its own secret, gives it to a live sign-in alone, and always
// gives the same person the same one; it is imported as not extractable and forgotten at sign-out or when the sign-in has run out. What
// was encrypted stays, and is read again once the same person has signed in.
const NAME = "betaloop-visit-day";
const OLD_DAY_MS = 24 * 3600 * 1000;

function open() {
  return new Promise((resolve, reject) => {
    const request = indexedDB.open(NAME, 1);
    request.onupgradeneeded = () => {
      const db = request.result;
      db.createObjectStore("keys", { keyPath: "owner" });
      db.createObjectStore("entries", { keyPath: "n", autoIncrement: true }).createIndex("uuid", "uuid", { unique: true });
      db.createObjectStore("days", { keyPath: ["owner", "visit"] });
    };
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

// strict: the promise resolves when the bytes are on the disk, so that an empty battery a moment later loses nothing
function write(db, stores, act) {
  return new Promise((resolve, reject) => {
    const transaction = db.transaction(stores, "readwrite", { durability: "strict" });
    transaction.oncomplete = () => resolve();
    transaction.onerror = transaction.onabort = () => reject(transaction.error);
    act(transaction);
  });
}

const asked = (request) => new Promise((resolve, reject) => {
  request.onsuccess = () => resolve(request.result);
  request.onerror = () => reject(request.error);
});
const all = (db, store) => asked(db.transaction(store).objectStore(store).getAll());
const bytes = (value) => new TextEncoder().encode(JSON.stringify(value));

export class Store {
  static async open() {
    const store = new Store();
    store.db = await open();
    navigator.storage?.persist?.().catch(() => false); // a request: the browser may say no, and then keeps it as long as there is room
    return store;
  }

  // Take over the key of a live sign-in. Returns the answer's status; 401 where nobody is signed in.
  async signIn(fetcher) {
    const answer = await fetcher("/visit-day/key");
    if (!answer.ok) return answer.status;
    const { owner, name, key, until } = await answer.json();
    const raw = Uint8Array.from(atob(key), (c) => c.charCodeAt(0));
    const imported = await crypto.subtle.importKey("raw", raw, "AES-GCM", false, ["encrypt", "decrypt"]);
    raw.fill(0);
    await write(this.db, ["keys"], (t) => {
      t.objectStore("keys").clear();
      t.objectStore("keys").put({ owner, name, key: imported, until: Date.parse(until) });
    });
    Object.assign(this, { owner, name, key: imported });
    return answer.status;
  }

  // The key of the last sign-in, for a page that starts without network. False where there is none or it has run out.
  async resume() {
    const [held] = await all(this.db, "keys");
    if (held && held.until < Date.now()) await this.forgetKey();
    if (!held || held.until < Date.now()) return false;
    Object.assign(this, { owner: held.owner, name: held.name, key: held.key });
    return true;
  }

  forgetKey() {
    this.key = null;
    return write(this.db, ["keys"], (t) => t.objectStore("keys").clear());
  }

  async #seal(value, about) {
    const iv = crypto.getRandomValues(new Uint8Array(12));
    const data = await crypto.subtle.encrypt({ name: "AES-GCM", iv, additionalData: bytes(about) }, this.key, bytes(value));
    return { iv, data };
  }

  async #open(record, about) {
    const plain = await crypto.subtle.decrypt({ name: "AES-GCM", iv: record.iv, additionalData: bytes(about) }, this.key, record.data);
    return JSON.parse(new TextDecoder().decode(plain));
  }

  // Resolves once the entry is on the disk.
  async add(visit, plan, entry) {
    const sealed = await this.#seal({ plan, entry }, [this.owner, visit, entry.uuid]);
    await write(this.db, ["entries"], (t) => t.objectStore("entries").add({ owner: this.owner, visit, uuid: entry.uuid, refused: false, ...sealed }));
  }

  // This person's entries about a visit that are not acknowledged yet, in their order: {plan, entry, refused, why}.
  async waiting(visit) {
    const rows = (await all(this.db, "entries")).filter((row) => row.owner === this.owner && row.visit === visit);
    return Promise.all(rows.map(async (row) => {
      const { plan, entry, why } = await this.#open(row, [row.owner, row.visit, row.uuid]);
      return { plan, entry, why: why ?? null, refused: row.refused };
    }));
  }

  // How many entries of other people wait here: they can be read by nobody else.
  async foreign() {
    return (await all(this.db, "entries")).filter((row) => row.owner !== this.owner).length;
  }

  async remove(uuids) {
    const rows = (await all(this.db, "entries")).filter((row) => uuids.includes(row.uuid));
    await write(this.db, ["entries"], (t) => { for (const row of rows) t.objectStore("entries").delete(row.n); });
  }

  // An entry that the service does not take stays, with the reason; `why` null: it is tried again.
  async setRefused(visit, uuid, why) {
    const row = (await all(this.db, "entries")).find((one) => one.uuid === uuid);
    if (!row) return;
    const about = [row.owner, row.visit, row.uuid];
    const sealed = await this.#seal({ ...(await this.#open(row, about)), why }, about);
    await write(this.db, ["entries"], (t) => t.objectStore("entries").put({ ...row, ...sealed, refused: why !== null }));
  }

  // The plan of the day, and of entries that were sent no more than is needed to go on without network: values stay with the service.
  async keepDay(day) {
    const entries = day.entries.map((e) => (["start", "stop", "repeat", "dyskinesia", "speech", "gait", "adverse_event"].includes(e.kind) ? e : { ...e, payload: null }));
    const sealed = await this.#seal({ ...day, entries }, [this.owner, day.visit_id]);
    const old = (await all(this.db, "days")).filter((row) => row.at < Date.now() - OLD_DAY_MS);
    await write(this.db, ["days"], (t) => {
      for (const row of old) t.objectStore("days").delete([row.owner, row.visit]);
      t.objectStore("days").put({ owner: this.owner, visit: day.visit_id, at: Date.now(), ...sealed });
    });
  }

  async keptDay(visit) {
    const row = await asked(this.db.transaction("days").objectStore("days").get([this.owner, visit]));
    return row ? this.#open(row, [this.owner, visit]) : null;
  }

  async dropDay(visit) {
    await write(this.db, ["days"], (t) => t.objectStore("days").delete([this.owner, visit]));
  }
}
