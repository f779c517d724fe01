// Moves along a comparison of policies: the slider sets the cursor and the numbers; without this script the form does it.
const form = document.querySelector("form[data-scrub]");
if (form) {
  const frame = JSON.parse(document.getElementById("scrub-frame").textContent);
  const slider = form.querySelector("input[type=range]");
  const cursors = document.querySelectorAll("[data-cursor]");
  const cells = document.querySelectorAll("[data-scrub-cell]");
  const last = frame.t_s.length - 1;
  const end = frame.t_s[last] + frame.period_s;
  const amplitude = (v) => v === null ? "—" : frame.cdbs_ma === null ? `${Math.round(100 * v)} % of cDBS` : `${(v * frame.cdbs_ma).toFixed(2)} mA`;
  // as the filter `number` writes it
  const number = (v) => v === null ? "—" : v === 0 ? "0" : Math.abs(v) >= 1000 ? String(Math.round(v)) : v.toPrecision(3).replace("-", "\u2212");
  const show = () => {
    const k = Math.min(Number(slider.value), last);
    const x = frame.left + (frame.t_s[k] / end) * frame.width;
    cursors.forEach((cursor) => ["x1", "x2"].forEach((end) => cursor.setAttribute(end, x)));
    const s = Math.round(frame.t_s[k]);
    const words = `${Math.floor(s / 60)} min ${String(s % 60).padStart(2, "0")} s`;
    document.querySelector("[data-scrub-time]").textContent = words;
    slider.setAttribute("aria-valuetext", words);
    cells.forEach((cell) => {
      const v = frame.rows[Number(cell.dataset.scrubCell)][k];
      cell.textContent = cell.dataset.scrubCell === "0" ? number(v) : amplitude(v);
    });
  };
  form.querySelector("[data-scrub-submit]").hidden = true;
  slider.addEventListener("input", show);
}
