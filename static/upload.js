// Drag and drop with progress: every file goes to the public upload route by itself, so that one bad file loses nothing else.
const form = document.querySelector("form[data-upload]");
const drop = form.querySelector("[data-drop]");
const input = form.querySelector('input[type="file"]');
const list = document.querySelector("[data-upload-list]");
const LABELS = { understood: "Understood", flagged: "Flagged", repaired: "Repaired", ignored: "Left aside", removed: "Removed" };

form.querySelector("[data-drop-hint]").prepend("Drop files here, or choose them. ");

for (const kind of ["dragenter", "dragover"]) drop.addEventListener(kind, (event) => { event.preventDefault(); drop.classList.add("over"); });
drop.addEventListener("dragleave", (event) => { if (!drop.contains(event.relatedTarget)) drop.classList.remove("over"); });
drop.addEventListener("drop", (event) => {
  event.preventDefault();
  drop.classList.remove("over");
  input.files = event.dataTransfer.files;
  if (form.reportValidity()) start();
});
form.querySelector("button.primary").addEventListener("click", () => { input.required = true; }); // comes before the browser's own check
form.addEventListener("submit", (event) => { event.preventDefault(); start(); });

let busy = Promise.resolve();
function start() {
  const fields = new FormData(form);
  const files = [...input.files];
  input.value = "";
  input.required = false; // emptied by us: an empty field is no mistake until somebody sends it again
  for (const file of files) {
    const item = listed(file);
    busy = busy.then(() => send(file, fields, item)); // one after the other: a clinic's line is narrow
  }
}

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function listed(file) {
  const bar = element("progress", { max: 1, value: 0 });
  const words = element("span", { textContent: "waiting" });
  const head = element("div", { className: "row" }, element("b", { textContent: file.name }), words);
  const item = element("li", {}, head, element("div", { className: "progress" }, bar));
  list.append(item);
  return { file: file.name, item, head, bar, words };
}

function send(file, fields, shown) {
  const body = new FormData();
  body.append("file", file, file.name);
  body.append("participant", form.dataset.participant);
  for (const name of ["visit", "controller", "policy", "started_at", "hemisphere", "beta_unit", "beta_source"]) if (fields.get(name)) body.append(name, fields.get(name));
  return new Promise((done) => {
    const request = new XMLHttpRequest();
    request.open("POST", "/api/v1/uploads");
    request.responseType = "json";
    request.upload.addEventListener("progress", (event) => {
      if (event.lengthComputable) shown.bar.value = event.loaded / event.total;
      shown.words.textContent = event.loaded < event.total ? `sending, ${Math.round((100 * event.loaded) / event.total)} %` : "decoding …";
    });
    request.addEventListener("load", () => { report(shown, request.status, request.response ?? {}); done(); });
    request.addEventListener("error", () => { report(shown, 0, { detail: "The connection broke off.", mend: "Send the file again; what has arrived is not counted twice." }); done(); });
    request.send(body);
  });
}

function report({ file, item, head, words }, status, answer) {
  item.querySelector(".progress").remove();
  const good = status >= 200 && status < 300;
  words.className = `badge ${!good ? "bad" : answer.duplicate ? "info" : "good"}`;
  words.textContent = !good ? "not usable" : answer.duplicate ? "known already" : "decoded";
  for (const session of answer.sessions ?? []) head.append(element("a", { className: "button", href: `/sessions/${session.id}`, textContent: `Session ${session.id}` }));
  if (!good) {
    const note = element("div", { className: "note bad" }, element("b", { textContent: answer.detail ?? `The service answered ${status}.` }));
    note.setAttribute("role", "alert");
    if (answer.mend) note.append(element("div", { textContent: answer.mend }));
    item.append(note);
  }
  for (const one of answer.report ?? []) {
    if (one.name !== file) item.append(element("h3", { textContent: one.name })); // a member of an archive
    const pairs = element("dl", { className: "pairs" });
    for (const [key, label] of Object.entries(LABELS)) if (one[key]?.length) {
      pairs.append(element("dt", { textContent: label }), element("dd", {}, ...one[key].map((line) => element("div", { textContent: line }))));
    }
    item.append(pairs);
  }
}
