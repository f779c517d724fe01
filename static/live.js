// Follows the server-sent events of a job: <section data-live="/api/v1/jobs/ID/events">. In the section, KEY is a step's key or "job":
//   [data-step="KEY"]     a bar (the `progress` macro with that key)
//   [data-status="KEY"]   an element whose text is the status
//   [data-time-left]      the time that is left of the whole job, in the words of its events
//   [data-log]            log lines are added to it (anywhere in the page); what stands there is replaced, for the log comes whole
//   figure[data-curve="KEY"]  points are added to the traces named like their values (or with them as `meta`)
// A step that the page does not know yet, and the job's end, load the page again.
function follow(section) {
  const source = new EventSource(section.dataset.live);
  const on = (kind, act) => source.addEventListener(kind, (event) => act(JSON.parse(event.data)));
  let first = true;
  on("job", (state) => {
    if (first) for (const log of document.querySelectorAll("[data-log]")) log.replaceChildren();
    first = false;
    show(section, "job", state);
    for (const step of state.steps) show(section, step.key, step);
  });
  for (const kind of ["status", "step", "progress"]) on(kind, (event) => {
    if (event.step && !byKey(section, "status", event.step).length && !byKey(section, "step", event.step).length) reload(section);
    show(section, event.step ?? "job", event.data);
    if (event.step && typeof event.data.job_progress === "number") show(section, "job", { progress: event.data.job_progress, time_left: event.data.time_left });
  });
  on("log", (event) => addLog(event.step, event.data.text));
  on("points", (event) => { for (const point of event.data.points) addPoint(section, event.step ?? "job", point); });
  on("end", (state) => {
    show(section, "job", state);
    source.close();
    reload(section);
  });
  source.addEventListener("error", () => { section.dataset.connection = source.readyState === EventSource.CLOSED ? "closed" : "retrying"; });
  source.addEventListener("open", () => { section.dataset.connection = "open"; });
  addEventListener("pagehide", () => source.close(), { once: true });
}

const byKey = (section, attribute, key) => section.querySelectorAll(`[data-${attribute}="${CSS.escape(key)}"]`);
const TONES = { succeeded: "good", failed: "bad", running: "info", cancelled: "warn" };

function show(section, key, { status, progress, message, time_left }) {
  for (const bar of byKey(section, "step", key)) {
    if (typeof progress === "number") {
      bar.querySelector("progress").value = progress;
      bar.querySelector("[data-progress-text]").textContent = `${Math.floor(100 * progress)} %`;
    }
    if (typeof message === "string") bar.querySelector("[data-progress-message]").textContent = message;
  }
  if (typeof time_left === "string") for (const place of section.querySelectorAll("[data-time-left]")) place.textContent = time_left;
  if (status) for (const place of byKey(section, "status", key)) {
    const badge = document.createElement("span");
    badge.className = `badge ${TONES[status] ?? ""}`;
    badge.textContent = status;
    place.replaceChildren(badge);
  }
}

function addLog(step, text) {
  for (const log of document.querySelectorAll("[data-log]")) {
    const atEnd = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
    log.append(`${step ? `[${step}] ` : ""}${text}\n`);
    if (atEnd) log.scrollTop = log.scrollHeight;
  }
}

// a repeated x, after a resumed step, replaces its point
const waiting = new Set();
function addPoint(section, key, { x, values }) {
  for (const figure of byKey(section, "curve", key)) {
    const source = figure.querySelector('script[type="application/json"]');
    const content = JSON.parse(source.textContent);
    for (const [name, y] of Object.entries(values)) {
      const trace = content.data.find((t) => t.name === name || t.meta === name);
      if (!trace) continue;
      const at = trace.x.indexOf(x);
      if (at >= 0) trace.y[at] = y; else { trace.x.push(x); trace.y.push(y); }
    }
    source.textContent = JSON.stringify(content);
    if (waiting.has(figure)) continue;
    waiting.add(figure);
    setTimeout(() => { waiting.delete(figure); figure.dispatchEvent(new Event("betaloop:redraw", { bubbles: true })); }, 500);
  }
}

// at most once per page and not within two seconds of its loading, so that a job that ends at once does not make the page flicker
function reload(section) {
  if (section.dataset.reloading) return;
  section.dataset.reloading = "yes";
  setTimeout(() => location.reload(), Math.max(0, 2000 - performance.now()));
}

for (const section of document.querySelectorAll("[data-live]")) follow(section);
