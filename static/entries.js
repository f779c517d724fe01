// What somebody typed into a form outlives a reload, an expired sign-in and a step aside: kept in this tab alone, for the person who typed
// it, by form and record, until the service has taken it. Passwords, codes and files are never kept. A value that somebody else stored
// meanwhile stays as it is stored. The clinic day keeps its own entries (visit-day/store.js).
const STORE = "betaloop-entries";
const person = document.body.dataset.person ?? "";
const SECRET = 'input[type="password"], input[type="file"], input[type="hidden"], [autocomplete="one-time-code"]';
const ABOUT_VERSIONS = /^(version|seen|revision)([-_]|$)/; // hidden fields that change with a record, and do not say which one it is

function read() {
  try {
    return JSON.parse(sessionStorage.getItem(STORE)) ?? { person: "", forms: {} };
  } catch (error) {
    console.info("entries cannot be kept in this window", error);
    return { person: "", forms: {} };
  }
}

function write(store) {
  try {
    if (Object.keys(store.forms).length) sessionStorage.setItem(STORE, JSON.stringify(store)); else sessionStorage.removeItem(STORE);
  } catch (error) {
    console.info("entries cannot be kept in this window", error);
  }
}

// another person finds nothing, and nothing stays; where nobody is signed in, what waits goes on waiting
function mine() {
  const store = read();
  if (!person || store.person === person) return store;
  write({ person, forms: {} });
  return { person, forms: {} };
}

const posts = (form) => form.getAttribute("method")?.toLowerCase() === "post";
const keeps = (form) => form instanceof HTMLFormElement && posts(form) && form.dataset.keep !== "no" && !document.getElementById("day");
const pathOf = (form) => new URL(form.getAttribute("action") || location.href, location.href).pathname;

// where a form goes, and what its hidden fields say that it is about
function keyOf(form) {
  const own = (one) => {
    const about = [...one.elements].filter((e) => e.type === "hidden" && e.name && !ABOUT_VERSIONS.test(e.name)).map((e) => `${e.name}=${e.value}`);
    return [pathOf(one), ...about].join("\n");
  };
  const key = own(form);
  const before = [...document.forms].filter((other) => posts(other) && own(other) === key).indexOf(form);
  return before > 0 ? `${key}\n${before}` : key;
}

// a box is known by its value, of other fields of one name each by its place
function nameOf(form, field) {
  if (field.type === "checkbox" || field.type === "radio") return `${field.name}=${field.value}`;
  const same = [...form.elements].filter((e) => e.name === field.name);
  return same.length > 1 ? `${field.name}#${same.indexOf(field)}` : field.name;
}

const isBox = (field) => field.type === "checkbox" || field.type === "radio";
const present = (field) => (isBox(field) ? field.checked : field.value);

function stored(field) {
  if (isBox(field)) return field.defaultChecked;
  if (field instanceof HTMLSelectElement) return ([...field.options].find((o) => o.defaultSelected) ?? field.options[0])?.value ?? "";
  return field.defaultValue;
}

const fieldsOf = (form) => [...form.elements].filter((e) => e.name && !e.matches(SECRET) && e.matches("input, select:not([multiple]), textarea"));

document.addEventListener("input", keep);
document.addEventListener("change", keep);
function keep({ target }) {
  const { form } = target;
  if (!person || !form || !keeps(form) || !fieldsOf(form).includes(target)) return;
  const store = mine();
  const key = keyOf(form);
  const typed = store.forms[key]?.fields ?? {};
  // a radio button that is chosen takes the choice from its neighbours
  for (const field of target.type === "radio" ? fieldsOf(form).filter((f) => f.name === target.name) : [target]) {
    const name = nameOf(form, field);
    const base = typed[name] ? typed[name].base : stored(field);
    if (present(field) === base) delete typed[name]; else typed[name] = { base, value: present(field) };
  }
  delete store.forms[key];
  if (Object.keys(typed).length) store.forms[key] = { fields: typed };
  write({ person, forms: store.forms });
}

// only over the value that it was typed over; what somebody else stored meanwhile stands, and what was typed is told beside it
function restore(root) {
  if (!person) return;
  const store = mine();
  for (const form of root.querySelectorAll("form")) {
    const held = keeps(form) ? store.forms[keyOf(form)] : null;
    if (!held) continue;
    const back = [];
    const overtaken = [];
    for (const field of fieldsOf(form)) {
      const entry = held.fields[nameOf(form, field)];
      const gone = entry && field instanceof HTMLSelectElement && ![...field.options].some((o) => o.value === entry.value);
      if (!entry || gone || present(field) === entry.value) continue;
      if (stored(field) !== entry.base) { if (!isBox(field)) overtaken.push([field, entry.value]); continue; }
      if (isBox(field)) field.checked = entry.value; else field.value = entry.value;
      back.push(field);
    }
    if (back.length || overtaken.length) tell(form, back, overtaken);
  }
}

const wordsOf = (field) => field.labels?.[0]?.firstChild?.textContent.trim() || field.getAttribute("aria-label") || field.name;

function tell(form, back, overtaken) {
  for (const field of back) field.closest("details")?.setAttribute("open", "");
  const note = document.createElement("div");
  note.className = "note info kept";
  note.setAttribute("role", "status");
  const words = document.createElement("span");
  words.textContent = [
    back.length ? "What you had typed here is back. It is not saved yet." : "",
    ...overtaken.map(([field, value]) => `${wordsOf(field)}: you had typed ${value || "nothing"}; ${stored(field) || "nothing"} was saved since, and stands.`),
  ].filter(Boolean).join(" ");
  const drop = document.createElement("button");
  drop.type = "button";
  drop.textContent = "Discard what I typed";
  drop.addEventListener("click", () => { forget(form); form.reset(); note.remove(); });
  note.append(words, drop);
  form.prepend(note);
  for (const field of back) field.dispatchEvent(new Event("input", { bubbles: true }));
}

function forget(form) {
  const store = mine();
  delete store.forms[keyOf(form)];
  write(store);
}

// the address says for whom the page was made: in a browser that has changed hands since, the service takes it under nobody else's name
function sign(form) {
  if (!person) return;
  const address = new URL(form.getAttribute("action") || location.href, location.href);
  address.searchParams.set("written_by", person);
  form.setAttribute("action", address.pathname + address.search);
}

// sent is not saved: what follows tells
document.addEventListener("submit", (event) => {
  const form = event.target;
  if (event.defaultPrevented || !(form instanceof HTMLFormElement)) return;
  if (posts(form) && form.getAttribute("action") !== "/sign-out") sign(form);
  if (form.getAttribute("action") === "/sign-out") { write({ person: "", forms: {} }); return; }
  if (!posts(form)) unsend();
  if (!keeps(form)) return;
  const store = read();
  // the page of an expired sign-in sends all of a form as hidden fields: there its address alone tells which one it was
  const again = (key) => "again" in form.dataset && key.split("\n")[0] === pathOf(form);
  for (const [key, held] of Object.entries(store.forms)) if (key === keyOf(form) || again(key)) held.sent = location.pathname;
  write(store);
});
document.addEventListener("betaloop:saved", (event) => forget(event.target)); // by a page's own script

// whoever goes on from a page by another way than its form was not answered: the connection broke off, or they stopped it
document.addEventListener("click", (event) => { if (event.target.closest?.("a[href]")) unsend(); });
window.addEventListener("pageshow", (event) => { if (event.persisted) unsend(); });
function unsend() {
  const store = read();
  for (const held of Object.values(store.forms)) if (held.sent === location.pathname) delete held.sent;
  write(store);
}

// this page answers what was sent from the page before it: led on to, or shown without a complaint, it was taken
function settle() {
  const store = mine();
  const [arrival] = performance.getEntriesByType("navigation");
  const from = document.referrer ? new URL(document.referrer).pathname : "";
  const refused = document.querySelector('main .note.bad[role="alert"], main .field-note') !== null;
  const taken = arrival && (arrival.redirectCount > 0 || (arrival.type === "navigate" && (arrival.responseStatus ?? 200) < 400 && !refused));
  for (const [key, held] of Object.entries(store.forms)) {
    if (!held.sent || held.sent !== from) continue;
    if (taken) delete store.forms[key]; else delete held.sent;
  }
  write(store);
}

if (person || document.referrer) settle();
restore(document);
document.addEventListener("betaloop:swap", (event) => restore(event.target));
