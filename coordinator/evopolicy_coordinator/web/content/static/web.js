"use strict";
// Keeps a page up to date from server-sent events, each of which holds what has changed. The server has escaped everything.
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
  const address = document.body.dataset.events;
  if (!state || !address) return;
  let cursor = document.body.dataset.cursor;
  let source = null;
  let timer = null;

  const made = (html) => {
    const template = document.createElement("template");
    template.innerHTML = html;
    return template.content.firstElementChild;
  };
  const take = (message) => {
    const fresh = new Map();
    for (const [id, html] of Object.entries(message.parts)) {
      const old = document.getElementById(id);
      if (old) Idiomorph.morph(old, made(html), { morphStyle: "outerHTML", ignoreActiveValue: true });
      else fresh.set(id, html);
    }
    for (const [id, order] of Object.entries(message.lists)) {
      const list = document.getElementById(id);
      if (!list) continue;
      const atEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 40;
      const kept = new Set(order);
      for (const child of [...list.children]) if (!kept.has(child.id)) child.remove();
      let place = list.firstElementChild;
      for (const name of order) {
        let child = document.getElementById(name);
        if (!child && fresh.has(name)) child = made(fresh.get(name));
        if (!child) continue;
        if (child === place) place = place.nextElementSibling;
        else list.insertBefore(child, place);
      }
      if (atEnd && list.dataset.follow !== undefined) list.scrollTop = list.scrollHeight;
    }
  };
  const say = (name, text) => {
    if (state.dataset.state === name) return;
    state.dataset.state = name;
    state.textContent = text;
  };
  const open = () => {
    clearTimeout(timer);
    if (source) source.close();
    source = new EventSource(address + (address.includes("?") ? "&" : "?") + "since=" + encodeURIComponent(cursor));
    source.onopen = () => say("live", "live");
    source.addEventListener("update", (event) => {
      cursor = event.lastEventId;
      say("live", "live");
      take(JSON.parse(event.data));
    });
    source.onerror = () => {
      say("away", "no connection; trying again");
      // A browser gives up for good after some answers, such as those of a proxy whose server is away.
      source.close();
      clearTimeout(timer);
      timer = setTimeout(open, 2000);
    };
  };
  // A page that nobody sees needs no connection: browsers allow few to one server. It catches up when it is seen again.
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) { clearTimeout(timer); if (source) source.close(); source = null; }
    else if (!source || source.readyState === EventSource.CLOSED) open();
  });
  for (const list of document.querySelectorAll("[data-follow]")) list.scrollTop = list.scrollHeight;
  if (!document.hidden) open();
})();
