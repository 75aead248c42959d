// Runs in every frame before the page's own scripts. Gives the page a clock and random numbers of its own, and takes
// from it what would let it leave, ask, or keep something. Its own calls go through what it saved here, so that nothing
// that the page defines later changes them. SEED stands for a text, VIRTUAL for whether the clock is its own.
(() => {
  "use strict";
  const EPOCH = 1483228800000;  // What the clock shows when a document begins: 2017-01-01, UTC.
  const FRAME_MS = 16;
  const HELD_MS = { first: 250, then: 50 };  // When a held arrow of a number field counts: the browser's own times.
  const MAX_TYPED = 16384;  // Characters of a field, with its markup.
  const native = {
    Date, Map, Object, Promise, Set, WeakMap, setTimeout: window.setTimeout.bind(window),
    frame: window.requestAnimationFrame.bind(window),
    stamp: Object.getOwnPropertyDescriptor(Event.prototype, "timeStamp").get, MessageChannel, json: JSON.stringify,
  };
  const define = (target, name, value) =>
    Object.defineProperty(target, name, { value, writable: true, configurable: true, enumerable: false });

  // Random numbers: xorshift128+ by splitmix, until a page seeds its own.
  const generator = (text) => {
    let h = 0x811c9dc5;
    for (let i = 0; i < text.length; i++) h = Math.imul(h ^ text.charCodeAt(i), 0x01000193) >>> 0;
    const split = () => {
      h = (h + 0x9e3779b9) | 0;
      let z = h ^ (h >>> 16);
      z = Math.imul(z, 0x21f0aaad); z ^= z >>> 15;
      z = Math.imul(z, 0x735a2d97); z ^= z >>> 15;
      return z >>> 0;
    };
    let [a, b, c, d] = [split(), split(), split(), split() | 1];
    return () => {
      const t = b << 9; let r = Math.imul(b, 5); r = Math.imul((r << 7) | (r >>> 25), 9) >>> 0;
      c ^= a; d ^= b; b ^= c; a ^= d; c ^= t; d = (d << 11) | (d >>> 21);
      return r;
    };
  };

  // One clock for all frames of a page: the outermost one's.
  let outer = null;
  try { outer = window !== window.top ? window.top.__evopolicy : null; } catch { outer = null; }
  const clock = outer ? outer.clock : {
    now: 0, next: 1, timers: new Map(), left: "", error: "", guarded: false, pending: 0, copied: true, mouse: null,
    int32: generator(SEED),  // `copied`: whether the clipboard may have a text; it outlasts a document.
  };
  const now = () => clock.now;

  const add = (fn, delay, every, args) => {
    const id = clock.next++;
    const wait = Math.max(1, Math.min(Number(delay) || 0, 2147483647));
    clock.timers.set(id, { at: now() + wait, id, fn, every: every ? wait : 0, args });
    return id;
  };
  const drop = (id) => { clock.timers.delete(Number(id)); };
  if (VIRTUAL) {
  define(window, "setTimeout", (fn, delay, ...args) => add(fn, delay, false, args));
  define(window, "setInterval", (fn, delay, ...args) => add(fn, delay, true, args));
  define(window, "setImmediate", (fn, ...args) => add(fn, 0, false, args));
  define(window, "clearTimeout", drop);
  define(window, "clearInterval", drop);
  define(window, "requestAnimationFrame", (fn) => {
    const t = now();
    const id = clock.next++;
    clock.timers.set(id, { at: (Math.floor(t / FRAME_MS) + 1) * FRAME_MS, id, fn, every: 0, args: null });
    return id;
  });
  define(window, "cancelAnimationFrame", drop);
  define(window, "webkitRequestAnimationFrame", window.requestAnimationFrame);
  define(window, "webkitCancelAnimationFrame", drop);
  define(window, "requestIdleCallback", (fn) =>
    add(() => fn({ didTimeout: false, timeRemaining: () => 50 }), 1, false, []));
  define(window, "cancelIdleCallback", drop);

  class VirtualDate extends native.Date {
    constructor(...args) { if (args.length === 0) super(EPOCH + now()); else super(...args); }
    static now() { return EPOCH + now(); }
  }
  define(window, "Date", new Proxy(VirtualDate, {
    apply: () => new VirtualDate().toString(),
  }));
  VirtualDate.prototype.constructor = window.Date;
  define(Performance.prototype, "now", () => now());
  Object.defineProperty(Event.prototype, "timeStamp", { get: () => now(), configurable: true });
  }
  define(Math, "random", () => (clock.int32() * 2097152 + (clock.int32() >>> 11)) / 9007199254740992);
  define(Crypto.prototype, "getRandomValues", (array) => {
    const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
    for (let i = 0; i < bytes.length; i++) bytes[i] = clock.int32() & 255;
    return array;
  });
  define(Crypto.prototype, "randomUUID", () => {
    const hex = Array.from({ length: 4 }, () => clock.int32().toString(16).padStart(8, "0")).join("");
    return `${hex.slice(0, 8)}-${hex.slice(8, 12)}-4${hex.slice(13, 16)}-a${hex.slice(17, 20)}-${hex.slice(20, 32)}`;
  });

  // Questions have no one to answer them, and there is one window.
  for (const name of ["alert", "print", "open", "close", "stop", "find"]) define(window, name, () => undefined);
  define(window, "open", () => null);
  define(window, "confirm", () => false);
  define(window, "prompt", () => null);
  for (const name of ["showModalDialog", "showOpenFilePicker", "showSaveFilePicker", "showDirectoryPicker",
    "RTCPeerConnection", "webkitRTCPeerConnection", "WebSocket", "WebTransport", "EventSource", "Worker", "SharedWorker",
    "Notification", "BroadcastChannel", "indexedDB", "caches", "cookieStore", "webkitRequestFileSystem"]) {
    try { define(window, name, undefined); } catch { /* Not in this browser. */ }
  }
  for (const name of ["serviceWorker", "storage", "sendBeacon", "locks", "clipboard"]) {
    try { Object.defineProperty(Navigator.prototype, name, { value: undefined, configurable: true }); } catch { /* as above */ }
  }
  // What a page keeps, it keeps for an episode.
  const kept = () => {
    const held = new Map();
    const store = {
      getItem: (key) => held.has(String(key)) ? held.get(String(key)) : null,
      setItem: (key, value) => { held.set(String(key), String(value)); },
      removeItem: (key) => { held.delete(String(key)); },
      clear: () => held.clear(),
      key: (k) => [...held.keys()][k] ?? null,
    };
    return { held, proxy: new Proxy(store, {
      get: (target, key) => key === "length" ? held.size : key in target ? target[key]
        : held.has(String(key)) ? held.get(String(key)) : undefined,
      set: (target, key, value) => { held.set(String(key), String(value)); return true; },
      has: (target, key) => key in target || held.has(String(key)),
      deleteProperty: (target, key) => { held.delete(String(key)); return true; },
      ownKeys: () => [...held.keys()],
      getOwnPropertyDescriptor: (target, key) => held.has(String(key))
        ? { value: held.get(String(key)), writable: true, enumerable: true, configurable: true } : undefined,
    }) };
  };
  const stores = { localStorage: kept(), sessionStorage: kept() };
  for (const [name, store] of Object.entries(stores)) {
    Object.defineProperty(window, name, { get: () => store.proxy, configurable: true });
  }
  if (!outer) window.name = "";
  const cookies = new Map();
  Object.defineProperty(Document.prototype, "cookie", {
    get: () => [...cookies].map(([name, value]) => `${name}=${value}`).join("; "),
    set: (text) => {
      const [pair] = String(text).split(";");
      const at = pair.indexOf("=");
      cookies.set((at < 0 ? "" : pair.slice(0, at)).trim(), pair.slice(at + 1).trim());
    },
    configurable: true,
  });

  // Leaving the page is noted and does not happen; places within it may change.
  const leaves = (why) => { clock.left = clock.left || why; };
  if (window.navigation) {
    window.navigation.addEventListener("navigate", (event) => {
      if (!clock.guarded || event.destination.sameDocument) return;
      event.preventDefault();
      if (event.downloadRequest === null) leaves("the page would be left");
    });
  }
  window.addEventListener("submit", (event) => {
    if (clock.guarded && !event.defaultPrevented) { event.preventDefault(); leaves("a form would be sent"); }
  });
  for (const name of ["click", "auxclick"]) {
    window.addEventListener(name, (event) => {
      const link = event.target instanceof Element ? event.target.closest("a[href], area[href]") : null;
      if (link === null || event.defaultPrevented) return;
      const elsewhere = link.target && !["_self", "_top", "_parent"].includes(link.target);
      if (elsewhere || name === "auxclick" || event.ctrlKey || event.shiftKey || event.metaKey) {
        event.preventDefault();
        if (clock.guarded) leaves("another window would be opened");
      }
    });
  }
  // A text or link that the mouse drags would leave its events to the browser's drag and drop.
  window.addEventListener("dragstart", (event) => { event.preventDefault(); });
  define(HTMLFormElement.prototype, "submit", () => leaves("a form would be sent"));
  for (const name of ["copy", "cut"]) {
    window.addEventListener(name, () => { clock.copied = true; }, true);
  }
  // The middle button pastes what was last selected, also in an earlier episode.
  let button;
  for (const name of ["mousedown", "keydown"]) window.addEventListener(name, (event) => { button = event.button; }, true);
  window.addEventListener("paste", (event) => {
    if (button === 1) { event.preventDefault(); event.stopImmediatePropagation(); }
  }, true);

  // The browser's history of edits outlasts an episode: undoing and redoing would bring back what was typed in an earlier one.
  // A text that doubles with each paste would soon be more than the browser can lay out.
  window.addEventListener("beforeinput", (event) => {
    const { target, inputType, data, dataTransfer } = event;
    const added = data ?? (dataTransfer ? dataTransfer.getData("text/plain") : "");
    const tooLong = (target.value ?? target.innerHTML ?? "").length + added.length > MAX_TYPED;
    if (inputType.startsWith("history") || (inputType.startsWith("insert") && tooLong)) {
      event.preventDefault();
      event.stopImmediatePropagation();
    }
  }, true);

  // Which elements do something when they are clicked: their listeners, by kind.
  const listening = new WeakMap();
  const PRESSES = ["click", "mousedown", "mouseup", "pointerdown"];
  for (const [name, change] of [["addEventListener", "add"], ["removeEventListener", "delete"]]) {
    const usual = EventTarget.prototype[name];
    define(EventTarget.prototype, name, function (kind, listener, ...args) {
      if (PRESSES.includes(kind) && this instanceof Element) {
        if (!listening.has(this)) listening.set(this, PRESSES.map(() => new native.Set()));
        listening.get(this)[PRESSES.indexOf(kind)][change](listener);
      }
      return usual.call(this ?? window, kind, listener, ...args);
    });
  }
  const clickable = (element) => listening.get(element)?.some((all) => all.size) || element.onclick !== null || element.onmousedown !== null
    || element.matches("a[href], button, input:not([type=hidden]), select, textarea, label, summary, option");

  // After a change of layout the browser moves the mouse on its own account, some time later. What is under the mouse is
  // looked after below; such an event itself is nobody's action. Those of an action bear a time of long ago.
  const own = (event) => {
    if (event.isTrusted && native.stamp.call(event) > 0) { event.stopImmediatePropagation(); event.preventDefault(); }
  };
  for (const name of ["mousemove", "pointermove", "pointerrawupdate"]) window.addEventListener(name, own, true);

  // The arrow of a number field that is held down counts by the machine's clock. The browser stops when the field may not be
  // changed for a moment; the episode's clock counts in its place, until mouse or keyboard are used.
  if (VIRTUAL) {
    let [field, value, timer] = [null, "", 0];  // The number field that is pressed, and its value before.
    for (const name of ["mousedown", "mousemove", "mouseup", "keydown", "wheel"]) window.addEventListener(name, (event) => {
      drop(timer);
      field = name === "mousedown" && event.target instanceof HTMLInputElement && event.target.type === "number" ? event.target : null;
      value = field?.value;
    }, true);
    window.addEventListener("input", (event) => {
      if (!event.isTrusted || field === null || event.target !== field || event.inputType !== undefined) return;
      const pressed = field;
      const step = Number(pressed.value) > Number(value) ? "stepUp" : "stepDown";
      pressed.readOnly = true;
      pressed.readOnly = false;
      const count = () => {
        const before = pressed.value;
        if (!pressed.disabled && !pressed.readOnly) pressed[step]();
        if (pressed.value !== before) pressed.dispatchEvent(new Event("input", { bubbles: true, composed: true }));
      };
      timer = add(() => { timer = add(count, HELD_MS.then, true); count(); }, HELD_MS.first);
    }, true);
  }

  // A caret that blinks would be in a picture or not, as the time has it.
  const still = new CSSStyleSheet();
  still.replaceSync("* { caret-animation: manual } @supports not (caret-animation: manual) { * { caret-color: transparent } }");
  document.adoptedStyleSheets = [still];

  // A page that still waits for an answer is not ready to be looked at.
  const send = XMLHttpRequest.prototype.send;
  define(XMLHttpRequest.prototype, "send", function (...args) {
    clock.pending++;
    this.addEventListener("loadend", () => { clock.pending--; }, { once: true });
    return send.apply(this, args);
  });

  if (outer) return;

  // The page's documents: its own, and those in its frames.
  const documents = (from = document) => [from, ...[...from.querySelectorAll("iframe")].flatMap((frame) => {
    try { return frame.contentDocument ? documents(frame.contentDocument) : []; } catch { return []; }
  })];
  const loading = (shown) => shown.readyState !== "complete" || shown.fonts.status !== "loaded"
    || [...shown.images].some((image) => !image.complete)
    || [...shown.querySelectorAll("iframe[src]")].some((frame) => {
      // A frame of the page's own begins as an empty document; one that is refused stays so, or shows no document.
      try { return new URL(frame.src).origin === location.origin && frame.contentWindow.location.href === "about:blank"; }
      catch { return false; }
    });
  const started = new WeakMap();
  const animate = () => {
    for (const animation of documents().flatMap((shown) => shown.getAnimations())) {
      if (!started.has(animation)) { started.set(animation, clock.now); animation.pause(); }
      const end = animation.effect ? animation.effect.getComputedTiming().endTime : 0;
      const time = clock.now - started.get(animation);
      if (time >= end) animation.finish(); else animation.currentTime = time;
    }
  };
  const port = new native.MessageChannel();
  const turns = [];
  port.port1.onmessage = () => turns.shift()();
  const turn = () => new native.Promise((done) => { turns.push(done); port.port2.postMessage(0); });
  const frame = () => new native.Promise((done) => native.frame(done));
  const hovered = () => {
    const all = document.querySelectorAll(":hover");
    return all.length ? all[all.length - 1] : null;
  };
  let places = "";
  const scrolled = () => {
    let found = `${scrollX},${scrollY}`;
    for (const element of document.querySelectorAll("*")) {
      if (element.scrollTop || element.scrollLeft) found += `;${element.scrollLeft},${element.scrollTop}`;
    }
    return found;
  };
  // What is no longer shown loses the focus, some time after the layout.
  const unseen = (element) => element !== null && element !== document.body
    && (!element.checkVisibility({ visibilityProperty: true }) || element.disabled === true);
  // Waits for what the browser does in its own time: tasks, images, fonts, answers; what is under the mouse; scrolling; focus.
  const settle = async () => {
    for (let round = 0; round < 5000; round++) {
      await turn();
      if (clock.pending || documents().some(loading)) {
        await new native.Promise((done) => native.setTimeout(done, 1));
        continue;
      }
      const now = scrolled();
      if (now !== places) {
        places = now;
        await frame(); await frame();
        continue;
      }
      if (clock.mouse !== null && round < 8) {
        const under = document.elementFromPoint(...clock.mouse);
        if (under !== null && under !== hovered()) { await frame(); continue; }
      }
      if (round < 8 && unseen(document.activeElement)) { await frame(); continue; }
      return;
    }
    throw new Error("what the page asked for does not arrive");
  };
  // Pictures that style sheets name. Without them an element's size depends on when its picture arrives.
  const pictures = [];
  const preload = async () => {
    const named = new Set();
    const collect = (rules, base) => {
      for (const rule of rules) {
        if (rule.cssRules && rule.cssRules.length) collect(rule.cssRules, base);
        for (const [, url] of (rule.cssText.match(/url\(["']?[^"')]+/g) ?? []).map((text) => text.match(/url\(["']?(.+)/))) {
          if (!url.startsWith("data:") && !/\.(woff2?|ttf|eot|otf)\b/.test(url)) named.add(new URL(url, base).href);
        }
      }
    };
    for (const sheet of document.styleSheets) collect(sheet.cssRules, sheet.href ?? document.baseURI);
    await native.Promise.all([...named].map((url) => {
      const picture = new Image();
      picture.src = url;
      pictures.push(picture);
      return picture.decode().catch(() => undefined);
    }));
  };
  // The browser scrolls some frames after the wheel has turned, or a drag has selected text: before the next event, or
  // it depends on the machine's load.
  const moved = async () => { await frame(); await frame(); await frame(); await settle(); };
  // Whether a place is on a scrollbar: what a press on one does depends on the machine's load.
  const bar = (x, y, shown = document) => {
    const view = shown.scrollingElement ?? shown.documentElement;
    if (x >= view.clientWidth || y >= view.clientHeight) return true;
    const found = shown.elementFromPoint(x, y);
    if (found === null || !found.offsetWidth || !found.offsetHeight) return false;
    const { left, top, width, height } = found.getBoundingClientRect();
    const [inX, inY] = [
      (x - left) * found.offsetWidth / width - found.clientLeft, (y - top) * found.offsetHeight / height - found.clientTop,
    ];
    if (found instanceof HTMLIFrameElement) return found.contentDocument !== null && bar(inX, inY, found.contentDocument);
    const style = getComputedStyle(found);
    const within = (at, inner, whole, one, other) => {
      const thick = whole - inner - parseFloat(one) - parseFloat(other);
      return thick > 2 && at >= inner && at < inner + thick;
    };
    return within(inX, found.clientWidth, found.offsetWidth, style.borderLeftWidth, style.borderRightWidth)
      || within(inY, found.clientHeight, found.offsetHeight, style.borderTopWidth, style.borderBottomWidth);
  };
  // Timers that are due, in order, up to `ms` later; between them, what they promised.
  const advance = async (ms) => {
    if (!VIRTUAL) return;
    const end = clock.now + ms;
    for (;;) {
      let first = null;
      for (const timer of clock.timers.values()) {
        if (timer.at <= end && (first === null || timer.at < first.at || (timer.at === first.at && timer.id < first.id))) {
          first = timer;
        }
      }
      if (first === null) break;
      clock.now = Math.max(clock.now, first.at);
      if (first.every) first.at = clock.now + first.every; else clock.timers.delete(first.id);
      try {
        if (typeof first.fn === "function") first.fn(...(first.args ?? [clock.now]));
        else if (first.fn) (0, eval)(String(first.fn));
      } catch (error) { clock.error = String(error); }
      await null;
    }
    clock.now = end;
    animate();
  };
  // Between two episodes the mouse is pressed on a button of this script's, so that nothing of the page is under it, and so
  // that what has the focus last has it from the mouse: the ring around what is focused next depends on that.
  const cover = document.createElement("button");
  cover.style = "position: fixed; inset: 0; opacity: 0; z-index: 2147483647";
  for (const name of ["focus", "focusin", "blur", "focusout"]) {
    window.addEventListener(name, (event) => { if (event.target === cover) event.stopImmediatePropagation(); }, true);
  }
  const rest = () => { document.documentElement.append(cover); };
  const forget = () => {
    cover.remove();
    for (const store of native.Object.values(stores)) store.held.clear();
    cookies.clear();
    clock.timers.clear();
    places = scrolled();
    clock.now = 0; clock.next = 1; clock.left = ""; clock.error = "";
    clock.mouse = null;
  };
  define(window, "__evopolicy", { clock, advance, settle, forget, clickable, moved, preload, bar, rest, json: native.json });
})();
