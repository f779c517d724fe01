// Small helpers of the page: elements, times, dialogs.
export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "text") node.textContent = value;
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

export const button = (text, tone, press, more = {}) => el("button", { type: "button", class: tone, onclick: press, ...more }, text);

export function clock(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  return `${String(Math.floor(whole / 60)).padStart(2, "0")}:${String(whole % 60).padStart(2, "0")}`;
}

export const timeOfDay = (ms) => new Date(ms).toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit" });

// A dialog that is removed when it closes. `fill(dialog, close)` gives its content.
export function openDialog(title, fill) {
  const dialog = el("dialog", { class: "day-dialog", "aria-label": title });
  const close = () => dialog.close();
  dialog.append(el("h2", { text: title }), ...[fill(dialog, close)].flat());
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  return dialog;
}
