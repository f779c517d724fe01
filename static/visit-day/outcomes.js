// What is asked at the end of a session: rating, grasp, side effects, notes; each is kept at once, and another tap corrects it.
import * as record from "./record.js";
import { button, el, timeOfDay } from "./dom.js";
import { askText, countGrasps, typeGrasp } from "./dialogs.js";

const GRADES = ["none", "mild", "severe"];
const NAMES = { dyskinesia: "Dyskinesia", speech: "Speech worse", gait: "Gait worse" };
const SENT = "sent";

export function outcomes(app, slot, where, about, state) {
  const rules = app.noteRules;
  const replace = (kind) => ({ ...where, replaces: (about[kind] ?? []).map((e) => e.uuid) });
  const enter = (kind, payload) => app.enter(kind, payload, replace(kind));
  const grasp = about.grasp?.[0];
  const off = !app.day.may_enter;
  const card = el("section", { class: "card day-outcomes", "aria-label": "Outcomes of the session" });
  card.append(
    el("fieldset", { class: "day-choice" }, el("legend", { text: "Participant's rating" }, about.rating && !about.rating[0].payload ? el("small", { text: " sent" }) : null),
      el("div", { class: "day-ten" }, Array.from({ length: 10 }, (_, i) => i + 1).map((value) => button(String(value), "", () => enter("rating", { value }),
        { "aria-pressed": String(about.rating?.[0].payload?.value === value), disabled: off, "data-act": `rating-${value}`, "data-focus": `rating-${value}` }))),
      el("p", { class: "day-ends muted" }, el("span", { text: "1 worst" }), el("span", { text: "10 best" }))),
    el("div", { class: "day-line" }, el("h3", { text: "Grasp" }), el("span", { class: "day-value", "data-value": "grasp", text: grasp ? valueOfGrasp(grasp) : "not yet" }),
      button("Count 10 s", "", () => countGrasps((payload) => enter("grasp", payload)), { disabled: off, "data-act": "count" }),
      button("Type a number", "", () => typeGrasp((payload) => enter("grasp", payload)), { disabled: off, "data-act": "type" })),
    el("div", { class: "day-line" }, el("h3", { text: "Tremor" }), el("span", { class: "muted", text: "from the watch, uploaded after the visit" })),
    ...record.GRADED.map((kind) => el("div", { class: "day-line", role: "group", "aria-label": NAMES[kind] }, el("h3", { text: NAMES[kind] }),
      el("div", { class: "day-three" }, GRADES.map((grade) => button(grade, grade === "severe" ? "danger" : "", () => enter(kind, { grade }),
        { "aria-pressed": String(about[kind]?.[0].payload?.grade === grade), disabled: off, "data-act": `${kind}-${grade}`, "data-focus": `${kind}-${grade}` }))))),
    notes(about),
    el("div", { class: "row" }, button("Add a note", "", () => askText("Note on this session", rules, (text, noNames) => app.enter("note", { text, no_names: noNames }, where)), { disabled: off, "data-act": "note" })));
  if (state === "asked") {
    const missing = [["rating", "rating"], ["grasp", "grasp test"], ...record.GRADED.map((kind) => [kind, NAMES[kind].toLowerCase()])].filter(([kind]) => !about[kind]).map(([, name]) => name);
    const next = async () => { await app.enter("session_end", {}, where); app.shown = null; app.draw(); };
    card.append(missing.length ? el("p", { class: "day-missing", text: `Not entered: ${missing.join(", ")}.` }) : "",
      button(missing.length ? "Finish the session without them" : "Finish the session", missing.length ? "huge" : "primary huge", next, { disabled: off, "data-act": "finish", "data-focus": "finish" }));
  }
  return card;
}

export function summary(app, slot, where, about) {
  const value = (kind, read) => (about[kind] ? (about[kind][0].payload ? read(about[kind][0]) : SENT) : "not entered");
  const pairs = [["Rating", value("rating", (e) => String(e.payload.value))], ["Grasp", about.grasp ? valueOfGrasp(about.grasp[0]) : "not entered"],
    ...record.GRADED.map((kind) => [NAMES[kind], value(kind, (e) => e.payload.grade)])];
  const reopen = el("details", {}, el("summary", { text: "Correct" }));
  reopen.addEventListener("toggle", () => { if (reopen.open && reopen.children.length === 1) reopen.append(outcomes(app, slot, where, about, "done")); });
  return el("section", { class: "card day-outcomes" }, el("h2", { text: "Entered" }),
    el("dl", { class: "pairs" }, pairs.flatMap(([name, text]) => [el("dt", { text: name }), el("dd", { text })])), notes(about), reopen);
}

const valueOfGrasp = (entry) => (entry.payload ? `${record.graspHz(entry.payload).toFixed(2)} Hz${entry.payload.method === "taps" ? `, ${entry.payload.taps_s.length} open fists` : ""}` : SENT);

function notes(about) {
  const rows = about.note ?? [];
  return rows.length ? el("ul", { class: "day-notes" }, rows.map((e) => el("li", {}, el("small", { class: "muted", text: timeOfDay(record.moment(e)) }), ` ${e.payload?.text ?? SENT}`))) : "";
}
