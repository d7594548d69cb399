// What the tests ask of a page: contrast of every visible text (WCAG 2.2, § 1.4.3), and what sticks out of it.
window.look = (() => {
  const canvas = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const rgba = (colour) => {
    canvas.clearRect(0, 0, 1, 1);
    canvas.fillStyle = colour;
    canvas.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = canvas.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  };
  const over = (top, below) => top.slice(0, 3).map((v, i) => v * top[3] + below[i] * (1 - top[3]));
  const light = (c) => {
    const [r, g, b] = c.map((v) => v / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const contrast = (a, b) => {
    const [x, y] = [light(a), light(b)].sort((p, q) => q - p);
    return (x + 0.05) / (y + 0.05);
  };
  const background = (element) => {
    const layers = [];
    for (let e = element; e; e = e.parentElement) layers.push(rgba(getComputedStyle(e).backgroundColor));
    return layers.reverse().reduce((below, top) => over(top, below), [255, 255, 255]);
  };
  const faint = () => {
    document.querySelectorAll("details").forEach((d) => (d.open = true));
    const found = [];
    const judge = (element, colour, text, needed) => {
      const ground = background(element);
      const ratio = contrast(over(rgba(colour), ground), ground);
      if (ratio < needed) found.push(`${ratio.toFixed(2)} < ${needed}: ${text.slice(0, 40)}`);
      return 1;
    };
    let seen = 0;
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node = walker.nextNode(); node; node = walker.nextNode()) {
      const element = node.parentElement;
      if (!node.data.trim() || element.closest("script, style") || !element.getClientRects().length) continue;
      const style = getComputedStyle(element);
      const size = parseFloat(style.fontSize);
      const large = size >= 24 || (size >= 18.66 && parseInt(style.fontWeight) >= 700);
      seen += judge(element, style.color, node.data.trim(), large ? 3 : 4.5);
    }
    for (const group of document.querySelectorAll('svg g[id*="-text_"]'))  // words of figures are drawn as outlines
      for (const path of group.querySelectorAll("use, path"))
        if (getComputedStyle(path).fill !== "none") seen += judge(group.closest("figure"), getComputedStyle(path).fill, group.id, 3);
    return { found: [...new Set(found)], seen };
  };
  const wide = () => {
    document.querySelectorAll("details").forEach((d) => (d.open = true));
    const page = document.documentElement;
    return { scroll: page.scrollWidth, width: page.clientWidth };
  };
  const cut = () => {
    document.querySelectorAll("details").forEach((d) => (d.open = true));
    const long = [...document.querySelectorAll("pre")].filter((e) => e.scrollWidth > e.clientWidth).map(() => "pre");
    const outside = [...document.querySelectorAll("svg text")].filter((e) => e.textContent).filter((e) => {
      const [word, drawing] = [e, e.closest("svg")].map((one) => one.getBoundingClientRect());
      return word.bottom > drawing.bottom + 1 || word.left < drawing.left - 1 || word.right > drawing.right + 1;
    });
    return [...long, ...outside.map((e) => e.textContent)];
  };
  const drawings = () =>
    [...document.querySelectorAll("svg, img")].map((e) => {
      const box = e.getBoundingClientRect();
      const empty = e.tagName === "IMG" ? !e.naturalWidth : !e.querySelector("path");
      return box.width > 100 && box.height > 50 && !empty;
    });
  const unnamed = () => {
    const silent = {
      "th:not([scope])": () => true,
      "svg, img, a, button, [role=button]": (e) =>
        !(e.textContent.trim() || e.getAttribute("aria-label") || e.alt) && e.getAttribute("aria-hidden") !== "true",
    };
    return Object.entries(silent).flatMap(([what, bad]) =>
      [...document.querySelectorAll(what)].filter(bad).map((e) => `${what}: ${e.outerHTML.slice(0, 80)}`));
  };
  return { cut, faint, wide, drawings, unnamed };
})();
