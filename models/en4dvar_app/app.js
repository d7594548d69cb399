"use strict";
const $ = (id) => document.getElementById(id);
const MINE = {
  track: ["movie", "pixel", "frame-rate", "exposure", "flashes", "bubble", "region", "mask", "raw"],
  init: ["table", "sheet", "time-column", "time-unit", "radius-column", "radius-unit", "table-pixel", "table-frame-rate", "by", "law", "medium", "start"],
  validate: ["config"], prior: ["config"], run: ["config", "run"], resume: ["config", "run"], export: ["run"], compare: [],
};
const option = (id) => id.replace("table-", ""); // of the command
const BOX = { prior: "validate", resume: "run", export: "compare" };
// A prior of the text: '  G: {prior: lognormal, median: 3.6 kPa, log_std: 1.6} # why'.
const PRIOR = /^(\s+)(\w+)(: \{prior: \w+, (?:[^{}]*, )?(?:median|mean): )([^\s,}]+)( ?)([^,}]*)(, (?:log_std|logit_std|std): )([^,}]+)([,}].*)$/;
const ANY_PRIOR = /^[^#\n]*\bprior:/gm;
const PARTS = { 4: "median or mean", 6: "unit", 8: "width" };
const turns = {}, drafts = {}; // of a configuration that was left with changes: what was read, and what was typed
let state = null, before = "", edited = "", lastJobs = null, table = null, checks = false, queue = Promise.resolve(), over = null;

// A message; it goes by itself once 'ends' is true.
function say(words, ends = null) { over = ends; $("message").textContent = words; if (words) $("message").scrollIntoView({ block: "nearest" }); }

// Of questions of one kind the last counts: the answer to an earlier one never comes, so that nothing follows from it.
function latest(kind, answer) {
  const turn = turns[kind] = (turns[kind] || 0) + 1;
  return answer.finally(() => turn === turns[kind] || new Promise(() => {}));
}

async function fetched(what, fields) {
  const answer = await fetch(`look/${what}?` + new URLSearchParams(fields));
  if (!answer.ok) throw new Error(await answer.text());
  return answer.headers.get("Content-Type").startsWith("image/") ? answer.blob() : answer.json();
}

async function post(step, fields) {
  const answer = await fetch(step, { method: "POST", body: JSON.stringify(fields) });
  say(answer.ok ? "" : await answer.text(), answer.status === 409 ? () => !busy() : null);
  return answer.ok;
}

function options(select, names, empty) {
  const shown = select.value, now = shown || sessionStorage.getItem(select.id), wanted = empty === undefined ? names : ["", ...names];
  if ([...select.options].map((o) => o.value).join("\n") === wanted.join("\n") && select.options.length) return false;
  select.replaceChildren(...wanted.map((name) => new Option(name || empty, name)));
  select.value = wanted.includes(now) ? now : wanted[0] ?? "";
  return select.value !== shown || !shown;
}

// The fields of a movie or a table: what was typed about it in this window, or else given to the last command about it.
// Of the one that was chosen before, nothing stays.
function recall(step) {
  const [of, ...ids] = MINE[step], name = $(of).value, last = state.jobs.findLast((job) => job.step === step && job.subject === name);
  const known = { ...last?.options, ...JSON.parse(sessionStorage.getItem(`${step} ${name}`)) };
  for (const id of ids) $(id).value = known[option(id)] ?? "";
  return known;
}

function remember(step) {
  const [of, ...ids] = MINE[step];
  sessionStorage.setItem(`${step} ${$(of).value}`, JSON.stringify(Object.fromEntries(ids.map((id) => [option(id), $(id).value]))));
}

const changed = (id) => $(id).dispatchEvent(new Event("change"));

function link(page, words) {
  const made = document.createElement("a");
  made.href = "file/" + page.split("/").map(encodeURIComponent).join("/");
  made.target = "_blank"; made.rel = "noopener"; made.textContent = words;
  return made;
}

function show(now) {
  const first = !state;
  state = now;
  $("folder").textContent = now.folder;
  const typed = !edited || $("text").value === before || now.configs.includes(edited) ? [] : [edited]; // a text that is in no file
  for (const [id, names, empty] of [["movie", now.movies, now.movies.length ? undefined : "no movie in this folder"],
    ["table", now.tables, "choose"], ["config", [...now.configs, ...typed], "choose"]]) {
    const gone = $(id).value;
    if (options($(id), names, empty)) changed(id);
    if (gone && !names.includes(gone)) say(`${gone}: is not in the folder any more.`);
  }
  if (first) resumeLast().catch((error) => say(error.message));
  for (const button of document.querySelectorAll("button[data-step]")) button.disabled = !!runs(...Object.keys(MINE).filter((s) => s !== "validate"));
  $("cancel").disabled = !busy();
  const last = {};
  for (const job of now.jobs) last[BOX[job.step] || job.step] = job;
  for (const [step, job] of Object.entries(last)) showJob(step, job);
  const ended = now.jobs.filter((job) => job.state === "done" && lastJobs && lastJobs.get(job.number) !== "done");
  lastJobs = new Map(now.jobs.map((job) => [job.number, job.state]));
  ended.forEach(finished);
  showRuns(now.runs);
  const pages = now.pages.filter((p) => p.startsWith("comparisons/"));
  $("pages").replaceChildren(...pages.map((p) => item(link(p, p))));
}

// A page that is loaded again shows the last run and its configuration, which the server knows.
async function resumeLast() {
  const last = state.jobs.findLast((job) => ["run", "resume"].includes(job.step));
  if (!state.configs.includes(last?.subject)) return;
  $("config").value = last.subject;
  await readConfig();
  $("run").value = last.out.replace("runs/", "");
}

const runs = (...steps) => state?.jobs.find((job) => job.state === "running" && steps.includes(job.step));
const busy = () => runs(...Object.keys(MINE));

function item(...parts) { const li = document.createElement("li"); li.append(...parts); return li; }

function showJob(step, job) {
  const box = $(`job-${step}`), whole = JSON.stringify(job);
  if (!box || box.dataset.whole === whole) return;
  box.dataset.whole = whole;
  box.className = `job ${job.state}`;
  const words = document.createElement("pre");
  words.textContent = `$ ${job.line}\n${job.output}`; words.tabIndex = 0;
  box.replaceChildren(`${job.state}; the command that repeats this step, in this folder:`, words);
  words.scrollTop = words.scrollHeight; // warnings come last
  const prior = job.output.match(/^prior predictive: (.*\.png) and/m);
  if (job.state === "done" && step === "track") box.append(link(job.out.replace(/csv$/, "html"), "Open the page of all outlines"));
  if (job.state === "done" && step === "run") box.append(link(`${job.out}/report.html`, "Open the result"));
  if (prior) {
    const picture = document.createElement("img");
    picture.src = link(prior[1].replace(`${state.folder}/`, ""), "").href;
    picture.alt = "The prior over the data";
    box.append(picture);
  }
  if (step === "validate") showFaults(job);
}

function finished(job) {
  if (job.step === "track" && movie && job.subject === movie.name) { readMovie(false); $("table").value = job.out; changed("table"); }
  if (job.step === "init" && $("text").value === before) { $("config").value = job.out; changed("config"); }
}

function showFaults(job) {
  const faults = [...job.output.matchAll(/^(?:error: )?\S*\.ya?ml:(\d+):(\d+): (.*)$/gm)];
  $("faults").replaceChildren(...faults.map(([, line, column, words]) => {
    const button = document.createElement("button");
    button.className = "plain"; button.textContent = `line ${line}: ${words}`;
    button.addEventListener("click", () => {
      const lines = $("text").value.split("\n"), at = lines.slice(0, line - 1).join("\n").length + (line > 1);
      $("text").focus(); $("text").setSelectionRange(at, at + lines[line - 1].length);
      $("text").scrollTop = (line - 4) * parseFloat(getComputedStyle($("text")).lineHeight);
    });
    return item(button);
  }));
  for (const input of document.querySelectorAll("#priors input"))
    input.setAttribute("aria-invalid", faults.some(([, line]) => line === input.dataset.line));
}

// The text is the truth: its priors as fields, which change one line of it.
function showPriors() {
  const found = $("text").value.split("\n").map((line, i) => [line.match(PRIOR), i + 1]).filter(([m]) => m), names = found.map(([m]) => m[2]).join();
  const all = $("text").value.match(ANY_PRIOR)?.length || 0;
  $("priors").hidden = !all;
  $("others").hidden = all <= found.length;
  if ($("priors").dataset.names !== names) $("priors").tBodies[0].replaceChildren(...found.map(([m]) => {
    const row = document.createElement("tr"), head = document.createElement("th");
    head.scope = "row"; head.textContent = m[2]; row.append(head);
    for (const [part, words] of Object.entries(PARTS)) {
      const input = row.insertCell().appendChild(document.createElement("input"));
      input.dataset.part = part; input.setAttribute("aria-label", `${m[2]}: ${words}`);
      input.addEventListener("change", () => writePrior(input));
    }
    return row;
  }));
  $("priors").dataset.names = names;
  found.forEach(([m, line], i) => $("priors").tBodies[0].rows[i].querySelectorAll("input").forEach((input) => {
    input.value = m[input.dataset.part]; input.dataset.line = line; }));
}

function writePrior({ value, dataset: { line, part } }) {
  const lines = $("text").value.split("\n"), m = lines[line - 1].match(PRIOR), words = value.trim();
  if (/[,{}#]/.test(words) || (!words && part !== "6")) say("Give a number or a unit, such as 3.6, kPa or 5 %.");
  else {
    m[part] = words; m[5] = m[6] && " ";
    lines[line - 1] = m.slice(1).join("");
    $("text").value = lines.join("\n");
    if (!checks) begin("validate");
    checks = true;
  }
  showPriors();
}

function showRuns(runs) {
  const whole = JSON.stringify(runs), list = $("runs");
  if (list.dataset.whole === whole) return;
  list.dataset.whole = whole;
  const chosen = new Set([...list.querySelectorAll("input:checked")].map((box) => box.value));
  list.replaceChildren(...runs.map(({ name, done }) => {
    const box = document.createElement("input"), label = document.createElement("label");
    box.type = "checkbox"; box.value = name; box.checked = chosen.has(name); label.append(box, ` ${name}`);
    return item(label, " ", done ? link(`runs/${name}/report.html`, "open the result") : "not finished");
  }));
}

async function refresh() {
  try {
    const answer = await fetch("state");
    if (!answer.ok) throw new Error();
    show(await answer.json());
    if (over?.()) say("");
  } catch (error) {
    if (!(error instanceof TypeError) && error.message) throw error;
    say("The server does not answer. Nothing is lost: start 'en4dvar app' again and open the address that it prints.", () => true);
  }
  await showLive(runs("run", "resume"));
}

// Of a run at work: parameters over the iterations, or where the data sets stand. Of one that has ended the result counts.
async function showLive(job) {
  const columns = Math.max(1, Math.min(4, Math.floor(document.body.clientWidth / 200)));
  const told = job && (await fetched("live", { run: job.out.replace("runs/", ""), columns }).catch(() => null));
  $("live").hidden = !told || !runs("run", "resume");
  if (!told) return;
  const log = $("log"), follows = log.scrollTop + log.clientHeight >= log.scrollHeight - 2; // not where somebody reads above
  log.textContent = told.text;
  if (follows) log.scrollTop = log.scrollHeight;
  $("bands").innerHTML = told.bands;
  $("sets").hidden = !told.sets.length;
  $("sets").tBodies[0].replaceChildren();
  for (const cells of told.sets) { const row = $("sets").tBodies[0].insertRow(); for (const words of cells) row.insertCell().textContent = words; }
}

const freeName = (stem, names, end = "") => {
  for (let n = 1; ; n++) { const name = `${stem}${n > 1 ? `_${n}` : ""}${end}`; if (!names.includes(name)) return name; }
};

async function readTable() {
  const name = $("table").value;
  table = null;
  const known = recall("init");
  if (name) $("proposal").value = freeName(name.replace(/\.[^.]*$/, ""), state.configs, ".yaml");
  const read = name ? fetched("table", { table: name, sheet: $("sheet").value }) : Promise.resolve(null);
  try { table = await latest("table", read); if (name) say(""); } catch (error) { say(error.message); }
  const names = table ? Object.keys(table.columns) : [], empty = table?.tracked ? "as the table says" : "choose";
  for (const [id, all, none, own] of [["by", [...(table?.words || []), ...names], "the file"],
    ["time-column", names, empty, table?.time], ["radius-column", names, empty, table?.radius]]) {
    options($(id), all, none);
    $(id).value = known[id] || (!table?.tracked && own) || "";
  }
  $("about-table").textContent = !table ? "" : table.tracked ? "A table of 'en4dvar track': it says its columns and units itself."
    : `${table.files > 1 ? `${table.files} files, of which this is ${table.file}` : table.file}${table.decimal === "," ? ", with decimal commas" : ""}. ${table.words.length ? `Words stand in ${table.words.join(", ")}: no times or radii. ` : ""}Units are those at the end of a column's name, as in t_us, or what you give; they are never guessed.`;
  plotTable();
}

function plotTable() {
  const own = table?.tracked, x = own ? "t_us" : $("time-column").value, y = own ? "R_um" : $("radius-column").value;
  const points = table?.columns[x] && table.columns[y] ? table.columns[x].map((t, i) => ({ x: t ?? NaN, y: table.columns[y][i] ?? NaN })) : [];
  plot($("plot"), points, `${x} ${own ? "" : $("time-unit").value}`, `${y} ${own ? "" : $("radius-unit").value}`);
}

async function readConfig() {
  const config = $("config").value;
  if (edited && $("text").value !== before) drafts[edited] = [before, $("text").value];
  $("text").value = before = edited = "";
  const { text } = await latest("config", config ? fetched("text", { config }) : Promise.resolve({ text: "" }));
  edited = config;
  [before, $("text").value] = drafts[config] || [text, text];
  if (drafts[config]) say(`${config}: the changes that you typed are not kept yet.`);
  delete drafts[config];
  showPriors();
  if (config) $("run").value = freeName(config.replace(/\.[^.]*$/, ""), (state?.runs || []).map((run) => run.name));
  $("faults").replaceChildren();
}

// Keep a text. If nothing was typed and the file is no longer what the page 'shows', that is mended and said.
async function keepText(of, read, text, shows) {
  if (await post("keep", { ...of, before: read, text })) return true;
  const now = text === read ? await fetched("text", of).catch(() => null) : null;
  if (now && now.text !== read) {
    shows(now.text);
    say(`${Object.values(of)[0]}: another window or program has changed the text; this is what it now is.`);
  }
  return false;
}

async function keep() {
  const text = $("text").value, config = $("config").value;
  const shows = (now) => { if (edited === config) { $("text").value = before = now; showPriors(); } };
  const done = await keepText({ config }, before, text, shows);
  if (done && edited === config) before = text;
  return done;
}

// One after the other: what is clicked while a text is checked begins after that.
function begin(step) { queue = queue.then(() => begun(step)).catch((error) => say(error.message)); }

async function begun(step) {
  while (runs("validate")) { await new Promise((wait) => setTimeout(wait, 200)); await refresh(); }
  if (step === "validate") checks = false;
  if (["validate", "prior", "run", "resume"].includes(step) && !(await keep())) return;
  if (step === "track" && movie && !(await keepCorrections())) return;
  const fields = Object.fromEntries([...MINE[step], "proposal"].map((id) => [option(id), $(id).value]));
  if (step === "compare") fields.runs = [...document.querySelectorAll("#runs input:checked")].map((box) => box.value).join("\n");
  await post(step, fields);
  await refresh();
}

for (const button of document.querySelectorAll("button[data-step]")) button.addEventListener("click", () => begin(button.dataset.step));
$("text").addEventListener("input", showPriors);
$("keep").addEventListener("click", keep);
$("cancel").addEventListener("click", async () => { await post("cancel", {}); await refresh(); });
for (const step of ["track", "init"]) for (const id of MINE[step].slice(1)) $(id).addEventListener("change", () => remember(step));
for (const id of ["movie", "table"]) $(id).addEventListener("change", () => sessionStorage.setItem(id, $(id).value));
for (const id of ["table", "sheet"]) $(id).addEventListener("change", readTable);
$("config").addEventListener("change", readConfig);
// What a hand changes ends a message about what was there; it may itself be the reason of a new one.
document.addEventListener("change", (event) => { if (event.bubbles) say(""); }, true);
// A browser shows a file that is dropped on a page in the page's place.
document.addEventListener("dragover", (event) => event.preventDefault());
document.addEventListener("drop", (event) => {
  event.preventDefault();
  const names = [...event.dataTransfer.files].map((file) => file.name).join(", ");
  if (names) say(`Nothing is sent to the page: put ${names} into the folder ${state.folder}, and the lists of movies and tables show it.`);
});
for (const id of ["time-column", "radius-column", "time-unit", "radius-unit"]) $(id).addEventListener("change", plotTable);
fetched("laws", {}).then(({ laws }) => $("laws").replaceChildren(...laws.map((law) => new Option(law, law)))).catch(() => {});
window.addEventListener("beforeunload", (event) => { if ($("text").value !== before || Object.keys(drafts).length) event.preventDefault(); });
window.addEventListener("load", () => { refresh(); setInterval(refresh, 1000); });
