// Moves along a comparison of policies: the slider sets the cursor and the numbers; without this script the form does it.
const form = document.querySelector("form[data-scrub]");
if (form) {
  const frame = JSON.parse(document.getElementById("scrub-frame").textContent);
  const slider = form.querySelector("input[type=range]");
  const cursor = document.querySelector("[data-cursor]");
  const cells = document.querySelectorAll("[data-scrub-cell]");
  const last = frame.t_s.length - 1;
  const end = frame.t_s[last] + frame.period_s;
  const amplitude = (v) => v === null ? "—" : frame.cdbs_ma === null ? `${Math.round(100 * v)} % of cDBS` : `${(v * frame.cdbs_ma).toFixed(2)} mA`;
  const show = () => {
    const k = Math.min(Number(slider.value), last);
    const x = frame.left + (frame.t_s[k] / end) * frame.width;
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
    const s = Math.round(frame.t_s[k]);
    const words = `${Math.floor(s / 60)} min ${String(s % 60).padStart(2, "0")} s`;
    document.querySelector("[data-scrub-time]").textContent = words;
    slider.setAttribute("aria-valuetext", words);
    cells.forEach((cell) => {
      const v = frame.rows[Number(cell.dataset.scrubCell)][k];
      cell.textContent = cell.dataset.scrubCell === "0" ? (v === null ? "—" : String(Number(v.toPrecision(3)))) : amplitude(v);
    });
  };
  form.querySelector("[data-scrub-submit]").hidden = true;
  slider.addEventListener("input", show);
}
