// The one place that draws charts. Plotly comes from this service; its cloud button is off, no data leave the browser.
const CONFIG = {
  showSendToCloud: false, plotlyServerURL: "", displaylogo: false, responsive: true, scrollZoom: false,
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "toggleSpikelines"], toImageButtonOptions: { format: "svg" },
};

const PAPER_PX = 660; // what the margins and cards of print.css leave of A4

let library = null;

function plotly() {
  library ??= new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = document.querySelector('meta[name="betaloop-plotly"]').content;
    script.onload = () => resolve(window.Plotly);
    script.onerror = () => reject(new Error("the chart library could not be loaded"));
    document.head.append(script);
  });
  return library;
}

// "token:rl" and "token:rl/0.25" become the colour of --c-rl in the theme in use
function colours(onPaper) {
  const probe = document.createElement("span");
  probe.hidden = true;
  if (onPaper) probe.style.colorScheme = "light";
  document.body.append(probe);
  const known = new Map();
  const resolve = (token) => {
    if (!known.has(token)) {
      const [name, alpha] = token.slice("token:".length).split("/");
      probe.style.color = `var(--c-${name})`;
      const [r, g, b] = getComputedStyle(probe).color.match(/[\d.]+/g).map(Number);
      known.set(token, alpha ? `rgba(${r}, ${g}, ${b}, ${alpha})` : `rgb(${r}, ${g}, ${b})`);
    }
    return known.get(token);
  };
  const walk = (value) => {
    if (typeof value === "string") return value.startsWith("token:") ? resolve(value) : value;
    if (Array.isArray(value)) return typeof value.at(-1) === "number" ? value : value.map(walk);
    if (value && typeof value === "object") return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, walk(v)]));
    return value;
  };
  return { walk, done: () => probe.remove() };
}

// a large figure comes by itself, once
const fetched = new Map();

async function content(source) {
  const { src } = source.dataset;
  if (!src) return JSON.parse(source.textContent);
  if (!fetched.has(src)) fetched.set(src, fetch(src).then((answer) => {
    if (!answer.ok) throw new Error(`the service answered ${answer.status}`);
    return answer.json();
  }));
  return fetched.get(src);
}

async function draw(figure, onPaper = false) {
  const plot = figure.querySelector(".plot");
  const source = figure.querySelector('script[type="application/json"]');
  try {
    const Plotly = await plotly();
    const theme = colours(onPaper);
    const { data, layout } = theme.walk(await content(source));
    theme.done();
    const { synthetic } = document.body.dataset;
    // within the picture, so that a saved figure says it too
    if (synthetic) layout.annotations = [...(layout.annotations ?? []), { text: `${synthetic}: synthetic`, xref: "paper", yref: "paper", x: 1, y: 1, xanchor: "right", yanchor: "bottom", showarrow: false, font: { size: 10 } }];
    const shown = zooms.get(figure.dataset.zoom);
    if (shown) Object.assign(layout.xaxis, { range: shown, autorange: false });
    // a sheet is narrower than most windows, and nothing tells the library how wide it is
    if (onPaper) Object.assign(layout, { width: figure.closest(".cards") ? PAPER_PX / 2 - 24 : PAPER_PX, height: parseFloat(plot.style.height), autosize: false });
    plot.querySelector(".loading")?.remove();
    await Plotly.react(plot, data, layout, CONFIG);
    // the table below says it in words; the buttons above stay for everyone
    for (const picture of plot.querySelectorAll(".main-svg")) picture.setAttribute("aria-hidden", "true");
    follow(plot);
    link(figure, plot);
    figure.dataset.drawn = "yes";
  } catch (error) {
    plot.textContent = `This chart could not be drawn (${error.message}). Its numbers are in the table below.`;
    figure.dataset.drawn = "failed";
  }
}

// a point that names a page of ours opens it; a number is one of the pages below its trace's `meta`
function follow(plot) {
  if (plot.dataset.follows) return;
  plot.dataset.follows = "yes";
  plot.on("plotly_click", ({ points }) => {
    const point = points[0];
    const base = point?.data?.meta;
    const place = typeof point?.customdata === "number" && base ? `${base}${point.customdata}` : point?.customdata;
    if (typeof place === "string" && /^\/[a-z]/.test(place)) location.assign(place);
  });
}

// charts of one group (data-zoom) show the same stretch of their horizontal axis
const zooms = new Map();

function link(figure, plot) {
  const group = figure.dataset.zoom;
  if (!group || plot.dataset.linked) return;
  plot.dataset.linked = "yes";
  plot.on("plotly_relayout", (change) => {
    const given = change["xaxis.range"] ?? (("xaxis.range[0]" in change) ? [change["xaxis.range[0]"], change["xaxis.range[1]"]] : null);
    const range = given ?? (change["xaxis.autorange"] ? null : undefined);
    if (range === undefined || String(range) === String(zooms.get(group) ?? null)) return;
    if (range) zooms.set(group, range); else zooms.delete(group);
    for (const other of document.querySelectorAll(`figure[data-zoom="${group}"][data-drawn=yes]`)) {
      if (other !== figure) library.then((Plotly) => Plotly.relayout(other.querySelector(".plot"), range ? { "xaxis.range": [...range] } : { "xaxis.autorange": true }));
    }
    document.dispatchEvent(new CustomEvent("betaloop:zoom", { detail: { group, range } }));
  });
}

// charts are drawn when they come near the window: a page with many stays quick
const watcher = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) { watcher.unobserve(entry.target); draw(entry.target); }
}, { rootMargin: "400px" });

function find(root) {
  for (const figure of root.querySelectorAll("figure[data-chart]:not([data-drawn])")) {
    figure.querySelector(".loading")?.replaceChildren("Drawing …");
    watcher.observe(figure);
  }
}

find(document);
document.addEventListener("betaloop:swap", (event) => find(event.target));
// a changed figure: replace the JSON in its script element, then dispatch this event on the <figure>
document.addEventListener("betaloop:redraw", (event) => draw(event.target.closest("figure[data-chart]")));
document.addEventListener("betaloop:theme", () => { for (const figure of document.querySelectorAll("figure[data-drawn=yes]")) draw(figure); });
// paper takes every chart, also those that nobody scrolled to, in the light colours
addEventListener("beforeprint", () => { for (const figure of document.querySelectorAll("figure[data-chart]")) draw(figure, true); });
addEventListener("afterprint", () => { for (const figure of document.querySelectorAll("figure[data-drawn=yes]")) draw(figure); });
if (document.querySelector("figure[data-chart]")) plotly().catch(() => {});
