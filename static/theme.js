// Runs before the first paint, so that a chosen theme does not flash. Charts listen for "betaloop:theme".
(() => {
  const root = document.documentElement;
  const chosen = () => { try { return localStorage.getItem("betaloop-theme"); } catch { return null; } };
  if (chosen()) root.dataset.theme = chosen();
  document.addEventListener("DOMContentLoaded", () => {
    const button = document.querySelector("[data-theme-toggle]");
    if (!button) return;
    button.hidden = false;
    button.addEventListener("click", () => {
      const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
      root.dataset.theme = dark ? "light" : "dark";
      try { localStorage.setItem("betaloop-theme", root.dataset.theme); } catch { /* private windows keep no choice */ }
      document.dispatchEvent(new Event("betaloop:theme"));
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => document.dispatchEvent(new Event("betaloop:theme")));
  });
})();
