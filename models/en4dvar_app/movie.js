"use strict";
// The inspector: frames with outlines beside R(t). Corrections are lines of the text file that `track` reads.
let movie = null, at = 0, kept = "", drag = null, bar = null, covered = null;
const bitmaps = new Map();
const LINE = /^\s*(\d+)\s+(\S.*)$/;

// Until the next movie is there none is shown, and no frame of the last one comes any more.
function noMovie() { movie = null; $("inspector").hidden = true; latest("frame", Promise.resolve()); }

async function readMovie(afresh = true, chosen = true) {
  const name = $("movie").value;
  if (!name) return;
  if (afresh) { noMovie(); $("length").value = ""; recall("track"); }
  const raw = $("raw").value;
  try {
    const [seen, { text }] = await latest("movie", Promise.all([fetched("movie", { movie: name, raw }), fetched("text", { movie: name })]));
    movie = Object.assign(movie || { name, raw, picture: null }, seen);
    if (afresh) $("corrections").value = kept = text;
  } catch (error) { noMovie(); return chosen && say(error.message); }
  if (afresh) {
    bitmaps.clear(); at = 0; bar = null;
    if (movie.pixel) $("pixel").value ||= `${+(movie.pixel * 1e6).toPrecision(9)} um`;
    if (movie.rate) $("frame-rate").value ||= `${+movie.rate.toPrecision(9)} Hz`;
  }
  movie.rows = new Map((movie.readings?.rows || []).map((row) => [row.frame, row]));
  $("corrections-name").textContent = `${stem()}.corrections.txt`;
  if (afresh) showMask();
  $("inspector").hidden = false;
  $("number").max = movie.count - 1;
  go(at);
}

const stem = () => movie.name.replace(/\.[^.]*$/, "");

async function showMask() {
  const name = $("mask").value, answer = name.endsWith(".png") ? fetch(link(name, "").href) : Promise.resolve({});
  covered = await latest("mask", answer.then(async (seen) => (seen.ok ? createImageBitmap(await seen.blob()) : null)));
  draw();
}

function bitmap(n) {
  if (!bitmaps.has(n)) {
    bitmaps.set(n, fetched("frame", { movie: movie.name, raw: movie.raw, n }).then(createImageBitmap));
    if (bitmaps.size > 400) bitmaps.delete(bitmaps.keys().next().value);
  }
  return bitmaps.get(n);
}

async function go(n) {
  at = Math.max(0, Math.min(movie.count - 1, n));
  $("number").value = at;
  tell();
  try { draw(await latest("frame", bitmap(at))); history(); } catch (error) { say(error.message); }
  for (let k = 1; k < 6 && at + k < movie.count; k++) bitmap(at + k).catch(() => {});
}

function lines() {
  const found = new Map();
  for (const text of $("corrections").value.split("\n")) { const m = text.match(LINE); if (m) found.set(+m[1], m[2].trim()); }
  return found;
}

// The circle of a frame, pixels: as corrected, else as read.
function circle(n) {
  const words = lines().get(n), numbers = words ? words.split(/\s+/).slice(0, 3).map(Number) : [];
  if (numbers.length === 3 && numbers.every(Number.isFinite)) return { x: numbers[0], y: numbers[1], r: numbers[2], by: "hand" };
  const row = movie.rows.get(n), pixel = movie.readings?.pixel;
  return row && row.R_um ? { x: row.x_um / pixel, y: row.y_um / pixel, r: row.R_um / pixel, by: "track" } : null;
}

function tell() {
  const row = movie.rows.get(at), words = lines().get(at), own = circle(at);
  const read = !row ? "not read yet" : row.R_um ? `R ${row.R ?? row.R_um} µm, used${row.reason ? `: ${row.reason}` : ""}` : `not used: ${row.reason}`;
  $("reading").textContent = `Frame ${at} of ${movie.count}${row ? `, ${row.t_us} µs` : ""}. ${read}.${words ? ` Correction: ${words}.` : ""}`;
  [$("x").value, $("y").value, $("radius").value] = own ? [own.x, own.y, own.r].map((v) => v.toFixed(1)) : ["", "", ""];
}

function draw(picture) {
  if (picture) movie.picture = picture;
  if (!movie?.picture) return; // it is on its way
  const canvas = $("frame"), scale = canvas.clientWidth / movie.width, ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * ratio; canvas.height = scale * movie.height * ratio;
  const pen = canvas.getContext("2d");
  pen.imageSmoothingEnabled = false;
  pen.setTransform(scale * ratio, 0, 0, scale * ratio, 0, 0);
  pen.drawImage(movie.picture, 0, 0, movie.width, movie.height);
  pen.lineWidth = 2 / scale;
  pen.globalCompositeOperation = "multiply"; pen.globalAlpha = 0.7;
  if (covered) pen.drawImage(covered, 0, 0, movie.width, movie.height);
  pen.globalCompositeOperation = "source-over"; pen.globalAlpha = 1;
  if (drag?.outline) { pen.strokeStyle = "#ff7070"; pen.beginPath(); drag.outline.forEach((p) => pen.lineTo(p.x, p.y)); pen.stroke(); }
  const own = drag?.circle || circle(at);
  if (own) {
    pen.strokeStyle = own.by === "track" ? "#00c8ff" : "#ffb000";
    pen.beginPath(); pen.arc(own.x + 0.5, own.y + 0.5, Math.max(0, own.r), 0, 7); pen.stroke();
    pen.beginPath(); pen.arc(own.x + 0.5, own.y + 0.5, 2 / scale, 0, 7); pen.stroke();
  }
  const box = drag?.region || $("region").value.split(",").map(Number);
  if (box.length === 4 && box.every(Number.isFinite)) { pen.strokeStyle = "#50e060"; pen.strokeRect(...box); }
  const place = $("bubble").value.split(",").map(Number);
  if (place.length === 2 && place.every(Number.isFinite)) {
    pen.strokeStyle = "#ff50d0"; pen.beginPath();
    pen.moveTo(place[0] - 6, place[1]); pen.lineTo(place[0] + 6, place[1]); pen.moveTo(place[0], place[1] - 6); pen.lineTo(place[0], place[1] + 6); pen.stroke();
  }
  if (bar) { pen.strokeStyle = "#ffff40"; pen.beginPath(); pen.moveTo(bar[0], bar[1]); pen.lineTo(bar[2], bar[3]); pen.stroke(); }
}

function history() {
  const rows = [...movie.rows.values()], corrected = lines();
  const points = rows.filter((row) => row.R_um).map((row) => ({
    x: row.t_us, y: row.R_um, std: row.R_std_um, frame: row.frame, colour: corrected.has(row.frame) ? "#b36b00" : undefined }));
  plot($("history"), points, "time, µs", "radius, µm", movie.rows.get(at)?.t_us);
}

async function correct(n, words) {
  const was = $("corrections").value;
  const others = $("corrections").value.split("\n").filter((text) => text.trim() && (text.match(LINE) || [])[1] !== String(n));
  if (words) others.push(`${n} ${words}`);
  $("corrections").value = others.length ? `${others.join("\n")}\n` : "";
  await keepCorrections(was);
}

// If that fails, a mark is taken back to what 'was' there; what was typed stays.
async function keepCorrections(was) {
  const text = $("corrections").value, own = movie, shows = (now) => { if (own === movie) $("corrections").value = kept = now; };
  const done = await keepText({ movie: own.name }, kept, text, shows);
  if (own !== movie) return false;
  if (done) kept = text;
  else if (was !== undefined) $("corrections").value = was;
  tell(); draw(); history();
  return done;
}

function where(event) {
  const scale = movie.width / $("frame").clientWidth;
  return { x: event.offsetX * scale, y: event.offsetY * scale };
}

const tool = () => document.querySelector("input[name=tool]:checked").value;
const rounded = (...values) => values.map((v) => Math.round(10 * v) / 10);

$("frame").addEventListener("pointerdown", (event) => {
  if (!movie) return;
  const p = where(event), own = circle(at);
  $("frame").setPointerCapture(event.pointerId);
  drag = { from: p, own, outline: tool() === "mask" ? [p] : null };
  if (tool() === "circle" && own) {
    const far = Math.hypot(p.x - own.x - 0.5, p.y - own.y - 0.5);
    drag.how = Math.abs(far - own.r) < Math.max(6, 0.25 * own.r) ? "size" : far < own.r ? "move" : "new";
  }
});

$("frame").addEventListener("pointermove", (event) => {
  if (!drag) return;
  const p = where(event), { from, own, how } = drag, dx = p.x - from.x, dy = p.y - from.y;
  if (Math.hypot(dx, dy) < 1 && !drag.moved) return;
  drag.moved = true;
  if (tool() === "circle") {
    drag.circle = how === "move" ? { ...own, x: own.x + dx, y: own.y + dy, by: "hand" }
      : how === "size" ? { ...own, r: Math.hypot(p.x - own.x - 0.5, p.y - own.y - 0.5), by: "hand" }
        : { x: from.x - 0.5, y: from.y - 0.5, r: Math.hypot(dx, dy), by: "hand" };
  } else if (tool() === "region") {
    const [x, y] = [Math.max(0, Math.round(Math.min(p.x, from.x))), Math.max(0, Math.round(Math.min(p.y, from.y)))];
    drag.region = [x, y, Math.min(movie.width - x, Math.round(Math.abs(dx))), Math.min(movie.height - y, Math.round(Math.abs(dy)))];
  } else if (drag.outline) drag.outline.push(p);
  else if (tool() === "scale") bar = [from.x, from.y, p.x, p.y];
  draw();
});

$("frame").addEventListener("pointerup", async (event) => {
  if (!drag) return;
  const { circle: own, region, outline, moved } = drag, p = where(event);
  drag = null;
  if (tool() === "circle" && own && own.r > 0) await correct(at, rounded(own.x, own.y, own.r).join(" "));
  if (tool() === "bubble") $("bubble").value = rounded(p.x, p.y).join(",");
  if (tool() === "region") $("region").value = moved && region && region[2] > 1 && region[3] > 1 ? region.join(",") : "";
  if (tool() === "scale") scaled();
  if (outline) {
    const text = outline.map(({ x, y }) => rounded(x, y).join(",")).join(" "), own = { movie: movie.name, raw: movie.raw, outline: text };
    const covers = moved && (await post("mask", { ...own, uncovers: event.shiftKey ? "1" : "" }));
    if (movie?.name !== own.movie) return;
    $("mask").value = covers ? `${stem()}.mask.png` : "";
    showMask();
  }
  remember("track");
  draw();
});

// The pixel from the bar that was drawn and its length, as typed: 100 um.
function scaled() {
  const typed = $("length").value.trim().match(/^([\d.]+)\s*(\S+)$/), pixels = bar ? Math.hypot(bar[2] - bar[0], bar[3] - bar[1]) : 0;
  if (typed && pixels > 1) { $("pixel").value = `${+(typed[1] / pixels).toPrecision(5)} ${typed[2]}`; remember("track"); say(""); }
  else if (pixels > 1) say("Type the length of the scale bar, such as 100 um.");
}

$("history").addEventListener("click", (event) => { const p = nearest($("history"), event); if (p) go(p.frame); });
$("number").addEventListener("input", () => go(+$("number").value));
for (const button of document.querySelectorAll("button[data-mark]"))
  button.addEventListener("click", () => correct(at, button.dataset.mark));
$("circle").addEventListener("click", () => {
  const numbers = ["x", "y", "radius"].map((id) => Number($(id).value));
  if (numbers.every(Number.isFinite) && numbers[2] > 0) correct(at, numbers.join(" "));
  else say("Give x, y and a positive radius in pixels.");
});
$("corrections").addEventListener("change", () => keepCorrections());
$("length").addEventListener("change", scaled);
$("mask").addEventListener("change", showMask);
for (const id of ["region", "bubble"]) $(id).addEventListener("change", () => draw());
for (const id of ["movie", "raw"]) $(id).addEventListener("change", (event) => readMovie(true, event.bubbles)); // a hand's event bubbles
$("inspector").addEventListener("keydown", (event) => {
  if (!movie || event.ctrlKey || event.altKey || event.metaKey || ["TEXTAREA", "SELECT"].includes(event.target.tagName)) return;
  if (event.target.tagName === "INPUT" && event.target.type !== "range") return;
  const step = event.shiftKey ? 10 : 1;
  const act = { ArrowLeft: () => go(at - step), ArrowRight: () => go(at + step), o: () => correct(at, "out"), k: () => correct(at, "ok"),
    Delete: () => correct(at, "") }[event.key];
  if (act) { event.preventDefault(); act(); }
});
window.addEventListener("resize", () => { if (movie?.picture) { draw(); history(); } plotTable(); });
