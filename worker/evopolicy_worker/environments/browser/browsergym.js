// Runs once in a page of MiniWoB++, after miniwob.js: shows it as BrowserGym does, and names its elements.
(() => {
  "use strict";
  const { clock, begin, state, clickable } = __evopolicy;
  const ZOOM = 1.4;
  const UNIT = 1 / 320;  // Of lengths: the browser's own ones are 1/64, zoomed 1.4/64, with errors of rounding.
  const HIDDEN = ["reward-display", "click-canvas", "sync-task-cover"];
  const NAMED = new Set(`a abbr acronym address applet area article aside audio b base basefont bdi bdo big blockquote body br
    button canvas caption center cite code col colgroup data datalist dd del details dfn dialog dir div dl dt em embed
    fieldset figcaption figure font footer form frame frameset h1 h2 h3 h4 h5 h6 head header hgroup hr html i iframe img
    input ins kbd label legend li link main map mark menu meta meter nav noframes noscript object ol optgroup option output
    p param picture pre progress q rp rt ruby s samp script search section select small source span strike strong style sub
    summary sup svg table tbody td template textarea tfoot th thead time title tr track tt u ul var video wbr`.split(/\s+/));
  const MARKED = new Set(["input", "textarea", "select", "button", "a", "iframe", "video", "li", "td", "option"]);
  const UNSEEN = new Set(["head", "script", "style", "noscript", "template", "meta", "link", "title", "base"]);

  // The instruction and what tells the score are not in the page; an agent is told the former as its goal.
  let aside = null;
  const hide = () => {
    core.clearTimer();
    document.body.removeEventListener("click", core.canvasDrawClick);
    const query = document.getElementById("query");
    aside = { query: [...query.childNodes], parts: HIDDEN.map((id) => document.getElementById(id)).filter(Boolean) };
    query.replaceChildren();
    for (const part of aside.parts) part.remove();
  };
  const show = () => {
    if (aside === null) return;
    document.getElementById("query").replaceChildren(...aside.query);
    for (const part of aside.parts) document.body.appendChild(part);
    core.createDisplay();
    aside = null;
  };
  for (const name of ["getUtterance", "endEpisode", "startEpisodeReal"]) {
    const usual = core[name];
    core[name] = (...args) => {
      show();
      try { return usual(...args); } finally { hide(); }
    };
  }
  // The instructions of two pages show an icon or a colour, which the goal names.
  const hex = (colour) => `#${colour.match(/\d+/g).map((part) => Number(part).toString(16).padStart(2, "0")).join("")}`;
  const goal = () => {
    show();
    try {
      const query = document.getElementById("query");
      const words = (node) => node.textContent.replace(/\s+/g, " ").trim();
      const page = location.pathname.split("/").pop();
      if (page === "click-menu-2.html" && query.children.length) {
        const icon = query.children[0].getAttribute("class").split(" ")[1];
        return `${words(query.childNodes[0])} "${icon}" ${words(query.childNodes[2])}`;
      }
      if (page === "use-colorwheel-2.html") {
        return `${words(query.children[0])} ${hex(query.children[1].style.backgroundColor)} ${words(query.children[2])}`;
      }
      return words(query);
    } finally { hide(); }
  };
  hide();

  let counted = 0;
  const mark = () => {
    const seen = new Set();
    for (const element of document.querySelectorAll("*")) {
      if (!NAMED.has(element.tagName.toLowerCase())) continue;
      let bid = element.getAttribute("bid");
      if (bid === null || seen.has(bid)) {
        bid = String(counted++);
        element.setAttribute("bid", bid);
      }
      seen.add(bid);
    }
  };
  const whole = (length) => Number((Math.round(length / UNIT) * UNIT).toFixed(6));
  const boxed = (element) => {
    const { left, top, right, bottom } = element.getBoundingClientRect();
    return {
      left: whole(left), top: whole(top), right: whole(right), bottom: whole(bottom),
      width: whole(right - left), height: whole(bottom - top),
    };
  };
  const hit = (element, box) => {
    const found = document.elementFromPoint((box.left + box.right) / 2, (box.top + box.bottom) / 2);
    return found !== null && (found === element || element.contains(found));
  };
  // The part of the window in which an element's children are shown.
  const clipped = (element, known) => {
    if (element === null || element === document.body || element === document.documentElement) {
      return { left: 0, top: 0, right: innerWidth, bottom: innerHeight };
    }
    if (!known.has(element)) {
      const style = getComputedStyle(element);
      const around = within(element, style, known);
      known.set(element, style.overflow === "visible" ? around : common(boxed(element), around));
    }
    return known.get(element);
  };
  const within = (element, style, known) =>
    clipped(style.position === "absolute" ? element.offsetParent : element.parentElement, known);
  const common = (one, other) => ({
    left: Math.max(one.left, other.left), top: Math.max(one.top, other.top),
    right: Math.min(one.right, other.right), bottom: Math.min(one.bottom, other.bottom),
  });
  const properties = () => {
    const found = {};
    const known = new Map();
    const marked = new Map();
    const buttons = [];
    const round = (x) => Math.round(x * 100) / 100;
    for (const element of document.querySelectorAll("[bid]")) {
      const box = boxed(element);
      const area = box.width * box.height;
      const tag = element.tagName.toLowerCase();
      const style = getComputedStyle(element);
      const shown = common(box, within(element, style, known));
      const [wide, high] = [Math.max(0, shown.right - shown.left), Math.max(0, shown.bottom - shown.top)];
      let som = false;
      if (area >= 20 && (MARKED.has(tag) || element.onclick !== null || style.cursor === "pointer") && hit(element, box)
          && buttons.every((button) => !button.contains(element))) {
        som = true;
        if (element.matches("button, a, input[type='button'], div[role='button']")) buttons.push(element);
        for (let above = element.parentElement; above; above = above.parentElement) {
          if (marked.has(above)) marked.get(above).set_of_marks = false;
        }
      }
      const rendered = element.getClientRects().length > 0;
      const told = {
        visibility: area > 0 ? round(wide * high / area) : 0,
        bbox: rendered ? [box.left, box.top, box.width, box.height] : null,
        clickable: clickable(element),
        set_of_marks: som,
      };
      found[element.getAttribute("bid")] = told;
      marked.set(element, told);
    }
    return found;
  };

  const text = (value) => ({ type: "computedString", value });
  const flag = (name, value, type = "booleanOrUndefined") => ({ name, value: { type, value } });
  const states = (element) => {
    const found = [];
    const tag = element.tagName.toLowerCase();
    const typed = tag === "textarea" || (tag === "input" && !["button", "checkbox", "radio", "submit", "image", "reset", "file",
      "range", "color"].includes(element.type));
    if (element.disabled) found.push(flag("disabled", true, "boolean"));
    if (element.tabIndex >= 0 && !element.disabled) found.push(flag("focusable", true));
    if (document.activeElement === element && element !== document.body) found.push(flag("focused", true));
    if (typed || element.isContentEditable) {
      found.push(flag("editable", element.isContentEditable ? "richtext" : "plaintext", "token"), flag("settable", true));
      if (tag === "textarea") found.push(flag("multiline", true, "boolean"));
      if (element.readOnly) found.push(flag("readonly", true, "boolean"));
      if (element.required) found.push(flag("required", true, "boolean"));
    }
    if (tag === "input" && ["checkbox", "radio"].includes(element.type)) {
      found.push(flag("checked", String(element.checked), "tristate"));
    }
    if (tag === "option") found.push(flag("selected", element.selected));
    if (tag === "select") found.push(flag("hasPopup", element.multiple ? "false" : "menu", "token"));
    for (const name of ["expanded", "pressed", "selected"]) {
      const told = element.getAttribute(`aria-${name}`);
      if (told !== null) found.push(flag(name, told === "true"));
    }
    if (/^h[1-6]$/.test(tag)) found.push(flag("level", Number(tag[1]), "integer"));
    return found;
  };
  const tree = () => {
    const nodes = [];
    const enter = (parent, told) => {
      const node = { nodeId: String(nodes.length + 1), ignored: false, ...told, childIds: [] };
      if (parent) { node.parentId = parent.nodeId; parent.childIds.push(node.nodeId); }
      nodes.push(node);
      return node;
    };
    const walk = (element, parent) => {
      for (const child of element.childNodes) {
        if (child instanceof Text) {
          const words = child.data.replace(/\s+/g, " ").trim();
          if (words) enter(parent, { role: { type: "internalRole", value: "StaticText" }, name: text(words), properties: [] });
        } else if (child instanceof Element) {
          const tag = child.tagName.toLowerCase();
          if (UNSEEN.has(tag) || child.getAttribute("aria-hidden") === "true") continue;
          const style = getComputedStyle(child);
          if (style.display === "none") continue;
          if (style.visibility === "hidden" || style.visibility === "collapse") { walk(child, parent); continue; }
          const told = {
            role: { type: "role", value: child.computedRole || "generic" }, name: text(child.computedName || ""),
            properties: states(child),
          };
          if ("value" in child && ["input", "textarea", "select", "progress", "meter"].includes(tag) && child.value !== "") {
            told.value = { type: "string", value: String(child.value) };
          }
          const bid = child.getAttribute("bid");
          if (bid !== null) told.browsergym_id = bid;
          walk(child, enter(parent, told));
        }
      }
    };
    const root = enter(null, {
      role: { type: "internalRole", value: "RootWebArea" }, name: text(document.title),
      properties: [flag("focusable", true)],
    });
    root.browsergym_id = document.documentElement.getAttribute("bid");
    walk(document.body, root);
    return { nodes };
  };

  // The browser keeps its accessibility tree, and does not see that a drawing's role changes with what is drawn in it.
  const redraw = () => {
    for (const drawing of document.querySelectorAll("svg:not([role])")) {
      drawing.setAttribute("role", "none");
      drawing.removeAttribute("role");
    }
  };

  const look = () => {
    const found = state();
    if (found.left) return found;
    mark();
    redraw();
    found.tree = tree();
    found.properties = properties();
    const focused = document.activeElement;
    found.focused = focused && focused !== document.body ? focused.getAttribute("bid") ?? "" : "";
    found.title = document.title;
    return found;
  };
  const first = () => { const told = goal(); return { ...look(), goal: told }; };
  const enter = async (...args) => {
    document.body.style.transform = "";
    for (const element of document.querySelectorAll("[bid]")) element.removeAttribute("bid");
    counted = 0;
    await begin(...args);
    document.body.style.transform = `scale(${ZOOM})`;
    document.body.style.transformOrigin = "top left";
  };

  // Places and states of elements, for actions that name one. Each refuses what BrowserGym's would wait for in vain.
  const named = (bid) => document.querySelector(`[bid="${CSS.escape(bid)}"]`);
  const labelled = (element) => (element && !element.matches("a, button, input, select, textarea, [role=button], [role=link]")
    && !element.isContentEditable && element.closest("label")?.control) || element;
  const refused = (bid, element) => {
    if (element === null) return `Could not find element with bid "${bid}"`;
    const box = boxed(element);
    if (box.width === 0 || box.height === 0 || getComputedStyle(element).visibility !== "visible") {
      return `Element with bid "${bid}" is not visible`;
    }
    return element.disabled ? `Element with bid "${bid}" is not enabled` : "";
  };
  const place = (bid) => {
    const element = named(bid);
    element?.scrollIntoView({ block: "nearest", inline: "nearest", behavior: "instant" });
    const error = refused(bid, element);
    if (error) return { error };
    const box = boxed(element);
    const [x, y] = [box.left + box.width / 2, box.top + box.height / 2];
    const top = document.elementFromPoint(x, y);
    if (top === null || !(top === element || element.contains(top) || top.contains(element)
        || (top.closest("label") && top.closest("label").control === element))) {
      return { error: `Another element lies over the element with bid "${bid}"` };
    }
    return { x, y };
  };
  const focus = (bid) => {
    const element = named(bid);
    if (element === null) return { error: `Could not find element with bid "${bid}"` };
    element.focus();
    return {};
  };
  const changed = (element) => {
    element.dispatchEvent(new Event("input", { bubbles: true, composed: true }));
    element.dispatchEvent(new Event("change", { bubbles: true }));
  };
  // Whether the value is in its place; otherwise it has to be typed, in place of what is selected now.
  const fill = (bid, value) => {
    const element = labelled(named(bid));
    const error = refused(bid, element);
    if (error) return { error };
    if (element.readOnly) return { error: `Element with bid "${bid}" is not editable` };
    const input = element instanceof HTMLInputElement;
    if (!input && !(element instanceof HTMLTextAreaElement) && !element.isContentEditable) {
      return { error: `Element with bid "${bid}" is not an <input>, <textarea> or [contenteditable] element` };
    }
    element.focus();
    if (input && ["color", "date", "time", "datetime-local", "month", "range", "week"].includes(element.type)) {
      element.value = value;
      if (element.value !== value) return { error: "Malformed value" };
      changed(element);
      return { filled: true };
    }
    if (input && !["email", "number", "password", "search", "tel", "text", "url"].includes(element.type)) {
      return { error: `Input of type "${element.type}" cannot be filled` };
    }
    if (input && element.type === "number" && Number.isNaN(Number(value))) {
      return { error: "Cannot type text into input[type=number]" };
    }
    if (element.isContentEditable) getSelection().selectAllChildren(element); else element.select();
    return { filled: false };
  };
  const checked = (bid) => {
    const element = labelled(named(bid));
    if (!(element instanceof HTMLInputElement && ["checkbox", "radio"].includes(element.type))) {
      return { error: `Element with bid "${bid}" is no checkbox or radio button` };
    }
    return { checked: element.checked };
  };
  const choose = (bid, wanted) => {
    const element = labelled(named(bid));
    const error = refused(bid, element);
    if (error) return { error };
    if (!(element instanceof HTMLSelectElement)) return { error: `Element with bid "${bid}" is not a <select> element` };
    const meant = (option, each) => option.value === each || option.label === each || option.text.trim() === each;
    const options = [...element.options];
    const found = options.filter((option) => wanted.some((each) => meant(option, each)));
    const missing = wanted.filter((each) => !options.some((option) => meant(option, each)));
    if (missing.length && (element.multiple || !found.length)) {
      return { error: `The element with bid "${bid}" has no option ${JSON.stringify(missing)}` };
    }
    const kept = element.multiple ? found : found.slice(0, 1);
    element.focus();
    for (const option of options) option.selected = kept.includes(option);
    changed(element);
    return {};
  };
  __evopolicy.gym = { begin: enter, look, first, place, focus, fill, checked, choose };
})();
