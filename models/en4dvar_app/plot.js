"use strict";
// Points over an axis, drawn to fit the canvas; what was drawn is kept, so that a click finds its point.
function ticks(low, high) {
  const step = 10 ** Math.floor(Math.log10((high - low) / 4 || 1));
  const wide = [1, 2, 5, 10].map((m) => m * step).find((s) => (high - low) / s <= 6);
  const out = [];
  for (let t = Math.ceil(low / wide) * wide; t <= high + 1e-9 * wide; t += wide) out.push(+t.toPrecision(10));
  return out;
}

function plot(canvas, points, xName, yName, cursor) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio;
  const draw = canvas.getContext("2d");
  draw.scale(ratio, ratio);
  draw.font = "13px system-ui, sans-serif";
  const seen = points.filter((p) => Number.isFinite(p.x) && Number.isFinite(p.y));
  canvas.points = [];
  if (!seen.length) { draw.fillText("no readings yet", 20, 30); return; }
  const xs = seen.map((p) => p.x), ys = seen.map((p) => p.y);
  const low = Math.min(...xs), high = Math.max(...xs), bottom = Math.min(0, ...ys), top = Math.max(...ys) * 1.05 || 1;
  const left = 30 + Math.max(32, ...ticks(bottom, top).map((t) => draw.measureText(t).width)), right = width - 12, base = height - 42;
  const px = (x) => left + ((x - low) / (high - low || 1)) * (right - left);
  const py = (y) => base - ((y - bottom) / (top - bottom || 1)) * (base - 10);
  draw.strokeStyle = "#d8d8de"; draw.fillStyle = "#44444c";
  for (const t of ticks(low, high)) { draw.strokeRect(px(t), 10, 0, base - 10); draw.textAlign = "center"; draw.fillText(t, px(t), base + 17); }
  for (const t of ticks(bottom, top)) { draw.strokeRect(left, py(t), right - left, 0); draw.textAlign = "right"; draw.fillText(t, left - 6, py(t) + 4); }
  draw.textAlign = "center"; draw.fillText(xName, (left + right) / 2, height - 6);
  draw.save(); draw.translate(14, base / 2); draw.rotate(-Math.PI / 2); draw.fillText(yName, 0, 0); draw.restore();
  for (const p of seen) {
    draw.fillStyle = draw.strokeStyle = p.colour || "#00619a";
    if (p.std) { draw.beginPath(); draw.moveTo(px(p.x), py(p.y - p.std)); draw.lineTo(px(p.x), py(p.y + p.std)); draw.stroke(); }
    draw.beginPath(); draw.arc(px(p.x), py(p.y), 2.6, 0, 7); draw.fill();
    canvas.points.push({ ...p, left: px(p.x), top: py(p.y) });
  }
  if (cursor >= low && cursor <= high) { draw.strokeStyle = "#a3330a"; draw.strokeRect(px(cursor), 10, 0, base - 10); }
}

function nearest(canvas, event) {
  const gap = (p) => (p.left - event.offsetX) ** 2 + (p.top - event.offsetY) ** 2;
  return (canvas.points || []).reduce((best, p) => (best && gap(best) <= gap(p) ? best : p), null);
}
