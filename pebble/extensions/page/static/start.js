/** Watches over the start, within the page itself: what is lost is fetched again, by an address that no browser has given up. */
{
  const WAIT_MS = /** @type {any} */ (globalThis).pebbleWaitMs ?? 10_000; // tests wait less
  const LOOK = ";font:bold 1.4em sans-serif;display:inline-block;padding:.5em;border:2px solid #b3001b";
  const here = new WeakSet();
  let tries = 0;
  let late = false;
  let whole = false; // it shows a STOP, and with its looks

  const again = (/** @type {any} */ file) => {
    const { localName, rel, type, src, href } = file;
    const next = Object.assign(/** @type {any} */ (document.createElement(localName)), { rel, type });
    next[src ? "src" : "href"] = (src || href).replace(/(\.\d+)?(?=\/[^/]*$)/, `.${++tries}`);
    file.replaceWith(next);
  };

  const look = () => {
    const stop = document.querySelector("#app .stop");
    whole = Boolean(stop && getComputedStyle(stop).getPropertyValue("--stop"));
    const form = /** @type {any} */ (document.getElementById("start"));
    if (form) form.hidden = whole || performance.now() < WAIT_MS;
    if (whole) return;
    setTimeout(look, 250);
    if (!form || form.hidden) return;
    const files = /** @type {any[]} */ ([...document.querySelectorAll("[rel=stylesheet],[rel=modulepreload],script[src]")]);
    const missing = files.filter((file) => !here.has(file));
    if (!late) missing.filter(({ rel }) => rel === "stylesheet").forEach(again); // one that never comes hides all
    late = true;
    const [text, button, link] = form.children;
    const names = missing.map(({ src, href }) => (src || href).replace(/.*\/static\/.*?\//, ""));
    text.textContent = `This page is incomplete. Missing: ${names.join(", ") || "no file"}`;
    form.style = "position:fixed;inset:0 0 auto;z-index:9;padding:1em;background:#fff;color:#000";
    button.style = `background:#b3001b;color:#fff${LOOK}`;
    link.style = `color:#b3001b${LOOK}`;
  };

  document.addEventListener("load", ({ target }) => target && here.add(target), true);
  document.addEventListener("error", ({ target }) => whole || retry(target), true);
  look();

  function retry(/** @type {any} */ file) {
    if (file.rel === "stylesheet" || file.localName === "script") setTimeout(again, 1000 * (tries + 1), file);
  }
}
