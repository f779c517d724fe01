// Small behaviours of every page: sorting, confirmation, single submission, refreshing. Pages work without all of them.

// --- tables: click a heading to sort; numbers, dates and missing values sort as such
const MISSING = new Set(["", "—"]);

function sortValue(cell) {
  const text = (cell?.dataset.value ?? cell?.textContent ?? "").trim();
  if (MISSING.has(text)) return null;
  const number = Number(text.replaceAll("\u202f", "").replace("\u2212", "-").replace(/\s*%$/, ""));
  return Number.isNaN(number) ? text.toLowerCase() : number;
}

function compare(a, b) {
  if (a === null || b === null) return a === b ? 0 : a === null ? 1 : -1; // missing values stay last
  if (typeof a === "number" && typeof b === "number") return a - b;
  return String(a).localeCompare(String(b), "en", { numeric: true });
}

function sortTable(heading) {
  const table = heading.closest("table");
  const column = [...heading.parentElement.children].indexOf(heading);
  const ascending = heading.getAttribute("aria-sort") !== "ascending";
  for (const other of heading.parentElement.children) other.removeAttribute("aria-sort");
  heading.setAttribute("aria-sort", ascending ? "ascending" : "descending");
  for (const body of table.tBodies) {
    // within each group, whose heading stays first
    const rows = [...body.rows].filter((row) => !row.classList.contains("group")).map((row) => [sortValue(row.cells[column]), row]);
    rows.sort(([a], [b]) => (a === null || b === null || ascending ? compare(a, b) : compare(b, a)));
    body.append(...rows.map(([, row]) => row));
  }
}

function makeSortable(root) {
  for (const heading of root.querySelectorAll("table[data-sort] thead th")) {
    if (heading.querySelector("button") || "nosort" in heading.dataset) continue;
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => sortTable(heading));
  }
}

// --- confirmation before what cannot be taken back
// both buttons say what they do, so that no answer can be read backwards: data-confirm-yes, data-confirm-no
async function confirmed(button) {
  const dialog = document.getElementById("confirm");
  dialog.querySelector("#confirm-text").textContent = button.dataset.confirm;
  dialog.querySelector("[value=yes]").textContent = button.dataset.confirmYes || button.textContent.trim();
  dialog.querySelector("[value=no]").textContent = button.dataset.confirmNo || "Leave it as it is";
  dialog.returnValue = "no";
  dialog.showModal();
  await new Promise((done) => dialog.addEventListener("close", done, { once: true }));
  return dialog.returnValue === "yes";
}

document.addEventListener("click", async (event) => {
  const button = event.target.closest("[data-confirm]");
  if (!button || button.dataset.confirmed) return;
  event.preventDefault();
  if (!(await confirmed(button))) return;
  button.dataset.confirmed = "yes";
  button.click();
  delete button.dataset.confirmed;
});

// --- a form is sent once
document.addEventListener("submit", (event) => {
  const form = event.target.closest("form[data-once]");
  if (!form) return;
  // after this turn, so that the pressed button's own name and value are still sent
  setTimeout(() => { for (const button of form.querySelectorAll("button")) button.disabled = true; });
});
addEventListener("pageshow", (event) => {
  // the back button brings the page back as it was left
  if (event.persisted) for (const button of document.querySelectorAll("form[data-once] button")) button.disabled = false;
});

// --- "/" goes to the search, unless somebody types
document.addEventListener("keydown", (event) => {
  if (event.key !== "/" || event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, textarea, select, [contenteditable]")) return;
  const find = document.getElementById("find");
  if (!find) return;
  event.preventDefault();
  find.select();
});

// --- what stands for some seconds gives way to what stands then, beside it; the service goes by its own clock
for (const part of document.querySelectorAll("[data-ends-in]")) {
  const ends = Date.now() + 1000 * Number(part.dataset.endsIn);
  const looking = setInterval(() => {
    if (Date.now() < ends) return;
    clearInterval(looking);
    part.hidden = true;
    part.parentElement.querySelector("[data-then]").hidden = false;
  }, 1000);
}

// --- what takes long comes after the page: a link to the page that holds it, within an element of the same id
for (const late of document.querySelectorAll("[data-late][id]")) {
  fetch(late.querySelector("a").href, { headers: { Accept: "text/html" } })
    .then(async (answer) => {
      const fresh = answer.ok && new DOMParser().parseFromString(await answer.text(), "text/html").getElementById(late.id);
      if (fresh) { late.replaceChildren(...fresh.childNodes); announce(late); }
      late.dataset.late = fresh ? "here" : "refused";
    })
    .catch((error) => { late.dataset.late = "refused"; console.info("left as a link", error); });
}

// --- parts of a page that fetch themselves again
async function refresh(id) {
  const old = document.getElementById(id);
  if (!old || !old.dataset.refresh) return;
  const seconds = Number(old.dataset.refresh);
  if (!document.hidden) {
    try {
      const answer = await fetch(location.href, { headers: { Accept: "text/html" } });
      if (answer.ok && !answer.redirected) {
        const fresh = new DOMParser().parseFromString(await answer.text(), "text/html").getElementById(id);
        if (fresh) { old.replaceWith(fresh); announce(fresh); }
      }
    } catch (error) {
      console.info("refresh failed, trying again later", error);
    }
  }
  setTimeout(() => refresh(id), seconds * 1000);
}

function announce(root) {
  makeSortable(root);
  for (const scroll of root.querySelectorAll(".table-scroll")) fitting.observe(scroll);
  root.dispatchEvent(new CustomEvent("betaloop:swap", { bubbles: true }));
}

document.addEventListener("betaloop:renewed", (event) => announce(event.target)); // a part that a page's own script has drawn anew

// --- a table that shows all its columns needs no stop of the Tab key for scrolling
const fitting = new ResizeObserver((entries) => {
  for (const { target } of entries) {
    if (target.scrollWidth > target.clientWidth || target.scrollHeight > target.clientHeight) target.tabIndex = 0;
    else target.removeAttribute("tabindex");
  }
});
for (const scroll of document.querySelectorAll(".table-scroll")) fitting.observe(scroll);

makeSortable(document);
for (const part of document.querySelectorAll("[data-refresh][id]")) setTimeout(() => refresh(part.id), Number(part.dataset.refresh) * 1000);

// --- paper has the rows that a count of the page includes, also of a fold that nobody opened
addEventListener("beforeprint", () => { for (const fold of document.querySelectorAll("details:is(.counted, .file:has(.file)):not([open])")) { fold.open = true; fold.dataset.printed = ""; } });
addEventListener("afterprint", () => { for (const fold of document.querySelectorAll("details[data-printed]")) { fold.open = false; delete fold.dataset.printed; } });
