"use strict";
// Keeps a page up to date: asks for it again and replaces what has changed. The server has escaped everything.
(() => {
  // A printed address has the token behind "#", which no browser sends and no log keeps: it is handed over in a request's body.
  const form = document.getElementById("signin");
  const told = new URLSearchParams(location.hash.slice(1)).get("token");
  if (form && told) {
    history.replaceState(null, "", location.pathname);
    form.elements.token.value = told;
    form.submit();
    return;
  }
  const state = document.getElementById("live");
  if (!state) return;
  const PAUSE_MS = 2000;
  const WAIT_MS = 30000;
  const known = new Map();
  let etag = "";
  let asking = false;
  let timer = null;

  const take = (page) => {
    for (const id of page.body.dataset.live.split(" ")) {
      const [old, fresh] = [document.getElementById(id), page.getElementById(id)];
      // Compared with the server's last text, as scripts may have changed the element since.
      if (!old || !fresh || known.get(id) === fresh.outerHTML) continue;
      known.set(id, fresh.outerHTML);
      const atEnd = old.scrollHeight - old.scrollTop - old.clientHeight < 40;
      Idiomorph.morph(old, fresh, { morphStyle: "outerHTML", ignoreActiveValue: true });
      if (atEnd && old.dataset.follow !== undefined) old.scrollTop = old.scrollHeight;
    }
  };
  const say = (name, text) => {
    if (state.dataset.state === name) return;
    state.dataset.state = name;
    state.textContent = text;
  };
  const ask = async () => {
    // A page that nobody sees asks for nothing. It catches up when it is seen again.
    if (asking || document.hidden) return;
    asking = true;
    clearTimeout(timer);
    try {
      const headers = etag ? { "If-None-Match": etag } : {};
      const answer = await fetch(location.href, { headers, signal: AbortSignal.timeout(WAIT_MS) });
      if (!answer.ok && answer.status !== 304) throw new Error(answer.statusText);
      if (answer.ok) {
        take(new DOMParser().parseFromString(await answer.text(), "text/html"));
        etag = answer.headers.get("etag");
      }
      say("live", "live");
    } catch {
      say("away", "no connection; trying again");
    }
    asking = false;
    timer = setTimeout(ask, PAUSE_MS);
  };
  document.addEventListener("visibilitychange", ask);
  for (const list of document.querySelectorAll("[data-follow]")) list.scrollTop = list.scrollHeight;
  ask();
})();
