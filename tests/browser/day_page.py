"""The page of the clinic day in a browser: what is done on it, and what is looked for."""

from __future__ import annotations

from contextlib import suppress

from playwright.sync_api import TimeoutError as NotInTime

from tests.browser.conftest import PASSWORD, Watched
from tests.clinic_day import ClinicDay

SMALL = """() => [...document.querySelectorAll('#day, dialog[open]')].flatMap(
    (box) => [...box.querySelectorAll('a, button, input, textarea, summary')])
  .filter((e) => e.checkVisibility()).map((e) => [e, e.getBoundingClientRect()]).filter(([e, b]) => b.height < 47.5 || b.width < 47.5)
  .map(([e, b]) => `${e.tagName} "${e.textContent.trim().slice(0, 30)}" ${Math.round(b.width)}x${Math.round(b.height)}`)"""
FAINT = """() => {
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = (c) => c.slice(0, 3).map((v) => v / 255).map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = (e) => {
    for (; e; e = e.parentElement) {
      const c = rgb(getComputedStyle(e).backgroundColor);
      if (c.length < 4 || c[3] === 1) return c;
    }
    return [255, 255, 255];
  };
  const faint = [];
  for (const e of document.querySelectorAll('#day *, dialog[open] *')) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!own || !e.checkVisibility() || e.closest(':disabled')) continue;
    const style = getComputedStyle(e), [a, b] = [light(rgb(style.color)), light(behind(e))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    if (ratio < (large ? 3 : 4.5)) faint.push(`${e.tagName} "${e.textContent.trim().slice(0, 30)}" ${ratio.toFixed(2)}`);
  }
  return faint;
}"""
KEPT = """async () => {
  const done = (request) => new Promise((resolve) => { request.onsuccess = () => resolve(request.result); });
  const db = await done(indexedDB.open('betaloop-visit-day'));
  const all = (name) => done(db.transaction(name).objectStore(name).getAll());
  const plain = (value) => (value instanceof ArrayBuffer ? new TextDecoder('latin1').decode(value) : String(value));
  const text = (row) => Object.entries(row).map(([name, value]) => `${name}=${plain(value)}`).join(' ');
  const [keys, entries, days] = [await all('keys'), await all('entries'), await all('days')];
  db.close();
  const read = await Promise.all(keys.map((row) => crypto.subtle.exportKey('raw', row.key).then(() => 'readable', (e) => e.name)));
  return { keys: read, entries: entries.map(text), days: days.map(text) };
}"""
TOO_WIDE = """() => [document.documentElement].map((e) => e.scrollWidth - e.clientWidth)
  .filter((more) => more > 0).map((more) => `${more} px wider than the screen`)"""


def once_drawn(watched: Watched) -> list[str]:
    """List what is too small, too faint or too wide, once the page is drawn: it may still be drawing after a tap."""
    look = f"() => [{SMALL}, {FAINT}, {TOO_WIDE}].flatMap((found) => found())"
    if found := watched.page.evaluate(look):
        with suppress(NotInTime):
            watched.page.wait_for_function(f"() => ({look})().length === 0", timeout=5_000)
        found = watched.page.evaluate(look)
    return list(found)


def tap(watched: Watched, act: str) -> None:
    watched.page.click(f"[data-act='{act}']")


def open_day(watched: Watched, day: ClinicDay) -> None:
    watched.open(f"/visit-day/{day.visit}")
    watched.page.wait_for_selector("#day[data-ready=yes]")


def wait_for(watched: Watched, waiting: int, status: str = "online") -> None:
    watched.page.wait_for_selector(f".day-link[data-link={status}][data-waiting='{waiting}']", timeout=30_000)


def stored(day: ClinicDay) -> list[str]:
    return [e["kind"] for e in day.client.get(f"/api/v1/visits/{day.visit}/day/entries").json()["items"]]


def wait_until_stored(watched: Watched, day: ClinicDay, entries: int) -> None:
    """Wait for so many entries in the record: that none waits on the tablet is true before a tap is taken too."""
    for _ in range(120):
        if len(stored(day)) >= entries:
            return
        watched.page.wait_for_timeout(250)
    raise AssertionError(f"{len(stored(day))} of {entries} entries arrived within 30 s")


def worker_ready(watched: Watched) -> None:
    """Wait until the page can be opened without network."""
    watched.page.evaluate("() => navigator.serviceWorker.ready.then(() => true)")
    watched.page.wait_for_function("() => caches.match('/visit-day/shell').then(Boolean)")


def fill(watched: Watched, email: str) -> None:
    watched.page.fill("[name=email]", email)
    watched.page.fill("[name=password]", PASSWORD)
    watched.page.click("main button")
