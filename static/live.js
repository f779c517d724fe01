// Follows the server-sent events of a job: <section data-live="/api/v1/jobs/ID/events">. An event is {id, kind, step, at, data}:
//   progress {progress, job_progress, message}   fills [data-step="STEP"] and [data-step="job"] (`progress` macros with these keys)
//   step, status {status}                        fills [data-status="STEP"] or, without a step, [data-status="job"]
//   log      {text}                              adds a line to [data-log]
//   points   {points: [{x, values}]}             adds to the figure [data-curve="STEP"]
// The first event, `job`, and the last, `end`, hold the whole job: at the end the page is loaded again.
const KINDS = ["status", "step", "progress", "points", "log"];

function follow(section) {
  const source = new EventSource(section.dataset.live);
  for (const kind of KINDS) source.addEventListener(kind, (event) => {
    const { step, data } = JSON.parse(event.data);
    apply(section, { ...data, step, log: data.text });
    if (typeof data.job_progress === "number") apply(section, { progress: data.job_progress, message: data.message });
  });
  source.addEventListener("job", (event) => {
    const job = JSON.parse(event.data);
    apply(section, { progress: job.progress, message: job.message, status: job.status });
    for (const step of job.steps) apply(section, { step: step.key, progress: step.progress, message: step.message, status: step.status });
  });
  source.addEventListener("end", () => { source.close(); location.reload(); });
  source.addEventListener("error", () => { section.dataset.connection = source.readyState === EventSource.CLOSED ? "closed" : "retrying"; });
  source.addEventListener("open", () => { section.dataset.connection = "open"; });
  addEventListener("pagehide", () => source.close(), { once: true });
}

const stepOf = (data) => data.step ?? null;
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
