// The service worker of the clinic day. It rules over /visit-day/ alone and keeps no data: a page without any, its scripts and styles.
const CACHE = "betaloop-visit-day";
const SHELL = "/visit-day/shell";
const PATIENCE_MS = 5000;

const isFile = (url) => url.pathname.startsWith("/static/") || url.pathname.startsWith("/visit-day/files/");

// Fetch the shell and every file that it names; the old ones go once all of the new ones are here.
async function renew() {
  const answer = await fetch(SHELL, { cache: "no-store", credentials: "omit" });
  if (!answer.ok) throw new Error(`the shell of the page answers ${answer.status}`);
  const html = await answer.clone().text();
  const files = [...html.matchAll(/(?:src|href)="(\/(?:static|visit-day\/files)\/[^"]+)"/g)].map((match) => match[1].replaceAll("&amp;", "&"));
  const cache = await caches.open(CACHE);
  await Promise.all([...new Set(files)].map(async (file) => { if (!(await cache.match(file))) await cache.add(file); }));
  await cache.put(SHELL, answer);
  const wanted = new Set([SHELL, ...files].map((path) => new URL(path, location.origin).href));
  for (const request of await cache.keys()) if (!wanted.has(request.url)) await cache.delete(request);
}

self.addEventListener("install", (event) => { event.waitUntil(renew().then(() => self.skipWaiting())); });
self.addEventListener("activate", (event) => { event.waitUntil(self.clients.claim()); });

// The service's page where it answers in time; the page without data where not.
async function page(event) {
  try {
    const answer = await fetch(event.request, { signal: AbortSignal.timeout(PATIENCE_MS) });
    if (answer.status < 502) {
      if (answer.ok) event.waitUntil(renew().catch((error) => console.info("the page was not renewed", error)));
      return answer;
    }
  } catch (error) {
    console.info("no network, the page comes from this tablet", error);
  }
  return (await caches.match(SHELL)) ?? Response.error();
}

async function file(request) {
  return (await caches.match(request)) ?? fetch(request);
}

self.addEventListener("fetch", (event) => {
  const url = new URL(event.request.url);
  if (event.request.method !== "GET" || url.origin !== location.origin) return;
  if (event.request.mode === "navigate") event.respondWith(page(event));
  else if (isFile(url)) event.respondWith(file(event.request));
});
