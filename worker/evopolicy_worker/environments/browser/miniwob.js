// Runs once in a page of MiniWoB++ after it has loaded: begins its episodes, and tells what there is to see.
(() => {
  "use strict";
  const { clock, advance, settle, forget } = __evopolicy;
  const MAX_CHARACTERS = 256;
  const MAX_ELEMENTS = 8192;
  const FIELDS = ["textarea", "input:not([type])", ...["text", "search", "url", "tel", "email", "password", "number"].map(
    (type) => `input[type=${type}]`)].join();
  const READY_ROUNDS = 20;
  const READY_MS = 50;
  // Time that the last episode's animations have to end: libraries that wait for a timer that was dropped start no other.
  const DRAIN_MS = 3000;
  const clip = (text) => {
    const whole = String(text ?? "");
    return whole.length > MAX_CHARACTERS ? Array.from(whole).slice(0, MAX_CHARACTERS).join("") : whole;
  };
  const colour = (text) => {
    if (!text) return [1, 1, 1, 1];
    const parts = (text.match(/[0-9.]+/g) ?? []).map(Number);
    return [parts[0] / 255, parts[1] / 255, parts[2] / 255, text.startsWith("rgba") ? parts[3] : 1];
  };
  const flat = (info, parent, found) => {
    let children = info.children;
    let text = "text" in info ? String(info.text) : null;
    if (children.length && children.every((child) => child.tag === "t")) {
      text = children.map((child) => child.text).join(" ");
      children = [];
    }
    const value = info.value === true ? "True" : info.value === false ? "" : info.value;
    found.push([
      info.ref, parent, info.left, info.top, info.width, info.height, clip(info.tag.toLowerCase()), clip(text),
      clip(value), clip(info.id), typeof (info.classes ?? "") === "string" ? clip(info.classes) : "SVG_CLASS",
      colour(info.bgColor), colour(info.fgColor),
      [Number(Boolean(info.focused)), Number(Boolean(info.tampered)), Number(Boolean(info.recordingTarget)), Number(text !== null)],
    ]);
    for (const child of children) flat(child, info.ref, found);
    return found;
  };
  const state = () => ({
    done: Boolean(WOB_DONE_GLOBAL), reward: Number(WOB_REWARD_GLOBAL), raw: Number(WOB_RAW_REWARD_GLOBAL),
    reason: WOB_REWARD_REASON == null ? "" : clip(typeof WOB_REWARD_REASON === "string" ? WOB_REWARD_REASON
      : JSON.stringify(WOB_REWARD_REASON)),
    left: clock.left || (document.getElementsByTagName("*").length > MAX_ELEMENTS ? "the page has too many elements" : ""),
    now: clock.now,
  });
  const look = () => {
    const found = state();
    if (found.done || found.left) return found;
    const told = core.getUtterance();
    found.utterance = clip(typeof told === "string" ? told : told.utterance);
    found.fields = typeof told === "string" ? null : Object.entries(told.fields);
    try {
      found.elements = flat(core.getDOMInfo(), 0, []);
    } catch (error) {
      // It gives up on a text of too many lines.
      found.left = `the page's elements cannot be listed: ${clip(error)}`;
    }
    return found;
  };
  const begin = async (seed, mode, limit, ms) => {
    clock.guarded = false;
    if (location.hash) history.replaceState(null, "", location.pathname + location.search);
    await advance(DRAIN_MS);
    forget();
    if (document.activeElement instanceof HTMLElement) document.activeElement.blur();
    getSelection().removeAllRanges();
    // A field that gets the value which it has keeps what is selected in it.
    for (const field of document.querySelectorAll(FIELDS)) {
      field.value = `${field.defaultValue}0`;
      field.value = field.defaultValue;
    }
    for (const element of document.querySelectorAll("[data-wob_ref], [data-wob_eps], [data-tampered]")) {
      delete element.dataset.wob_ref; delete element.dataset.wob_eps; delete element.dataset.tampered;
    }
    if (clock.copied) {
      // Nothing is left to paste for the next episode.
      const empty = (event) => {
        event.clipboardData.setData("text/plain", "");
        event.preventDefault();
        event.stopImmediatePropagation();
      };
      window.addEventListener("copy", empty, true);
      document.execCommand("copy");
      window.removeEventListener("copy", empty, true);
      clock.copied = false;
    }
    for (const element of document.querySelectorAll("*")) {
      if (element.scrollTop || element.scrollLeft) element.scrollTop = element.scrollLeft = 0;
    }
    core.wob_latest = "-";
    core.wob_scores = [];
    core.previousDOMInfo = {};
    WOB_EPISODE_ID = 0;
    for (const id of ["episode-id", "reward-last", "reward-avg"]) {
      const shown = document.getElementById(id);
      if (shown) { shown.innerHTML = id === "episode-id" ? "0" : "-"; shown.removeAttribute("style"); }
    }
    if (limit) core.EPISODE_MAX_TIME = limit;
    core.setDataMode(mode);
    Math.seedrandom(seed);
    core.startEpisodeReal();
    for (let round = 0; !WOB_TASK_READY && round < READY_ROUNDS; round++) {
      await settle();
      await advance(READY_MS);
    }
    await settle();
    clock.guarded = true;
    await advance(ms);
    await settle();
  };
  const pass = async (ms, mouse = clock.mouse) => {
    clock.mouse = mouse;
    await settle();
    await advance(ms);
    await settle();
  };
  Object.assign(__evopolicy, { begin, pass, look, state });
})();
