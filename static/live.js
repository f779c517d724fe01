// Follows server-sent events of a job: <section data-live="/api/v1/jobs/ID/events">.
//   progress {progress, message, step?}   fills [data-step="KEY"] (a `progress` macro with that key; the job's own has the key "job")
//   status   {status, step?}              fills [data-status="KEY"]; when the job itself has ended, the page is loaded again
//   log      {log}                        adds a line to [data-log]
//   point    {step, points: [{x, values}]}  adds to the figure [data-curve="STEP"]
const ENDED = new Set(["succeeded", "failed", "cancelled"]);

function follow(section) {
  const source = new EventSource(section.dataset.live);
  const handle = (kind) => (event) => {
    const data = JSON.parse(event.data);
    apply(section, { kind, ...data });
    if (data.status && ENDED.has(data.status) && !stepOf(data)) { source.close(); location.reload(); }
  };
  for (const kind of ["progress", "status", "log", "point", "message"]) source.addEventListener(kind, handle(kind));
  source.addEventListener("error", () => { section.dataset.connection = source.readyState === EventSource.CLOSED ? "closed" : "retrying"; });
  source.addEventListener("open", () => { section.dataset.connection = "open"; });
  addEventListener("pagehide", () => source.close(), { once: true });
}

const stepOf = (data) => data.step ?? data.step_key ?? null;
const byKey = (section, attribute, key) => section.querySelectorAll(`[data-${attribute}="${CSS.escape(key)}"]`);

function apply(section, data) {
  const key = stepOf(data) ?? "job";
  if (typeof data.progress === "number") {
    for (const bar of byKey(section, "step", key)) {
      bar.querySelector("progress").value = data.progress;
      bar.querySelector("[data-progress-text]").textContent = `${Math.round(100 * data.progress)} %`;
    }
  }
  if (data.message !== undefined) for (const bar of byKey(section, "step", key)) bar.querySelector("[data-progress-message]").textContent = data.message;
  if (data.status) for (const badge of byKey(section, "status", key)) badge.textContent = data.status;
  if (data.log) for (const log of section.querySelectorAll("[data-log]")) {
    const atEnd = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
    log.append(`${stepOf(data) ? `[${stepOf(data)}] ` : ""}${data.log}\n`);
    if (atEnd) log.scrollTop = log.scrollHeight;
  }
  for (const point of data.points ?? []) addPoint(section, key, point);
}

// learning curves: traces are named after the values; a repeated x after a resumed step replaces its point
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

for (const section of document.querySelectorAll("[data-live]")) follow(section);
