// What the entries of a clinic day amount to; app/planning/visit_day/record.py does the same for the study.
export const SAME_MOMENT_MS = 5000;
export const GRADED = ["dyskinesia", "speech", "gait"];
const LOGS = new Set(["note", "adverse_event", "clinical_settings", "repeat", "dose"]);
const STATES = [["skip", "skipped"], ["session_end", "done"], ["stop", "asked"], ["start", "running"]];

export const moment = (entry) => Date.parse(entry.device_time) + (entry.clock_offset_ms ?? 0);

export function standing(entries) {
  const replaced = new Set(entries.flatMap((e) => e.replaces));
  return entries.filter((e) => !replaced.has(e.uuid)).sort((a, b) => moment(a) - moment(b));
}

export function lastAttempt(entries, item) {
  return 1 + Math.max(0, ...entries.filter((e) => e.plan_item_id === item && e.kind === "repeat").map((e) => e.attempt));
}

export function graspHz(payload) {
  if (payload.method === "typed") return payload.hz;
  const taps = payload.taps_s;
  return (taps.length - 1) / (taps[taps.length - 1] - taps[0]);
}

// What was sent keeps no values on the tablet after a reload without network: it agrees with everything.
export function agree(one, other) {
  if (one.kind === "start" || one.kind === "stop") return Math.abs(moment(one) - moment(other)) <= SAME_MOMENT_MS;
  if (one.payload === null || other.payload === null) return true;
  if (one.kind === "grasp") return graspHz(one.payload) === graspHz(other.payload);
  return canonical(one.payload) === canonical(other.payload);
}

const canonical = (payload) => JSON.stringify(Object.entries(payload).sort(([a], [b]) => (a < b ? -1 : 1)));

export function contradictions(entries) {
  const matters = new Map();
  for (const entry of standing(entries)) {
    if (entry.plan_item_id === null || LOGS.has(entry.kind)) continue;
    const key = `${entry.plan_item_id}/${entry.attempt}/${entry.kind}`;
    matters.set(key, [...(matters.get(key) ?? []), entry]);
  }
  return [...matters.values()].filter((rows) => !rows.every((row) => agree(rows[0], row)));
}

// Everything that stands of one attempt of a session: by kind the entries, earliest first.
export function about(entries, item, attempt) {
  const said = {};
  for (const entry of standing(entries)) {
    if (entry.plan_item_id === item && entry.attempt === attempt) (said[entry.kind] ??= []).push(entry);
  }
  return said;
}

export function stateOf(entries, item) {
  const said = about(entries, item, lastAttempt(entries, item));
  return STATES.find(([kind]) => said[kind])?.[1] ?? "waiting";
}

// A severe side effect, and a severe adverse event, are stop rules.
const isSevere = (e) => (GRADED.includes(e.kind) ? e.payload?.grade : e.kind === "adverse_event" ? e.payload?.severity : null) === "severe";

// The severe side effect after which nobody has confirmed the clinical settings yet.
export function openSevere(entries) {
  const rows = standing(entries);
  const confirmed = Math.max(-Infinity, ...rows.filter((e) => e.kind === "clinical_settings").map(moment));
  return rows.filter((e) => isSevere(e) && moment(e) >= confirmed).pop() ?? null;
}

// The day is over once the clinical settings were confirmed after the last session.
export function dayEnd(entries) {
  const rows = standing(entries);
  const last = Math.max(-Infinity, ...rows.filter((e) => e.kind === "start" || e.kind === "stop").map(moment));
  return rows.find((e) => e.kind === "clinical_settings" && e.plan_item_id === null && moment(e) >= last) ?? null;
}

// The doses of the visit, those of entries that the service does not list yet among them, by time.
export function dosesOf(day, entries) {
  const entered = entries.filter((e) => e.kind === "dose" && e.payload).map((e) => ({ ...e.payload, taken_at: new Date(minute(moment(e))).toISOString() }));
  const key = (dose) => `${dose.drug} ${minute(Date.parse(dose.taken_at))}`;
  return [...new Map([...day.doses, ...entered].map((dose) => [key(dose), dose])).values()].sort((a, b) => Date.parse(a.taken_at) - Date.parse(b.taken_at));
}

const minute = (ms) => ms - (((ms % 60_000) + 60_000) % 60_000);
