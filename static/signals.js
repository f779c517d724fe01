// Loads the samples of a session into its page's chart, and again for whatever stretch of time the reader zooms to.
const figure = document.querySelector("figure[data-signal]");
if (figure) {
  const choice = document.querySelector("[data-signal-channel]");
  const json = figure.querySelector('script[type="application/json"]');
  const subtitle = figure.querySelector("[data-signal-subtitle]");
  let window_min = null, asked = 0, timer = 0;

  const load = async () => {
    const mine = ++asked;
    const query = new URLSearchParams({ channel: choice.value || "0" });
    if (window_min) { query.set("begin_s", 60 * window_min[0]); query.set("end_s", 60 * window_min[1]); }
    figure.setAttribute("aria-busy", "true");
    try {
      const answer = await fetch(`${figure.dataset.signal}?${query}`, { headers: { Accept: "application/json" } });
      const content = await answer.json();
      if (mine !== asked) return;  // a later request stands for this one
      if (!answer.ok) throw new Error([content.detail, content.hint].filter(Boolean).join(" "));
      if (!choice.options.length) {
        content.channels.forEach((name, i) => choice.add(new Option(name, i)));
        choice.closest("form").hidden = content.channels.length < 2;
      }
      json.textContent = JSON.stringify(content.figure);
      subtitle.textContent = content.subtitle;
      figure.dataset.chart = "";
      figure.dispatchEvent(new CustomEvent("betaloop:redraw", { bubbles: true }));
    } catch (error) {
      if (mine === asked) figure.querySelector(".loading")?.replaceChildren(`The samples could not be shown: ${error.message}`);
    } finally {
      if (mine === asked) figure.removeAttribute("aria-busy");
    }
  };

  const seen = new IntersectionObserver((entries) => {
    if (!entries.some((e) => e.isIntersecting)) return;
    seen.disconnect();
    figure.querySelector(".loading")?.replaceChildren("Reading the samples …");
    load();
  }, { rootMargin: "200px" });
  seen.observe(figure);
  choice.addEventListener("change", load);
  document.addEventListener("betaloop:zoom", ({ detail }) => {
    if (detail.group !== figure.dataset.zoom) return;
    window_min = detail.range;
    clearTimeout(timer);
    timer = setTimeout(load, 200);  // one request when the hand rests
  });
}
