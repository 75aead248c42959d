"use strict";
(() => {
  const root = document.documentElement;
  const themes = ["auto", "light", "dark"];
  const button = document.getElementById("theme");
  const store = {
    get() { try { return localStorage.getItem("evopolicy-theme"); } catch { return null; } },
    set(value) { try { localStorage.setItem("evopolicy-theme", value); } catch { /* a file has no storage in some browsers */ } },
  };
  const show = (theme) => {
    if (theme === "auto") delete root.dataset.theme; else root.dataset.theme = theme;
    if (button) { button.textContent = "Theme: " + theme; button.value = theme; }
  };
  show(themes.includes(store.get()) ? store.get() : "auto");
  if (button) {
    button.hidden = false;
    button.addEventListener("click", () => {
      const next = themes[(themes.indexOf(button.value) + 1) % themes.length];
      store.set(next);
      show(next);
    });
  }

  // Sorting: a click on a header sorts by its column, the next click the other way; rows without a value stay last.
  const valueOf = (row, column) => {
    const cell = row.cells[column];
    const value = cell.dataset.v;
    if (value === undefined) return cell.textContent.trim();
    return value === "" ? null : Number(value);
  };
  const compare = (a, b) =>
    typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true });
  for (const table of document.querySelectorAll("table.data")) {
    const body = table.tBodies[0];
    const headers = [...table.tHead.rows[0].cells];
    headers.forEach((header, column) => {
      const sorter = header.querySelector("button");
      if (!sorter) return;
      sorter.addEventListener("click", () => {
        const numeric = header.classList.contains("n");
        const before = header.getAttribute("aria-sort");
        const next = before === null ? (numeric ? "descending" : "ascending") : before === "ascending" ? "descending" : "ascending";
        headers.forEach((other) => other.removeAttribute("aria-sort"));
        header.setAttribute("aria-sort", next);
        const sign = next === "ascending" ? 1 : -1;
        const rows = [...body.rows].map((row, place) => ({ row, place, value: valueOf(row, column) }));
        rows.sort((a, b) => {
          if (a.value === null || b.value === null) return (a.value === null) - (b.value === null) || a.place - b.place;
          return sign * compare(a.value, b.value) || a.place - b.place;
        });
        body.append(...rows.map((entry) => entry.row));
      });
    });
  }

  // Filters: every word must occur in the row.
  for (const input of document.querySelectorAll("input[data-filter]")) {
    const table = document.getElementById(input.dataset.filter);
    const count = document.getElementById(input.dataset.filter + "-count");
    const rows = [...table.tBodies[0].rows];
    const texts = new Map(rows.map((row) => [row, row.textContent.toLowerCase()]));
    input.addEventListener("input", () => {
      table.classList.remove("short");
      const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
      let shown = 0;
      for (const row of rows) {
        const hit = words.every((word) => texts.get(row).includes(word));
        row.hidden = !hit;
        shown += hit;
      }
      count.textContent = shown + " of " + rows.length + " rows";
    });
  }
  // A long table shows its first rows; a link to a folded section opens it.
  for (const button of document.querySelectorAll("button.more")) {
    const table = document.getElementById(button.dataset.table);
    button.hidden = false;
    table.classList.add("cut");
    button.addEventListener("click", () => { table.classList.remove("short"); button.hidden = true; });
  }
  const unfold = () => {
    const target = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!target) return;
    for (let one = target.querySelector(":scope > details.fold") || target.closest("details"); one; one = one.parentElement.closest("details")) one.open = true;
    target.scrollIntoView();
  };
  addEventListener("hashchange", unfold);
  for (const link of document.querySelectorAll('nav.bar a[href^="#"]')) link.addEventListener("click", () => setTimeout(unfold));
  if (document.querySelector("details.fold")) unfold();
  for (const tools of document.querySelectorAll(".tools[hidden]")) tools.hidden = false;

  // A figure as PNG, drawn by the browser on white in the light theme.
  for (const button of document.querySelectorAll("button.png")) {
    button.hidden = false;
    button.addEventListener("click", async () => {
      const svg = button.closest("figure").querySelector("svg").cloneNode(true);
      const [, , width, height] = svg.getAttribute("viewBox").split(/\s+/).map(Number);
      const sizes = { xmlns: "http://www.w3.org/2000/svg", width: 3 * width, height: 3 * height, style: "--ink: #15181d; --muted: #5c6773; --grid: #d5dae1" };
      for (const [name, value] of Object.entries(sizes)) svg.setAttribute(name, value);
      const image = new Image();
      image.src = "data:image/svg+xml," + encodeURIComponent(new XMLSerializer().serializeToString(svg));
      await image.decode();
      const canvas = Object.assign(document.createElement("canvas"), { width: image.width, height: image.height });
      const context = canvas.getContext("2d");
      context.fillStyle = "white";
      context.fillRect(0, 0, canvas.width, canvas.height);
      context.drawImage(image, 0, 0);
      Object.assign(document.createElement("a"), { href: canvas.toDataURL(), download: button.dataset.name + ".png" }).click();
    });
  }

  // One timeline at a time; without scripts all of them show.
  const picker = document.getElementById("timeline-picker");
  if (picker) {
    const figures = [...document.querySelectorAll("figure[data-timeline]")];
    const pick = () => figures.forEach((figure) => { figure.hidden = picker.value !== "" && figure.dataset.timeline !== picker.value; });
    picker.addEventListener("change", pick);
    pick();
  }
})();
