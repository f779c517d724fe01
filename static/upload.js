// Drag and drop with progress: files and whole folders go to the public upload route as one upload, so that recordings that belong together
// (the two implants, the loose files of a folder) meet; one bad file loses nothing else there.
const form = document.querySelector("form[data-upload]");
const drop = form.querySelector("[data-drop]");
const input = form.querySelector('input[type="file"]');
const list = document.querySelector("[data-upload-list]");
const home = `/participants/${form.dataset.participant}`;
const LABELS = { understood: "Understood", flagged: "Flagged", repaired: "Repaired", ignored: "Left aside", removed: "Removed" };
const FIELDS = ["visit", "controller", "policy", "started_at", "hemisphere", "beta_unit", "beta_source", "lfp_unit", "session"];
const UNKNOWN_COLUMNS = ["columns not known", "warn"];
const STATES = { decoded: ["read", "good"], received: ["being read", "info"], released: ["released unread", "warn"], discarded: ["discarded", "warn"] };

for (const kind of ["dragenter", "dragover"]) drop.addEventListener(kind, (event) => { event.preventDefault(); drop.classList.add("over"); });
drop.addEventListener("dragleave", (event) => { if (!drop.contains(event.relatedTarget)) drop.classList.remove("over"); });
drop.addEventListener("drop", async (event) => {
  event.preventDefault();
  drop.classList.remove("over");
  const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  const files = entries.length ? (await Promise.all(entries.map(filesOf))).flat() : named(event.dataTransfer.files);
  start(files);
});
form.querySelector("button.primary").addEventListener("click", () => { input.required = true; }); // comes before the browser's own check
form.addEventListener("submit", (event) => { event.preventDefault(); start(named(input.files)); });

function named(files) {
  return [...files].map((file) => ({ file, path: file.webkitRelativePath || file.name }));
}

// every file below a dropped folder, with its path, by which loose files of one recording are kept together
async function filesOf(entry) {
  const path = entry.fullPath.replace(/^\//, "");
  if (entry.isFile) return [{ file: await new Promise((found, failed) => entry.file(found, failed)), path }];
  const reader = entry.createReader();
  const inside = [];
  for (let batch; (batch = await new Promise((found, failed) => reader.readEntries(found, failed))).length;) inside.push(...batch);
  return (await Promise.all(inside.map(filesOf))).flat();
}

let busy = Promise.resolve();
function start(files) {
  if (!files.length) return;
  unmark();
  const fields = new FormData(form);
  input.value = "";
  input.required = false; // emptied by us: an empty field is no mistake until somebody sends it again
  const shown = listed(files);
  const limit = Number(form.dataset.limitMb);
  const total = files.reduce((sum, { file }) => sum + file.size, 0) / 1048576;
  if (total > limit) {
    report(shown, 413, { detail: `These files have ${Math.round(total)} MiB together; one upload may have ${limit} MiB.`, hint: "Send them in several uploads." }, files);
    return;
  }
  busy = busy.then(() => send(files, fields, shown)); // one upload after the other: a clinic's line is narrow
}

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function listed(files) {
  const bar = element("progress", { max: 1, value: 0 });
  const words = element("span", { textContent: "waiting" });
  const title = files.length === 1 ? files[0].path : `${files.length} files`;
  const head = element("div", { className: "row" }, element("b", { textContent: title }), words);
  const item = element("li", {}, head, element("div", { className: "progress" }, bar));
  list.prepend(item);
  return { item, head, bar, words };
}

function send(files, fields, shown) {
  const body = new FormData();
  for (const { file, path } of files) body.append("file", file, path);
  body.append("participant", form.dataset.participant);
  for (const name of FIELDS) if (fields.get(name)) body.append(name, fields.get(name));
  if (!fields.get("visit")) body.append("confirm", "false"); // proposed, with the visit of their date
  return new Promise((done) => {
    const request = new XMLHttpRequest();
    request.open("POST", `/api/v1/uploads?written_by=${document.body.dataset.person}`); // refused where somebody else has signed in since
    request.responseType = "json";
    request.upload.addEventListener("progress", (event) => {
      if (event.lengthComputable) shown.bar.value = event.loaded / event.total;
      shown.words.textContent = event.loaded < event.total ? `sending, ${Math.round((100 * event.loaded) / event.total)} %` : "decoding …";
    });
    request.upload.addEventListener("load", () => follow(shown, request));
    request.addEventListener("load", () => { report(shown, request.status, request.response ?? {}, files); taken(request.status); renew(); done(); });
    request.addEventListener("error", () => { report(shown, 0, { detail: "The connection broke off.", hint: "Send the files again; what has arrived is not counted twice." }, files); done(); });
    request.send(body);
  });
}

// what was stated for these files is no entry that waits to be saved any more
function taken(status) {
  if (status < 400) form.dispatchEvent(new CustomEvent("betaloop:saved", { bubbles: true }));
}

// on the page of a visit, what the files changed is shown at once
async function renew() {
  const old = document.querySelector("[data-after-upload][id]");
  if (!old) return;
  try {
    const answer = await fetch(old.dataset.afterUpload, { headers: { Accept: "text/html" } });
    const fresh = answer.ok && new DOMParser().parseFromString(await answer.text(), "text/html").getElementById(old.id);
    if (!fresh) return;
    old.replaceWith(fresh);
    fresh.dispatchEvent(new CustomEvent("betaloop:renewed", { bubbles: true }));
  } catch (error) {
    console.info("the page is as it was before the upload; load it again", error);
  }
}

// while the service reads a file, which may take minutes, the page asks how far it is
function follow(shown, request) {
  const watching = setInterval(async () => {
    if (request.readyState === XMLHttpRequest.DONE) { clearInterval(watching); return; }
    const answer = await fetch(`${home}/upload/progress`).catch(() => null);
    const newest = answer?.ok ? (await answer.json()).at(-1) : null;
    if (!newest || request.readyState === XMLHttpRequest.DONE) return;
    shown.bar.value = newest.share;
    shown.words.textContent = newest.text;
  }, 1000);
}

// of a table whose columns nobody has stated yet
function mappingLink(id, which = "") { return element("a", { className: "button primary", href: `/uploaded-files/${id}/mapping`, textContent: `Say what its columns are${which}` }); }

function badge(text, tone) { return element("span", { className: `badge ${tone}`, textContent: text }); }

// what a refusal says of a field stands at it, as where the service makes the page (macros.html, at_field); ids of the fields so marked
function mark(answer) {
  const own = (error) => error.name ?? error.where?.split(" > ").at(-1); // of a value of the wrong type the service names its place alone
  const told = (answer.errors ?? []).map((error) => [own(error), error.what]);
  if (answer.field) told.push([answer.field, [answer.detail, answer.hint].filter(Boolean).join(" ")]);
  const marked = [];
  for (const [name, text] of told) {
    const field = name && form.elements.namedItem(name);
    if (!(field instanceof HTMLElement) || field.type === "hidden" || field.getAttribute("aria-invalid")) continue;
    const note = element("div", { className: "field-note", id: `n-${name}`, textContent: text });
    (field.closest(".with-unit") ?? field).after(note);
    field.setAttribute("aria-invalid", "true");
    field.setAttribute("aria-describedby", [field.getAttribute("aria-describedby"), note.id].filter(Boolean).join(" "));
    field.closest(".field")?.classList.add("wrong");
    const fold = field.closest("details");
    if (fold) fold.open = true;
    marked.push(field.id);
  }
  return marked;
}

function unmark() {
  for (const note of form.querySelectorAll(".field-note")) note.remove();
  for (const field of form.querySelectorAll("[aria-invalid]")) {
    field.removeAttribute("aria-invalid");
    const left = (field.getAttribute("aria-describedby") ?? "").split(" ").filter((id) => id && !id.startsWith("n-"));
    if (left.length) field.setAttribute("aria-describedby", left.join(" ")); else field.removeAttribute("aria-describedby");
    field.closest(".field")?.classList.remove("wrong");
  }
}

// files that were refused before they were read are chosen again, unless others were meanwhile; a folder's cannot be, their paths would go
function chosenAgain(files) {
  if (input.files.length || files.some(({ file, path }) => path !== file.name)) return false;
  const again = new DataTransfer();
  for (const { file } of files) again.items.add(file);
  input.files = again.files;
  return true;
}

function report({ item, head, words }, status, answer, files) {
  item.querySelector(".progress").remove();
  const good = status >= 200 && status < 300;
  const waiting = answer.waits_for_mapping ?? []; // where nothing was usable; else each file says so itself
  const [came, tone] = waiting.length ? UNKNOWN_COLUMNS : !good ? ["not usable", "bad"] : answer.duplicate ? ["known already", "info"] : ["received", "good"];
  words.replaceWith(badge(came, tone));
  if (answer.proposals?.length) head.append(element("a", { className: "button primary", href: `${home}/proposals`, textContent: `Confirm ${answer.proposals.length} proposed session${answer.proposals.length > 1 ? "s" : ""}` }));
  for (const session of answer.sessions ?? []) if (session.status === "confirmed") head.append(element("a", { className: "button", href: `/sessions/${session.id}`, textContent: `Session ${session.id}` }));
  if (!good) {
    const note = element("div", { className: "note bad" }, element("b", { textContent: answer.detail ?? `The service answered ${status}.` }));
    note.setAttribute("role", "alert");
    if (answer.hint) note.append(element("div", { textContent: answer.hint }));
    for (const id of mark(answer)) note.append(element("div", {}, element("a", { href: `#${id}`, textContent: "To the field" })));
    if (!answer.report && chosenAgain(files)) note.append(element("div", { textContent: "The files are still chosen." }));
    note.append(...waiting.map((id, i) => mappingLink(id, waiting.length > 1 ? ` (${i + 1} of ${waiting.length})` : "")));
    item.append(note);
  }
  const states = new Map((answer.files ?? []).map((file) => [file.name, file]));
  const groups = []; // a file, and the members of an archive after it
  for (const one of answer.report ?? []) {
    if (!answer.files || states.has(one.name) || !groups.length) groups.push({ one, inner: [] });
    else groups.at(-1).inner.push(one);
  }
  const lines = element("ul", { className: "files" });
  for (const { one, inner } of groups) {
    const file = states.get(one.name);
    const marks = file ? [file.duplicate ? badge("known already", "info") : badge(...(STATES[file.status] ?? (file.waits_for_mapping ? UNKNOWN_COLUMNS : ["not usable, kept", "bad"])))] : [];
    const link = file?.waits_for_mapping ? [mappingLink(file.id)] : [];
    const told = inner.filter((r) => r.problem || Object.keys(LABELS).some((key) => r[key]?.length));
    const own = said(one, good || one.name !== answer.file); // the note above has that file's problem
    const inside = told.length ? [element("ul", { className: "files" }, ...told.map((r) => element("li", {}, folded(r, [r], [], said(r, good)))))] : [];
    lines.append(element("li", {}, folded(one, [one, ...told], marks, [...own, ...inside], inner.length), ...link));
  }
  if (lines.children.length) item.append(lines);
}

// a file is one line, open only where there is a problem; what was understood, and how much is to be looked at, stands in it
function folded(one, reports, marks, content, inside = 0) {
  const problems = reports.filter((r) => r.problem).length;
  const odd = reports.reduce((sum, r) => sum + (r.flagged?.length ?? 0), 0);
  const first = reports.map((r) => ["understood", "flagged", "repaired", "ignored", "removed"].flatMap((key) => r[key] ?? [])[0]).find(Boolean);
  const line = [inside ? `${inside} ${inside > 1 ? "files" : "file"} in it` : "", first ?? ""].filter(Boolean).join(" · ");
  const made = [element("b", { textContent: one.name }), ...marks];
  if (problems) made.push(badge(`${problems} ${problems > 1 ? "problems" : "problem"}`, "bad"));
  if (odd) made.push(badge(`${odd} to look at`, "warn"));
  return element("details", { className: "file", open: problems > 0 }, element("summary", {}, ...made, element("span", { className: "line", textContent: line })), ...content);
}

// what a report says, label by label
function said(one, good) {
  const found = [];
  if (one.problem && good) found.push(element("div", { className: "note bad" }, ...["what", "where", "hint"].map((part) => element("div", { textContent: one.problem[part] }))));
  const pairs = element("dl", { className: "pairs" });
  for (const key of Object.keys(LABELS).filter((k) => one[k]?.length)) pairs.append(element("dt", {}, key === "flagged" ? badge("look at this", "warn") : LABELS[key]), element("dd", {}, ...one[key].map((text) => element("div", { textContent: text }))));
  if (pairs.children.length) found.push(pairs);
  return found;
}
