"use strict";
const $ = (id) => document.getElementById(id);
const SECTION = { track: "track", init: "init", validate: "init", run: "run", resume: "run" };
let kept = null;

const stem = () => $("movie").value.replace(/\.[^.]*$/, "");

async function ask(step) {
  const body = { movie: $("movie").value, pixel: $("pixel").value, "frame-rate": $("rate").value, config: $("config").value };
  const answer = await fetch(step, { method: "POST", body: JSON.stringify(body) });
  $("message").textContent = answer.ok ? "" : await answer.text();
  return answer.ok;
}

function show(state) {
  $("folder").textContent = state.folder;
  if (!$("movie").options.length) for (const name of state.movies) $("movie").add(new Option(name));
  if (!state.movies.length) $("message").textContent = "This folder holds no movie (mp4, avi, mov, mkv, tif).";
  if ($("config").value === (kept ?? "")) $("config").value = kept = state.config;
  const running = state.jobs.some((job) => job.state === "running");
  for (const button of document.querySelectorAll("button"))
    button.disabled = (button.dataset.step === "cancel") !== running;
  document.querySelectorAll(".job").forEach((old) => old.remove());
  const last = {};
  for (const job of state.jobs) last[SECTION[job.step.split(" ")[0]]] = job;
  for (const [section, job] of Object.entries(last)) {
    const box = document.createElement("div"), page = state.pages[section];
    box.className = `job ${job.state}`;
    const words = document.createElement("pre");
    words.textContent = `$ ${job.line}\n${job.output}`;
    box.append(`${job.state}; the command that repeats this step:`, words);
    if (page && job.state === "done") {
      const link = document.createElement("a");
      link.href = "file/" + page.split("/").map(encodeURIComponent).join("/");
      link.target = "_blank";
      link.rel = "noopener";
      link.textContent = section === "run" ? "Open the result" : "Open the page of all outlines";
      box.append(link);
    }
    $(section).append(box);
  }
}

async function refresh() {
  try {
    show(await (await fetch("state?stem=" + encodeURIComponent(stem()))).json());
  } catch {
    $("message").textContent = "The server does not answer. Nothing is lost: start 'en4dvar app' again.";
  }
}

for (const button of document.querySelectorAll("button"))
  button.addEventListener("click", async () => {
    const { step } = button.dataset;
    if (["validate", "run"].includes(step) && $("config").value !== kept && !(await ask("keep"))) return;
    if (await ask(step)) if (["keep", "validate", "run", "init"].includes(step)) kept = $("config").value;
    await refresh();
  });
$("movie").addEventListener("change", () => { $("config").value = kept = ""; refresh(); });
refresh().then(refresh);
setInterval(refresh, 1000);
