// What is on the screen: one session at a time, and what must be known about the day as a whole.
import * as record from "./record.js";
import { button, clock, el, timeOfDay } from "./dom.js";
import { adverseEvent, askReason, enterDose, short, showRules } from "./dialogs.js";
import { outcomes, summary } from "./outcomes.js";

const SYMBOLS = { waiting: "○", running: "▶", asked: "✎", done: "✓", skipped: "–" };
const NAMES = { waiting: "to come", running: "running", asked: "to be rated", done: "finished", skipped: "skipped" };
const MATTERS = { start: "starts", stop: "stops", stop_cause: "causes", rating: "ratings", grasp: "grasp tests", skip: "reasons", dyskinesia: "grades of dyskinesia", speech: "grades of speech", gait: "grades of gait" };

export function current(app) {
  const chosen = app.day.slots.find((slot) => slot.plan_item_id === app.shown);
  return chosen ?? app.day.slots.find((slot) => !["done", "skipped"].includes(record.stateOf(app.entries, slot.plan_item_id))) ?? null;
}

export function draw(root, app) {
  const kept = root.contains(document.activeElement) ? document.activeElement.dataset.focus : null;
  const slot = current(app);
  root.replaceChildren(stopRule(app) ?? "", top(app), banners(app), ...(slot ? session(app, slot) : [finished(app)]), bottom(app, slot));
  if (kept) root.querySelector(`[data-focus="${CSS.escape(kept)}"]`)?.focus();
  tick(root, app);
}

// --- head: whose day, how far, and whether all is sent
function top(app) {
  const { day } = app;
  const slot = current(app);
  const at = slot ? day.slots.indexOf(slot) : day.slots.length;
  const go = (step) => () => { app.shown = day.slots[at + step]?.plan_item_id ?? null; app.draw(); };
  const steps = el("ol", { class: "day-steps", "aria-label": "Sessions of the day" }, day.slots.map((s, i) => {
    const state = record.stateOf(app.entries, s.plan_item_id);
    const label = `Session ${s.position}, ${NAMES[state]}`;
    return el("li", {}, button([el("span", { "aria-hidden": "true", text: SYMBOLS[state] }), ` ${s.position}`], "", () => { app.shown = s.plan_item_id; app.draw(); },
      { "aria-label": label, "aria-current": i === at ? "step" : null, "data-state": state, "data-focus": `step-${s.position}` }));
  }));
  return el("header", { class: "day-top" },
    el("div", { class: "day-who" }, el("b", { text: `${day.participant} · visit ${day.visit}` }), el("span", { class: "muted", text: day.date ?? "no date" })),
    chip(app),
    lastDose(app),
    el("nav", { class: "day-nav", "aria-label": "Sessions" },
      button("‹", "icon", go(-1), { "aria-label": "Session before", disabled: at <= 0, "data-focus": "before" }), steps,
      button("›", "icon", go(1), { "aria-label": "Session after", disabled: at >= day.slots.length - 1, "data-focus": "after" })));
}

function lastDose(app) {
  const doses = record.dosesOf(app.day, app.link.waiting.filter((row) => !row.refused).map((row) => row.entry));
  if (!doses.length) return null;
  const said = doses.slice(-3).map((dose) => `${timeOfDay(Date.parse(dose.taken_at)).slice(0, 5)} ${short(app.drugs.get(dose.drug))} ${dose.mg} mg`);
  return el("p", { class: "day-last-dose", "data-doses": String(doses.length) }, `Doses: ${said.join(", ")}`);
}

function chip(app) {
  const n = app.link.waiting.filter((row) => !row.refused).length;
  const entries = `${n} ${n === 1 ? "entry" : "entries"}`;
  const [tone, text] = {
    online: n ? ["info", `Sending ${entries}`] : ["good", "All sent"],
    starting: ["info", n ? `${entries} to send` : "Connecting"],
    offline: ["warn", n ? `No connection: ${entries} kept on this tablet` : "No connection: entries are kept on this tablet"],
    "signed-out": ["warn", `Signed out: ${entries} kept on this tablet`],
    refused: ["bad", `Not taken: ${entries} kept on this tablet`],
  }[app.link.status];
  return el("span", { class: `badge day-link ${tone}`, role: "status", "data-link": app.link.status, "data-waiting": String(n) }, text);
}

// A stop rule stays at the top of the screen until somebody confirms the clinical settings.
function stopRule(app) {
  const severe = record.openSevere(app.entries);
  if (!severe) return null;
  const item = severe.plan_item_id;
  const where = { item, attempt: severe.attempt };
  const running = app.day.slots.map((s) => s.plan_item_id).find((id) => record.stateOf(app.entries, id) === "running");
  const what = (severe.kind === "adverse_event" ? severe.payload.kind : severe.kind).replaceAll("_", " ");
  const stop = async () => {
    const of = { item: running, attempt: record.lastAttempt(app.entries, running) };
    await app.enter("stop", {}, of);
    await app.enter("stop_cause", { cause: "participant", text: `severe: ${what}` }, of);
  };
  return el("div", { class: "day-stop-rule", role: "alert" }, el("b", { text: `Stop rule: severe ${what}. Return to clinical settings now.` }),
    running ? button("Stop the session", "big", stop, { "data-act": "severe-stop", disabled: !app.day.may_enter }) : null,
    button("It is back on clinical settings", "big", () => app.enter("clinical_settings", {}, where), { "data-act": "severe-back", disabled: Boolean(running) || !app.day.may_enter }));
}

// --- what must be dealt with, worst first
function banners(app) {
  const { day, link } = app;
  const box = el("div", { class: "stack" });
  const add = (tone, title, ...more) => box.append(el("div", { class: `note ${tone}`, role: tone === "bad" ? "alert" : "note" }, el("b", { text: title }), el("div", { class: "row" }, ...more)));
  if (day.not_runnable) add("bad", "Nothing may be started.", el("span", { text: day.not_runnable }));
  if (app.failure) add("bad", app.failure);
  for (const row of link.waiting.filter((one) => one.refused)) {
    add("bad", `An entry was not taken: ${row.entry.kind.replaceAll("_", " ")} of ${timeOfDay(Date.parse(row.entry.device_time))}.`, el("span", { text: row.why }),
      button("Try again", "", async () => { await app.store.setRefused(day.visit_id, row.entry.uuid, null); await link.load(); link.send(); }),
      button("Remove from this tablet", "danger", async () => { await app.store.remove([row.entry.uuid]); await link.load(); }, { "data-confirm": "Remove this entry? It is stored nowhere else." }));
  }
  for (const rows of record.contradictions(app.entries)) {
    const slot = day.slots.find((s) => s.plan_item_id === rows[0].plan_item_id);
    const choose = (row) => app.enter(row.kind, row.payload, { item: row.plan_item_id, attempt: row.attempt, replaces: rows.map((r) => r.uuid), at: record.moment(row) - (link.offsetMs ?? 0) });
    add("warn", `Session ${slot?.position} has different ${MATTERS[rows[0].kind] ?? "entries"}. Which one counts?`,
      rows.map((row) => button(`${said(row)}, ${row.entered_by ?? "this tablet"}, ${timeOfDay(record.moment(row))}`, "", () => choose(row), { "data-act": "choose" })));
  }
  if (link.status === "signed-out") add("warn", "The sign-in has ended. Nothing is lost: go on, and sign in when you can.", signInLink());
  if (link.status === "refused") add("bad", link.problem?.detail || "The service does not take the entries.", el("span", { text: link.problem?.hint ?? "" }));
  if (app.replacedBy) add("warn", "The plan of this visit was replaced. What was entered stays with the old one.", el("a", { class: "button", href: location.pathname, text: "Load the new plan" }));
  if (app.foreign) add("info", `${app.foreign} ${app.foreign === 1 ? "entry" : "entries"} of somebody else ${app.foreign === 1 ? "waits" : "wait"} on this tablet. They are sent when that person signs in here.`);
  if (day.locked) add("warn", "This visit is locked. Entries are kept on the tablet and sent once a clinician unlocks it.");
  if (link.offsetMs !== null && Math.abs(link.offsetMs) > 60_000) add("info", `This tablet's clock is ${Math.round(Math.abs(link.offsetMs) / 1000)} s ${link.offsetMs > 0 ? "behind" : "ahead of"} the service's. Both times are kept.`);
  if (day.date && !day.entries.length && day.date !== localDay()) add("warn", `This plan is for ${day.date}; the tablet says that today is ${localDay()}.`);
  return box;
}

const signInLink = () => el("a", { class: "button primary", href: `/sign-in?next=${encodeURIComponent(location.pathname)}`, text: "Sign in" });
const localDay = () => { const d = new Date(); return `${d.getFullYear()}-${String(d.getMonth() + 1).padStart(2, "0")}-${String(d.getDate()).padStart(2, "0")}`; };

function said(row) {
  if (row.kind === "start" || row.kind === "stop") return row.kind === "start" ? "Started" : "Stopped";
  if (row.kind === "grasp") return `${record.graspHz(row.payload).toFixed(2)} Hz`;
  return String(row.payload?.value ?? row.payload?.grade ?? row.payload?.reason ?? row.payload?.cause ?? row.kind);
}

// --- one session
function session(app, slot) {
  const item = slot.plan_item_id;
  const attempt = record.lastAttempt(app.entries, item);
  const state = record.stateOf(app.entries, item);
  const about = record.about(app.entries, item, attempt);
  const where = { item, attempt };
  const card = el("section", { class: `card day-session ${slot.controller ?? ""}`, "data-session": String(slot.position), "data-state": state });
  card.append(el("header", {},
    el("h1", {}, slot.controller ? el("span", { class: `controller ${slot.controller}` }, el("i", { "aria-hidden": "true" })) : null, ` ${slot.label}`),
    el("p", { class: "muted", text: [`Session ${slot.position} of ${app.day.slots.length}`, attempt > 1 ? `attempt ${attempt}` : "", slot.detail].filter(Boolean).join(" · ") })));
  card.append(limits(slot));
  if (slot.note) card.append(el("p", { text: slot.note }));
  if (state === "skipped") card.append(el("p", { text: `Skipped${about.skip[0].payload ? `: ${about.skip[0].payload.reason}` : ""}.` }));
  else card.append(timer(slot, about, state));
  const mayEnter = app.day.may_enter;
  if (state === "waiting") {
    const other = app.day.slots.find((s) => record.stateOf(app.entries, s.plan_item_id) === "running");
    const blocked = app.day.not_runnable ? "This plan may not run." : other ? `Session ${other.position} is running: stop it first.` : record.openSevere(app.entries) ? "Confirm first that the stimulator is back on clinical settings." : "";
    card.append(button("Start", "primary huge", () => app.enter("start", {}, where), { disabled: Boolean(blocked) || !mayEnter, "data-act": "start", "data-focus": "startstop" }));
    if (blocked) card.append(el("p", { class: "muted", text: blocked }));
    const until = washoutEnd(app);
    if (until > Date.now() + (app.link.offsetMs ?? 0)) card.append(el("p", { class: "day-washout", "data-until": until }));
  }
  if (state === "running") card.append(button("Stop", "stop huge", () => app.enter("stop", {}, where), { disabled: !mayEnter, "data-act": "stop", "data-focus": "startstop" }));
  if (["asked", "done"].includes(state) && early(slot, about)) card.append(stopCause(app, where, about));
  const parts = [card];
  if (["running", "asked"].includes(state)) parts.push(outcomes(app, slot, where, about, state));
  if (state === "done") parts.push(summary(app, slot, where, about));
  return parts;
}

// When the washout of the session before ends, by the service's clock.
function washoutEnd(app) {
  const ends = app.day.slots.map((slot) => {
    const stop = record.about(app.entries, slot.plan_item_id, record.lastAttempt(app.entries, slot.plan_item_id)).stop;
    return stop ? record.moment(stop[0]) + slot.washout_minutes * 60_000 : -Infinity;
  });
  return Math.max(-Infinity, ...ends);
}

function limits(slot) {
  const pairs = [];
  if (slot.limits) {
    const { min_ma: low, max_ma: high, ramp_ma_per_s: ramp } = slot.limits;
    pairs.push(["Amplitude", low === high ? `${low} mA` : `${low} to ${high} mA`]);
    if (ramp !== null) pairs.push(["Change", `at most ${ramp} mA/s`]);
  } else pairs.push(["Amplitude", "limits as on the sheet"]);
  pairs.push(["Planned", `${slot.minutes} min`]);
  if (slot.washout_minutes) pairs.push(["Then", `${slot.washout_minutes} min clinical settings`]);
  return el("dl", { class: "day-limits" }, pairs.map(([name, value]) => el("div", {}, el("dt", { text: name }), el("dd", { text: value }))));
}

function timer(slot, about, state) {
  const began = about.start ? record.moment(about.start[0]) : null;
  const ended = about.stop ? record.moment(about.stop[0]) : null;
  return el("div", { class: "day-timer", "data-began": began, "data-ended": ended, "data-planned": slot.minutes * 60, "data-state": state },
    el("b", { role: "timer", text: clock(0) }), el("span", { text: `of ${clock(slot.minutes * 60)}` }),
    el("progress", { max: slot.minutes * 60, value: 0, "aria-label": "Time of the session" }), el("p", { class: "day-due", text: "" }));
}

// Four times a second: the clock alone, so that nothing that is being touched is drawn anew.
export function tick(root, app) {
  const washout = root.querySelector(".day-washout");
  if (washout) {
    const left = (Number(washout.dataset.until) - Date.now() - (app.link.offsetMs ?? 0)) / 1000;
    washout.textContent = left > 0 ? `Washout on clinical settings: ${clock(left + 0.999)} left.` : "The washout is over.";
  }
  const box = root.querySelector(".day-timer");
  if (!box) return;
  const began = box.dataset.began ? Number(box.dataset.began) : null;
  const now = box.dataset.ended ? Number(box.dataset.ended) : Date.now() + (app.link.offsetMs ?? 0);
  const seconds = began === null ? 0 : (now - began) / 1000;
  const planned = Number(box.dataset.planned);
  box.querySelector("b").textContent = clock(seconds);
  box.querySelector("progress").value = Math.min(seconds, planned);
  const due = box.dataset.state === "running" && seconds >= planned;
  box.classList.toggle("due", due);
  const text = due ? "The planned time is over: stop the session." : "";
  if (box.querySelector(".day-due").textContent !== text) box.querySelector(".day-due").textContent = text;
}

const early = (slot, about) => about.start && about.stop && record.moment(about.stop[0]) - record.moment(about.start[0]) < slot.minutes * 60_000 - 15_000;

function stopCause(app, where, about) {
  const known = about.stop_cause ?? [];
  const choices = [["participant", "For the participant's sake"], ["technical", "Technical"], ["other", "Another reason"]];
  return el("fieldset", { class: "day-choice" }, el("legend", { text: "Stopped before the planned end: why?" }),
    el("div", { class: "day-three" }, choices.map(([cause, text]) => button(text, "", () => app.enter("stop_cause", { cause, text: "" }, { ...where, replaces: known.map((e) => e.uuid) }),
      { "aria-pressed": String(known[0]?.payload?.cause === cause), "data-act": `cause-${cause}`, "data-focus": `cause-${cause}` }))));
}

// --- the end of the day
function finished(app) {
  const end = record.dayEnd(app.entries);
  if (end) {
    return el("section", { class: "card day-session", "data-state": "day-over" }, el("h1", { text: "The day is complete" }),
      el("p", { text: `Back on clinical settings, confirmed at ${timeOfDay(record.moment(end))}.` }),
      el("p", { text: app.link.waiting.length ? "Keep this page open until all is sent." : "All entries are sent; none is left on this tablet." }),
      el("p", {}, el("a", { class: "button big", href: `/visits/${app.day.visit_id}`, text: "Visit" })));
  }
  return el("section", { class: "card day-session", "data-state": "day-end" }, el("h1", { text: "All sessions are over" }),
    el("p", { text: "Check the stimulator: program, amplitude and sides as the participant came in with." }),
    button("It is back on clinical settings", "primary huge", () => app.enter("clinical_settings", {}), { "data-act": "back", disabled: !app.day.may_enter, "data-focus": "back" }));
}

function bottom(app, slot) {
  const item = slot?.plan_item_id ?? null;
  const attempt = slot ? record.lastAttempt(app.entries, item) : null;
  const state = slot ? record.stateOf(app.entries, item) : null;
  const where = { item, attempt };
  const enter = (kind) => (reason) => app.enter(kind, { reason }, where).then(() => { app.shown = kind === "skip" ? null : item; app.draw(); });
  const rules = app.noteRules;
  return el("footer", { class: "day-bottom" },
    button("Adverse event", "danger", () => adverseEvent(app, where, app.eventKinds, rules), { "data-act": "event", disabled: !app.day.may_enter }),
    app.day.may_dose ? button("Dose", "", () => enterDose(app), { "data-act": "dose" }) : null,
    slot && state === "waiting" ? button("Skip", "", () => askReason(`Skip session ${slot.position}`, rules, enter("skip")), { "data-act": "skip", disabled: !app.day.may_enter }) : null,
    slot && ["asked", "done", "skipped"].includes(state) ? button(state === "skipped" ? "Run it after all" : "Repeat", "", () => askReason(`Repeat session ${slot.position}`, rules, enter("repeat")), { "data-act": "repeat", disabled: !app.day.may_enter }) : null,
    button("Stop rules", "", () => showRules(app.day.stop_rules)));
}
