// Figures answer: a panel says where the pointer is, an entry of a legend switches its marks off and on.
for (const svg of document.querySelectorAll("figure svg")) {
  const text = document.createElementNS(svg.namespaceURI, "text");
  text.setAttribute("class", "reading");
  text.setAttribute("aria-hidden", "true");
  svg.append(text);
  for (const panel of svg.querySelectorAll("rect.read")) {
    const [[x0, x1], [y0, y1]] = [panel.dataset.x, panel.dataset.y].map((two) => two.split(" ").map(Number));
    const short = (value, span) => value.toFixed(Math.min(12, Math.max(0, 2 - Math.floor(Math.log10(Math.abs(span))))));
    panel.addEventListener("pointermove", (event) => {
      const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
      const box = panel.getBBox();
      const [across, up] = [(at.x - box.x) / box.width, 1 - (at.y - box.y) / box.height];
      const at_share = (low, high, share, log) => log ? (low * (high / low) ** share).toPrecision(3) : short(low + (high - low) * share, high - low);
      text.textContent = `${at_share(x0, x1, across, "xlog" in panel.dataset)}, ${at_share(y0, y1, up, "log" in panel.dataset)}`;
      text.setAttribute("text-anchor", across > 0.5 ? "end" : "start");
      text.setAttribute("x", at.x + (across > 0.5 ? -3 : 3));
      text.setAttribute("y", at.y - 3);
    });
    panel.addEventListener("pointerleave", () => (text.textContent = ""));
  }
  for (const entry of svg.querySelectorAll(".entry")) {
    svg.setAttribute("role", "group"); // within an image nothing can be pressed
    const label = entry.dataset.label;
    const marks = [...svg.querySelectorAll("path[data-label]")].filter((p) => p.dataset.label === label);
    const press = () => {
      const off = entry.getAttribute("aria-pressed") === "true";
      entry.setAttribute("aria-pressed", String(!off));
      marks.forEach((mark) => mark.toggleAttribute("hidden", off));
    };
    for (const [key, value] of [["role", "button"], ["tabindex", "0"], ["aria-pressed", "true"], ["aria-label", entry.textContent]])
      entry.setAttribute(key, value);
    entry.addEventListener("click", press);
    entry.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      press();
    });
  }
}
