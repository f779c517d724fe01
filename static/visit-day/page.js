// The page of the clinic day: what is entered is on the disk first, then on the screen, then on its way to the service.
import { dayEnd, dosesOf } from "./record.js";
import { el } from "./dom.js";
import { Store } from "./store.js";
import { Link, call } from "./sync.js";
import { draw, tick } from "./view.js";

const root = document.getElementById("day");
const plain = document.getElementById("plain");
const visit = Number(location.pathname.split("/").pop());
const REFRESH_MS = 20000; // what others entered, where two tablets are at work

class App {
  day = null;
  shown = null; // session chosen by hand; null: the first that is not finished

  get entries() {
    const known = new Set(this.day.entries.map((e) => e.uuid));
    return [...this.day.entries, ...this.link.waiting.filter((row) => !row.refused && !known.has(row.entry.uuid)).map((row) => row.entry)];
  }

  // Put an entry on the disk, show it, send it. `at`: when it happened, by this tablet's clock.
  async enter(kind, payload, { item = null, attempt = null, replaces = [], at = Date.now() } = {}) {
    const entry = {
      uuid: crypto.randomUUID(), plan_item_id: item, attempt: item === null ? null : attempt, kind, payload, replaces,
      device_time: new Date(at).toISOString(), clock_offset_ms: this.link.offsetMs,
    };
    try {
      await this.store.add(visit, this.day.plan_id, entry);
    } catch (error) {
      this.failure = `This entry could not be kept on the tablet (${error?.name ?? error}). Write it on the sheet, then load the page again.`;
      this.draw();
      throw error;
    }
    await this.link.load();
    this.link.send();
  }

  async acknowledged(entries) {
    const known = new Set(this.day.entries.map((e) => e.uuid));
    this.day.entries.push(...entries.filter((e) => !known.has(e.uuid)).map((e) => ({ ...e, entered_by: this.store.name })));
    this.day.doses = dosesOf(this.day, entries);
    await this.keep();
  }

  async arrived(day) {
    if (this.day && day.plan_id !== this.day.plan_id) this.replacedBy = day.plan_id;
    else this.day = day;
    await this.keep();
    this.draw();
  }

  // The plan stays on the tablet, encrypted, until the day is over and all is sent.
  async keep() {
    const over = dayEnd(this.entries) && this.link.waiting.length <= 1;
    await (over ? this.store.dropDay(visit) : this.store.keepDay(this.day));
  }

  // Nothing is drawn anew between finger down and finger up: the button under the finger would be another, and the tap lost.
  draw() {
    if (this.pressed) this.late = true;
    else if (this.day) draw(root, this);
  }

  watchFingers() {
    const released = () => setTimeout(() => {
      this.pressed = false;
      if (this.late) { this.late = false; this.draw(); }
    });
    root.addEventListener("pointerdown", () => { this.pressed = true; });
    for (const kind of ["pointerup", "pointercancel"]) addEventListener(kind, released);
  }
}

function tell(title, ...text) {
  root.hidden = false;
  root.replaceChildren(el("div", { class: "note warn", role: "alert" }, el("b", { text: title }), el("div", {}, ...text)));
}

async function boot() {
  if (!isSecureContext || !crypto.subtle || !navigator.serviceWorker || !navigator.locks || !indexedDB) {
    tell("Nothing can be kept on this tablet.", "This page was not served over TLS (https), or the browser is too old. Entries are sent at once, with the form below; without network they are not taken.");
    return;
  }
  navigator.serviceWorker.register("/visit-day/worker.js", { scope: "/visit-day/" })
    .catch((error) => console.info("this page does not open without network", error));
  const app = new App();
  app.noteRules = JSON.parse(root.dataset.noteRules);
  app.eventKinds = JSON.parse(root.dataset.eventKinds);
  app.drugs = new Map(JSON.parse(root.dataset.drugs));
  app.store = await Store.open();
  let status = 0;
  try {
    status = await app.store.signIn((path) => call(path));
  } catch (error) {
    if (!(error instanceof TypeError) && !["AbortError", "TimeoutError"].includes(error?.name)) throw error;
  }
  if (status !== 200 && !(await app.store.resume())) {
    const again = el("a", { class: "button primary", href: `/sign-in?next=${encodeURIComponent(location.pathname)}`, text: "Sign in" });
    tell(status === 401 ? "Sign in to go on." : "There is no network, and nobody is signed in on this tablet.",
      "What was entered before waits here, encrypted, and is sent after you have signed in again. ", again);
    return;
  }
  app.link = new Link(app.store, visit, {
    changed: () => app.draw(),
    acknowledged: (entries) => app.acknowledged(entries),
    arrived: (day) => app.arrived(day),
  });
  app.day = await app.link.fetchDay() ?? await app.store.keptDay(visit);
  if (!app.day) {
    if (plain) return; // the page says why
    tell(app.link.problem?.detail ?? "There is no network, and this day was not opened on this tablet before.", app.link.problem?.hint ?? "Connect the tablet and load the page again. Until then use the sheet.");
    return;
  }
  app.foreign = await app.store.foreign();
  await app.link.load();
  await app.keep();
  if (plain) plain.remove();
  root.hidden = false;
  app.watchFingers();
  app.draw();
  app.link.send();
  setInterval(() => tick(root, app), 250);
  setInterval(async () => {
    if (document.hidden || app.link.sending || app.link.waiting.some((row) => !row.refused)) return;
    const day = await app.link.fetchDay();
    if (day) await app.arrived(day);
    else app.draw();
  }, REFRESH_MS);
  root.dataset.ready = "yes";
}

boot().catch((error) => {
  tell("This page cannot work on this tablet.", `${error?.name ?? "Error"}: ${error?.message ?? error}. Use the sheet, and tell your administrator.`);
  throw error;
});
