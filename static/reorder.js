// Sessions of a plan are dragged into another order; without a pointer or scripts the buttons beside them do the same.
const list = document.querySelector("[data-reorder]");
let moved = null;

function places(target) {
  const rows = [...list.children];
  return rows.indexOf(target) - rows.indexOf(moved);
}

function send(by) {
  const form = Object.assign(document.createElement("form"), { method: "post", action: list.dataset.reorder });
  const fields = { position: moved.dataset.position, earlier: by < 0 ? "yes" : "no", places: Math.abs(by) };
  for (const [name, value] of Object.entries(fields)) form.append(Object.assign(document.createElement("input"), { type: "hidden", name, value }));
  document.body.append(form);
  form.submit();
}

if (list) {
  for (const row of list.children) row.draggable = true;
  list.addEventListener("dragstart", (event) => {
    moved = event.target.closest("li");
    event.dataTransfer.effectAllowed = "move";
    event.dataTransfer.setData("text/plain", moved.textContent.trim());
  });
  list.addEventListener("dragover", (event) => {
    const over = event.target.closest("li");
    if (!moved || !over) return;
    event.preventDefault();
    for (const row of list.children) row.toggleAttribute("data-over", row === over && row !== moved);
  });
  list.addEventListener("drop", (event) => {
    const over = event.target.closest("li");
    if (!moved || !over) return;
    event.preventDefault();
    const by = places(over);
    if (by) send(by);
  });
  list.addEventListener("dragend", () => {
    moved = null;
    for (const row of list.children) row.removeAttribute("data-over");
  });
}
