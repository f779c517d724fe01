// What is asked in a window of its own: reasons, notes, grasp tests, adverse events, doses.
import { graspHz } from "./record.js";
import { screen } from "./screening.js";
import { button, clock, el, openDialog } from "./dom.js";

const TEST_MS = 10_000;
const WHAT = { date: "a date", number: "a number of four or more digits", address: "an address" };

export function showRules(rules) {
  openDialog("Stop rules", (dialog, close) => [...rules.map((text) => el("p", { text })), el("menu", {}, button("Close", "primary big", close))]);
}

// A text that is screened before it is kept: `keep(text, noNames)` is called once nothing in it may say who the participant is.
export function askText(title, rules, keep, { rows = 3, most = 1000 } = {}) {
  openDialog(title, (dialog, close) => {
    const area = el("textarea", { rows: String(rows), maxlength: String(most), "aria-label": title, autofocus: true });
    const told = el("div", { role: "alert", class: "stack" });
    const check = async (noNames = []) => {
      const text = area.value.trim();
      if (!text) { told.replaceChildren(el("p", { text: "Nothing is written yet." })); return; }
      const found = screen(text, rules, noNames);
      const refused = found.filter((one) => one.kind !== "name");
      const names = found.filter((one) => one.kind === "name").map((one) => one.text);
      if (refused.length) {
        told.replaceChildren(el("p", {}, el("b", { text: "Take this out first: " }), refused.map((one) => `${WHAT[one.kind]} (${one.text})`).join(", ") + "."));
      } else if (names.length) {
        told.replaceChildren(el("p", {}, el("b", { text: names.length === 1 ? "Is this a name? " : "Are these names? " }), names.join(", ")),
          el("div", { class: "row" }, button(names.length === 1 ? "It is no name: keep the text" : "None is a name: keep the text", "big", () => check(names), { "data-act": "no-names" })));
      } else {
        await keep(text, noNames);
        close();
      }
    };
    return [el("p", { class: "muted", text: "No names, no dates, no long numbers." }), area, told,
      el("menu", {}, button("Cancel", "quiet big", close), button("Keep", "primary big", () => check(), { "data-act": "keep" }))];
  });
}

export const askReason = (title, rules, keep) => askText(`${title}: why?`, rules, (text) => keep(text), { rows: 2, most: 500 });

// --- grasp: taps counted for ten seconds, or a number that was read elsewhere
export function countGrasps(keep) {
  openDialog("Grasp test, 10 s", (dialog, close) => {
    let began = null, began0 = 0, taps = [], timer = null, ended = null;
    const shown = el("b", { class: "day-count", text: "0" });
    const left = el("span", { class: "muted", text: "The count starts with the first tap and ends by itself." });
    const pad = el("button", { type: "button", class: "primary tap-pad", "data-act": "tap", autofocus: true }, "Tap at each open fist");
    const result = el("menu", {}, button("Cancel", "quiet big", () => { clearTimeout(timer); close(); }));
    const over = () => {
      ended = Date.now();
      clearInterval(timer);
      pad.disabled = true;
      const payload = { method: "taps", hz: null, taps_s: taps, began_at: new Date(began).toISOString(), ended_at: new Date(ended).toISOString() };
      const enough = taps.length >= 2;
      left.textContent = enough ? `${taps.length} open fists, ${graspHz(payload).toFixed(2)} Hz.` : "Fewer than two taps make no frequency. Count again.";
      result.replaceChildren(button("Count again", "big", () => { close(); countGrasps(keep); }),
        enough ? button("Keep", "primary big", async () => { await keep(payload); close(); }, { "data-act": "keep" }) : button("Cancel", "quiet big", close));
    };
    // pointerdown, not click: the moment of the touch, and a glove that slides does not lose it
    const tap = (event) => {
      if (event.type === "keydown" && (event.repeat || ![" ", "Enter"].includes(event.key))) return;
      event.preventDefault();
      if (ended !== null) return;
      if (began === null) {
        began = Date.now();
        began0 = event.timeStamp;
        timer = setInterval(() => {
          const passed = Date.now() - began;
          left.textContent = `${clock((TEST_MS - passed) / 1000 + 0.999)} left`;
          if (passed >= TEST_MS) over();
        }, 100);
      }
      const at = Math.round(event.timeStamp - began0) / 1000;
      if (at * 1000 >= TEST_MS || (taps.length && at <= taps[taps.length - 1])) return;
      taps.push(at);
      shown.textContent = String(taps.length);
    };
    pad.addEventListener("pointerdown", tap);
    pad.addEventListener("keydown", tap);
    dialog.addEventListener("close", () => clearInterval(timer));
    return [shown, left, pad, result];
  });
}

const USUAL_HZ = [0.3, 6]; // app/study/outcome_fields.py
export function typeGrasp(keep) {
  openDialog("Grasp frequency", (dialog, close) => {
    const field = el("input", { type: "number", inputmode: "decimal", min: "0", max: "19.9", step: "0.01", "aria-label": "Grasp frequency in Hz", autofocus: true });
    const told = el("p", { role: "alert" });
    let sure = null;
    const check = async () => {
      const hz = Number(field.value);
      if (field.value === "" || !Number.isFinite(hz) || hz < 0 || hz >= 20) { told.textContent = "Give a frequency from 0 to below 20 Hz."; return; }
      if ((hz < USUAL_HZ[0] || hz > USUAL_HZ[1]) && sure !== field.value) {
        sure = field.value;
        told.textContent = `${hz} Hz lies outside what is usual (${USUAL_HZ[0]} to ${USUAL_HZ[1]} Hz). Is it right? Keep it once more, or correct it.`;
        return;
      }
      await keep({ method: "typed", hz, taps_s: [], began_at: null, ended_at: null });
      close();
    };
    return [el("div", { class: "with-unit" }, field, el("span", { class: "unit", text: "Hz" })), told,
      el("menu", {}, button("Cancel", "quiet big", close), button("Keep", "primary big", check, { "data-act": "keep" }))];
  });
}

// --- adverse events: the second tap says what and how bad
export function adverseEvent(app, where, kinds, rules) {
  const at = Date.now();
  openDialog("Adverse event", (dialog, close) => {
    const enter = async (kind, severity, serious, note = "", noNames = []) => {
      await app.enter("adverse_event", { kind, severity, serious, note, no_names: noNames }, { ...where, at });
      close();
    };
    const pick = (kind, severity, serious) => () => {
      if (kind !== "other") return enter(kind, severity, serious);
      close();
      return askText("What happened?", rules, (text, noNames) => enter(kind, severity, serious, text, noNames));
    };
    const rows = kinds.map(([kind, name]) => el("div", { class: "day-event", role: "group", "aria-label": name }, el("span", { text: name }),
      [["mild", false, "Mild"], ["moderate", false, "Moderate"], ["severe", false, "Severe"], ["severe", true, "Serious"]].map(([severity, serious, text]) =>
        button(text, severity === "severe" ? "danger" : "", pick(kind, severity, serious), { "data-act": `event-${kind}-${text.toLowerCase()}` }))));
    return [el("p", {}, el("b", { text: "First stop the controller on its tablet (Ctrl-C): it returns to clinical settings at once." }),
      " Nothing that is entered on this page, Stop included, reaches the controller."),
      el("p", { class: "muted", text: "Serious: danger to life, hospital, lasting harm, or what a clinician holds equal. More can be said later, on the page of the event." }),
      el("div", { class: "day-events" }, rows), el("menu", {}, button("Cancel", "quiet big", close))];
  });
}

// --- doses: the second tap says what was taken, just now or so many minutes ago
const USUAL_MG = [50, 100, 150, 200];
const AGO = [[0, "just now"], [15, "15 min ago"], [30, "30 min ago"], [60, "1 h ago"]];

export function enterDose(app) {
  const at = Date.now();
  openDialog("Dose taken", (dialog, close) => {
    let ago = 0;
    const told = el("p", { role: "alert" });
    const when = el("div", { class: "day-ago", role: "group", "aria-label": "When" }, AGO.map(([minutes, text]) => button(text, "", () => {
      ago = minutes;
      clockTime.value = "";
      press();
    }, { "data-ago": String(minutes), "data-act": `ago-${minutes}` })));
    const press = () => when.querySelectorAll("[data-ago]").forEach((one) => one.setAttribute("aria-pressed", String(!clockTime.value && Number(one.dataset.ago) === ago)));
    const clockTime = el("input", { type: "time", "aria-label": "Taken at, by this tablet's clock", oninput: () => press() });
    const enter = async (drug, mg) => { await app.enter("dose", { drug, mg }, { at: taken(at, ago, clockTime.value) }); close(); };
    const offered = new Map([...app.day.planned_doses, ...USUAL_MG.map((mg) => ({ drug: "levodopa", mg }))].map((dose) => [`${dose.drug} ${dose.mg}`, dose]));
    const drug = el("select", { "aria-label": "Drug" }, [...app.drugs].map(([value, text]) => el("option", { value, text })));
    const mg = el("input", { type: "number", inputmode: "decimal", min: "0", max: "5000", step: "any", "aria-label": "Dose in mg" });
    const other = () => {
      const value = Number(mg.value);
      if (!(value > 0 && value <= 5000)) { told.textContent = "Give the dose in mg."; return null; }
      return enter(drug.value, value);
    };
    press();
    return [when, el("label", { class: "day-line" }, el("span", { text: "or at" }), clockTime),
      el("div", { class: "day-doses" }, [...offered.values()].map((dose) => button(`${short(app.drugs.get(dose.drug))} ${dose.mg} mg`, "", () => enter(dose.drug, dose.mg), { "data-act": `dose-${dose.drug}-${dose.mg}` }))),
      el("details", {}, el("summary", { text: "Another drug or dose" }), el("div", { class: "day-line" }, drug,
        el("div", { class: "with-unit" }, mg, el("span", { class: "unit", text: "mg" })), button("Enter", "", other, { "data-act": "dose-other" }))),
      told, el("p", { class: "muted", text: "Of levodopa combinations the levodopa: 100 of a 25/100 tablet. A wrong dose is removed on the visit's page, with a reason." }),
      el("menu", {}, button("Cancel", "quiet big", close))];
  });
}

// When a dose was taken: at a time of this tablet's day, or of the day before where that has not come yet; else so many minutes ago.
function taken(now, minutesAgo, clockTime) {
  if (!clockTime) return now - minutesAgo * 60_000;
  const [hours, minutes] = clockTime.split(":").map(Number);
  const that = new Date(now);
  that.setHours(hours, minutes, 0, 0);
  if (that.getTime() > now) that.setDate(that.getDate() - 1);
  return that.getTime();
}

export const short = (name) => name.replace(/ \(.*\)/, "");
