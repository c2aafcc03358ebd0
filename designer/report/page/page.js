"use strict";
{
  const data = JSON.parse(document.getElementById("data").textContent);
  const said = document.getElementById("said");
  const plots = [...document.querySelectorAll(".plot")].map(prepare);
  const raised = (digits) => [...digits].map((digit) => digit === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit]).join("");
  const number = (value) => {
    if (value === null) return "–";
    const plain = value === 0 || (Math.abs(value) >= 1e-4 && Math.abs(value) < 1e5);
    const [digits, exponent] = (plain ? String(value) : value.toExponential(2)).split("e");
    return (exponent ? `${digits}·10${raised(String(Number(exponent)))}` : digits).replace("-", "−");
  };

  function prepare(element) {
    const figure = element.closest("figure");
    const plot = {...data.charts[figure.id], element, area: element.querySelector(".area"), row: 0,
      cursor: element.querySelector(".cursor"), values: figure.querySelectorAll(".legend b"),
      title: figure.querySelector("h3").textContent};
    plot.count = Math.ceil((plot.stop - plot.first) / plot.stretch);
    for (const name of ["cells", "codes"])
      if (plot[name]) plot[name] = Uint8Array.from(atob(plot[name]), (letter) => letter.charCodeAt(0));
    const area = plot.area;
    Object.assign(area, {tabIndex: 0});
    area.setAttribute("role", "slider");
    area.setAttribute("aria-label", `step, in: ${plot.title}`);
    area.setAttribute("aria-valuemin", plot.first);
    area.setAttribute("aria-valuemax", plot.stop - 1);
    area.addEventListener("pointermove", (event) => {
      const box = area.getBoundingClientRect();
      const part = Math.min(0.999999, Math.max(0, (event.clientX - box.left) / box.width));
      const down = Math.min(0.999999, Math.max(0, (event.clientY - box.top) / box.height));
      if (plot.rows) plot.row = Math.floor(down * plot.rows.length);
      show(plot.first + Math.floor(part * plot.count) * plot.stretch);
    });
    area.addEventListener("pointerleave", () => show(data.start));
    area.addEventListener("keydown", (event) => {
      const moves = {ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10, Home: -Infinity, End: Infinity};
      const rows = {ArrowUp: -1, ArrowDown: 1};
      if (event.key in moves) {
        const to = step + moves[event.key] * plot.stretch;
        show(Math.min(plot.stop - 1, Math.max(plot.first, to)));
      } else if (plot.rows && event.key in rows) {
        plot.row = Math.min(plot.rows.length - 1, Math.max(0, plot.row + rows[event.key]));
        show(step);
      } else return;
      event.preventDefault();
      said.textContent = plot.area.getAttribute("aria-valuetext");
    });
    return plot;
  }

  function texts(plot, column) {
    if (plot.series)
      return plot.series.map(({low, high}) => plot.words ? plot.words[low[column]] ?? "–" :
        high && high[column] !== low[column] ? `${number(low[column])} … ${number(high[column])}` : number(low[column]));
    const at = plot.row * plot.count + column, row = `${plot.rows[plot.row]}: `;
    if (plot.cells) {
      const [low, high, log] = plot.scale, part = (plot.cells[at] - 1) / 254;
      const value = log ? low * Math.pow(high / low, part) : low + (high - low) * part;
      return [row + (plot.cells[at] ? "≈ " + number(Number(value.toPrecision(2))) : "not known")];
    }
    return [...plot.values].map((_, layer) => {
      const code = plot.codes[at] >> (2 * layer) & 3;
      return row + (code & 1 ? "yes" : code & 2 ? "not known" : "no");
    });
  }

  let step = data.start;
  function show(to) {
    step = to;
    let mode = null;
    for (const plot of plots) {
      const column = Math.floor((step - plot.first) / plot.stretch);
      plot.cursor.hidden = column < 0 || column >= plot.count;
      if (plot.cursor.hidden) { plot.values.forEach((value) => { value.textContent = ""; }); continue; }
      const first = plot.first + column * plot.stretch, last = Math.min(plot.stop, first + plot.stretch) - 1;
      const name = `step ${first}${last > first ? " to " + last : ""}`;
      plot.cursor.style.left = `${100 * (column + 0.5) / plot.count}%`;
      plot.cursor.dataset.step = name;
      plot.cursor.classList.toggle("left", column > plot.count / 2);
      const shown = texts(plot, column);
      plot.values.forEach((value, i) => { value.textContent = shown[i] ?? ""; });
      plot.area.setAttribute("aria-valuenow", first);
      plot.area.setAttribute("aria-valuetext", `${name}: ${[...plot.values].map((value) =>
        value.closest("li").textContent.replace(/\s+/g, " ").trim()).join("; ")}`);
      if (plot.words && plot.stretch === 1) mode = plot.series[0].low[column];
    }
    for (const topology of document.querySelectorAll(".topology"))
      topology.classList.toggle("lit", mode !== null && Number(topology.dataset.mode) === mode);
  }
  show(step);
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((details) => { details.open = true; }));
}
